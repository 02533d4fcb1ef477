# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faults that could leave a plant without control while every status is OK, or end a process."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
import itertools
import math
import signal
import sys
import time
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
from std_srvs.srv import SetBool, Trigger

from koopman_ros.ros import topics
from koopman_ros.ros.signals import by_topic
from koopman_ros.units import NANOSECONDS
from validation.faults import interceptor
from validation.faults.case import Case, Trace
from validation.faults.cases.any_plant import case_on
from validation.faults.cases.messages import altered, Maker
from validation.faults.harness import FaultHarness
from validation.faults.interceptor import Alteration, lost, message_of, stamped, value
from validation.faults.plants import (
    LOCKSTEP,
    PATIENT,
    PENDULUM,
    Plant,
    QUADRUPLE_TANK,
    REACTOR,
    TWO_TANKS,
)

_CONTROL = 'controller: control'
_FAST = {'lockstep': True, 'speed': 30.0}
_BY_CLOCK = {'use_sim_time': True}
_WATCHED = 8.0  # s of plant time at that speed between two looks of the controller
_NEVER_IN_TIME = {'levels': ('mpc', 'sdre', 'linear'), 'law_deadline': 1e-6}
_SHORT_HOLD = {**_NEVER_IN_TIME, 'hold_timeout': 1.0, 'recovery_time': 1.0}
# Largest distance from the set-point after a few seconds of the safe inputs.
_NEAR = {REACTOR.name: 10.0, TWO_TANKS.name: 0.08}
_SLOW = {'speed': 1.0, 'start_time': 10_000.0}
# One of its sensors has a topic of its own.
_APART = replace(QUADRUPLE_TANK, wired={**QUADRUPLE_TANK.wired, 'level_4.topic': 'level_4'})
_STRAY = 1000.0  # s behind the stamps of the plant
# Of the standard library: no law, no estimator, none at all, and one that ends the process.
_NO_PLUG_INS: tuple[dict[str, Any], ...] = (
    *({'levels': ['sdre', name]} for name in (
        'json:dumps', 'builtins:dict', 'no.such:thing', 'unittest.__main__:main')),
    *({'estimator': name} for name in (
        'os:getcwd', 'builtins:dict', 'unittest.__main__:main')))


# Stamps.

def _cycle(samples: int, period: float) -> Alteration:
    """Let the stamps of the first samples come again and again."""
    span = round(samples * period * NANOSECONDS)
    return interceptor.changed(lambda first, packet: packet._replace(
        stamp_ns=first.stamp_ns + (packet.stamp_ns - first.stamp_ns) % span))


def _without_news(loop: FaultHarness, make: Maker) -> None:
    """Let measurements come without a new stamp: the inputs are held, then go to safe values."""
    altered(loop, make, 150.0)
    _expect_error(loop)
    safe = [tuned.safe for tuned in loop.on.parameters.inputs.values()]
    last = [command.values for command in loop.trace.commands
            if command.seconds <= loop.trace.end][-1]
    loop.expect(max(abs(a - b) for a, b in zip(last, safe, strict=True)) < 1e-6,
                f'the last commands in the fault were {last}, the safe ones are {safe}')


def _expect_error(loop: FaultHarness, name: str = _CONTROL) -> None:
    loop.expect(any(status.level >= 2 for status in loop.trace.statuses
                    if status.name == name and status.seconds >= loop.trace.begin),
                f'{name} never reported ERROR in the fault')


def _stray(loop: FaultHarness) -> None:
    """Let another source with old stamps measure in turn with the plant, in manual mode."""
    on = loop.on
    publishers = [(loop.ros.node.create_publisher(kind, topic, topics.LOOP_QOS), kind, names)
                  for topic, kind, names in by_topic(on.wiring.measured)]
    loop.wait(lambda: all(publisher.get_subscription_count() for publisher, *_ in publishers),
              'the controller does not subscribe to the measurements')
    loop.ros.set_bool('controller/set_automatic', False)
    loop.run_for(2.0 * on.period)
    with loop.fault():
        for end in ('max', 'min'):
            loop.by_hand(*(getattr(tuned, end) for tuned in on.parameters.inputs.values()))
            until = loop.now + 6.0
            while loop.now < until:
                loop.run_for(on.period)
                _, states = loop.trace.samples[-1]
                stamp_ns = round((_SLOW['start_time'] + loop.now - _STRAY) * NANOSECONDS)
                for publisher, kind, names in publishers:
                    publisher.publish(message_of(kind, on.wiring.measured, {
                        name: shown for name, shown in zip(on.states, states, strict=True)
                        if name in names}, stamp_ns))
    _expect_error(loop)
    for publisher, *_ in publishers:
        loop.ros.node.destroy_publisher(publisher)
    _expect_rate(loop.trace)
    loop.run_for(5.0)
    loop.ros.set_bool('controller/set_automatic', True)


def _expect_rate(trace: Trace) -> None:
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


def _excursion() -> Alteration:
    """Show a plant that goes far outside the trained range and comes half the way back."""
    def shown(seconds: float, _: float) -> float:
        if seconds < 80.0:
            return 51.3 - 28.6 * min(seconds / 60.0, 1.0)
        return 22.7 + 18.7 * min((seconds - 80.0) / 13.0, 1.0)

    return value(shown)


# Operators.

def _unheard(on: Plant) -> dict[str, str]:
    """Return the parameters of a plant whose inputs are not measured."""
    return {f'{name}.topic': f'unheard/{name}' for name in on.inputs}


def _transit(loop: FaultHarness, *transitions: int) -> None:
    for transition in transitions:
        answer = loop.ros.call(ChangeState, 'controller/change_state', ChangeState.Request(
            transition=Transition(id=transition)))
        loop.expect(answer.success, f'transition {transition} failed')


def _activated_again(loop: FaultHarness) -> None:
    """Deactivate and activate a controller that commands lower inputs by hand."""
    loop.ros.set_bool('controller/set_automatic', False)
    wanted = tuple(0.5 * (tuned.min + last) for tuned, last in zip(
        loop.on.parameters.inputs.values(), loop.trace.commands[-1].values, strict=True))
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


def _experiment(loop: FaultHarness) -> None:
    """Let the trainer move the inputs instead, and end it in between."""
    loop.kill('controller', signal.SIGINT)
    with loop.fault():
        loop.start('trainer', {
            'system': loop.on.system, 'record_at_start': False, 'min_free_disk': 0.0,
            'experiment_shortest_hold': 5.0, 'experiment_longest_hold': 6.0,
            **{f'{name}.experiment_rate_limit': loop.on.rate for name in loop.on.inputs}})
        answer = loop.ros.set_bool('trainer/experiment', True)
        loop.expect(answer.success, f'no experiment: {answer.message}')
        loop.run_for(30.0)
        loop.kill('trainer', signal.SIGTERM)
        loop.run_for(5.0)
        loop.start('controller')
        loop.request_until_tracked(*loop.on.setpoint)


def _cleaned_up(loop: FaultHarness) -> None:
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


def _no_plug_in(loop: FaultHarness) -> None:
    """Name what is no law and no estimator, and what ends a process, while the loop runs."""
    with loop.fault():
        for change in _NO_PLUG_INS:
            refused = loop.set_parameters('controller', **change)
            loop.expect(bool(refused) and all(refused), f'{change} was taken')
            loop.run_for(5.0)


def _hosted(loop: FaultHarness) -> None:
    """Host two loops, of which one names a module that ends the process."""
    names, site = loop.folder / 'loops.txt', loop.folder / 'site.yaml'
    names.write_text('good\nbad\n')
    site.write_text(
        f'/**:\n  ros__parameters: {{system: {loop.on.system}}}\n'
        '/bad/controller:\n'
        "  ros__parameters: {levels: ['sdre', 'unittest.__main__:main']}\n")
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

def _unmeasured(loop: FaultHarness) -> None:
    """Request a set-point, then command by hand, while a sensor reports nothing."""
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


def _away(on: Plant) -> dict[str, str]:
    """Return the parameters of a plant that subscribes to commands on other topics."""
    return {f'{name}.command_topic': f'unheard/{place.topic}'
            for name, place in on.wiring.commands.items()}


def _open_loop(loop: FaultHarness) -> None:
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


def _demo(loop: FaultHarness) -> None:
    """Start the demo in the domain of a loop: it refuses, and names the domain."""
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
        loop.expect(code not in (0, -signal.SIGINT), f'the demo ran beside the loop: {code}')
        loop.expect(domain in printed, f'the demo does not print the domain {domain}: {printed}')


# The tables.

def _of_plant(on: Plant) -> Iterable[Case]:
    """Faults of a plant whose two sensors or one may fail together."""
    case = partial(case_on, on)
    fast: dict[str, Any] = {'plant': _FAST, 'controller': _BY_CLOCK, 'between': True,
                            'largest_step': _WATCHED * on.rate,
                            'recovery': 1.5 * on.recovery, 'afterwards': 1.5 * on.afterwards}
    yield case('clocks', 'stamps-cycle', 'the stamps of five measurements come again and again, '
               '150 s', partial(_without_news, make=partial(_cycle, 5, on.period)), **fast)
    yield case('clocks', 'two-sources', 'another source, 1000 s behind, measures in turn with the '
               'plant while an operator moves the inputs through their range', _stray, plant=_SLOW,
               between=True, settle=5.0, afterwards=5.0, band=math.inf,
               largest_step=3.0 * on.rate * on.period)
    yield case('laws', 'plans-late', 'no plan of mpc meets its deadline, and a sensor shows NaN '
               'until the safe inputs are commanded, 4 s', partial(
                   altered, make=lambda: value(lambda *_: math.nan), seconds=4.0), between=True,
               controller=_SHORT_HOLD, worst=_NEAR[on.name])
    yield case('sensor', 'unmeasured', 'no measurement and no watch over it, while an operator '
               'asks for a set-point, and then for inputs by hand', _unmeasured,
               **{**fast, 'controller': {**_BY_CLOCK, 'measurement_timeout': 0.0}})
    case = partial(case_on, on, 'processes')
    yield case('activated-again', 'deactivated and activated in manual mode, the inputs not '
               'measured', _activated_again, plant={**PATIENT, **_unheard(on)})
    yield case('experiment-ended', 'the trainer moves the inputs instead of the controller, and '
               'is ended (SIGTERM) meanwhile', _experiment, plant=PATIENT)
    yield case('cleaned-up', 'cleaned up while requests are on their way, and activated again',
               _cleaned_up, plant=PATIENT)
    yield case('no-plug-in', 'laws and estimators that are none are named', _no_plug_in)
    yield case('hosted-exit', 'one of two hosted loops names a module that ends the process',
               _hosted, allowed_errors=('controller_host: loops',))
    case = partial(case_on, on, 'neighbours')
    yield case('open-loop', 'the plant listens for commands on another topic', _open_loop,
               plant={'speed': 20.0, **_away(on)}, settle=5.0, largest_step=math.inf)
    yield case('demo', 'the demo is started in the same domain', _demo)


def _silent_pendulum(loop: FaultHarness) -> None:
    """Measure nothing for longer than the filter can predict, then measure again."""
    random = np.random.default_rng(0)
    # as a camera shows one that stands still
    loop.alter(1.0, value(lambda *_: float(random.normal(0.0, 0.026))))
    altered(loop, lost, 10.0)
    _expect_error(loop)
    before = len(loop.trace.commands)
    loop.run_for(2.0)
    loop.expect(len(loop.trace.commands) > before + 50, 'measurements are not answered any more')


def _one_ahead(loop: FaultHarness) -> None:
    """Let the clock of a sensor be ahead for more samples than wait to be completed."""
    on = loop.on
    altered(loop, lambda: interceptor.part(stamped(
        lambda stamp_ns: stamp_ns + 3600 * NANOSECONDS), on.states[-1]), 110.0 * on.period)
    before = len(loop.trace.commands)
    loop.run_for(40.0 * on.period)
    loop.expect(len(loop.trace.commands) > before + 20, 'measurements are not answered any more')


def _ahead(on: Plant) -> Case:
    return case_on(on, 'clocks', 'ahead-one', f'{on.states[-1]}: stamps an hour ahead, 110 '
                   'samples', _one_ahead, between=True, largest_step=2.0 * on.rate * on.period)


CASES = (
    case_on(PENDULUM, 'sensor', 'silent', 'no measurement of the angle, from which the rate is '
            'estimated, 10 s: the pendulum falls', _silent_pendulum, between=True,
            plant={'speed': 2.0}, controller={
                **_BY_CLOCK, 'measurement_timeout': 1.0, 'hold_timeout': 5.0},
            largest_step=math.inf, allowed_errors=(_CONTROL,)),
    *_of_plant(REACTOR), *_of_plant(TWO_TANKS), _ahead(TWO_TANKS), _ahead(_APART),
    case_on(REACTOR, 'clocks', 'seconds-stopped', 'the seconds of the stamps stand still, their '
            'nanoseconds go on, 150 s', partial(_without_news, make=partial(_cycle, 1, 1.0)),
            plant={**_FAST, 'sample_period': 0.3}, controller=_BY_CLOCK, between=True,
            largest_step=_WATCHED * REACTOR.rate),
    case_on(REACTOR, 'laws', 'excursion', 'a sensor shows an excursion to 22.7 degC and back to '
            '41.4 degC, and no plan of mpc meets its deadline', partial(
                altered, make=_excursion, seconds=200.0), between=True,
            controller=_NEVER_IN_TIME))
