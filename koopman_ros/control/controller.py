# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The control step: one pure function of state, measurement and time, replayable bit for bit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property

from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.laws import feedback, Law, Weights
from koopman_ros.control.limits import InputLimits, limit
from koopman_ros.control.setpoint import NANOSECONDS, Setpoint
from koopman_ros.control.target import steady_state_target
from koopman_ros.lifting import LiftedModel
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


# A measurement earlier than the last by no more than this is out of order; one that is earlier
# still means that time itself was set back.
LATE_NANOSECONDS = NANOSECONDS


class Mode(Enum):
    """Who commands the input; the value is the word an operator reads."""

    AUTOMATIC = 'automatic'
    MANUAL = 'manual'


@dataclass(frozen=True)
class Settings:
    """
    What an engineer tunes, in physical units.

    :param state_weight: (n_x,) weights of squared state errors, per state unit squared.
    :param input_weight: (n_u,) weights of squared input deviations, per input unit squared.
    :param limits: range and rate of the inputs.
    :param setpoint_ramp: largest change of the set-point per second; infinity for steps.
    :param max_gain: bound on the norm of the Riccati gain in scaled coordinates.
    :param max_residual: bound on the relative Riccati residual.
    """

    state_weight: Array
    input_weight: Array
    limits: InputLimits
    setpoint_ramp: float = np.inf
    max_gain: float = 1e3
    max_residual: float = 1e-8

    def __post_init__(self) -> None:
        if not (np.all(np.isfinite(self.state_weight)) and np.all(self.state_weight >= 0.0)
                and np.any(self.state_weight > 0.0)):
            raise ValueError('state_weight must be finite, at least 0 and not all 0, got '
                             f'{self.state_weight.tolist()}')
        if not (np.all(np.isfinite(self.input_weight)) and np.all(self.input_weight > 0.0)):
            raise ValueError('input_weight must be finite and above 0, got '
                             f'{self.input_weight.tolist()}')
        if not self.setpoint_ramp > 0.0:
            raise ValueError(f'setpoint_ramp must be above 0, got {self.setpoint_ramp}')


@dataclass(frozen=True)
class State:
    """
    All that a controller remembers between two measurements.

    :param mode: who commands.
    :param setpoint: requested, active and scheduled set-points.
    :param manual_input: (n_u,) what the operator asked for in manual mode, or None.
    :param time_ns: stamp of the last measurement, or None before the first.
    :param command: (n_u,) last command, or None before the first.
    :param interval: usual seconds between measurements; infinity before the second.
    """

    mode: Mode = Mode.AUTOMATIC
    setpoint: Setpoint = field(default_factory=Setpoint)
    manual_input: Array | None = None
    time_ns: int | None = None
    command: Array | None = None
    interval: float = np.inf


@dataclass(frozen=True)
class Report:
    """
    What a step did, for diagnostics.

    :param mode: who commanded.
    :param law: the feedback law in force, or None when none was.
    :param problem: why the law could not act, in words; empty when it did.
    :param active_setpoint: (n_x,) what was tracked, or None before the first valid measurement.
    :param outside: distance of the measurement from the training box, in half widths.
    :param residual: relative Riccati residual; NaN without a law.
    :param gain: norm of the Riccati gain; NaN without a law.
    :param at_range: whether the input's range was active.
    :param at_rate: whether the input's rate limit was active.
    :param clock_went_back: whether the stamp was earlier than the one before, by so much that
        time starts afresh.
    :param late: whether the measurement was out of order and the last command repeated.
    :param clock_stood_still: whether the stamp was the same as the one before.
    """

    mode: Mode
    law: Law | None = None
    problem: str = ''
    active_setpoint: Array | None = None
    outside: float = np.nan
    residual: float = np.nan
    gain: float = np.nan
    at_range: bool = False
    at_rate: bool = False
    clock_went_back: bool = False
    late: bool = False
    clock_stood_still: bool = False


@dataclass(frozen=True)
class Controller:
    """
    A lifted model with its tuning; every method is pure and returns a new state.

    :param model: the lift.
    :param settings: the tuning.
    """

    model: LiftedModel
    settings: Settings

    @cached_property
    def weights(self) -> Weights:
        """The cost in the model's scaled deviations."""
        return Weights(np.diag(self.settings.state_weight * self.model.states.scale ** 2),
                       np.diag(self.settings.input_weight * self.model.inputs.scale ** 2))

    def request_setpoint(self, state: State, value: Array, effective_ns: int = 0,
                         show: setpoints.Show = setpoints.in_state_units) -> tuple[State, str]:
        """
        Ask for a set-point, at once or from a later time on.

        :param state: the present state.
        :param value: (n_x,) in state units.
        :param effective_ns: stamp from which it holds; see :func:`setpoint.request`.
        :param show: how values are written in a reason of refusal.
        :return: the new state with an empty string, or the old one with the reason of refusal.
        """
        reason = setpoints.refusal(self.model, value, show)
        if reason:
            return state, reason
        if (len(state.setpoint.scheduled) >= setpoints.MAX_SCHEDULED
                and setpoints.lies_ahead(effective_ns, state.time_ns)):
            return state, (f'{setpoints.MAX_SCHEDULED} set-points are scheduled already: wait '
                           'until some have taken effect, or send this one with stamp 0')
        return replace(state, setpoint=setpoints.request(
            state.setpoint, _kept(value), effective_ns, state.time_ns)), ''

    def request_manual_input(self, state: State, value: Array) -> tuple[State, str]:
        """
        Set the input that manual mode commands; refused in automatic mode.

        :param state: the present state.
        :param value: (n_u,) in input units; brought within the limits when commanded.
        :return: as :meth:`request_setpoint`.
        """
        if state.mode is not Mode.MANUAL:
            return state, 'manual command refused in automatic mode: switch to manual mode first'
        if not np.all(np.isfinite(value)):
            return state, f'manual command {value.tolist()} is not finite: the old one is kept'
        return replace(state, manual_input=_kept(value)), ''

    def set_mode(self, state: State, mode: Mode) -> State:
        """Hand over between operator and law; manual mode starts from the last command."""
        return state if mode is state.mode else replace(state, mode=mode, manual_input=None)

    def step(self, state: State, measurement: Array, time_ns: int
             ) -> tuple[State, Array, Report]:
        """
        Answer one measurement.

        A repeated stamp and one out of order, earlier by at most a second, return the last
        command again, within the limits of now; a still earlier stamp starts time afresh. After
        a gap in the measurements ramp and rate limit count twice the interval before it, not the
        gap. When no law can act, the last command is held, or the nominal input before the first.

        :param state: as returned by the step before.
        :param measurement: (n_x,) measured state, in state units.
        :param time_ns: its stamp.
        :return: the new state, the command (n_u,) in input units, always finite and within the
            limits, and the report.
        """
        ahead = 1 if state.time_ns is None else time_ns - state.time_ns
        if state.command is not None and -LATE_NANOSECONDS <= ahead <= 0:
            again = limit(self.settings.limits, state.command, state.command, 0.0)
            return replace(state, command=again.u), again.u, Report(
                state.mode, active_setpoint=state.setpoint.active, at_range=again.at_range,
                outside=self.model.states.violation(measurement), late=ahead < 0,
                clock_stood_still=ahead == 0)
        back = ahead < 0
        if back:
            # what was scheduled by the old time has lost its meaning
            state = replace(state, time_ns=None, setpoint=replace(state.setpoint, scheduled=()))
        seconds = 0.0 if state.time_ns is None else ahead / NANOSECONDS
        if seconds > 0.0:
            # the plant stood under the old command all through a gap
            seconds = min(seconds, 2.0 * state.interval)
            # a burst of measurements does not make the next regular one a gap
            usual = 0.0 if np.isinf(state.interval) else 0.5 * state.interval
            state = replace(state, interval=max(seconds, usual))
        state = replace(state, time_ns=time_ns)
        if np.all(np.isfinite(measurement)):
            state = replace(state, setpoint=setpoints.advance(
                state.setpoint, measurement, self.model, self.settings.setpoint_ramp, time_ns,
                seconds))
        held = self.model.inputs.center if state.command is None else state.command
        # a measurement of 1e300 may overflow on its way; the result is checked and limited
        with np.errstate(all='ignore'):
            wanted, report = self._wanted(state, measurement, held)
        # without elapsed time the rate limit holds the last command
        limited = limit(self.settings.limits, wanted, state.command, seconds)
        return (replace(state, command=limited.u), limited.u,
                replace(report, at_range=limited.at_range, at_rate=limited.at_rate,
                        active_setpoint=state.setpoint.active, clock_went_back=back))

    def _wanted(self, state: State, measurement: Array, held: Array) -> tuple[Array, Report]:
        """Return the command before limits with what is known of it."""
        # finite, yet beyond what scaled deviations can hold, is no measurement either
        if not np.all(np.isfinite(self.model.states.to_deviation(measurement))):
            if state.mode is Mode.MANUAL and state.manual_input is not None:
                return state.manual_input, Report(state.mode, problem='measurement not finite')
            return held, Report(state.mode, problem=(
                f'measurement {measurement.tolist()} is not finite: the last command is held; '
                'check the sensor'))
        outside = self.model.states.violation(measurement)
        if state.mode is Mode.MANUAL:
            wanted = held if state.manual_input is None else state.manual_input
            return wanted, Report(state.mode, outside=outside)
        assert state.setpoint.active is not None
        target = steady_state_target(
            self.model, self.model.states.to_deviation(state.setpoint.active))
        law = feedback(self.model, self.model.states.to_deviation(measurement), target,
                       self.weights, max_gain=self.settings.max_gain,
                       max_residual=self.settings.max_residual)
        report = Report(state.mode, law.law, outside=outside, residual=law.riccati.residual,
                        gain=law.riccati.gain)
        wanted = self.model.inputs.to_physical(law.u)
        if law.solved and np.all(np.isfinite(wanted)):
            return wanted, report
        return held, replace(report, law=None, problem=(
            f'no feedback gain: {law.riccati.status.value}; the last command is held'))


def _kept(value: Array) -> Array:
    """Return a copy that nobody can change."""
    copy = np.array(value, dtype=np.float64)
    copy.setflags(write=False)
    return copy
