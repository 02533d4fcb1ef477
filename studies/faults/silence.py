# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faults that could leave a plant without control while every status is OK, or end a process."""

from collections.abc import Callable
import itertools
import signal
import sys
import time
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
from std_srvs.srv import SetBool, Trigger

from koopman_ros.core.units import NANOSECONDS
from studies.faults import interceptor
from studies.faults.case import LoopTrace
from studies.faults.harness import FaultHarness
from studies.faults.interceptor import Alteration, lost, stamped, value
from studies.faults.operators import altered, Maker
from studies.faults.plants import FaultPlant, LOCKSTEP

CONTROL = 'controller: control'
SLOW = {'speed': 1.0, 'start_time': 10_000.0}
_STRAY = 1000.0  # s behind the stamps of the plant
# Of the standard library: no law, no estimator, none at all, and one that ends the process.
_NO_PLUG_INS: tuple[dict[str, Any], ...] = (
    *({'fallback_order': ['sdre', name]} for name in (
        'json:dumps', 'builtins:dict', 'no.such:thing', 'unittest.__main__:main')),
    *({'estimator': name} for name in (
        'os:getcwd', 'builtins:dict', 'unittest.__main__:main')))


# Stamps.

def cycle(samples: int, period: float) -> Alteration:
    """Let the stamps of the first samples come again and again."""
    span = round(samples * period * NANOSECONDS)
    return interceptor.changed(lambda first, packet: packet._replace(
        stamp_ns=first.stamp_ns + (packet.stamp_ns - first.stamp_ns) % span))


def without_news(loop: FaultHarness, make: Maker) -> None:
    """Let measurements come without a new stamp: the inputs are held, then go to safe values."""
    altered(loop, make, 150.0)
    _expect_error(loop)
    safe = [loop.on.default(f'{name}.safe_value') for name in loop.on.inputs]
    last = [command.values for command in loop.trace.commands
            if command.seconds <= loop.trace.end][-1]
    loop.expect(max(abs(a - b) for a, b in zip(last, safe, strict=True)) < 1e-6,
                f'the last commands in the fault were {last}, the safe ones are {safe}')


def _expect_error(loop: FaultHarness, name: str = CONTROL) -> None:
    loop.expect(any(status.level >= 2 for status in loop.trace.statuses
                    if status.name == name and status.seconds >= loop.trace.begin),
                f'{name} never reported ERROR in the fault')


def stray(loop: FaultHarness) -> None:
    """Let another source with old stamps measure in turn with the plant, in manual mode."""
    on = loop.on
    send = interceptor.Sender(loop.ros.node, on.wiring.measured)
    loop.wait(lambda: all(publisher.get_subscription_count() for publisher in send.publishers),
              'the controller does not subscribe to the measurements')
    loop.ros.set_bool('controller/set_automatic', False)
    loop.run_for(2.0 * on.period)
    with loop.fault():
        for end in ('max', 'min'):
            loop.by_hand(*on.each_input(end))
            until = loop.now + 6.0
            while loop.now < until:
                loop.run_for(on.period)
                _, states = loop.trace.samples[-1]
                stamp_ns = round((SLOW['start_time'] + loop.now - _STRAY) * NANOSECONDS)
                send(interceptor.Packet(stamp_ns, dict(zip(on.states, states, strict=True))))
    _expect_error(loop)
    for publisher in send.publishers:
        loop.ros.node.destroy_publisher(publisher)
    _expect_rate(loop.trace)
    loop.run_for(5.0)
    loop.ros.set_bool('controller/set_automatic', True)


def _expect_rate(trace: LoopTrace) -> None:
    """Hold commands against the case that moved faster than the rate limit within a second."""
    on = trace.on
    for first, then in itertools.combinations(
            [c for c in trace.commands if c.seconds >= trace.begin], 2):
        # plant time is wall time here, in whole samples
        passed = then.seconds - first.seconds + 2.0 * on.period
        moved = max(abs(a - b) for a, b in zip(first.values, then.values, strict=True))
        if passed <= 1.0 + 2.0 * on.period and moved > on.rate * passed + 1e-6:
            trace.complaints.append(
                f'the command moved by {moved:.3g} {on.input_unit} within {passed:g} s')
            return


# Operators.

def unheard(on: FaultPlant) -> dict[str, str]:
    """Return the parameters of a plant whose inputs are not measured."""
    return {f'{name}.topic': f'unheard/{name}' for name in on.inputs}


def _transit(loop: FaultHarness, *transitions: int) -> None:
    for transition in transitions:
        answer = loop.ros.call(ChangeState, 'controller/change_state', ChangeState.Request(
            transition=Transition(id=transition)))
        loop.expect(answer.success, f'transition {transition} failed')


def activated_again(loop: FaultHarness) -> None:
    """Deactivate and activate a controller that commands lower inputs in manual mode."""
    loop.ros.set_bool('controller/set_automatic', False)
    wanted = tuple(0.5 * (loop.on.range(name)[0] + last) for name, last in zip(
        loop.on.inputs, loop.trace.commands[-1].values, strict=True))
    loop.by_hand(*wanted)
    loop.wait(lambda: np.allclose(loop.trace.commands[-1].values, wanted, rtol=0.0, atol=1e-6),
              'the inputs are not commanded')
    with loop.fault():
        _transit(loop, Transition.TRANSITION_DEACTIVATE)
        loop.run_for(5.0)
        _transit(loop, Transition.TRANSITION_ACTIVATE)
        before = len(loop.trace.commands)
        loop.wait(lambda: len(loop.trace.commands) > before + 3, 'no command after activation')
        # the plant is far away until then, however long the answer takes
        loop.ros.set_bool('controller/set_automatic', True)
    loop.request_until_tracked(*loop.on.setpoint)


def experiment(loop: FaultHarness) -> None:
    """Let the trainer move the inputs instead, and end it in between."""
    loop.kill('controller', signal.SIGINT)
    with loop.fault():
        loop.start('trainer', {
            'system': loop.on.system, 'record_at_start': False, 'min_free_disk': 0.0,
            'experiment_min_hold_time': 5.0, 'experiment_max_hold_time': 6.0,
            **{f'{name}.experiment_rate_limit': loop.on.rate for name in loop.on.inputs}})
        answer = loop.ros.set_bool('trainer/experiment', True)
        loop.expect(answer.success, f'no experiment: {answer.message}')
        loop.run_for(30.0)
        loop.kill('trainer', signal.SIGTERM)
        loop.run_for(5.0)
        loop.start('controller')
        loop.request_until_tracked(*loop.on.setpoint)


def cleaned_up(loop: FaultHarness) -> None:
    """Clean up the inactive controller while requests are on their way."""
    node = loop.ros.node
    change = node.create_client(ChangeState, 'controller/change_state')
    mode = node.create_client(SetBool, 'controller/set_automatic')
    model = node.create_client(Trigger, 'controller/reload_model')
    for client in (change, mode, model):
        loop.wait(client.service_is_ready, f'there is no service {client.srv_name}')
    loop.ros.meet('controller')

    def operate() -> None:
        for _ in range(20):
            loop.ask(**dict(zip(loop.on.controlled, loop.on.other, strict=True)))
            loop.by_hand(*loop.on.by_hand)

    requests: tuple[Callable[[], object], ...] = (
        operate, lambda: mode.call_async(SetBool.Request(data=True)),
        lambda: model.call_async(Trigger.Request()))
    with loop.fault():
        for request in requests:
            _transit(loop, Transition.TRANSITION_DEACTIVATE)
            cleaned = change.call_async(ChangeState.Request(
                transition=Transition(id=Transition.TRANSITION_CLEANUP)))
            request()
            loop.wait(cleaned.done, 'the clean-up is not answered')
            loop.linger(0.2)
            _transit(loop, Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
        loop.request_until_tracked(*loop.on.setpoint)


def no_plug_in(loop: FaultHarness) -> None:
    """Name objects that are not laws or estimators, or that end a process, while the loop runs."""
    with loop.fault():
        for change in _NO_PLUG_INS:
            rejected = loop.ros.rejected_parameters('controller', **change)
            loop.expect(bool(rejected), f'{change} was taken')
            loop.run_for(5.0)


def hosted(loop: FaultHarness) -> None:
    """Host two loops, of which one names a module that ends the process."""
    names, site = loop.folder / 'loops.txt', loop.folder / 'site.yaml'
    names.write_text('good\nbad\n')
    site.write_text(
        f'/**:\n  ros__parameters: {{system: {loop.on.system}}}\n'
        '/bad/controller:\n'
        "  ros__parameters: {fallback_order: ['sdre', 'unittest.__main__:main']}\n")
    with loop.fault():
        loop.start('host', command=(
            sys.executable, '-m', 'koopman_ros.nodes.controller', '--loops', str(names),
            '--ros-args', '--params-file', str(site)))
        # the other loop answers, and goes on doing so
        loop.ros.meet('good/controller')
        loop.linger(3.0)
        loop.ros.meet('good/controller')
        loop.kill('host', signal.SIGINT)


# Silence.

def unmeasured(loop: FaultHarness) -> None:
    """Request a set-point, then command manually, while a sensor reports nothing."""
    def commands_from(before: int) -> list[tuple[float, ...]]:
        return [command.values for command in loop.trace.commands[before:]]

    on = loop.on
    with loop.fault():
        loop.interceptor.measurements = lost()
        loop.run_for(12.0)
        before = len(loop.trace.commands)
        held = loop.trace.commands[-1].values
        loop.request(*on.other)
        loop.wait(lambda: any(values != held for values in commands_from(before)),
                  'no command follows from the set-point')
        loop.ros.set_bool('controller/set_automatic', False)
        before = len(loop.trace.commands)
        loop.by_hand(*on.by_hand)
        loop.wait(lambda: any(max(abs(a - b) for a, b in zip(values, on.by_hand, strict=True))
                              < 1e-6 for values in commands_from(before)),
                  'the manual command is not published')
        loop.interceptor.measurements = interceptor.unchanged
        loop.ros.set_bool('controller/set_automatic', True)
        loop.request(*on.setpoint)


def away(on: FaultPlant) -> dict[str, str]:
    """Return the parameters of a plant that subscribes to commands on other topics."""
    return {f'{name}.command_topic': f'unheard/{place.topic}'
            for name, place in on.wiring.commands.items()}


def open_loop(loop: FaultHarness) -> None:
    """Let the plant listen elsewhere until controller and plant both say so."""
    topic = next(iter(loop.on.wiring.commands.values())).topic
    with loop.fault():
        loop.interceptor.leave_commands()
        for node, word in (('controller: ', topic), ('plant: ', 'command')):
            loop.wait(lambda node=node, word=word: any(  # type: ignore[misc]
                status.level >= 1 and status.name.startswith(node) and word in status.message
                for status in loop.trace.statuses if status.seconds > loop.trace.begin),
                f'{node}does not report the open loop')
        loop.kill('plant', signal.SIGINT)
        loop.interceptor.hear_commands()
        loop.start('plant', {**LOCKSTEP, 'lockstep_subscribers': 2, 'start_time': 10_000.0})
        before = len(loop.trace.commands)
        loop.wait(lambda: len(loop.trace.commands) > before + 5, 'the loop does not go on')
        loop.request_until_tracked(*loop.on.setpoint)


def demo(loop: FaultHarness) -> None:
    """Start the demo in the domain of a loop: it rejects, and names the domain."""
    domain = loop.ros.environment['ROS_DOMAIN_ID']
    with loop.fault():
        # its results go there
        process = loop.start('demo', command=(
            'sh', '-c', f'cd {loop.folder} && exec "$@"', 'sh', sys.executable, '-m',
            'koopman_ros.demo', '--plant', loop.on.system))
        loop.processes.pop('demo').told_to_end = True
        deadline = time.monotonic() + 30.0
        loop.wait(lambda: not process.running or time.monotonic() > deadline, '')
        code = process.stop(signal.SIGINT)
        printed = process.output()
        loop.expect(code not in (0, -signal.SIGINT), f'the demo ran next to the loop: {code}')
        loop.expect(domain in printed, f'the demo does not print the domain {domain}: {printed}')


def silent_pendulum(loop: FaultHarness) -> None:
    """Measure nothing for longer than the filter can predict, then measure again."""
    random = np.random.default_rng(0)
    # as a camera shows one that stands still
    loop.alter(1.0, measurements=value(lambda *_: float(random.normal(0.0, 0.026))))
    altered(loop, lost, 10.0)
    _expect_error(loop)
    before = len(loop.trace.commands)
    loop.wait(lambda: len(loop.trace.commands) > before + 50,
              'measurements are not answered any more')


def one_ahead(loop: FaultHarness) -> None:
    """Let the clock of a sensor be ahead for more samples than wait to be completed."""
    on = loop.on
    altered(loop, lambda: interceptor.part(stamped(
        lambda stamp_ns: stamp_ns + 3600 * NANOSECONDS), on.states[-1]), 110.0 * on.period)
    before = len(loop.trace.commands)
    loop.run_for(40.0 * on.period)
    loop.expect(len(loop.trace.commands) > before + 20, 'measurements are not answered any more')
