# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faults of the sensor: what it shows is not the temperature of the reactor."""

from collections.abc import Callable
import math
from typing import Any

from koopman_ros.reasons import Code
from validation.faults.alterations import Alteration, frozen, lost, noise, unchanged, value
from validation.faults.case import Case, case
from validation.faults.harness import FaultHarness

GROUP = 'sensor'
_BIAS = 'equivalent sensor bias [K]'


def altered(make: Callable[[], Alteration], seconds: float, setpoint: float | None = None,
            wait: float = 0.0, commands: bool = False) -> Callable[[FaultHarness], None]:
    """
    Return the play that alters measurements, or commands, for so many seconds of plant time.

    :param make: makes the alteration.
    :param seconds: of plant time.
    :param setpoint: requested before, or None.
    :param wait: s of plant time between both.
    :param commands: whether commands are altered instead.
    """
    def play(loop: FaultHarness) -> None:
        if setpoint is not None:
            loop.request(setpoint)
            loop.run_for(wait)
        loop.begin()
        loop.alter(seconds, **{'commands' if commands else 'measurements': make()})
        loop.end()

    return play


def fault(name: str, does: str, make: Callable[[], Alteration], seconds: float, **expected: Any
          ) -> Case:
    """Build a case in which measurements are altered for some time."""
    return case(GROUP, name, f'{does}, {seconds:g} s', altered(make, seconds), between=True,
                **expected)


def constant(shown: float) -> Callable[[], Alteration]:
    """Return the maker of a sensor that shows one value."""
    return lambda: value(lambda *_: shown)


def shifted(shift: Callable[[float], float]) -> Callable[[], Alteration]:
    """Return the maker of a sensor that is wrong by so much after so many seconds."""
    return lambda: value(lambda seconds, measured: measured + shift(seconds))


def _biased(loop: FaultHarness) -> None:
    """Nobody can correct a biased sensor, but an operator can be told."""
    loop.begin()
    loop.interceptor.measurements = shifted(lambda _: 2.0)()
    loop.run_for(300.0)
    # until figures are published, which happens once a second of wall time
    since = len(loop.trace.statuses)
    shown = loop.wait(lambda: next(
        (status.values[_BIAS] for status in loop.trace.statuses[since:]
         if status.name == 'controller: control'), None), 'no bias is shown')
    loop.trace.notes.append(f'shown as a bias of {shown} K')
    loop.expect(shown is not None and abs(float(shown) - 2.0) < 0.1,
                f'a bias of 2 K is shown as {shown} K')
    loop.interceptor.measurements = unchanged
    loop.end()


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
    fault('frozen-at-rest', 'bit-identical values', frozen, 120.0),
    case(GROUP, 'frozen-in-a-step', 'bit-identical values, 10 s after a step of the '
         'set-point, 90 s', altered(frozen, 90.0, 42.0, 10.0), between=True,
         codes=(Code.FROZEN,)),
    fault('drift', 'drifts by 1 K/min', shifted(lambda seconds: seconds / 60.0), 180.0),
    case(GROUP, 'bias', 'wrong by +2 K, 300 s and more', _biased, between=True, recovery=360.0,
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
