# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faults of a plant that runs away by itself, at its saddle, of which one state is estimated."""

from collections.abc import Mapping
from functools import partial
import math
from typing import Any

from sensor_msgs.msg import JointState

from koopman_ros.demo import reactor
from koopman_ros.reasons import Code
from koopman_ros.ros import topics
from studies.faults import interceptor
from studies.faults.cases.any_plant import case_on
from studies.faults.cases.messages import altered, Maker
from studies.faults.cases.operators import changed_for_good, scaled
from studies.faults.cases.processes import controller_again
from studies.faults.harness import FaultHarness
from studies.faults.interceptor import lost, noise, value
from studies.faults.plants import PATIENT, SADDLE

_FEED = 76.85  # degC
_LIMIT, _BEYOND = 75.85, 0.4  # degC, K above it that noise and estimate may cost
_AT_LIMIT = f'at_limit_{reactor.TEMPERATURE} [-1 lower, 1 upper]'


def _stepped(loop: FaultHarness) -> None:
    with loop.fault():
        loop.request(*loop.on.other)


def _out_of_reach(loop: FaultHarness) -> None:
    """Ask for what the model was never trained for; the set-point of before stays."""
    with loop.fault():
        loop.ask(temperature=120.0)
        loop.wait_for_report('request refused')


def _limited(loop: FaultHarness) -> None:
    """Hold the temperature under a limit that is below its set-point, for a while."""
    name = f'{reactor.TEMPERATURE}.max'
    limits: list[JointState] = loop.ros.listen(JointState, topics.ACTIVE_LIMITS)
    with loop.fault():
        refused = loop.set_parameters('controller', **{name: _LIMIT})
        loop.expect(not refused, f'the limit was refused: {refused}')
        loop.run_for(120.0)
        since = loop.now
        loop.run_for(120.0)
        active = sum(dict(zip(message.name, message.position, strict=True))[_AT_LIMIT] > 0.0
                     for message in limits)
        held = [celsius for seconds, (celsius,) in loop.trace.samples if seconds > since]
        loop.trace.notes.append(f'active in {active} plans; {min(held):.2f} to {max(held):.2f} '
                                'degC after 2 min')
        loop.expect(active > 100, f'the limit was active in {active} plans only')
        loop.expect(max(held) < _LIMIT + _BEYOND,
                    f'it reached {max(held):g} degC, the limit is {_LIMIT:g} degC')
        loop.set_parameters('controller', **{name: loop.on.default(name)})


def _altered(name: str, does: str, make: Maker, seconds: float, *, step: bool = False,
             code: Code | None = None, **details: Any) -> Any:
    given: dict[str, Any] = {'setpoint': SADDLE.other if step else (),
                             'what': details.pop('what', 'measurements')}
    return case_on(
        SADDLE, details.pop('group', 'sensor'), name, f'{does}, {seconds:g} s'
        + (', while the set-point steps' if step else ''),
        partial(altered, make=make, seconds=seconds, **given), between=True, code=code,
        largest_step=2.0 * SADDLE.rate, **details)


def _plant(name: str, does: str, parameters: Mapping[str, float], **details: Any) -> Any:
    return case_on(SADDLE, 'disturbances', name, f'{does}, for good',
                   partial(changed_for_good, parameters=parameters), offset=0.3, **details)


CASES = (
    _altered('lost', 'no measurement', lost, 5.0),
    _altered('nan', 'NaN', lambda: value(lambda *_: math.nan), 5.0, code=Code.NOT_FINITE),
    _altered('noise-burst', 'noise of 0.5 K', lambda: noise(0.5), 60.0),
    _altered('outliers', '+20 K in every seventh sample', lambda: value(
        lambda seconds, shown: shown + 20.0 * (seconds % 7.0 == 0.0)), 140.0, code=Code.JUMPED),
    _altered('measurements-lost', '30 % of the measurements lost', lambda: lost(0.3), 120.0,
             step=True, group='messages'),
    _altered('late', 'each measurement 3 samples late', lambda: interceptor.delayed(3), 60.0,
             step=True, group='messages'),
    _altered('doubled', 'each measurement comes twice', lambda: interceptor.twice, 120.0,
             step=True, group='messages'),
    _altered('valve-stuck', 'the coolant does not move, the set-point steps before',
             interceptor.frozen, 20.0, step=True, what='commands', group='actuator'),
    _plant('jacket-fouled', 'UA -15 %', scaled('heat_transfer_coefficient', 0.85)),
    _plant('feed-warm', 'T_f +5 K', {'constants.feed_temperature': _FEED + 5.0}),
    _plant('feed-cold', 'T_f -5 K', {'constants.feed_temperature': _FEED - 5.0}),
    case_on(SADDLE, 'operators', 'setpoint-out-of-reach', 'a set-point of 120 degC',
            _out_of_reach, code=Code.SETPOINT_OUTSIDE),
    case_on(SADDLE, 'operators', 'temperature-limited',
            f'the temperature may not exceed {_LIMIT:g} degC, 1 K below the set-point, 240 s',
            _limited),
    case_on(SADDLE, 'processes', 'controller-killed', 'the controller is killed and started again',
            controller_again, plant=PATIENT),
    case_on(SADDLE, 'processes', 'solver-missing', 'the controller has no solver of quadratic '
            'programs, and the set-point steps', _stepped, missing=('daqp',),
            code=Code.PACKAGE_MISSING))
