# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controller: its parts, the control step, requests of the operator, bumpless exchanges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
import math

import numpy as np

from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.bumpless import with_step
from koopman_ros.control.estimates import StateEstimation
from koopman_ros.control.fallback import build_levels, FallbackLevel
from koopman_ros.control.margin import delay_margin
from koopman_ros.control.recovery import rest_under, RestState
from koopman_ros.control.state import Mode, State, StepReport
from koopman_ros.control.step import ControlStep
from koopman_ros.control.supervisor import FallbackOrder, Supervisor
from koopman_ros.control.timing import usual_interval
from koopman_ros.core.arrays import Array, expect, read_only, short_repr
from koopman_ros.core.plugins import contained
from koopman_ros.core.signals import numbers, Outputs
from koopman_ros.core.status import Reason, reason, StatusCode, UNMEASURED
from koopman_ros.core.units import NANOSECONDS, nanoseconds
from koopman_ros.estimation import (
    DisturbanceObserver,
    equivalent_bias,
    Estimate,
    History,
    PendingInputs,
)
from koopman_ros.model import Coordinates, LiftedModel
from koopman_ros.tuning import Tuning


@dataclass(frozen=True)
class Controller:
    """
    A lifted model with its tuning, in a loop; every method is pure and returns a new state.

    It has levels (a law and an estimator each), an order in which the supervisor chooses among
    them, the estimation by the estimators, and a step that uses these.

    >>> controller = Controller(model, Tuning.for_model(model))
    >>> state, refused = controller.request_setpoint(State(), [0.1, 0.15])
    >>> state, command, report = controller.step(state, [0.11, 0.14], 1_000_000_000)
    >>> command.shape, report.level
    ((2,), 'sdre')

    :raises TypeError: for a model or a tuning that is none.
    :raises ValueError: when the tuning does not fit the model's signals, or the measured signals
        do not suffice for the estimator.
    """

    model: LiftedModel  #: the lift
    tuning: Tuning  #: with one number for each signal
    #: measured outputs; by default the states that were measured in the model's training record
    outputs: Outputs | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        expect(model=(self.model, LiftedModel), tuning=(self.tuning, Tuning))
        if self.outputs is not None:
            expect(outputs=(self.outputs, Outputs))
        object.__setattr__(self, 'tuning', self.tuning.for_signals(
            self.model, self.measured.names))
        # reject now if a part cannot be built, and keep the built parts
        assert self.order

    # Its parts.

    @cached_property
    def measured(self) -> Outputs:
        """The measured outputs: y = C x."""
        states, rows = self.model.states, self.model.measured
        own = states.only([states.names[i] for i in rows])
        return self.outputs or Outputs(own.names, own.units, np.eye(len(states))[rows])

    @cached_property
    def levels(self) -> dict[str, FallbackLevel]:
        """The levels with a law, by name, best first."""
        return build_levels(self.model, self.measured, self.tuning)

    @cached_property
    def order(self) -> FallbackOrder:
        """The order of all levels."""
        return FallbackOrder(
            tuple(self.levels), tuple(level.law.margin for level in self.levels.values()),
            self.tuning.hold_timeout, self.tuning.recovery_time, self.tuning.safe_latch)

    @cached_property
    def estimation(self) -> StateEstimation:
        """The estimators of the levels, behind the checks of the measurements."""
        return StateEstimation(self.model, self.measured, self.tuning, self.levels)

    @cached_property
    def calculation(self) -> ControlStep:
        """The calculations of a step, by these parts."""
        return ControlStep(self.model, self.tuning, self.levels, self.order, self.estimation)

    @property
    def best(self) -> FallbackLevel:
        """The first level."""
        return self.calculation.best

    @property
    def controlled(self) -> Coordinates:
        """The states with a set-point."""
        return self.best.controlled_states

    @property
    def safe_input(self) -> Array:
        """The safe input (n_u,), commanded when no law can act, in input units."""
        return self.calculation.safe_input

    @property
    def nominal_input(self) -> Array:
        """The nominal input (n_u,) within its limits, in input units."""
        return self.calculation.nominal_input

    @cached_property
    def rest(self) -> RestState:
        """Where the safe input leads the plant, according to the model."""
        return rest_under(self.model, self.safe_input, self.order.return_margin)

    # Answers to measurements.

    def step(self, state: State, y: Array, time_ns: int, applied: Array | None = None,
             countable: float | None = None, disturbances: Array | None = None,
             ages: Array | None = None, quality: tuple[int, ...] | None = None
             ) -> tuple[State, Array, StepReport]:
        """
        Answer one measurement.

        A repeated stamp and one out of order, earlier by at most a second, return the last command
        again; a still earlier stamp resets the time. After a gap in the measurements ramp and rate
        limit count twice the interval before it, not the gap. Stamps that return to where they
        were before they went back count from the newest of those.

        :param y: (n_y,) measured, in the signals' units.
        :param applied: (n_u,) measured input at that time, or None; see
            :meth:`StateEstimation.applied`.
        :param countable: largest number of seconds since the last stamp that ramp and rate limit
            count, from another clock; None for any.
        :param disturbances: (n_d,) measured disturbances, NaN for one that is not measured, or
            None; see :func:`koopman_ros.estimation.check_disturbances`.
        :param ages: (n_d,) their ages in s, or None where they are of that time.
        :param quality: (n_y,) 0 good, 1 uncertain, more bad, which counts as missing; None for
            good.
        :return: the new state, the command (n_u,) in input units, always finite and within the
            limits, and the report.
        :raises TypeError: for a time that is not an integer.
        :raises ValueError: for a measurement or an input of another size.
        """
        if not isinstance(state, State):
            expect(state=(state, State))  # which says what is wrong
        return self.calculation.step(
            state, y, time_ns, applied, countable, disturbances, ages, quality)

    def hold(self, state: State, time_ns: int, cause: StatusCode | None = StatusCode.NO_MEASUREMENT
             ) -> tuple[State, Array | None, StepReport]:
        """
        Command without a measurement: hold, and later go to the safe input.

        :param time_ns: up to which nothing came, in the time of the measurements' stamps; before
            the first of them, in that of any clock.
        :param cause: why the command is held; None to command from the estimate, which the model
            predicts.
        :return: as :meth:`step`; the command is None before the first.
        """
        expect(state=(state, State))
        if cause is not None:
            expect(cause=(cause, StatusCode))
        return self.calculation.hold(state, time_ns, cause)

    # Requests of the operator.

    def request_setpoint(self, state: State, value: Array, effective_ns: int = 0,
                         signals: tuple[str, ...] | None = None) -> tuple[State, Reason | None]:
        """
        Request a set-point, at once or from a later time on.

        It has to lie in the trained range, and an input within its range has to hold it,
        together with the other requests, under the disturbance that is estimated now. A signal
        without a request stays where it is, or as near to it as the requested ones allow.

        :param value: (n,) of the signals, in state units.
        :param effective_ns: stamp from which it holds; see :func:`setpoint.request`.
        :param signals: (n,) which of the controlled ones are requested, the others stay as they
            are; None for all.
        :return: the new state and None, or the old one with the reason of rejection.
        :raises ValueError: for signals that are not controlled, or that do not fit the value.
        """
        expect(state=(state, State))
        every = self.controlled
        asked = every.names if signals is None else (
            (signals,) if isinstance(signals, str) else signals)
        if not asked or len(set(asked)) != len(asked) or not set(asked) <= set(every.names):
            raise ValueError(f'signals must be some of {", ".join(every.names)}, each once, got '
                             f'{list(asked)}')
        value, effective_ns = numbers('set-point', value, asked), nanoseconds(effective_ns)
        rejection = setpoints.rejection(every.only(asked), value)
        if rejection is not None:
            return state, rejection
        ahead = setpoints.lies_ahead(effective_ns, state.time_ns)
        lost = _unmeasured(state.supervisor.reason)
        if lost is not None and not ahead:
            return state, reason(StatusCode.SETPOINT_UNMEASURED, signal=asked[0],
                                 value=float(value[0]), cause=lost)
        if ahead and len(state.setpoint.scheduled) >= setpoints.MAX_SCHEDULED:
            return state, reason(StatusCode.SCHEDULE_FULL, most=setpoints.MAX_SCHEDULED)
        whole = np.full(len(every), np.nan)
        whole[[every.names.index(name) for name in asked]] = value
        requested = setpoints.request(state.setpoint, read_only(whole), effective_ns,
                                      state.time_ns)
        goal = setpoints.at_its_time(requested, effective_ns, state.time_ns)
        try:
            with np.errstate(all='ignore'):
                rejection = self.calculation.feasibility(state).infeasibility(
                    goal, np.isfinite(whole))
                if rejection is None:
                    return state._replace(
                        setpoint=self.calculation.with_room(state, requested)), None
        except BaseException as error:
            rejection = reason(StatusCode.SETPOINT_NOT_TRIED, error=contained(error))
        return state, rejection

    def untrained(self, setpoint: setpoints.Setpoint) -> Reason | None:
        """Return the part of a requested set-point that is outside the trained range, or None."""
        for value in (*(value for _, value in setpoint.scheduled), setpoint.requested,
                      setpoint.active):
            if value is not None:
                given = np.isfinite(value)
                rejection = setpoints.rejection(self.controlled.only(tuple(
                    name for name, one in zip(self.controlled.names, given, strict=True) if one)),
                    value[given])
                if rejection is not None:
                    return rejection
        return None

    def request_manual_input(self, state: State, value: Array) -> tuple[State, Reason | None]:
        """
        Set the input that manual mode commands; rejected in automatic mode.

        :param value: (n_u,) in input units; brought within the limits when commanded.
        :return: as :meth:`request_setpoint`.
        :raises ValueError: for another size.
        """
        if state.mode is not Mode.MANUAL:
            return state, reason(StatusCode.NOT_IN_MANUAL_MODE)
        names = self.model.inputs.names
        value = numbers('manual input', value, names)
        for name, number in zip(names, value.tolist(), strict=True):
            if not math.isfinite(number):
                return state, reason(StatusCode.MANUAL_NOT_FINITE, signal=name, value=number)
        return state._replace(manual_input=read_only(value)), None

    def set_mode(self, state: State, mode: Mode) -> State:
        """
        Switch between operator and law, bumplessly.

        Both modes start from the last command; the difference to the law's input fades in.
        """
        if mode is state.mode:
            return state
        estimate = state.estimate
        try:
            with np.errstate(all='ignore'):
                if estimate is not None:
                    estimate = self.estimation.transfer_estimate(
                        estimate, self.estimation.level(state.supervisor), self.best)
        except BaseException as error:
            contained(error)
            estimate = None  # the next measurement starts it
        supervisor = replace(
            state.supervisor, better_since_ns=None) if state.supervisor.latched else Supervisor()
        return state._replace(mode=mode, manual_input=None, supervisor=supervisor,
                       recovery=None, estimate=estimate, history=History())

    def take_analysis(self, state: State, signal: str, value: float, stamp_ns: int
                      ) -> tuple[State, Reason | None]:
        """
        Correct the estimate by a late value of a state, in its unit, at the time of its stamp.

        :return: as :meth:`request_setpoint`.
        """
        instants, found, stamp_ns = state.history.instants, None, nanoseconds(stamp_ns)
        newest_ns, oldest_ns = (
            instants[at].time_ns if instants else stamp_ns for at in (-1, 0))
        try:
            # another model may not have the state
            index = self.model.states.names.index(signal)
            if math.isfinite(value) and newest_ns - stamp_ns <= (
                    self.tuning.analysis_delay[index] * NANOSECONDS):
                with np.errstate(all='ignore'):
                    found = self.estimation.corrected(state, index, value, stamp_ns)
        except BaseException as error:
            contained(error)
        return (state, reason(
            StatusCode.ANALYSIS_REJECTED, signal=signal, value=value,
            age=(newest_ns - stamp_ns) / NANOSECONDS,
            reach=(newest_ns - oldest_ns) / NANOSECONDS)) if found is None else (found, None)

    def clear_safe_state(self, state: State) -> tuple[State, Reason | None]:
        """
        Let the laws act again after the safe state has latched.

        In automatic mode one of them must have been possible for `recovery_time`.

        :return: as :meth:`request_setpoint`.
        """
        latched, why = state.supervisor.latched, state.supervisor.reason
        if not latched or why is None:
            return state, reason(StatusCode.NOT_LATCHED)
        if state.mode is Mode.AUTOMATIC and why.code is not StatusCode.LATCH_CLEARABLE:
            return state, reason(
                StatusCode.LATCH_KEPT, recovery_time=self.order.recovery_time,
                cause=why if why.cause is None else why.cause)
        return state._replace(supervisor=Supervisor()), None

    # Start and exchange of the controller itself.

    def initialise(self, state: State, applied: Array) -> State:
        """
        Start from the input (n_u,) that is applied already, as after a restart.

        It is ignored after the first command, and if it is not finite; another size is a
        ValueError.
        """
        applied = numbers('applied input', applied, self.model.inputs.names)
        if state.command is not None or not np.all(np.isfinite(applied)):
            return state
        return state._replace(command=read_only(self.tuning.limits.within(applied)),
                       applied=state.applied.corrected(applied))

    def switch_to(self, predecessor: Controller, state: State) -> State:
        """
        Take the place of a controller with another tuning or model, without a bump.

        The difference between the inputs of the two laws in the present state fades; the
        estimated rate of the plant stays. The state comes back in this controller's units. Where
        that calculation fails the next measurement starts the estimate and the law.
        """
        same = self.controlled.names == predecessor.controlled.names
        every = self.best.controls_all and predecessor.best.controls_all
        state = state._replace(history=History())
        try:
            with np.errstate(all='ignore'):
                state = self.estimation.take_over(predecessor.estimation, state)
                if not (same or every):
                    # the next measurement is held until there is another request
                    state = state._replace(setpoint=setpoints.Setpoint())
                level = self.levels.get(state.law or '')
                if (level is None or state.law_input is None or state.estimate is None
                        or state.setpoint.active is None):
                    return state
                now = level.compute(
                    state.setpoint.active, state.estimate.under(
                        self.estimation.feed_forward(state)), None, usual_interval(state),
                    state.target, state.own_command,
                    PendingInputs(state.applied, state.commanded_ns or 0,
                                  self.estimation.dead_ns))[1]
                return state if now.u is None else state._replace(
                    law_input=now.u, law_memory=now.memory, transfer=with_step(
                        state.transfer, state.law_input - now.u))
        except BaseException as error:
            contained(error)
            return state.restarted(state.time_ns)._replace(accepted=None,
                           setpoint=state.setpoint if same else setpoints.Setpoint())

    # Questions about the loop.

    def __str__(self) -> str:
        """Show levels, estimator, signals, delay margin, and a tuning that has no effect."""
        margin, bandwidth = self.delay_margin, self.tuning.observer_bandwidth
        estimator = self.best.estimator
        lines = [f'controller of {self.model.provenance.plant or self.model.kind}',
                 f'laws, best first: {", ".join(self.levels)}',
                 f'estimator: {type(estimator).__name__}',
                 f'measured: {", ".join(self.measured.names)}',
                 f'controlled: {", ".join(self.controlled.names)}',
                 f'delay margin at a sample every {self.model.sample_interval:.3g} s: '
                 + ('not calculated' if math.isnan(margin) else 'no limit' if math.isinf(margin)
                    else f'{margin:.3g} s')]
        if bandwidth > 0.0 and not isinstance(estimator, DisturbanceObserver):
            lines.append(f'observer_bandwidth = {bandwidth:g} 1/s has no effect on this '
                         'estimator: set disturbance_noise')
        return '\n  '.join(lines)

    @cached_property
    def delay_margin(self) -> float:
        """
        Return the delay in s beyond the known one with which the loop becomes unstable.

        Of the best law at the nominal point, at the sample interval of the training record; see
        :func:`koopman_ros.control.margin.delay_margin`. NaN where it is not known.
        """
        try:
            with np.errstate(all='ignore'):
                return delay_margin(
                    self.usable, self.measured, max(self.estimation.dead_ns, default=0)
                    / NANOSECONDS, self.model.sample_interval)
        except BaseException as error:
            contained(error)
            return math.nan

    @cached_property
    def usable(self) -> FallbackLevel:
        """The best level whose law can act at all, or the best one where none can."""
        return next((level for level in self.levels.values() if level.unusable is None), self.best)

    def steady_state(self, setpoint: Array) -> Array:
        """Return where (n_x,) the model has a set-point (n_c,) undisturbed; NaN for nowhere."""
        if self.best.controls_all:
            return setpoint
        try:
            with np.errstate(all='ignore'):
                target = self.best.target(setpoint, np.zeros(self.model.n_x), None)
        except BaseException as error:
            contained(error)
            target = None
        return np.full(self.model.n_x, np.nan) if target is None else (
            self.model.states.to_physical(target.x))

    def position(self, y: Array) -> Array:
        """Return the state (n_x,) that a measurement (n_y,) is taken for by itself."""
        return self.estimation.position(None, y)

    def try_law(self, x: Array, setpoint: Array) -> Reason | None:
        """Return why the first usable law fails at a state (n_x,), set-point (n_c,); or None."""
        estimate = Estimate(self.model.states.to_deviation(x), np.zeros(self.model.n_x))
        with np.errstate(all='ignore'):
            return self.usable.compute(setpoint, estimate, None, 0.0, None, None)[1].failure

    def equivalent_bias(self, state: State) -> Array:
        """Return the sensor's error (n_x,) that would explain the disturbance; NaN for none."""
        if state.estimate is None:
            return np.full(self.model.n_x, np.nan)
        model = self.estimation.level(state.supervisor).model
        try:
            return equivalent_bias(model, state.estimate) * self.model.states.scale
        except np.linalg.LinAlgError:
            return np.full(self.model.n_x, np.nan)


def _unmeasured(why: Reason | None) -> Reason | None:
    """Return the reason of a hold for want of measurements, which lasts; else None."""
    while why is not None and why.code is StatusCode.HELD_TOO_LONG:
        why = why.cause
    return why if why is not None and why.code in UNMEASURED else None
