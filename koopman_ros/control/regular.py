# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The regular step at once, by one compiled function: all goes well, and the best law acts on.

It knows no case of its own: whatever is not regular, or not sure, is left to the step itself,
which gives the same but for rounding. Which of both answers depends on nothing but the state and
the event, so that a replay finds the same commands bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.laws.base import Figures, Target, Weights
from koopman_ros.control.laws.riccati import closed, Form, StateDependentRiccati
from koopman_ros.control.levels import Level
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
from koopman_ros.estimation import Accepted, DisturbanceObserver, FrozenCheck, MeasuredState
from koopman_ros.estimation.observer import Estimate, longest_step
from koopman_ros.lifting import LiftedModel
from koopman_ros.signals import Outputs
from koopman_ros.units import NANOSECONDS
from koopman_ros.values import amended

STEP = 'regular_step'  # among the compiled functions
# Columns of the figures of a step in one row, before the arrays.
FIGURES = 7
# More states have no compiled growth, and of more inputs the norm of a gain takes longer.
_MOST_STATES = 2


@dataclass(frozen=True, eq=False)
class Regular:
    """What the compiled function goes by, beside the state."""

    function: Any  #: that is compiled
    model: LiftedModel
    level: Level  #: the best one
    #: time constant of nothing but numbers: bandwidth of the observer, seconds in a unit of time,
    #: longest step of integration, bounds of residual and gain, distance between training states
    numbers: Array
    #: (9, n_x) center, scale, ends of the box, half widths of it, range, rate and jump of sensors
    states: Array
    #: (8, n_u) center, scale, range and rate, ends of the box, bound of a disturbance
    inputs: Array
    training: Array  #: (M, n_x) training states, M = 0 where they are not known
    weights: Weights  #: of the law
    inverse: Array  #: (n_u, n_x) of the input matrix
    settings: Settings  #: the tuning
    recentred: bool  #: whether the law is, or goes by the averaged Jacobian
    form: str  #: the same in a word

    @staticmethod
    def of(model: LiftedModel, outputs: Outputs, settings: Settings, level: Level
           ) -> Regular | None:
        """Return it where there is a compiled function for the best level, else None."""
        function, law, estimator = model.kernels.get(STEP), level.law, level.estimator
        if (function is None or type(law) is not StateDependentRiccati or law.model is not model
                or type(estimator) not in (DisturbanceObserver, MeasuredState)
                or not (outputs.all_states and level.controls_all) or model.layout is None
                or model.n_u > 1 or model.n_x > _MOST_STATES or model.tried_loops is not None
                or not (closed(model) or model.readout is not None)):
            return None
        states, inputs, sensor, limits = (
            model.states, model.inputs, settings.sensor, settings.limits)
        known, tuning = model.training_states, law.tuning
        bandwidth = estimator.tuning.bandwidth if isinstance(estimator, DisturbanceObserver) else (
            0.0)
        recentred = closed(model)
        return Regular(
            function, model, level,
            np.array([bandwidth, model.seconds_per_time_unit, longest_step(model),
                      tuning.max_residual, tuning.max_gain,
                      0.0 if known is None else known.fill_distance]),
            np.array([states.center, states.scale, states.lower, states.upper,
                      states.half_widths, sensor.lower, sensor.upper, sensor.rate, sensor.jump]),
            np.array([inputs.center, inputs.scale, limits.lower, limits.upper, limits.rate,
                      inputs.lower, inputs.upper, estimator.tuning.max_disturbance]),
            np.zeros((0, model.n_x)) if known is None else np.ascontiguousarray(known.states),
            tuning.weights, np.ascontiguousarray(model.input_inverse()), settings,
            recentred, (Form.RECENTRED if recentred else Form.AVERAGED).value)

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
                        is supervisor.better_since_ns is before.covariance is None)):
            return None
        model, settings, y = self.model, self.settings, np.ascontiguousarray(y)
        setpoint = setpoints.advance(
            state.setpoint, y, level.controlled_states, settings.setpoint_ramp, time_ns, seconds,
            settings.setpoint_filter)
        active, layout = setpoint.active, model.layout
        assert active is not None and layout is not None
        n, m, target = model.n_x, model.n_u, level.reference(active)
        found = self.function(
            layout.sizes, layout.numbers, self.numbers, self.states, self.inputs, self.training,
            self.weights.Q, self.weights.R, self.inverse, y, last.value, before.x, before.w, u,
            state.command, target.x, target.z, target.drift, elapsed,
            (time_ns - last.time_ns) / NANOSECONDS, seconds, spacing, self.recentred)
        if found is None:
            return None
        found.setflags(write=False)
        residual, gain, growth, rest, outside, at_range, at_rate = found[:FIGURES].tolist()
        at = FIGURES + 3 * n
        x, w, expected = found[FIGURES:FIGURES + n], found[FIGURES + n:at - n], found[at - n:at]
        u_ref, forcing = found[at:at + m], found[at + m:at + m + n]
        asked, command = found[at + m + n:at + 2 * m + n], found[at + 2 * m + n:]
        estimate = Estimate(x, w)
        frozen = FrozenCheck((time_ns,) * n, np.zeros(n), before.w)
        return amended(
            state, setpoint=setpoint, time_ns=time_ns, command=command, commanded_ns=time_ns,
            accepted=Accepted(y, time_ns, frozen), estimate=estimate, law_input=asked,
            law_memory=None
        ), command, Report(
            state.mode, level.name, 0, None,
            MeasurementReport(Arrival.ACCEPTED, 0.0, expected, missed, False, follows),
            EstimateReport(estimate, level.estimator),
            TargetReport(active, level.controlled_states, model, Target(
                target.x, target.z, target.drift, u_ref, forcing, rest)),
            CommandReport(Figures(self.form, residual, gain, growth), None, 0.0,
                          at_range > 0.0, at_rate > 0.0, None, outside))
