# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The control step: one pure function of state, measurement and time, replayable bit for bit.

check the measurement -> estimate -> set-point -> level -> law -> transfer -> limits -> report
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.bumpless import BumplessTransfer, limit, with_step
from koopman_ros.control.configuration import Configuration
from koopman_ros.control.estimates import UNCERTAIN
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
from koopman_ros.control.supervisor import HOLD, LevelRequest, MANUAL, SAFE, Supervisor
from koopman_ros.control.timing import (
    afresh,
    check_interval,
    StepTime,
    time_of_measurement,
    time_of_silence,
)
from koopman_ros.core.arrays import all_finite, Array, read_only
from koopman_ros.core.plugins import contained
from koopman_ros.core.signals import numbers
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.core.units import LATE_NANOSECONDS, NANOSECONDS, nanoseconds
from koopman_ros.estimation import Estimate, History, Verdict


@dataclass(frozen=True)
class ControlStep(Configuration):
    """The step of a configured loop; every method is pure and returns a new state."""

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
        y = numbers('measurement', y, self.measured.names,
                    'pass outputs= to the controller if other signals are measured')
        time_ns = nanoseconds(time_ns)
        if applied is not None:
            applied = numbers('applied input', applied, self.model.inputs.names)
        if disturbances is not None and (signals := self.model.disturbances.names):
            disturbances = numbers('measured disturbances', disturbances, signals)
            ages = None if ages is None else numbers('ages of disturbances', ages, signals)
        ahead = 1 if state.time_ns is None else time_ns - state.time_ns
        if state.command is not None and -LATE_NANOSECONDS <= ahead <= 0:
            arrival = Arrival.LATE if ahead < 0 else Arrival.REPEATED
            return state, state.command, self._report(
                state, state.supervisor.reason, MeasurementReport(
                    arrival, self._outside(state.estimate, y)))
        back = ahead < 0
        if back:
            state = afresh(state, ahead)
        time, missed = time_of_measurement(state, time_ns, countable)
        check_interval(self.model, state.interval, time.interval)

        def calculate() -> tuple[State, Array, StepReport]:
            known, follows = self.estimation.applied(state, applied)
            known = self.estimation.disturbed(known, disturbances, ages, time_ns)
            now, seen = self.estimation.observe(known, y, time, quality)
            accepted = seen.verdict.fault is None
            if accepted:
                now = self._advanced(now, seen.x, time)
            return self._command(now, seen.verdict, MeasurementReport(
                Arrival.ACCEPTED if accepted else Arrival.REJECTED,
                seen.outside if accepted else self._outside(state.estimate, y), seen.expected,
                missed, back, follows, tuple(
                    name for name, level in zip(self.measured.names, quality or (), strict=False)
                    if level == UNCERTAIN)), time)

        return self._contained(
            calculate, state, MeasurementReport(
                Arrival.ACCEPTED, np.nan, missed=missed, clock_went_back=back), time, time_ns)

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
        held, time_ns = state.command, nanoseconds(time_ns)
        if held is None:
            return state, None, self._report(state, None)
        time = time_of_silence(state, time_ns)

        def calculate() -> tuple[State, Array, StepReport]:
            now = self.estimation.predicted(state, time)
            if cause is not None or state.mode is Mode.MANUAL:
                fault = None if cause is None else reason(cause)
                return self._command(now, Verdict(now.accepted, fault), NOTHING_MEASURED, time)
            if now.estimate is None or now.setpoint.active is None:
                now = now._replace(commanded_ns=time.command_ns)
                return now, held, self._report(now, now.supervisor.reason)
            x = self.model.states.to_physical(now.estimate.x)
            return self._command(
                self._advanced(now, x, time), Verdict(now.accepted),
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
            if not all_finite(command):
                raise FloatingPointError(f'the command would be {command.tolist()}')
            if state.estimate is not None:
                state.estimate.check(self.model.n_x)
            return state, command, report
        except BaseException as error:
            fault = reason(StatusCode.CALCULATION_FAILED, error=contained(error))
            return self._command(
                before.restarted(time_ns), Verdict(before.accepted, fault), measured, time)

    def _advanced(self, state: State, x: Array, time: StepTime) -> State:
        """Return the state with the set-point of now; it begins from `x` (n_x,)."""
        setpoint = setpoints.advance(
            state.setpoint, self.best.controlled_of(x), self.controlled,
            self.tuning.setpoint_ramp, time.now_ns, time.counted,
            self.tuning.setpoint_filter_time)
        if setpoint is state.setpoint:
            return state
        if setpoint.asked != state.setpoint.asked or state.setpoint.active is None:
            # a request from before the first measurement, or whose time has come
            setpoint = setpoints.advance(
                self._with_room(state, setpoint), self.best.controlled_of(x), self.controlled,
                self.tuning.setpoint_ramp, time.now_ns, 0.0, self.tuning.setpoint_filter_time)
        return state._replace(setpoint=setpoint)

    def _with_room(self, state: State, setpoint: setpoints.Setpoint) -> setpoints.Setpoint:
        """Move signals without a request to where the requested ones can be held."""
        goal, asked = setpoint.requested, np.array(setpoint.asked)
        if goal is None or asked.all() or not (asked.any() and np.isfinite(goal).all()):
            return setpoint
        return replace(setpoint, requested=self._feasibility(state).yielding(goal, asked))

    def _feasibility(self, state: State) -> Feasibility:
        """Return the feasibility of set-points as things are."""
        acting, w = self.estimation.level(state.supervisor), np.zeros(self.model.n_x)
        # where a law acts that needs no model, none is trusted
        if state.estimate is not None and not acting.law.model_free:
            w = self.estimation.transfer_estimate(state.estimate, acting, self.best).under(
                self.estimation.feed_forward(state)).w
        return Feasibility(self.best, self.order.margins[0], w, state.target)

    def _command(self, state: State, verdict: Verdict, measured: MeasurementReport,
                 time: StepTime) -> tuple[State, Array, StepReport]:
        """Choose a level, and bring its input within the limits."""
        transfer = state.transfer and state.transfer.after(
            time.elapsed, self.tuning.bumpless_transfer_time)
        target, changes = None, dict(WITHOUT_LAW)
        if state.mode is Mode.MANUAL:
            wanted = state.manual_input if state.manual_input is not None else (
                self._last_command(state))
            done, why = NO_COMMAND, verdict.fault
        else:
            supervisor, target, result = self._choose(state, verdict, measured.outside, time)
            recovery = self._recovery(state, supervisor, verdict, measured.outside, time.now_ns)
            changes, wanted, done = self._act(state, supervisor, recovery, result, transfer)
            why = supervisor.reason
            changes |= {'supervisor': supervisor, 'recovery': recovery}
            if state.estimate is not None:
                levels = [self.estimation.level(one) for one in (state.supervisor, supervisor)]
                changes['estimate'] = self.estimation.transfer_estimate(state.estimate, *levels)
                if levels[0] is not levels[1]:
                    changes['history'] = History()
            if target is not None and not self.best.controls_all:
                changes['target'] = read_only(np.concatenate((
                    self.model.states.to_physical(target.x),
                    self.model.inputs.to_physical(target.u))))
        u, at_range, at_rate = limit(
            self.tuning.limits, self.model.inputs.scale, wanted, state.command, time.counted)
        done = done._replace(at_range=done.at_range or at_range, at_rate=at_rate,
                             outside=self.model.inputs.violation(u))
        applied = state.applied.followed_by(time.command_ns, u, self.estimation.dead_ns)
        # a command that is held leaves its time to the next one
        held = measured.arrival is Arrival.MISSING and state.mode is Mode.AUTOMATIC and (
            changes['supervisor'].level == HOLD)
        state = state._replace(**changes, command=u, commanded_ns=time.command_ns,
                        applied=applied, interval=time.interval,
                        counted=state.counted if held else time.ahead)
        return state, u, self._report(state, why, measured, target, done)

    def _choose(self, state: State, verdict: Verdict, outside: float, time: StepTime
                ) -> tuple[Supervisor, Target | None, LawResult | None]:
        """Find the level that acts; also give target and result of the last law tried, if any."""
        if verdict.fault is not None:
            requested = LevelRequest(HOLD, verdict.fault, passing=True)
        else:
            requested = state.supervisor.allowed(self.order, outside, self.ranges)
            while (level := self.levels.get(requested.level)) and level.unusable is not None:
                requested = self._failed(level, level.unusable)
        target, result = None, None
        while True:
            supervisor = state.supervisor.at(self.order, requested, time.now_ns)
            level = self.levels.get(supervisor.level or '')
            if level is None or state.estimate is None or state.setpoint.active is None:
                return supervisor, target, result
            estimate = self.estimation.transfer_estimate(
                state.estimate, self.estimation.level(state.supervisor), level
                ).under(self.estimation.feed_forward(state))
            memory = state.law_memory if state.law == level.name else None
            target, result = level.compute(
                state.setpoint.active, estimate, memory, time.spacing, state.target,
                state.own_command, self.estimation.pending(state, time.command_ns),
                partial(setpoints.ahead, state.setpoint, self.controlled,
                        self.tuning.setpoint_ramp, self.tuning.setpoint_filter_time, time.now_ns))
            if result.failure is not None:
                requested = self._failed(level, result.failure, result.passing)
                continue
            # a poor law is better than none
            below = self.order.below(level.name)
            if below not in self.levels or target is None or not level.model.failed_near(
                    estimate.x, target.x):
                return supervisor, target, result
            requested = LevelRequest(below, reason(StatusCode.LOST_HERE, level=level.name))

    def _failed(self, level: FallbackLevel, why: Reason, passing: bool = False) -> LevelRequest:
        return LevelRequest(self.order.below(level.name), reason(
            StatusCode.LAW_FAILED, level=level.name, cause=why), passing)

    def _recovery(self, state: State, supervisor: Supervisor, verdict: Verdict, outside: float,
                  time_ns: int) -> SafeStateRecovery | None:
        """Return how far the plant has come back where the safe input keeps it outside."""
        if (supervisor.level != SAFE or supervisor.latched or verdict.fault is not None
                or verdict.accepted is None):
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

    def _act(self, state: State, supervisor: Supervisor, recovery: SafeStateRecovery | None,
             result: LawResult | None, transfer: BumplessTransfer | None
             ) -> tuple[dict[str, Any], Array, CommandReport]:
        """Return the changes of the state, the command before limits, and its report."""
        level, held = supervisor.level, self._last_command(state)
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

    def _last_command(self, state: State) -> Array:
        return self.model.inputs.center if state.command is None else state.command

    def _outside(self, known: Estimate | None, y: Array) -> float:
        """Return how far a measurement is from the training data; NaN when it is none."""
        try:
            return self.model.distance(
                self.estimation.position(known, y)) if all_finite(y) else np.nan
        except np.linalg.LinAlgError:
            return np.nan

    def _report(self, state: State, why: Reason | None,
                measured: MeasurementReport = NOTHING_MEASURED, target: Target | None = None,
                command: CommandReport = NO_COMMAND) -> StepReport:
        active, manual = state.setpoint.active, state.mode is Mode.MANUAL
        depth = len(self.order.levels) if manual else self.order.depth(state.supervisor.level)
        known = None if state.estimate is None else EstimateReport(
            state.estimate, self.estimation.level(state.supervisor).estimator)
        steady = () if target is None else (
            target.residual, self.model.states.to_physical(target.x),
            self.model.inputs.to_physical(target.u))
        aim = None if active is None else TargetReport(
            active, self.controlled.violation(active), *steady)
        return StepReport(state.mode, MANUAL if manual else self.order.levels[depth], depth, why,
                          measured, known, aim, command)
