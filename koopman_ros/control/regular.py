# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The regular step: all is well, and the best law acts on, which most steps are.

It knows no case of its own. Whatever is not regular is left to the step itself, which gives the
same, and decides what else there is to decide. Which of both answers depends on nothing but the
state and the event, so that a replay finds the same commands bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.laws.base import Figures, steady_state_target, Target, Tuning
from koopman_ros.control.laws.riccati import answer, checked, StateDependentRiccati
from koopman_ros.control.levels import Level
from koopman_ros.control.limits import finite, limit
from koopman_ros.control.settings import Settings
from koopman_ros.control.state import (
    Arrival,
    CommandReport,
    EstimateReport,
    MeasurementReport,
    Mode,
    Report,
    State,
    TargetReport,
)
from koopman_ros.estimation import (
    Accepted,
    DisturbanceObserver,
    Estimate,
    FrozenCheck,
    MeasuredState,
)
from koopman_ros.estimation.measurement import changed_as_it_may
from koopman_ros.estimation.observer import longest_step
from koopman_ros.kernels import compilable
from koopman_ros.lifting import LiftedModel
from koopman_ros.signals import Outputs
from koopman_ros.units import NANOSECONDS
from koopman_ros.values import amended, record


@record
class Answered:
    """The numbers of a regular step."""

    estimate: Estimate  #: with the measurement
    expected: Array  #: (n_y,) of the measurement, in the units of the signals
    target: Target  #: of the law
    figures: Figures  #: of the law
    asked: Array  #: (n_u,) what the law asks for, within the range, in input units
    command: Array  #: (n_u,) likewise, also within the rate
    at_range: bool  #: whether the range was active
    at_rate: bool  #: whether the rate was active
    outside: float  #: distance of the command from the training box, in half widths


@dataclass(frozen=True, eq=False)
class Regular:
    """What a regular step goes by, beside the state."""

    model: LiftedModel
    settings: Settings
    level: Level  #: the best one
    estimator: DisturbanceObserver | MeasuredState
    tuning: Tuning  #: of the law

    @staticmethod
    def of(model: LiftedModel, outputs: Outputs, settings: Settings, level: Level
           ) -> Regular | None:
        """Return it for the best level, or None where that has no regular steps."""
        law, estimator = level.law, level.estimator
        # no other class, which may do something else
        if (type(law) is not StateDependentRiccati or law.model is not model
                or type(estimator) not in (DisturbanceObserver, MeasuredState)
                or not (outputs.all_states and level.controls_all)
                or model.tried_loops is not None):
            return None
        assert isinstance(estimator, DisturbanceObserver | MeasuredState)
        return Regular(model, settings, level, estimator, law.tuning)

    def step(self, state: State, y: Array, time_ns: int, u: Array, elapsed: float,
             seconds: float, spacing: float, missed: int, follows: bool
             ) -> tuple[State, Array, Report] | None:
        """
        Answer a measurement as :meth:`Controller.step` does; None where that has to.

        :param u: (n_u,) what has acted since the last command, in scaled deviations.
        :param elapsed: seconds since the last command, of which `seconds` count for the rate
            limit; `spacing` are those between samples.
        :param missed: measurements, and whether the input follows its command, for the report.
        """
        level, supervisor, last, before = (
            self.level, state.supervisor, state.accepted, state.estimate)
        if (last is None or before is None or state.command is None
                or state.mode is not Mode.AUTOMATIC or state.law != level.name
                or supervisor.level != level.name or last.jumped
                or not (state.transfer is state.way_back is supervisor.reason
                        is supervisor.resumes is supervisor.bad_since_ns
                        is supervisor.better_since_ns is before.covariance is None)
                or not (elapsed > 0.0 and spacing > 0.0)):
            return None
        model, settings = self.model, self.settings
        setpoint = setpoints.advance(
            state.setpoint, y, level.controlled_states, settings.setpoint_ramp, time_ns, seconds,
            settings.setpoint_filter)
        active = setpoint.active
        assert active is not None
        found: Answered | None = regular_step(
            model, self, y, last.value, before, u, state.command, level.reference(active),
            elapsed, (time_ns - last.time_ns) / NANOSECONDS, seconds, spacing)
        if found is None:
            return None
        frozen = FrozenCheck((time_ns,) * len(y), np.zeros(len(y)), before.w)
        return amended(
            state, setpoint=setpoint, time_ns=time_ns, command=found.command,
            commanded_ns=time_ns, accepted=Accepted(y, time_ns, frozen), estimate=found.estimate,
            law_input=found.asked, law_memory=None
        ), found.command, Report(
            state.mode, level.name, 0, None,
            MeasurementReport(Arrival.ACCEPTED, 0.0, found.expected, missed, False, follows),
            EstimateReport(found.estimate, level.estimator),
            TargetReport(active, level.controlled_states, model, found.target),
            CommandReport(found.figures, None, 0.0, found.at_range, found.at_rate, None,
                          found.outside))

    # As compiled code takes it.

    @cached_property
    def numbers(self) -> Array:
        """Bandwidth, seconds in a unit of time, longest step, bounds of the law, fill distance."""
        model, tuning, known = self.model, self.tuning, self.model.training_states
        bandwidth = self.estimator.tuning.bandwidth if isinstance(
            self.estimator, DisturbanceObserver) else 0.0
        return np.array([
            bandwidth, model.seconds_per_time_unit, longest_step(model), tuning.max_residual,
            tuning.max_gain, 0.0 if known is None else known.fill_distance])

    @cached_property
    def states(self) -> Array:
        """(9, n_x) center, scale, box, half widths, and range, rate and jump of the sensors."""
        states, sensor = self.model.states, self.settings.sensor
        return np.array([states.center, states.scale, states.lower, states.upper,
                         states.half_widths, sensor.lower, sensor.upper, sensor.rate,
                         sensor.jump])

    @cached_property
    def inputs(self) -> Array:
        """(8, n_u) center, scale, range, rate, box, and bound of a disturbance."""
        inputs, limits = self.model.inputs, self.settings.limits
        return np.array([inputs.center, inputs.scale, limits.lower, limits.upper, limits.rate,
                         inputs.lower, inputs.upper, self.estimator.tuning.max_disturbance])

    @cached_property
    def training(self) -> Array:
        """(M, n_x) training states, none where they are not known."""
        known = self.model.training_states
        return np.zeros((0, self.model.n_x)) if known is None else (
            np.ascontiguousarray(known.states))

    @cached_property
    def inverse(self) -> Array:
        """(n_u, n_x) of the input matrix."""
        return np.ascontiguousarray(self.model.input_inverse())


@compilable
def regular_step(model: LiftedModel, regular: Regular, y: Array, last: Array, before: Estimate,
                 acted: Array, command: Array, known: Target, elapsed: float, since: float,
                 seconds: float, spacing: float) -> Answered | None:
    """
    Take a measurement (n_y,) into account, and return the answer; None where it is not regular.

    :param last: (n_y,) measurement `since` seconds before, and what was estimated then.
    :param acted: (n_u,) since then, in scaled deviations.
    :param command: (n_u,) the last one, in input units.
    :param known: target without disturbance.
    :param elapsed: as those that follow, see :meth:`Regular.step`.
    """
    settings, estimator, level = regular.settings, regular.estimator, regular.level
    if not changed_as_it_may(settings.sensor, last, y, since) or model.distance(y) > 0.0:
        return None
    predicted = estimator.predict(before, acted, elapsed)
    if predicted is None or not finite(predicted.x):
        return None
    estimate = estimator.correct(predicted, model.states.to_deviation(y), elapsed)
    target = level.within_reach(steady_state_target(
        model, known.x, estimate.w, known=known), estimate.w, settings.limits)
    try:
        found = checked(model, answer(
            model, estimate.x, target, regular.tuning, spacing / model.seconds_per_time_unit),
            settings.limits, spacing)
    except np.linalg.LinAlgError:
        return None
    if found.u is None:
        return None
    limited = limit(settings.limits, found.u, command, seconds)
    return Answered(
        estimate, model.states.to_physical(predicted.x), target, found.figures, found.u,
        limited.u, found.clipped or limited.at_range, limited.at_rate,
        model.inputs.violation(limited.u))
