# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Checks of measurements: which are accepted, by their own stamps alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from operator import eq

import numpy as np

from koopman_ros.arrays import Array, as_arrays
from koopman_ros.reasons import Code, Reason, reason
from koopman_ros.signals import Outputs, per_signal
from koopman_ros.units import NANOSECONDS
from koopman_ros.values import record


@record
class FrozenCheck:
    """Since when each signal has stood still, and how far the model says that it has moved."""

    #: (n_y,) stamps of the first of the measurements that are bit-identical
    since_ns: tuple[int, ...]
    travel: Array  #: (n_y,) predicted since then, in the signals' units
    #: (n_x,) disturbance that was estimated when all signals last changed: what an observer makes
    #: of a sensor that does not move is no disturbance
    w: Array

    def after(self, still: Sequence[bool], time_ns: int, w: Array,
              travel: Callable[[FrozenCheck], Array]) -> FrozenCheck:
        """
        Take a measurement into account, of which the signals `still` (n_y,) have not changed.

        :param w: (n_x,) disturbance that is estimated now.
        :param travel: predicts how far (n_y,) the signals have moved since the last measurement.
        """
        if not any(still):
            return FrozenCheck((time_ns,) * len(still), np.zeros(len(still)), w)
        return FrozenCheck(
            tuple(since if same else time_ns
                  for since, same in zip(self.since_ns, still, strict=True)),
            np.where(still, self.travel + travel(self), 0.0), self.w)

    def longest(self, time_ns: int, still: Sequence[bool], significant: Array
                ) -> tuple[int, float]:
        """
        Return which signal has stood still for longest although it should have moved.

        :param significant: (n_y,) predicted travel above which it should have.
        :return: its place, and for how many seconds; 0 when there is none.
        """
        place, stood = 0, 0.0
        for i, same in enumerate(still):
            if same and abs(self.travel[i]) > significant[i]:
                seconds = (time_ns - self.since_ns[i]) / NANOSECONDS
                if seconds > stood:
                    place, stood = i, seconds
        return place, stood


@dataclass(frozen=True)
class SensorLimits:
    """What the sensors can measure and their plant can do, one number per measured signal."""

    lower: Array  #: (n_y,) smallest measurement accepted, in the signal's unit
    upper: Array  #: (n_y,) largest measurement accepted
    #: (n_y,) fastest change of the plant per second; a jump that stays is accepted when the plant
    #: could have got there by then
    rate: Array
    jump: Array  #: (n_y,) change that noise alone may bring between two measurements
    #: seconds that a measurement may stay bit-identical while the model moves by more than half of
    #: `jump`; infinity for ever
    frozen_timeout: float = math.inf

    def __post_init__(self) -> None:
        as_arrays(self, 'lower', 'upper', 'rate', 'jump')
        if not np.all(self.lower < self.upper):
            raise ValueError(f'sensor limits must be lower < upper, got {self.lower.tolist()} '
                             f'and {self.upper.tolist()}')
        for name in ('rate', 'jump'):
            if not np.all(getattr(self, name) > 0.0):
                raise ValueError(f'sensor {name} must be above 0, got '
                                 f'{getattr(self, name).tolist()}')
        if not self.frozen_timeout > 0.0:
            raise ValueError(f'frozen_timeout must be above 0, got {self.frozen_timeout}')

    @classmethod
    def none(cls, n_y: int) -> SensorLimits:
        """Accept everything that is finite of n_y signals."""
        endless = np.full(n_y, np.inf)
        return cls(-endless, endless, endless, endless)

    def check(self, names: Sequence[str]) -> None:
        """Check that there is one number for each signal (n_y,); a ValueError names which not."""
        for name in ('lower', 'upper', 'rate', 'jump'):
            per_signal(f'sensor {name}', getattr(self, name), names)

    @cached_property
    def each(self) -> list[tuple[float, float, float, float]]:
        """Lower, upper, rate and jump of each signal, as plain numbers."""
        return list(zip(self.lower.tolist(), self.upper.tolist(), self.rate.tolist(),
                        self.jump.tolist(), strict=True))


@record
class Accepted:
    """What is remembered of the measurements."""

    value: Array  #: (n_y,) the last one that was accepted, in the signals' units
    time_ns: int  #: its stamp
    frozen: FrozenCheck  #: which signals stand still
    jumped: bool = False  #: whether a later one was taken for a jump


@record
class Verdict:
    """What became of a measurement."""

    accepted: Accepted | None  #: to be remembered; None as long as none was accepted
    fault: Reason | None = None  #: why it is rejected; None when it is accepted
    moved: bool = False  #: whether it is accepted although the plant has jumped there


def check(limits: SensorLimits, outputs: Outputs, last: Accepted | None, y: Array, time_ns: int,
          w: Array, travel: Callable[[FrozenCheck], Array]) -> Verdict:
    """
    Accept or reject a measurement (n_y,), in the signals' units.

    :param last: what is remembered, or None before the first.
    :param time_ns: its stamp, later than those before.
    :param w: (n_x,) disturbance that is estimated now.
    :param travel: tells how far (n_y,) the model says that the signals have moved since the last
        measurement, under the disturbance that is remembered.
    """
    fault = _impossible(limits, outputs, y)
    if fault is not None:
        return Verdict(last, fault)
    if last is None:
        return Verdict(Accepted(y, time_ns, FrozenCheck((time_ns,) * len(y), np.zeros_like(y), w)))
    seconds = (time_ns - last.time_ns) / NANOSECONDS
    unreachable = _unreachable(limits, last.value, y, seconds)
    if unreachable is not None:
        i = unreachable
        return Verdict(Accepted(last.value, last.time_ns, last.frozen, True), reason(
            Code.JUMPED, signal=outputs.names[i], before=float(last.value[i]), value=float(y[i]),
            seconds=seconds, jump=float(limits.jump[i]), rate=float(limits.rate[i])))
    still = list(map(eq, y.tolist(), last.value.tolist()))
    frozen = last.frozen.after(still, time_ns, w, travel)
    remembered = Accepted(y, time_ns, frozen)
    if not any(still):
        return Verdict(remembered, moved=last.jumped and _unreachable(
            limits, last.value, y, 0.0) is not None)
    i, stood = frozen.longest(time_ns, still, 0.5 * limits.jump)
    if stood > limits.frozen_timeout:
        return Verdict(remembered, reason(
            Code.FROZEN, signal=outputs.names[i], value=float(y[i]),
            timeout=limits.frozen_timeout, change=0.5 * float(limits.jump[i])))
    return Verdict(remembered, moved=last.jumped and not all(still) and _unreachable(
        limits, last.value, y, 0.0) is not None)


def changed_as_it_may(limits: SensorLimits, before: Array, y: Array, seconds: float) -> bool:
    """
    Tell whether every signal of a measurement (n_y,) has changed since one before, and may have.

    Then :func:`check` accepts it, and there is nothing to remember of a sensor that stands still.
    """
    for a, b, (lower, upper, rate, jump) in zip(
            y.tolist(), before.tolist(), limits.each, strict=True):
        possible = jump + (rate * seconds if seconds > 0.0 else 0.0)
        if not (lower <= a <= upper and 0.0 < abs(a - b) <= possible and math.isfinite(a)):
            return False
    return True


def _impossible(limits: SensorLimits, outputs: Outputs, y: Array) -> Reason | None:
    for value, name, (lower, upper, _, _) in zip(y.tolist(), outputs.names, limits.each,
                                                 strict=True):
        if not math.isfinite(value):
            return reason(Code.NOT_FINITE, signal=name, value=value)
        if not lower <= value <= upper:
            return reason(Code.OUTSIDE_SENSOR, signal=name, value=value, lower=lower, upper=upper)
    return None


def _unreachable(limits: SensorLimits, before: Array, y: Array, seconds: float) -> int | None:
    """Return the place of the signal that is farthest beyond what it could have reached."""
    worst, excess = None, 0.0
    for i, (a, b, (_, _, rate, jump)) in enumerate(zip(
            y.tolist(), before.tolist(), limits.each, strict=True)):
        possible = jump + (rate * seconds if seconds > 0.0 else 0.0)
        if abs(a - b) > possible and abs(a - b) / possible > excess:
            worst, excess = i, abs(a - b) / possible
    return worst
