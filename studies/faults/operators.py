# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Alterations of messages by the campaign, and actions of operators, without delays."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
import itertools
import time
from typing import Any

import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import UInt8
from std_srvs.srv import SetBool

from koopman_ros.demo import reactor
from koopman_ros.ros import topics
from studies.faults import interceptor
from studies.faults.harness import FaultHarness
from studies.faults.interceptor import Alteration, value

Maker = Callable[[], Alteration]
_BIAS = 'equivalent sensor bias [K]'
NO_CLOCK = '^controller: control: use_sim_time is set, but /clock is not published'
_AT_ONCE = 10  # requests on their way
REQUESTS = 400
_STORM = 2.0  # s of wall time
_WORKED_OFF = 30.0  # s of wall time, within which a storm is worked off on a busy machine
STUCK_AT = 25.0  # degC; the set-point needs 23.4 degC, and the reactor gets 2.1 K too warm
LIMIT, _BEYOND = 75.85, 0.4  # degC, K above it that noise and estimate may cost
QUALITY, _BAD = 'temperature_quality', 2
_AT_LIMIT = f'at_limit_{reactor.TEMPERATURE} [-1 lower, 1 upper]'


def altered(loop: FaultHarness, make: Maker, seconds: float, setpoint: tuple[float, ...] = (),
            wait: float = 0.0, what: str = 'measurements') -> None:
    """Alter measurements or commands for some seconds of plant time, after a step if asked to."""
    if setpoint:
        loop.request(*setpoint)
        loop.run_for(wait)
    with loop.fault():
        loop.alter(seconds, **{what: make()})


def biased(loop: FaultHarness) -> None:
    """No controller can correct a biased sensor, but diagnostics can report it."""
    with loop.fault():
        loop.interceptor.measurements = value(lambda _, measured: measured + 2.0)
        loop.run_for(300.0)
        # until figures are published, which happens once a second of wall time
        since = len(loop.trace.statuses)
        shown = loop.wait(lambda: next(
            (status.values[_BIAS] for status in loop.trace.statuses[since:]
             if status.name == 'controller: control'), None), 'no bias is shown')
        loop.trace.notes.append(f'shown as a bias of {shown} K')
        loop.expect(shown is not None and abs(float(shown) - 2.0) < 0.1,
                    f'a bias of 2 K is shown as {shown} K')
        loop.interceptor.measurements = interceptor.unchanged


def _send(loop: FaultHarness, kind: Any, service: str, requests: Iterable[Any]) -> list[Any]:
    """Send requests as fast as they are answered, and return the answers."""
    client = loop.ros.node.create_client(kind, service)
    loop.wait(client.service_is_ready, f'there is no service {service}')
    loop.ros.meet('controller')
    waiting: deque[Future] = deque()
    answers = []
    for request in itertools.chain(requests, [None] * _AT_ONCE):
        if request is not None:
            waiting.append(client.call_async(request))
        if waiting and (request is None or len(waiting) >= _AT_ONCE):
            loop.wait(waiting[0].done, f'{service} does not answer')
            answers.append(waiting.popleft().result())
    return answers


def _change(change: Mapping[str, Any]) -> SetParameters.Request:
    return SetParameters.Request(parameters=[
        Parameter(name, value=value).to_parameter_msg() for name, value in change.items()])


def drawn(seed: int, ranges: Mapping[str, tuple[float, float]], exponents: bool = False
          ) -> Iterator[dict[str, float]]:
    """Draw parameters, or their decimal exponents, from ranges."""
    random = np.random.default_rng(seed)
    for _ in range(REQUESTS):
        values = {name: float(random.uniform(*range_)) for name, range_ in ranges.items()}
        yield {name: 10.0 ** value for name, value in values.items()} if exponents else values


def storm_of_parameters(loop: FaultHarness, make: Callable[[], Iterable[Mapping[str, Any]]],
                        rejected: bool = False) -> None:
    """Change a controller's parameters as fast as it goes, all of which are taken or rejected."""
    with loop.fault():
        loop.request(*loop.on.other)
        changes = list(make())
        started = time.monotonic()
        answers = _send(loop, SetParameters, 'controller/set_parameters', map(_change, changes))
        seconds = time.monotonic() - started
        loop.trace.notes.append(f'{len(answers)} changes at {len(answers) / seconds:.0f} 1/s')
        results = [result for answer in answers for result in answer.results]
        if rejected:
            taken = sum(result.successful for result in results)
            loop.expect(taken == 0, f'{taken} bad values were taken')
            loop.expect(all(result.reason for result in results), 'rejected without a reason')
        else:
            reasons = {result.reason for result in results if not result.successful}
            loop.expect(not reasons, f'good values were rejected: {sorted(reasons)[:2]}')
            loop.set_parameters('controller', **{
                name: loop.on.default(name) for change in changes[:1] for name in change})


def storm_of_setpoints(loop: FaultHarness, asked: tuple[Mapping[str, float], ...]) -> None:
    """Ask for set-points in turn, a thousand times a second."""
    with loop.fault():
        started = time.monotonic()
        sent = 0
        while (passed := time.monotonic() - started) < _STORM:
            while sent < 1000.0 * passed:
                loop.ask(**asked[sent % len(asked)])
                sent += 1
            loop.linger(0.001)
        loop.trace.notes.append(f'{sent} set-points at {sent / passed:.0f} 1/s')
        over = time.monotonic()
        loop.request_until_tracked(*loop.on.setpoint)
        waited = time.monotonic() - over
        loop.trace.notes.append(f'the next one was tracked {waited:.1f} s of wall time later')
        loop.expect(waited < _WORKED_OFF, f'the next one was tracked {waited:.1f} s later only')


def storm_of_modes(loop: FaultHarness) -> None:
    """Between operator and law, while a manual command is always on its way."""
    def requests() -> Iterator[SetBool.Request]:
        for number in range(REQUESTS):
            loop.by_hand(*(value * (1.0 + number % 7 / 20.0) for value in loop.on.by_hand))
            yield SetBool.Request(data=bool(number % 2))

    with loop.fault():
        _send(loop, SetBool, 'controller/set_automatic', requests())
        loop.ros.set_bool('controller/set_automatic', True)
        # answers overtake messages: the storm is over once all its changes are recorded
        loop.wait(lambda: sum('"event":"mode"' in text for _, text in loop.trace.records)
                  >= REQUESTS, 'the changes of mode are not recorded')


def mode_once(loop: FaultHarness, seconds: float = 60.0) -> None:
    """Switch to manual mode for a while, without a command."""
    with loop.fault():
        loop.ros.set_bool('controller/set_automatic', False)
        loop.run_for(seconds)
        loop.ros.set_bool('controller/set_automatic', True)


def modes_in_a_step(loop: FaultHarness) -> None:
    """Change between manual and automatic mode, each while inputs are on their way."""
    loop.request(*loop.on.other)
    with loop.fault():
        for number in range(6):
            loop.run_for(15.0)
            loop.by_hand(*loop.on.by_hand)
            loop.ros.set_bool('controller/set_automatic', bool(number % 2))


def bad_quality(loop: FaultHarness, seconds: float) -> None:
    """Report the temperature as bad for a plant time."""
    publisher = loop.ros.node.create_publisher(UInt8, QUALITY, topics.LOOP_QOS)
    loop.wait(publisher.get_subscription_count, 'the quality has no subscription')
    with loop.fault():
        publisher.publish(UInt8(data=_BAD))
        loop.run_for(seconds)
        publisher.publish(UInt8(data=0))


def latched(loop: FaultHarness, alteration: Alteration, seconds: float) -> None:
    """Lose the temperature until the safe input is latched, and clear that."""
    with loop.fault():
        loop.alter(seconds, measurements=alteration)
        loop.run_for(100.0)
        safe = loop.on.default(f'{loop.on.inputs[0]}.safe_value')
        loop.expect(loop.trace.commands[-1].values == (safe,), 'the safe input is not latched')
        answer = loop.ros.trigger('controller/clear_safe_state')
        loop.expect(answer.success, f'the safe state was not cleared: {answer.message}')


def changed_for_good(loop: FaultHarness, parameters: Mapping[str, float],
                     setpoint: tuple[float, ...] = ()) -> None:
    """Change the plant for good, after a step of the set-point if asked to."""
    if setpoint:
        loop.request(*setpoint)
    with loop.fault():
        loop.set_parameters('plant', **parameters)


def without_the_cold(loop: FaultHarness, node: str, usual: float) -> None:
    """Take the lower part of a node's range of the coolant for 15 min."""
    with loop.fault():
        loop.set_parameters(node, **{f'{reactor.COOLANT_TEMPERATURE}.min': STUCK_AT})
        loop.run_for(900.0)
        loop.set_parameters(node, **{f'{reactor.COOLANT_TEMPERATURE}.min': usual})


def scaled(name: str, factor: float) -> dict[str, float]:
    """Return a constant of the plant by a factor of its usual value."""
    return {f'constants.{name}': factor * reactor.constant(name)}


def stepped(loop: FaultHarness) -> None:
    """Step the set-point."""
    with loop.fault():
        loop.request(*loop.on.other)


def limited(loop: FaultHarness) -> None:
    """Hold the temperature under a limit that is below its set-point, for a while."""
    name = f'mpc.{reactor.TEMPERATURE}.max'
    limits: list[JointState] = loop.ros.listen(JointState, topics.ACTIVE_CONSTRAINTS)
    with loop.fault():
        loop.set_parameters('controller', **{name: LIMIT})
        loop.run_for(120.0)
        since = loop.now
        loop.run_for(120.0)
        active = sum(dict(zip(message.name, message.position, strict=True))[_AT_LIMIT] > 0.0
                     for message in limits)
        held = [celsius for seconds, (celsius,) in loop.trace.samples if seconds > since]
        loop.trace.notes.append(f'active in {active} plans; {min(held):.2f} to {max(held):.2f} '
                                'degC after 2 min')
        loop.expect(active > 100, f'the limit was active in {active} plans only')
        loop.expect(max(held) < LIMIT + _BEYOND,
                    f'it reached {max(held):g} degC, the limit is {LIMIT:g} degC')
        loop.set_parameters('controller', **{name: loop.on.default(name)})


def setpoint_rejected(loop: FaultHarness, asked: Mapping[str, float], says: str) -> None:
    """Request set-points that are rejected; the previous ones stay."""
    with loop.fault():
        loop.ask(**asked)
        loop.wait_for_report(says)


def without_clock(loop: FaultHarness) -> None:
    """Wait until the controller reports that there is no clock."""
    with loop.fault():
        loop.request(*loop.on.other)
        loop.wait_for_report(NO_CLOCK)
