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
    #: (n_y,) stamps since when that has been more than noise and resolution of the sensor hide
    seen_ns: tuple[int, ...]
    #: (n_x,) disturbance that was estimated when all signals last changed: what an observer makes
    #: of a sensor that does not move is no disturbance
    w: Array


@dataclass(frozen=True, slots=True)
class Accepted:
    """The last measurement that was accepted."""

    value: Array  #: (n_y,) in the signals' units
    time_ns: int  #: its stamp
    standstill: Standstill
    resolution: Array  #: (n_y,) smallest change so far, 0 before the first, in the signals' units
    jumped: bool = False  #: whether a later one was rejected as a jump


class Verdict(NamedTuple):
    """The outcome of the check of a measurement."""

    accepted: Accepted | None  #: to be remembered; None as long as none was accepted
    fault: Reason | None = None  #: why it is rejected; None when it is accepted
    moved: bool = False  #: whether it is accepted although the plant has jumped there


def check(limits: SensorLimits, outputs: Outputs, last: Accepted | None, y: Array, time_ns: int,
          w: Array, travel: Callable[[Standstill], Array], dead_ns: int = 0) -> Verdict:
    """
    Accept or reject a measurement (n_y,), in the signals' units.

    A signal that does not move is stuck where the model has moved by more than half of the noise
    and four times the resolution of the sensor, since gain and disturbance of the model may be
    twice those of the plant, and has done so for two dead times: one as the dead time may be twice
    as long as known, and one in which the loop answers to that.

    :param last: the last accepted measurement, or None before the first.
    :param time_ns: its stamp, later than those before.
    :param w: (n_x,) disturbance that is estimated now.
    :param travel: predicts how far (n_y,) the signals have moved since the last measurement,
        under the disturbance that is remembered.
    :param dead_ns: longest dead time of the inputs.
    """
    fault = out_of_range(outputs.names, y, limits.lower, limits.upper,
                         StatusCode.OUTSIDE_SENSOR)
    if fault is not None:
        return Verdict(last, fault)
    stamps, none = (time_ns,) * len(y), np.zeros(len(y))
    if last is None:
        return Verdict(Accepted(y, time_ns, Standstill(stamps, none, stamps, w), none))
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
    still = change == 0.0
    resolution = np.where(still, last.resolution, np.where(
        last.resolution > 0.0, np.minimum(change, last.resolution), change))
    if not still.any():
        return Verdict(Accepted(y, time_ns, Standstill(stamps, none, stamps, w), resolution),
                       moved=moved)
    before = last.standstill
    gone = np.where(still, before.travel + travel(before), 0.0)
    hidden = np.maximum(0.5 * limits.jump, 4.0 * resolution)
    seen = still & (np.abs(gone) > hidden)
    stuck = Standstill(
        tuple(since if same else time_ns
              for since, same in zip(before.since_ns, still, strict=True)), gone,
        tuple(since if is_seen else time_ns
              for since, is_seen in zip(before.seen_ns, seen, strict=True)), before.w)
    accepted = Accepted(y, time_ns, stuck, resolution)
    # one that reports on change has a heartbeat
    should_move = seen & (time_ns - np.array(stuck.seen_ns) >= 2 * dead_ns) & (
        limits.report_on_change == 0.0)
    stood = np.where(should_move, (time_ns - np.array(stuck.since_ns)) / NANOSECONDS, 0.0)
    i = int(stood.argmax())
    if stood[i] > limits.stuck_sensor_timeout > 0.0:
        return Verdict(accepted, reason(
            StatusCode.FROZEN, signal=outputs.names[i], value=float(y[i]),
            timeout=limits.stuck_sensor_timeout, change=float(hidden[i])))
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
