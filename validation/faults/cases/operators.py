# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Storms of requests: parameters, set-points and modes, good and bad, as fast as they go."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
import functools
import itertools
import math
import time
from typing import Any

import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_srvs.srv import SetBool

from koopman_ros.reasons import Code
from koopman_ros.ros import topics
from validation.faults.case import case, SETPOINT
from validation.faults.harness import FaultHarness

GROUP = 'operators'
_AT_ONCE = 10  # requests on their way
_REQUESTS = 400
_STORM = 2.0  # s of wall time
_WORKED_OFF = 30.0  # s of wall time, within which a storm is worked off on a busy machine


def _send(loop: FaultHarness, kind: Any, service: str, requests: Iterator[Any]) -> list[Any]:
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


def _changes(values: Iterator[Mapping[str, Any]]) -> Iterator[SetParameters.Request]:
    for change in values:
        yield SetParameters.Request(parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in change.items()])


def _weights() -> Iterator[dict[str, Any]]:
    random = np.random.default_rng(0)
    for _ in range(_REQUESTS):
        yield {'temperature_weight': float(10.0 ** random.uniform(-2.0, 2.0)),
               'coolant_weight': float(10.0 ** random.uniform(-2.0, 2.0))}


def _limits() -> Iterator[dict[str, Any]]:
    random = np.random.default_rng(1)
    for _ in range(_REQUESTS):
        yield {'coolant_min': float(random.uniform(5.0, 22.0)),
               'coolant_max': float(random.uniform(24.0, 32.0)),
               'coolant_rate_limit': float(random.uniform(1.0, 60.0))}


def _ramps() -> Iterator[dict[str, Any]]:
    random = np.random.default_rng(2)
    for _ in range(_REQUESTS):
        yield {'setpoint_ramp': float(10.0 ** random.uniform(-3.0, 3.0))}


_BAD: tuple[tuple[str, Any], ...] = (
    ('temperature_weight', math.nan), ('temperature_weight', -1.0), ('temperature_weight', 1),
    ('coolant_weight', 0.0), ('coolant_weight', math.inf), ('coolant_weight', 'much'),
    ('coolant_min', 60.0), ('coolant_max', -10.0), ('coolant_max', math.nan),
    ('coolant_rate_limit', 0.0), ('setpoint_ramp', -math.inf), ('max_gain', 0.0),
    ('max_riccati_residual', 2.0), ('measurement_timeout', math.nan),
    ('model', ''), ('model', '/nowhere/lift.safetensors'), ('model', 3.0))


def _bad() -> Iterator[dict[str, Any]]:
    for name, value in itertools.islice(itertools.cycle(_BAD), _REQUESTS):
        yield {name: value}


def _storm_of_parameters(values: Callable[[], Iterator[Mapping[str, Any]]], refused: bool = False
                         ) -> Callable[[FaultHarness], None]:
    def play(loop: FaultHarness) -> None:
        loop.begin()
        loop.request(44.0)
        started = time.monotonic()
        answers = _send(loop, SetParameters, 'controller/set_parameters', _changes(values()))
        seconds = time.monotonic() - started
        loop.trace.notes.append(f'{len(answers)} changes at {len(answers) / seconds:.0f} 1/s')
        results = [result for answer in answers for result in answer.results]
        if refused:
            taken = sum(result.successful for result in results)
            loop.expect(taken == 0, f'{taken} bad values were taken')
            loop.expect(all(result.reason for result in results), 'refused without a reason')
        else:
            reasons = {result.reason for result in results if not result.successful}
            loop.expect(not reasons, f'good values were refused: {sorted(reasons)[:2]}')
            last = loop.set_parameters(
                'controller', temperature_weight=1.0, coolant_weight=1.0, coolant_min=5.0,
                coolant_max=32.0, coolant_rate_limit=60.0, setpoint_ramp=1000.0)
            loop.expect(not last, f'the defaults were refused: {last}')
        loop.end()

    return play


def _storm_of_setpoints(values: Callable[[int], float]) -> Callable[[FaultHarness], None]:
    """Return the play that asks for a set-point a thousand times a second."""
    def play(loop: FaultHarness) -> None:
        loop.begin()
        started = time.monotonic()
        sent = 0
        while (passed := time.monotonic() - started) < _STORM:
            while sent < 1000.0 * passed:
                loop.setpoint.publish(Temperature(temperature=values(sent)))
                sent += 1
            loop.linger(0.001)
        loop.trace.notes.append(f'{sent} set-points at {sent / passed:.0f} 1/s')
        over = time.monotonic()
        loop.request_until_tracked(SETPOINT)
        waited = time.monotonic() - over
        loop.trace.notes.append(f'the next one was tracked {waited:.1f} s of wall time later')
        loop.expect(waited < _WORKED_OFF, f'the next one was tracked {waited:.1f} s later only')
        loop.end()

    return play


def _storm_of_modes(loop: FaultHarness) -> None:
    """Between operator and law, while a manual command is always on its way."""
    manual = loop.publisher(topics.MANUAL_COOLANT_SETPOINT)
    loop.begin()

    def requests() -> Iterator[SetBool.Request]:
        for number in range(_REQUESTS):
            manual.publish(Temperature(temperature=20.0 + number % 7))
            yield SetBool.Request(data=bool(number % 2))

    _send(loop, SetBool, 'controller/set_automatic', requests())
    loop.ros.set_bool('controller/set_automatic', True)
    loop.end()


def _mode_once(loop: FaultHarness) -> None:
    loop.begin()
    loop.ros.set_bool('controller/set_automatic', False)
    loop.run_for(60.0)
    loop.ros.set_bool('controller/set_automatic', True)
    loop.end()


_case = functools.partial(case, GROUP)

CASES = (
    _case('weights-storm', f'{_REQUESTS} changes of both weights by factors of up to 10,000',
          _storm_of_parameters(_weights)),
    _case('limits-storm', f'{_REQUESTS} changes of range and rate of the coolant',
          _storm_of_parameters(_limits)),
    _case('ramps-storm', f'{_REQUESTS} changes of the ramp of the set-point',
          _storm_of_parameters(_ramps)),
    _case('bad-values-storm', f'{_REQUESTS} parameters that cannot be', _storm_of_parameters(
        _bad, refused=True)),
    _case('setpoint-storm', 'set-points at 1 kHz, all the same',
          _storm_of_setpoints(lambda _: SETPOINT)),
    _case('setpoint-storm-nan', 'set-points at 1 kHz: NaN',
          _storm_of_setpoints(lambda _: math.nan), codes=(Code.SETPOINT_NOT_FINITE,)),
    _case('setpoint-storm-outside', 'set-points at 1 kHz: 500 and -1e308 degC',
          _storm_of_setpoints(lambda number: (500.0, -1e308)[number % 2]),
          codes=(Code.SETPOINT_OUTSIDE,)),
    _case('setpoint-storm-alternating', 'set-points at 1 kHz: 41 and 51 degC in turn',
          _storm_of_setpoints(lambda number: (41.0, 51.0)[number % 2])),
    _case('mode-once', 'manual mode for a minute, and back, without a bump', _mode_once,
          bump=0.01),
    _case('mode-storm', f'{_REQUESTS} changes between automatic and manual mode',
          _storm_of_modes),
)
