# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faults of the sensor: what it says is not the temperature of the reactor."""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any

from koopman_ros.reasons import Code
from validation.faults.alterations import Alteration, frozen, lost, noise, unchanged, value
from validation.faults.case import Case
from validation.faults.rig import Rig

GROUP = 'sensor'


def altered(make: Callable[[], Alteration], seconds: float) -> Callable[[Rig], None]:
    """Return the play that alters measurements for so many seconds of plant time."""
    def play(rig: Rig) -> None:
        rig.begin()
        rig.line.measurements = make()
        rig.run_for(seconds)
        rig.line.measurements = unchanged
        rig.end()

    return play


def fault(name: str, does: str, make: Callable[[], Alteration], seconds: float, **expected: Any
          ) -> Case:
    """Build a case in which measurements are altered for some time."""
    return Case(name, GROUP, f'{does}, {seconds:g} s', altered(make, seconds), between=True,
                **expected)


def constant(shown: float) -> Callable[[], Alteration]:
    """Return the maker of a sensor that shows one value."""
    return lambda: value(lambda *_: shown)


def shifted(shift: Callable[[float], float]) -> Callable[[], Alteration]:
    """Return the maker of a sensor that is wrong by so much after so many seconds."""
    return lambda: value(lambda seconds, measured: measured + shift(seconds))


def _frozen_in_a_step(rig: Rig) -> None:
    rig.operator.ask(42.0)
    rig.run_for(10.0)
    rig.begin()
    rig.line.measurements = frozen()
    rig.run_for(90.0)
    rig.line.measurements = unchanged
    rig.end()


def _biased(rig: Rig) -> None:
    """Nobody can correct a biased sensor, but an operator can be told."""
    rig.begin()
    rig.line.measurements = shifted(lambda _: 2.0)()
    rig.run_for(300.0)
    # until figures are published, which happens once a second of wall time
    before = len(rig.course.said)
    rig.wait(lambda: _shown_bias(rig, before) is not None, 'no bias is shown')
    shown = _shown_bias(rig, before)
    rig.course.notes.append(f'shown as a bias of {shown} K')
    rig.expect(shown is not None and abs(float(shown) - 2.0) < 0.1,
               f'a bias of 2 K is shown as {shown} K')
    rig.line.measurements = unchanged
    rig.end()


def _shown_bias(rig: Rig, since: int) -> str | None:
    return next((said.values['the same as a sensor bias [K]'] for said in rig.course.said[since:]
                 if said.name == 'controller: control'), None)


CASES = (
    fault('nan-short', 'NaN', constant(math.nan), 5.0, codes=(Code.NOT_FINITE,)),
    fault('nan-long', 'NaN', constant(math.nan), 180.0, codes=(Code.NOT_FINITE,)),
    fault('infinity', '+inf', constant(math.inf), 10.0, codes=(Code.NOT_FINITE,)),
    fault('minus-infinity', '-inf', constant(-math.inf), 10.0, codes=(Code.NOT_FINITE,)),
    fault('huge', '1e300 degC', constant(1e300), 10.0, codes=(Code.OUTSIDE_SENSOR,)),
    fault('minus-zero', '-0.0 degC', constant(-0.0), 10.0, codes=(Code.JUMPED,)),
    fault('below-absolute-zero', '-300 degC', constant(-300.0), 10.0,
          codes=(Code.NOT_FINITE,)),
    fault('out-of-range', '200 degC', constant(200.0), 20.0, codes=(Code.OUTSIDE_SENSOR,)),
    fault('railed', 'at the upper end of its range, 150 degC', constant(150.0), 60.0,
          codes=(Code.JUMPED,)),
    fault('spike-short', '+30 K in one sample', shifted(lambda _: 30.0), 1.0,
          codes=(Code.JUMPED,)),
    fault('spike-long', '+15 K', shifted(lambda _: 15.0), 20.0, codes=(Code.JUMPED,)),
    fault('spikes', 'a spike of +20 K in every seventh sample',
          shifted(lambda seconds: 20.0 * (seconds % 7.0 == 0.0)), 140.0, codes=(Code.JUMPED,)),
    fault('frozen-at-rest', 'the same value to the bit', frozen, 120.0),
    Case('frozen-in-a-step', GROUP, 'the same value to the bit, 10 s after a step of the '
         'set-point, 90 s', _frozen_in_a_step, between=True,
         codes=(Code.FROZEN,)),
    fault('drift', 'drifts by 1 K/min', shifted(lambda seconds: seconds / 60.0), 180.0),
    Case('bias', GROUP, 'wrong by +2 K, 300 s and more', _biased, between=True, recovery=360.0,
         afterwards=420.0),
    fault('noise-burst', 'noise of 1 K', lambda: noise(1.0), 60.0),
    fault('noise-wild', 'noise of 10 K', lambda: noise(10.0), 60.0, codes=(Code.JUMPED,)),
    fault('quantised', 'in steps of 0.5 K, the set-point between two of them',
          lambda: value(lambda _, measured: round(2.0 * measured) / 2.0), 300.0, setpoint=45.8),
    fault('dropout-short', 'no measurement', lost, 5.0),
    fault('dropout-long', 'no measurement', lost, 150.0,
          plant={'lockstep': True, 'speed': 60.0}, controller={'use_sim_time': True},
          # the controller looks every 0.1 s of wall time, so every 6 s of the plant's
          largest_step=8.0,
          says=('^controller: control: no measurement',), codes=(Code.NO_MEASUREMENT,)),
)
