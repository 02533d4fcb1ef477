# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The measurement watchdog: which measurements are believed, by their own stamps alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.setpoint import in_state_units, NANOSECONDS, Show
from koopman_ros.lifting import Coordinates

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorLimits:
    """
    What a sensor can measure and its plant can do; by default, everything.

    :param lower: smallest measurement believed, in state units.
    :param upper: largest measurement believed.
    :param rate: fastest change of the plant per second; a jump that stays is believed when the
        plant could have got there by then.
    :param jump: change that noise alone may bring between two measurements.
    :param frozen_timeout: seconds that a measurement may stay the same to the bit while the
        model moves by more than `jump` or half of it; infinity for ever.
    """

    lower: float = -np.inf
    upper: float = np.inf
    rate: float = np.inf
    jump: float = np.inf
    frozen_timeout: float = np.inf

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f'sensor limits must be lower < upper, got {self.lower} and '
                             f'{self.upper}')
        for name in ('rate', 'jump', 'frozen_timeout'):
            if not getattr(self, name) > 0.0:
                raise ValueError(f'{name} must be above 0, got {getattr(self, name)}')


@dataclass(frozen=True)
class Sensed:
    """
    What is remembered of the measurements.

    :param value: (n_x,) the last one that was believed, in state units.
    :param time_ns: its stamp.
    :param w: (n_x,) disturbance that was believed when the measurement last changed, as the
        observer gives it.
    :param since_ns: stamp of the first of those that are the same to the bit.
    :param motion: (n_x,) how far the model says that the state has moved since then.
    :param jumped: whether a later one was taken for a jump.
    """

    value: Array
    time_ns: int
    w: Array
    since_ns: int
    motion: Array
    jumped: bool = False


@dataclass(frozen=True)
class Verdict:
    """
    What became of a measurement.

    :param sensed: to be remembered; None as long as none was believed.
    :param fault: why it is not believed, in words; empty when it is.
    :param moved: whether it is believed although the state has jumped there.
    :param frozen: whether it is the same for too long.
    """

    sensed: Sensed | None
    fault: str = ''
    moved: bool = False
    frozen: bool = False


def judge(limits: SensorLimits, states: Coordinates, sensed: Sensed | None, x: Array,
          time_ns: int, w: Array, motion: Callable[[Sensed], Array],
          show: Show = in_state_units) -> Verdict:
    """
    Tell whether a measurement is to be believed.

    :param limits: of the sensor.
    :param states: names and units.
    :param sensed: what is remembered, or None before the first.
    :param x: (n_x,) measured, in state units.
    :param time_ns: its stamp, later than those before.
    :param w: (n_x,) disturbance that is believed now.
    :param motion: tells how far (n_x,) the model says that the state has moved since the last
        measurement, under the disturbance that is remembered.
    :param show: how values are written.
    """
    fault = _absurd(limits, states, x, show)
    if fault:
        return Verdict(sensed, fault)
    changed = Sensed(x, time_ns, w, time_ns, np.zeros_like(x))
    if sensed is None:
        return Verdict(changed)
    seconds = (time_ns - sensed.time_ns) / NANOSECONDS
    if not _reachable(limits, sensed.value, x, seconds):
        return Verdict(replace(sensed, jumped=True),
                       _jump(limits, states, sensed, x, seconds, show))
    if not (x == sensed.value).all():
        return Verdict(changed, moved=sensed.jumped and not _reachable(
            limits, sensed.value, x, 0.0))
    moved = sensed.motion + motion(sensed)
    still = replace(sensed, time_ns=time_ns, motion=moved, jumped=False)
    stood = (time_ns - sensed.since_ns) / NANOSECONDS
    if stood > limits.frozen_timeout and np.max(np.abs(moved)) > 0.5 * limits.jump:
        i = int(np.argmax(np.abs(moved)))
        return Verdict(still, (
            f'the measured {states.names[i]} has been {show(x[i], states.units[i])} to the bit '
            f'for longer than {limits.frozen_timeout:g} s while the model moved by more than '
            f'{0.5 * limits.jump:g} {states.units[i]}: the sensor is frozen; check it'),
            frozen=True)
    return Verdict(still)


def _absurd(limits: SensorLimits, states: Coordinates, x: Array, show: Show) -> str:
    for value, name, unit in zip(x.tolist(), states.names, states.units, strict=True):
        if not math.isfinite(value):
            return f'the measured {name} is {value}, not finite: check the sensor'
        if not limits.lower <= value <= limits.upper:
            return (f'the measured {name} {show(value, unit)} is outside the range of the sensor, '
                    f'{show(limits.lower, unit)} to {show(limits.upper, unit)}: check it')
    return ''


def _reachable(limits: SensorLimits, before: Array, x: Array, seconds: float) -> bool:
    farthest = max(abs(a - b) for a, b in zip(x.tolist(), before.tolist(), strict=True))
    possible = limits.rate * seconds if seconds > 0.0 else 0.0
    return farthest <= limits.jump + possible


def _jump(limits: SensorLimits, states: Coordinates, sensed: Sensed, x: Array, seconds: float,
          show: Show) -> str:
    i = int(np.argmax(np.abs(x - sensed.value)))
    unit = states.units[i]
    return (f'the measured {states.names[i]} jumped from {show(sensed.value[i], unit)} to '
            f'{show(x[i], unit)} in {seconds:.3g} s, at most {limits.jump:g} {unit} and '
            f'{limits.rate:.3g} {unit}/s are possible: check the sensor')
