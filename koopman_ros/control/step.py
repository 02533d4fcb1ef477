# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The control step: one pure function of state, measurement and time, replayable bit for bit.

check the measurement -> estimate -> set-point -> level and law -> transfer -> limits -> report
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
import math
from typing import Any

import numpy as np

from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.bumpless import BumplessTransfer, limit, with_step
from koopman_ros.control.estimates import StateEstimation, UNCERTAIN
from koopman_ros.control.fallback import FallbackLevel
from koopman_ros.control.feasibility import Feasibility
from koopman_ros.control.laws.base import LawResult, Target
from koopman_ros.control.recovery import moves_toward_nominal, SafeStateRecovery
from koopman_ros.control.state import (
    Arrival,
    CommandReport,
    EstimateReport,
    MeasurementReport,
    Mode,
    NO_COMMAND,
    NOTHING_MEASURED,
    State,
    StepReport,
    TargetReport,
    WITHOUT_LAW,
)
from koopman_ros.control.supervisor import (
    Condition,
    FallbackOrder,
    HOLD,
    MANUAL,
    SAFE,
    Supervisor,
)
from koopman_ros.control.timing import (
    afresh,
    check_interval,
    StepTime,
    time_of_measurement,
    time_of_silence,
)
from koopman_ros.core.arrays import Array, read_only
from koopman_ros.core.plugins import contained
from koopman_ros.core.signals import numbers
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.core.units import LATE_NANOSECONDS, NANOSECONDS, nanoseconds
from koopman_ros.estimation import Estimate, History, PendingInputs, Verdict
from koopman_ros.model import LiftedModel
from koopman_ros.tuning import Tuning


@dataclass(frozen=True)
class ControlStep:
    """The list of calculations of a step; each is done by one of the parts of a controller."""

    model: LiftedModel  #: the lift
    tuning: Tuning  #: for its signals
    levels: dict[str, FallbackLevel]  #: with a law, by name, best first
    order: FallbackOrder  #: of all levels
    estimation: StateEstimation  #: by the estimators of the levels

    @cached_property
    def best(self) -> FallbackLevel:
        """The first level."""
        return next(iter(self.levels.values()))

    @cached_property
    def safe_input(self) -> Array:
        """The safe input (n_u,), commanded when no law can act, in input units."""
        return read_only(self.tuning.limits.within(self.tuning.safe_value))

    @cached_property
    def nominal_input(self) -> Array:
        """The nominal input (n_u,) within its limits, in input units."""
        return read_only(self.tuning.limits.within(self.model.inputs.center))

    @cached_property
    def ranges(self) -> tuple[tuple[str, float, float], ...]:
        """(name, lower, upper) of the states' trained ranges."""
        states = self.model.states
        return tuple(zip(states.names, states.lower.tolist(), states.upper.tolist(), strict=True))

    def step(self, state: State, y: Array, time_ns: int, applied: Array | None = None,
             countable: float | None = None, disturbances: Array | None = None,
             ages: Array | None = None, quality: tuple[int, ...] | None = None
             ) -> tuple[State, Array, StepReport]:
        """Answer one measurement; see :meth:`Controller.step`."""
        y = numbers('measurement', y, self.estimation.outputs.names,
                    'pass outputs= to the controller if other signals are measured')
        if type(time_ns) is not int:
            time_ns = nanoseconds(time_ns)
        if applied is not None:
            applied = numbers('applied input', applied, self.model.inputs.names)
        if disturbances is not None and (signals := self.model.disturbances.names):
            disturbances = numbers('measured disturbances', disturbances, signals)
            ages = None if ages is None else numbers('ages of disturbances', ages, signals)
        if quality is not None and len(quality) != len(y):
            raise ValueError('quality must have a code for each of '
                             f'{", ".join(self.estimation.outputs.names)}, got {quality!r}')
        ahead = 1 if state.time_ns is None else time_ns - state.time_ns
        if state.command is not None and -LATE_NANOSECONDS <= ahead <= 0:
            arrival = Arrival.LATE if ahead < 0 else Arrival.REPEATED
            return state, state.command, self._report(
                state, self.estimation.level(state.supervisor), state.supervisor.reason,
                MeasurementReport(arrival, self._outside(state.estimate, y)))
        back = ahead < 0
        if back:
            state = afresh(state, ahead)
        time, missed = time_of_measurement(state, time_ns, countable)
        if time.interval < state.interval:
            check_interval(self.model, state.interval, time.interval)

        def calculate() -> tuple[State, Array, StepReport]:
            acting = self.estimation.level(state.supervisor)
            known, follows = self.estimation.applied(state, applied)
            known = self.estimation.disturbed(known, disturbances, ages, time_ns)
            now, seen = self.estimation.observe(known, acting.estimator, y, time, quality)
            accepted = seen.verdict.fault is None
            if accepted:
                now = self._advanced(now, seen.x, time)
            return self._command(now, acting, seen.verdict, MeasurementReport(
                Arrival.ACCEPTED if accepted else Arrival.REJECTED,
                seen.outside if accepted else self._outside(state.estimate, y), seen.expected,
                missed, back, follows, () if quality is None else tuple(
                    name for name, level in zip(
                        self.estimation.outputs.names, quality, strict=False)
                    if level == UNCERTAIN)), time)

        return self._contained(
            calculate, state, MeasurementReport(
                Arrival.ACCEPTED, np.nan, missed=missed, clock_went_back=back), time, time_ns)

    def hold(self, state: State, time_ns: int, cause: StatusCode | None = StatusCode.NO_MEASUREMENT
             ) -> tuple[State, Array | None, StepReport]:
        """Command without a measurement; see :meth:`Controller.hold`."""
        held, time_ns = state.command, nanoseconds(time_ns)
        if held is None:
            return state, None, self._report(
                state, self.estimation.level(state.supervisor), None)
        time = time_of_silence(state, time_ns)

        def calculate() -> tuple[State, Array, StepReport]:
            acting = self.estimation.level(state.supervisor)
            now = self.estimation.predicted(state, acting.estimator, time)
            if cause is not None or state.mode is Mode.MANUAL:
                fault = None if cause is None else reason(cause)
                return self._command(
                    now, acting, Verdict(now.accepted, fault), NOTHING_MEASURED, time)
            if now.estimate is None or now.setpoint.active is None:
                now = now._replace(commanded_ns=time.command_ns)
                return now, held, self._report(now, acting, now.supervisor.reason)
            x = self.model.states.to_physical(now.estimate.x)
            return self._command(
                self._advanced(now, x, time), acting, Verdict(now.accepted),
                MeasurementReport(outside=self.model.distance(x)), time)

        return self._contained(calculate, state, NOTHING_MEASURED, time, state.time_ns)

    def _contained(self, calculate: Callable[[], tuple[State, Array, StepReport]], before: State,
                   measured: MeasurementReport, time: StepTime, time_ns: int | None
                   ) -> tuple[State, Array, StepReport]:
        """
        Return the result of a calculation; where it fails the command is held, later the safe one.

        This is the one place where a failure of an estimator, or of anything else that a step
        calculates, is caught; that of a law is a reason for the next level (see
        :class:`FallbackLevel`).

        :param before: the state to hold from; its estimate restarts from the next measurement.
        :param time_ns: stamp of the last measurement.
        """
        try:
            # a measurement of 1e300 may overflow on its way; the result is checked and limited
            with np.errstate(all='ignore'):
                state, command, report = calculate()
            if not all(map(math.isfinite, command.tolist())):
                raise FloatingPointError(f'the command would be {command.tolist()}')
            if state.estimate is not None:
                state.estimate.check(self.model.n_x)
            return state, command, report
        except BaseException as error:
            fault = reason(StatusCode.CALCULATION_FAILED, error=contained(error))
            return self._command(
                before.restarted(time_ns), self.estimation.level(before.supervisor),
                Verdict(before.accepted, fault), measured, time)

    def _advanced(self, state: State, x: Array, time: StepTime) -> State:
        """Return the state with the set-point of now; it begins from `x` (n_x,)."""
        advance = partial(
            setpoints.advance, measured=x[self.best.indices], box=self.best.controlled_states,
            ramp=self.tuning.setpoint_ramp, now_ns=time.now_ns,
            lag=self.tuning.setpoint_filter_time)
        setpoint = advance(state.setpoint, seconds=time.counted)
        if setpoint is state.setpoint:
            return state
        if setpoint.asked != state.setpoint.asked or state.setpoint.active is None:
            # a request from before the first measurement, or whose time has come
            setpoint = advance(self.with_room(state, setpoint), seconds=0.0)
        return state._replace(setpoint=setpoint)

    def with_room(self, state: State, setpoint: setpoints.Setpoint) -> setpoints.Setpoint:
        """Move signals without a request to where the requested ones can be held."""
        goal, asked = setpoint.requested, np.array(setpoint.asked)
        if goal is None or asked.all() or not (asked.any() and np.isfinite(goal).all()):
            return setpoint
        return replace(setpoint, requested=self.feasibility(state).yielding(goal, asked))

    def feasibility(self, state: State) -> Feasibility:
        """Return the feasibility of set-points as things are."""
        acting, w = self.estimation.level(state.supervisor), np.zeros(self.model.n_x)
        # where a law acts that needs no model, none is trusted
        if state.estimate is not None and not acting.law.model_free:
            w = self.estimation.transfer_estimate(state.estimate, acting, self.best).under(
                self.estimation.feed_forward(state)).w
        return Feasibility(self.best, self.order.margins[0], w, state.target)

    def _command(self, state: State, acting: FallbackLevel, verdict: Verdict,
                 measured: MeasurementReport, time: StepTime
                 ) -> tuple[State, Array, StepReport]:
        """
        Choose a level, and bring its input within the limits.

        :param acting: in terms of whose model the estimate is.
        """
        now = acting
        held = self.model.inputs.center if state.command is None else state.command
        transfer = None if state.transfer is None else state.transfer.after(
            time.elapsed, self.tuning.bumpless_transfer_time)
        target, changes = None, dict(WITHOUT_LAW)
        if state.mode is Mode.MANUAL:
            wanted = held if state.manual_input is None else state.manual_input
            done, why = NO_COMMAND, verdict.fault
        else:
            supervisor, target, result = self._choose(
                state, acting, verdict, measured.outside, time)
            recovery = None if supervisor.level != SAFE else self._recovery(
                state, supervisor, verdict, measured.outside, time.now_ns)
            changes, wanted, done = self._act(
                state, held, supervisor, recovery, result, transfer)
            why = supervisor.reason
            changes |= {'supervisor': supervisor, 'recovery': recovery}
            if (supervisor.resumes or supervisor.level) != acting.name:
                now = self.estimation.level(supervisor)
            if now is not acting and state.estimate is not None:
                changes |= {'history': History(), 'estimate': self.estimation.transfer_estimate(
                    state.estimate, acting, now)}
            if target is not None and not self.best.controls_all:
                changes['target'] = read_only(np.concatenate((
                    self.model.states.to_physical(target.x),
                    self.model.inputs.to_physical(target.u))))
        u, at_range, at_rate = limit(
            self.tuning.limits, self.model.inputs.scale, wanted, state.command, time.counted)
        applied = state.applied.followed_by(time.command_ns, u, self.estimation.dead_ns)
        # a command that is held leaves its time to the next one
        kept = measured.arrival is Arrival.MISSING and state.mode is Mode.AUTOMATIC and (
            changes['supervisor'].level == HOLD)
        state = state._replace(**changes, command=u, commanded_ns=time.command_ns,
                               applied=applied, interval=time.interval,
                               counted=state.counted if kept else time.ahead)
        return state, u, self._report(state, now, why, measured, target, done._replace(
            at_range=done.at_range or at_range, at_rate=at_rate), u)

    def _choose(self, state: State, acting: FallbackLevel, verdict: Verdict, outside: float,
                time: StepTime) -> tuple[Supervisor, Target | None, LawResult | None]:
        """Find the level that acts; also give target and result of the last law tried, if any."""
        if verdict.fault is not None:
            requested = self.order.request(Condition.STATE_UNKNOWN, cause=verdict.fault)
        else:
            requested = state.supervisor.allowed(self.order, outside, self.ranges)
            while (level := self.levels.get(requested.level)) and level.unusable is not None:
                requested = self.order.request(
                    Condition.LAW_FAILED, level.name, cause=level.unusable)
        target, result = None, None
        while True:
            supervisor = state.supervisor.at(self.order, requested, time.now_ns)
            level = self.levels.get(supervisor.level or '')
            if level is None or state.estimate is None or state.setpoint.active is None:
                return supervisor, target, result
            estimate = state.estimate if level is acting else self.estimation.transfer_estimate(
                state.estimate, acting, level)
            if state.disturbances is not None:
                estimate = estimate.under(self.estimation.feed_forward(state))
            target, result = level.compute(
                state.setpoint.active, estimate,
                state.law_memory if state.law == level.name else None, time.spacing,
                state.target, state.command if state.transfer is None else state.own_command,
                PendingInputs(state.applied, time.command_ns, self.estimation.dead_ns), None
                if not state.setpoint.scheduled else partial(
                    setpoints.ahead, state.setpoint, self.best.controlled_states,
                    self.tuning.setpoint_ramp, self.tuning.setpoint_filter_time, time.now_ns))
            if result.failure is not None:
                requested = self.order.request(
                    Condition.LAW_MISSED if result.passing else Condition.LAW_FAILED,
                    level.name, cause=result.failure)
                continue
            # leave a law that failed near here, if there is one below
            if target is None or level.model.verified_loops is None or (
                    self.order.below(level.name) not in self.levels) or (
                        not level.model.failed_near(estimate.x, target.x)):
                return supervisor, target, result
            requested = self.order.request(Condition.LAW_LOST, level.name)

    def _recovery(self, state: State, supervisor: Supervisor, verdict: Verdict, outside: float,
                  time_ns: int) -> SafeStateRecovery | None:
        """Return how far the plant has come back where the safe input keeps it outside."""
        if supervisor.latched or verdict.fault is not None or verdict.accepted is None:
            return None
        if outside > 0.0 and not moves_toward_nominal(
                self.model, self.estimation.position(state.estimate, verdict.accepted.value),
                self.safe_input, self.nominal_input):
            return None
        if state.recovery is not None:
            return state.recovery.moved(outside, time_ns, self.order.recovery_time,
                                        max(self.estimation.dead_ns, default=0) / NANOSECONDS)
        # where laws failed, or one may act soon, it is not the distance that keeps them off
        kept_out = supervisor.bad_since_ns is None and supervisor.better_since_ns is None
        return SafeStateRecovery(outside, outside, time_ns) if kept_out and outside > 0.0 else None

    def _act(self, state: State, held: Array, supervisor: Supervisor,
             recovery: SafeStateRecovery | None, result: LawResult | None,
             transfer: BumplessTransfer | None) -> tuple[dict[str, Any], Array, CommandReport]:
        """Return the changes of the state, the command before limits, and its report."""
        level = supervisor.level
        if result is None or result.u is None:
            done = NO_COMMAND if result is None else CommandReport(
                result.info._replace(form=''), at_range=result.clipped, plan=result.plan)
            if level == SAFE:
                share = 0.0 if recovery is None else recovery.share
                wanted = self.safe_input + share * (self.nominal_input - self.safe_input)
                return dict(WITHOUT_LAW), wanted, done._replace(recovery=share)
            passing = supervisor.resumes is not None
            return {} if passing else {**WITHOUT_LAW, 'transfer': state.transfer}, held, done
        if state.law != level and state.command is not None and self.tuning.bumpless_transfer_time:
            # the command was not this law's so far
            transfer = with_step(None, held - result.u)
        offset = None if transfer is None else transfer.offset
        changes = {'law': level, 'law_input': result.u, 'law_memory': result.memory,
                   'transfer': transfer}
        return changes, result.u if offset is None else result.u + offset, CommandReport(
            result.info, offset, at_range=result.clipped, plan=result.plan)

    def _outside(self, known: Estimate | None, y: Array) -> float:
        """Return how far a measurement is from the training data; NaN when it is none."""
        try:
            return self.model.distance(
                self.estimation.position(known, y)) if np.isfinite(y).all() else np.nan
        except np.linalg.LinAlgError:
            return np.nan

    def _report(self, state: State, acting: FallbackLevel, why: Reason | None,
                measured: MeasurementReport = NOTHING_MEASURED, target: Target | None = None,
                command: CommandReport = NO_COMMAND, u: Array | None = None) -> StepReport:
        """
        Return the report of a step.

        :param acting: in terms of whose model the estimate is.
        :param u: (n_u,) new command; None where there is none.
        """
        if u is not None:
            command = command._replace(outside=self.model.inputs.violation(u))
        active, manual, order = state.setpoint.active, state.mode is Mode.MANUAL, self.order
        depth = len(order.levels) if manual else order.places.get(state.supervisor.level, 0)
        known = None if state.estimate is None else EstimateReport(
            state.estimate, acting.estimator)
        steady = () if target is None else (
            target.residual, self.model.states.to_physical(target.x),
            self.model.inputs.to_physical(target.u))
        aim = None if active is None else TargetReport(
            active, self.best.controlled_states.violation(active), *steady)
        return StepReport(state.mode, MANUAL if manual else order.levels[depth], depth, why,
                          measured, known, aim, command)
