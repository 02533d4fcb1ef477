# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a step did, for diagnostics: the results of its parts side by side."""

from dataclasses import dataclass, field
from enum import Enum
import math

from koopman_ros.arrays import Array
from koopman_ros.control.laws.base import Figures, NO_FIGURES
from koopman_ros.control.state import Mode
from koopman_ros.reasons import Reason


class Arrival(Enum):
    """What came of a measurement."""

    ACCEPTED = 'accepted'
    REJECTED = 'rejected'
    # the last command is given again
    LATE = 'late'
    REPEATED = 'repeated'
    # nothing was measured
    MISSING = 'missing'


@dataclass(frozen=True)
class MeasurementReport:
    """
    The measurement that was answered.

    :param arrival: what came of it.
    :param outside: its distance from the training data, in half widths; NaN when there is none.
    :param predicted: (n_y,) what was expected of it, or None.
    :param missed: measurements that should have come since the last one.
    :param clock_went_back: whether its stamp was so much earlier than the one before that time
        starts afresh.
    :param follows: whether the measured input, where there is one, is what was commanded.
    """

    arrival: Arrival = Arrival.MISSING
    outside: float = math.nan
    predicted: Array | None = None
    missed: int = 0
    clock_went_back: bool = False
    follows: bool = True


@dataclass(frozen=True)
class EstimateReport:
    """
    The estimate.

    :param state: (n_x,) in state units.
    :param disturbance: (n_u,) as an input that would have the same effect, in input units.
    :param at_bound: whether the disturbance is as large as is allowed.
    """

    state: Array
    disturbance: Array
    at_bound: bool


@dataclass(frozen=True)
class TargetReport:
    """
    Where the law goes.

    :param setpoint: (n_x,) what is tracked, in state units.
    :param outside: its distance from the training box, in half widths.
    :param residual: rate of the state there that no input balances, scaled; NaN without a law.
    """

    setpoint: Array
    outside: float
    residual: float = math.nan


@dataclass(frozen=True)
class CommandReport:
    """
    How the command came about.

    :param law: what the law says of its solution.
    :param transfer: (n_u,) what a change of law or mode still adds to it, or None.
    :param way_back: share of the nominal input in it on the way back from the safe one.
    :param at_range: whether the range of an input was active.
    :param at_rate: whether the rate limit of an input was active.
    :param outside: its distance from the training box, in half widths; NaN where not looked at.
    """

    law: Figures = NO_FIGURES
    transfer: Array | None = None
    way_back: float = 0.0
    at_range: bool = False
    at_rate: bool = False
    outside: float = math.nan


@dataclass(frozen=True)
class Report:
    """
    What a step did.

    :param mode: who commanded.
    :param level: the control level that acted; 'manual' in manual mode.
    :param depth: its place among the levels, 0 for the best; in manual mode, one after the last.
    :param reason: why not a better one, or why a measurement is rejected; None without.
    :param measurement: the measurement.
    :param estimate: the estimate, or None.
    :param target: where the law goes, or None before the first measurement.
    :param command: the command.
    """

    mode: Mode
    level: str
    depth: int = 0
    reason: Reason | None = None
    measurement: MeasurementReport = field(default_factory=MeasurementReport)
    estimate: EstimateReport | None = None
    target: TargetReport | None = None
    command: CommandReport = field(default_factory=CommandReport)
