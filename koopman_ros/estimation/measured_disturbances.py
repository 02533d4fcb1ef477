# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Measured disturbances with their sensor checks; the last value is held where one fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from koopman_ros.core.arrays import Array, change_within, read_only
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation.sensor_checks import out_of_range
from koopman_ros.model import Coordinates
from koopman_ros.tuning import DisturbanceLimits


@dataclass(frozen=True, slots=True)
class MeasuredDisturbances:
    """The values in use, and the reasons for which newer ones are not accepted."""

    value: Array  #: (n_d,) last accepted, in their units; the nominal ones before the first
    #: (n_d,) stamps of the accepted measurements; None before the first
    times_ns: tuple[int | None, ...]
    faults: tuple[Reason, ...] = ()  #: at the last sample, of signals whose value is held

    def shifted(self, by_ns: int) -> MeasuredDisturbances:
        """Move all stamps, as a clock was set."""
        return replace(self, times_ns=tuple(
            None if time is None else time + by_ns for time in self.times_ns))

    def lost_for(self, names: Sequence[str], time_ns: int) -> Array:
        """Return the age (n_d,) in s of each last measurement; infinity before the first."""
        faulty = {fault.values['signal'] for fault in self.faults}
        return np.array([np.inf if time is None else (time_ns - time) / NANOSECONDS
                         if name in faulty else 0.0
                         for name, time in zip(names, self.times_ns, strict=True)])


def check_disturbances(limits: DisturbanceLimits, signals: Coordinates,
                       last: MeasuredDisturbances, values: Array, ages: Array,
                       time_ns: int) -> MeasuredDisturbances:
    """
    Accept or reject the measurement of each disturbance, by its own stamp.

    :param last: of the sample before.
    :param values: (n_d,) measured last, in units; NaN for none.
    :param ages: (n_d,) of these in s; infinity for none.
    :param time_ns: of the sample.
    """
    found, times, faults = last.value.copy(), list(last.times_ns), []
    for i, (name, value, age) in enumerate(zip(
            signals.names, values.tolist(), ages.tolist(), strict=True)):
        fault, before_ns = None, times[i]
        # a stamp that is as far ahead is of another clock
        if abs(age) > limits.timeout[i]:
            fault = reason(StatusCode.DISTURBANCE_SILENT, signal=name, timeout=float(
                limits.timeout[i]), held=float(found[i])) if before_ns is not None else reason(
                    StatusCode.DISTURBANCE_UNKNOWN, signal=name, held=float(found[i]))
        else:
            fault = out_of_range((name,), values[i:i + 1], limits.lower[i:i + 1],
                                 limits.upper[i:i + 1], StatusCode.OUTSIDE_SENSOR)
        if fault is None:
            stamp_ns = time_ns - round(age * NANOSECONDS)
            seconds = math.inf if before_ns is None else max(
                0.0, (stamp_ns - before_ns) / NANOSECONDS)
            # also of a stamp that does not advance, with which no sensor changes
            if abs(value - found[i]) > change_within(limits.rate, seconds)[i]:
                fault = reason(
                    StatusCode.JUMPED, signal=name, before=float(found[i]), value=value,
                    seconds=seconds, jump=0.0, rate=float(limits.rate[i]))
            else:
                found[i], times[i] = value, stamp_ns
        if fault is not None:
            faults.append(fault)
    return MeasuredDisturbances(read_only(found), tuple(times), tuple(faults))
