# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The state of a controller between two measurements, and the report of a step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
import math
from typing import Any, NamedTuple

import numpy as np

from koopman_ros.control.bumpless import BumplessTransfer
from koopman_ros.control.laws.base import NO_SOLUTION, Plan, SolutionInfo
from koopman_ros.control.recovery import SafeStateRecovery
from koopman_ros.control.setpoint import Setpoint
from koopman_ros.control.supervisor import Supervisor
from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.core.plugins import contained
from koopman_ros.core.status import Reason
from koopman_ros.estimation import (
    Accepted,
    AppliedInputs,
    Estimate,
    Estimator,
    History,
    Innovation,
    MeasuredDisturbances,
)


class Mode(Enum):
    """Who commands the input; the value is the word an operator reads."""

    AUTOMATIC = 'automatic'
    MANUAL = 'manual'


class State(NamedTuple):
    """
    All that a controller remembers between two measurements.

    The first one knows nothing:

    >>> state, command, report = controller.step(State(), [0.1, 0.15], 5_000_000_000)
    >>> state.time_ns
    5000000000
    """

    mode: Mode = Mode.AUTOMATIC  #: who commands
    #: requested, active and scheduled set-points
    setpoint: Setpoint = Setpoint()
    #: (n_u,) requested by the operator in manual mode, or None
    manual_input: Array | None = None
    time_ns: int | None = None  #: stamp of the last measurement, or None before the first
    former_ns: int | None = None  #: newest stamp before the stamps went back, or None
    command: Array | None = None  #: (n_u,) last command, or None before the first
    commanded_ns: int | None = None  #: when it was given, or None
    #: applied inputs that act, or will act; empty before the first command
    applied: AppliedInputs = AppliedInputs()
    interval: float = np.inf  #: usual seconds between measurements; infinity before the second
    #: seconds after the last measurement that ramp and rate limit have counted already
    counted: float = 0.0
    accepted: Accepted | None = None  #: the last accepted measurement
    #: state and disturbance, in the deviations of the acting level's model
    estimate: Estimate | None = None
    disturbances: MeasuredDisturbances | None = None  #: measured ones; None without any so far
    history: History = History()  #: of the estimate, for late values
    supervisor: Supervisor = Supervisor()  #: which level acts
    #: from the safe input, while it is applied where no law may act, or None
    recovery: SafeStateRecovery | None = None
    law: str | None = None  #: the level whose law gave the last command; None when none did
    law_input: Array | None = None  #: (n_u,) input of that law, within the range
    law_memory: object = None  #: memory of that law
    transfer: BumplessTransfer | None = None  #: the offset that fades from it, or None
    #: (n_x + n_u,) steady state that was last aimed at and its input, in their units, where the
    #: next one is looked for; None at first, and where every state has a set-point
    target: Array | None = None

    def __repr__(self) -> str:
        return short_repr(self)

    def restarted(self, time_ns: int | None) -> State:
        """Return the state after a measurement, without the parts that may have made it fail."""
        return self._replace(**WITHOUT_LAW, estimate=None, history=History(),
                       recovery=None, target=None, time_ns=time_ns)

    @property
    def own_command(self) -> Array | None:
        """The last command (n_u,) without the offset of a transfer; None for none."""
        if self.command is None or self.transfer is None:
            return self.command
        return self.command - self.transfer.offset


#: changes of a state in which no law acts
WITHOUT_LAW: Mapping[str, Any] = {
    'law': None, 'law_input': None, 'law_memory': None, 'transfer': None}


class Arrival(Enum):
    """The outcome of a measurement; after one late or repeated the last command is given again."""

    ACCEPTED = 'accepted'
    REJECTED = 'rejected'
    LATE = 'late'
    REPEATED = 'repeated'
    MISSING = 'missing'


class MeasurementReport(NamedTuple):
    """The measurement that was answered."""

    arrival: Arrival = Arrival.MISSING  #: its outcome
    #: its distance from the training data, in half-ranges; NaN when there is none
    outside: float = math.nan
    predicted: Array | None = None  #: (n_y,) its prediction, or None
    missed: int = 0  #: measurements that should have come since the last one
    #: whether its stamp was earlier than the last by more than 1 s, which resets time
    clock_went_back: bool = False
    follows: bool = True  #: whether the applied input, if measured, equals the command
    uncertain: tuple[str, ...] = ()  #: signals of uncertain quality


NOTHING_MEASURED = MeasurementReport()


class EstimateReport(NamedTuple):
    """The estimate, for which numbers in the units of the signals are calculated when read."""

    estimate: Estimate  #: in scaled deviations
    estimator: Estimator  #: of the level that acts

    @property
    def state(self) -> Array:
        """The estimated state (n_x,), in state units."""
        return self.estimator.model.states.to_physical(self.estimate.x)

    @property
    def disturbance(self) -> Array:
        """The disturbance as an input (n_u,) with the same effect; NaN where not known."""
        inputs = self.estimator.model.inputs
        try:
            return np.asarray(self.estimator.as_input(self.estimate.w)) * inputs.scale
        except BaseException as error:
            contained(error)
            return np.full(len(inputs), np.nan)

    @property
    def at_bound(self) -> bool:
        """Whether the disturbance is as large as is allowed."""
        try:
            return bool(self.estimator.at_bound(self.estimate.w))
        except BaseException as error:
            contained(error)
            return False

    @property
    def covariance(self) -> Array | None:
        """That of the state's error (n_x, n_x), in products of units; None where not known."""
        states, P = self.estimator.model.states, self.estimate.covariance
        return None if P is None else (
            states.scale[:, None] * P[:len(states), :len(states)] * states.scale)

    @property
    def innovation(self) -> Innovation | None:
        """How well the measurements were predicted; None where not known."""
        return self.estimate.innovation

    @property
    def deviation(self) -> Array | None:
        """Standard deviation (n_x,) of the state's error, in state units; None if not known."""
        return None if self.covariance is None else np.sqrt(self.covariance.diagonal())


class TargetReport(NamedTuple):
    """The target of the law, in the units of the signals."""

    setpoint: Array  #: (n_c,) that is tracked, in state units
    outside: float  #: its distance from the training box, in half-ranges
    #: rate of the state there that no input balances, scaled; NaN without a law
    residual: float = math.nan
    state: Array | None = None  #: (n_x,) steady state, in state units; None without a law
    input: Array | None = None  #: (n_u,) that holds it, in input units; None without a law


class CommandReport(NamedTuple):
    """How the command came about."""

    law: SolutionInfo = NO_SOLUTION  #: about the solution of the law
    transfer: Array | None = None  #: (n_u,) rest of a bumpless transfer, or None
    recovery: float = 0.0  #: share of the nominal input in it while recovering from the safe one
    at_range: bool = False  #: whether the range of an input was active
    at_rate: bool = False  #: whether the rate limit of an input was active
    plan: Plan | None = None  #: the plan of a law with a horizon
    #: its distance from the training box, in half-ranges; NaN where not looked at
    outside: float = math.nan


NO_COMMAND = CommandReport()


@dataclass(frozen=True, slots=True)
class StepReport:
    """The report of a step."""

    mode: Mode  #: who commanded
    level: str  #: the control level that acted; 'manual' in manual mode
    #: its place among the levels, 0 for the best; in manual mode, one after the last
    depth: int = 0
    #: why not a better one, or why a measurement is rejected; None without
    reason: Reason | None = None
    measurement: MeasurementReport = NOTHING_MEASURED  #: the measurement
    estimate: EstimateReport | None = None  #: the estimate, or None
    target: TargetReport | None = None  #: where the law goes, or None before the first measurement
    command: CommandReport = NO_COMMAND  #: the command

    __repr__ = short_repr
