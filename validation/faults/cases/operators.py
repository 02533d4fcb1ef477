# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Storms of requests, as fast as they go, and plants that the model does not know."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
import itertools
import math
import time
from typing import Any

import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import SetBool

from koopman_ros.demo import reactor
from koopman_ros.reasons import Code
from validation.faults.case import Case
from validation.faults.harness import FaultHarness
from validation.faults.plants import LOCKSTEP, REACTOR

_AT_ONCE = 10  # requests on their way
REQUESTS = 400
_STORM = 2.0  # s of wall time
_WORKED_OFF = 30.0  # s of wall time, within which a storm is worked off on a busy machine
STUCK_AT = 25.0  # degC; the set-point needs 23.4 degC, and the reactor gets 2.1 K too warm
WINDUP = 3.0  # K; who has wound up meanwhile goes further to the other side
_COOLANT = reactor.COOLANT_TEMPERATURE


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


_BAD: tuple[dict[str, Any], ...] = (
    {'temperature.weight': math.nan}, {'temperature.weight': -1.0}, {'temperature.weight': 1},
    {f'{_COOLANT}.weight': 0.0}, {f'{_COOLANT}.weight': math.inf}, {f'{_COOLANT}.weight': 'much'},
    {f'{_COOLANT}.min': 60.0}, {f'{_COOLANT}.max': -10.0}, {f'{_COOLANT}.max': math.nan},
    {f'{_COOLANT}.rate_limit': -1.0}, {'temperature.setpoint_ramp': -math.inf}, {'max_gain': 0.0},
    {'min_riccati_digits': -1.0}, {'measurement_timeout': math.nan},
    {'model': ''}, {'model': '/nowhere/lift.safetensors'}, {'model': 3.0})


def storm_of_parameters(loop: FaultHarness, make: Callable[[], Iterable[Mapping[str, Any]]],
                        refused: bool = False) -> None:
    """Change a controller's parameters as fast as it goes, all of which are taken or refused."""
    with loop.fault():
        loop.request(*loop.on.other)
        changes = list(make())
        started = time.monotonic()
        answers = _send(loop, SetParameters, 'controller/set_parameters', map(_change, changes))
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
            last = loop.set_parameters('controller', **{
                name: loop.on.default(name) for change in changes[:1] for name in change})
            loop.expect(not last, f'the defaults were refused: {last}')


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


def mode_once(loop: FaultHarness, seconds: float = 60.0) -> None:
    """Take over by hand for a while, without a command."""
    with loop.fault():
        loop.ros.set_bool('controller/set_automatic', False)
        loop.run_for(seconds)
        loop.ros.set_bool('controller/set_automatic', True)


def changed_for_good(loop: FaultHarness, parameters: Mapping[str, float],
                     setpoint: tuple[float, ...] = ()) -> None:
    """Change the plant for good, after a step of the set-point if asked to."""
    if setpoint:
        loop.request(*setpoint)
    with loop.fault():
        reasons = loop.set_parameters('plant', **parameters)
        loop.expect(not reasons, f'the plant was not changed: {reasons}')


def _without_the_cold(loop: FaultHarness, node: str, usual: float) -> None:
    """Take the lower part of a node's range of the coolant for 15 min."""
    with loop.fault():
        loop.set_parameters(node, **{f'{_COOLANT}.min': STUCK_AT})
        loop.run_for(900.0)
        loop.set_parameters(node, **{f'{_COOLANT}.min': usual})


def scaled(name: str, factor: float) -> dict[str, float]:
    """Return a constant of the plant by a factor of its usual value."""
    return {f'constants.{name}': factor * reactor.constant(name)}


def _parameters(name: str, does: str, make: Callable[[], Iterable[Mapping[str, Any]]],
                refused: bool = False) -> Case:
    return Case('operators', name, f'{REQUESTS} {does}',
                partial(storm_of_parameters, make=make, refused=refused))


def _setpoints(name: str, does: str, *values: float, code: Code | None = None) -> Case:
    return Case('operators', name, f'set-points at 1 kHz{does}',
                partial(storm_of_setpoints, asked=tuple(
                    {reactor.TEMPERATURE: value} for value in values)), code=code)


def _constant(name: str, does: str, play: Callable[[FaultHarness], None], **details: Any) -> Case:
    return Case('disturbances', name, does, play,
                **{'recovery': 360.0, 'afterwards': 600.0, 'offset': 0.01, **details})


CASES = (
    _parameters('weights-storm', 'changes of both weights by factors of up to 10,000', partial(
        drawn, 0, {'temperature.weight': (-2.0, 2.0), f'{_COOLANT}.weight': (-2.0, 2.0)}, True)),
    _parameters('limits-storm', 'changes of range and rate of the coolant', partial(
        drawn, 1, {f'{_COOLANT}.min': (5.0, 22.0), f'{_COOLANT}.max': (24.0, 32.0),
                    f'{_COOLANT}.rate_limit': (0.02, 1.0)})),
    _parameters('ramps-storm', 'changes of the ramp of the set-point', partial(
        drawn, 2, {'temperature.setpoint_ramp': (-5.0, 1.0)}, True)),
    _parameters('bad-values-storm', 'parameters that cannot be',
                lambda: itertools.islice(itertools.cycle(_BAD), REQUESTS), refused=True),
    _setpoints('setpoint-storm', ', all the same', *REACTOR.setpoint),
    _setpoints('setpoint-storm-nan', ': NaN', math.nan, code=Code.SETPOINT_NOT_FINITE),
    _setpoints('setpoint-storm-outside', ': 500 and -1e308 degC', 500.0, -1e308,
               code=Code.SETPOINT_OUTSIDE),
    _setpoints('setpoint-storm-alternating', ': 41 and 51 degC in turn', 41.0, 51.0),
    Case('operators', 'mode-once', 'manual mode for a minute, and back, without a bump',
         mode_once, bump=0.01),
    Case('operators', 'mode-storm', f'{REQUESTS} changes between automatic and manual mode',
         storm_of_modes),
    *(_constant(name, f'{does}, for good', partial(changed_for_good, parameters=changes))
      for name, does, changes in (
          ('heat-transfer-low', 'UA -20 %', scaled('heat_transfer_coefficient', 0.8)),
          ('heat-transfer-high', 'UA +20 %', scaled('heat_transfer_coefficient', 1.2)),
          ('feed-warm', 'T_i +5 K', {'constants.feed_temperature': 81.85}),
          ('feed-cold', 'T_i -5 K', {'constants.feed_temperature': 71.85}),
          ('concentration-high', 'C_A +10 %', scaled('concentration', 1.1)),
          ('concentration-low', 'C_A -10 %', scaled('concentration', 0.9)))),
    _constant('actuator-lag', 'the coolant follows its command with 5 s, for good, and the '
              'set-point steps',
              partial(changed_for_good, parameters={f'{_COOLANT}.lag': 5.0}, setpoint=(42.0,))),
    _constant('actuator-late', 'commands act one sample late, for good, and the set-point steps',
              partial(changed_for_good, parameters={f'{_COOLANT}.delay': 1.0}, setpoint=(42.0,))),
    _constant('actuator-saturated', f'the coolant does not get below {STUCK_AT:g} degC, 15 min',
              partial(_without_the_cold, node='plant', usual=-20.0), worst=WINDUP),
    _constant('coolant-limited', f'the controller may not command less than {STUCK_AT:g} degC, '
              '15 min', partial(_without_the_cold, node='controller',
                                usual=reactor.coolant_limits()[0]),
              worst=WINDUP),
    _constant('noise', 'noise of 0.1 K, for good',
              partial(changed_for_good, parameters={'temperature.noise': 0.1}), band=0.5,
              offset=0.5),
    _constant('two-state', 'the concentration moves, which the model does not know, and the feed '
              'gets 1 K warmer; near the stable point',
              partial(changed_for_good, parameters={'constants.feed_temperature': 77.85}),
              setpoint=(50.5,), plant={**LOCKSTEP, 'system': 'two_state'}))
