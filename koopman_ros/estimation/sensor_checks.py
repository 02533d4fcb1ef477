# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Checks of measurements against range, jumps and stuck sensors, by their own stamps alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.signals import Outputs
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.tuning import SensorLimits


@dataclass(frozen=True, slots=True)
class Standstill:
    """Since when each signal has been bit-identical, and how far the model has moved since."""

    since_ns: tuple[int, ...]  #: (n_y,) stamps of the first of the identical measurements
    travel: Array  #: (n_y,) predicted since then, in the signals' units
    #: (n_x,) disturbance that was estimated when all signals last changed: what an observer makes
    #: of a sensor that does not move is no disturbance
    w: Array


@dataclass(frozen=True, slots=True)
class Accepted:
    """The last measurement that was accepted."""

    value: Array  #: (n_y,) in the signals' units
    time_ns: int  #: its stamp
    standstill: Standstill
    jumped: bool = False  #: whether a later one was rejected as a jump


class Verdict(NamedTuple):
    """The outcome of the check of a measurement."""

    accepted: Accepted | None  #: to be remembered; None as long as none was accepted
    fault: Reason | None = None  #: why it is rejected; None when it is accepted
    moved: bool = False  #: whether it is accepted although the plant has jumped there


def check(limits: SensorLimits, outputs: Outputs, last: Accepted | None, y: Array, time_ns: int,
          w: Array, travel: Callable[[Standstill], Array]) -> Verdict:
    """
    Accept or reject a measurement (n_y,), in the signals' units.

    :param last: the last accepted measurement, or None before the first.
    :param time_ns: its stamp, later than those before.
    :param w: (n_x,) disturbance that is estimated now.
    :param travel: predicts how far (n_y,) the signals have moved since the last measurement,
        under the disturbance that is remembered.
    """
    fault = out_of_range(outputs.names, y, limits.lower, limits.upper,
                         StatusCode.OUTSIDE_SENSOR)
    if fault is not None:
        return Verdict(last, fault)
    changed = Accepted(y, time_ns, Standstill((time_ns,) * len(y), np.zeros(len(y)), w))
    if last is None:
        return Verdict(changed)
    seconds = (time_ns - last.time_ns) / NANOSECONDS
    change = np.abs(y - last.value)
    excess = change / (limits.at_rest + limits.rate * seconds)
    i = int(excess.argmax())
    if excess[i] > 1.0:
        return Verdict(replace(last, jumped=True), reason(
            StatusCode.JUMPED, signal=outputs.names[i], before=float(last.value[i]),
            value=float(y[i]),
            seconds=seconds, jump=float(limits.jump[i]), rate=float(limits.rate[i])))
    # back after a jump, and further than noise brings it
    moved = last.jumped and bool(np.any(change > limits.at_rest))
    if 0.0 not in change.tolist():
        return Verdict(changed, moved=moved)
    still = change == 0.0
    before = last.standstill
    stuck = Standstill(
        tuple(since if same else time_ns
              for since, same in zip(before.since_ns, still, strict=True)),
        np.where(still, before.travel + travel(before), 0.0), before.w)
    accepted = Accepted(y, time_ns, stuck)
    # one that reports on change has a heartbeat
    should_move = still & (np.abs(stuck.travel) > 0.5 * limits.jump) & (
        limits.report_on_change == 0.0)
    stood = np.where(should_move, (time_ns - np.array(stuck.since_ns)) / NANOSECONDS, 0.0)
    i = int(stood.argmax())
    if stood[i] > limits.stuck_sensor_timeout > 0.0:
        return Verdict(accepted, reason(
            StatusCode.FROZEN, signal=outputs.names[i], value=float(y[i]),
            timeout=limits.stuck_sensor_timeout, change=0.5 * float(limits.jump[i])))
    return Verdict(accepted, moved=moved)


def out_of_range(names: Sequence[str], y: Array, lower: Array, upper: Array, code: StatusCode,
                 not_finite: StatusCode = StatusCode.NOT_FINITE) -> Reason | None:
    """
    Return which of some values (n,) is not finite or outside its range, or None.

    :param code: of a value outside its range.
    :param not_finite: of one that is not finite.
    """
    for name, value, low, high in zip(
            names, y.tolist(), lower.tolist(), upper.tolist(), strict=True):
        if not math.isfinite(value):
            return reason(not_finite, signal=name, value=value)
        if not low <= value <= high:
            return reason(code, signal=name, value=value, lower=low, upper=high)
    return None
