# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control step: one pure function of state, measurement and time, replayable bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np

from koopman_ros.arrays import Array, brief
from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.holding import Holding
from koopman_ros.control.laws import LawResult
from koopman_ros.control.laws.base import Target
from koopman_ros.control.levels import Estimating, Level, levels_of
from koopman_ros.control.limits import finite, limit, shifted, Transfer
from koopman_ros.control.regular import Regular
from koopman_ros.control.settings import Settings
from koopman_ros.control.state import (
    Arrival,
    CommandReport,
    EstimateReport,
    MeasurementReport,
    Mode,
    NO_COMMAND,
    NOTHING_MEASURED,
    Report,
    State,
    TargetReport,
)
from koopman_ros.control.supervisor import (
    HOLD,
    leads_home,
    MANUAL,
    Requested,
    Rest,
    rest_under,
    SAFE,
    Supervisor,
    WayBack,
)
from koopman_ros.estimation import equivalent_bias, Estimate, Verdict
from koopman_ros.lifting import Coordinates, LiftedModel
from koopman_ros.plugs import contained
from koopman_ros.reasons import Code, Reason, reason, UNMEASURED
from koopman_ros.signals import numbers, Outputs
from koopman_ros.units import LATE_NANOSECONDS, NANOSECONDS
from koopman_ros.values import amended

# s that the rate limit counts at most between two commands without a measurement, unless
# measurements are usually further apart.
_LONGEST_WATCH = 1.0
# What changes of the state when no law acts any more, and when none is on its way back.
_LAW_ENDS: Mapping[str, object] = {'law': None, 'law_input': None, 'law_memory': None}
_WITHOUT_LAW: Mapping[str, object] = {**_LAW_ENDS, 'transfer': None}
# What is forgotten where a calculation has failed, as it may be the cause.
_RESTARTED: Mapping[str, object] = {
    **_WITHOUT_LAW, 'estimate': None, 'way_back': None, 'target': None}


@dataclass(frozen=True)
class Controller:
    """
    A lifted model with its tuning; every method is pure and returns a new state.

    :raises ValueError: when the settings do not fit the model's signals, or the estimator cannot
        do with what is measured.
    """

    model: LiftedModel  #: the lift
    settings: Settings  #: the tuning
    outputs: Outputs | None = None  #: what is measured; every state by default

    __repr__ = brief

    def __post_init__(self) -> None:
        self.settings.check(self.model, self.measured)
        # what cannot be built is refused now, and what was built is kept
        assert self.levels

    @cached_property
    def measured(self) -> Outputs:
        """What is measured: y = C x."""
        states = self.model.states
        return self.outputs or Outputs(states.names, states.units, np.eye(self.model.n_x))

    @cached_property
    def levels(self) -> dict[str, Level]:
        """The levels with a law, by name, best first."""
        return levels_of(self.model, self.measured, self.settings)

    @cached_property
    def _best(self) -> Level:
        return next(iter(self.levels.values()))

    @cached_property
    def usable(self) -> Level:
        """The best level whose law can act at all, or the best one where none can."""
        return next((level for level in self.levels.values() if level.unusable is None),
                    self._best)

    @property
    def controlled(self) -> Coordinates:
        """The states with a set-point."""
        return self._best.controlled_states

    @cached_property
    def _estimating(self) -> Estimating:
        return Estimating(self.model, self.measured, self.settings, self.levels)

    @cached_property
    def _regular(self) -> Regular | None:
        return Regular.of(self.model, self.measured, self.settings, self._best)

    @cached_property
    def safe_input(self) -> Array:
        """What is commanded when nothing else can be, (n_u,) in input units."""
        return _kept(self.settings.limits.within(self.settings.safe_input))

    @cached_property
    def _nominal_input(self) -> Array:
        return _kept(self.settings.limits.within(self.model.inputs.center))

    @cached_property
    def _ranges(self) -> tuple[tuple[str, float, float], ...]:
        states = self.model.states
        return tuple(zip(states.names, states.lower.tolist(), states.upper.tolist(), strict=True))

    @cached_property
    def rest(self) -> Rest:
        """Where the safe input leads the plant, as far as the model tells."""
        return rest_under(self.model, self.safe_input, self.settings.supervisor.return_margin)

    # What the operator asks for.

    def request_setpoint(self, state: State, value: Array, effective_ns: int = 0,
                         signals: tuple[str, ...] | None = None) -> tuple[State, Reason | None]:
        """
        Ask for a set-point, at once or from a later time on.

        It has to lie in the trained range, and an input within its range has to hold it under the
        disturbance that is estimated now.

        :param value: (n,) of the signals, in state units.
        :param effective_ns: stamp from which it holds; see :func:`setpoint.request`.
        :param signals: (n,) which of the controlled ones are asked for, the others stay as they
            are; None for all.
        :return: the new state and None, or the old one with the reason of refusal.
        :raises ValueError: for signals that are not controlled, or that do not fit the value.
        """
        asked, every = self.controlled.names if signals is None else signals, self.controlled
        if not asked or len(set(asked)) != len(asked) or not set(asked) <= set(every.names):
            raise ValueError(f'signals must be some of {", ".join(every.names)}, each once, got '
                             f'{list(asked)}')
        value = numbers('set-point', value, asked)
        refusal = setpoints.refusal(every.only(asked), value)
        if refusal is not None:
            return state, refusal
        lost = _unmeasured(state.supervisor.reason)
        if lost is not None and not setpoints.lies_ahead(effective_ns, state.time_ns):
            return state, reason(Code.SETPOINT_UNMEASURED, signal=asked[0],
                                 value=float(value[0]), cause=lost)
        whole = np.full(len(every), np.nan)
        whole[[every.names.index(name) for name in asked]] = value
        if (len(state.setpoint.scheduled) >= setpoints.MAX_SCHEDULED
                and setpoints.lies_ahead(effective_ns, state.time_ns)):
            return state, reason(Code.SCHEDULE_FULL, most=setpoints.MAX_SCHEDULED)
        requested = setpoints.request(
            state.setpoint, _kept(whole), effective_ns, state.time_ns)
        refusal = self._unheld(state, setpoints.at_its_time(
            requested, effective_ns, state.time_ns), len(asked) == len(every))
        return (amended(state, setpoint=requested), None) if refusal is None else (state, refusal)

    def _unheld(self, state: State, goal: Array, whole: bool) -> Reason | None:
        """Return why a set-point (n_c,) cannot be held as things are, or None."""
        level, estimating = self._best, self._estimating
        try:
            with np.errstate(all='ignore'):
                acting = estimating.level(state)
                # where a law acts that needs no model, none is trusted
                estimate = None if acting.model_free else estimating.rebase(
                    state.estimate, acting, level)
                holding = Holding(
                    level, self.settings.limits, self.settings.supervisor.levels[0].margin,
                    np.zeros(self.model.n_x) if estimate is None else estimate.w, state.target)
                return holding.refusal(
                    goal, (state.setpoint.requested, state.setpoint.active), state.command, whole)
        except BaseException as error:
            return reason(Code.SETPOINT_NOT_TRIED, error=contained(error))

    def untrained(self, setpoint: setpoints.Setpoint) -> Reason | None:
        """Return what of a set-point, asked for already, is outside the trained range, or None."""
        for value in (*(value for _, value in setpoint.scheduled), setpoint.requested,
                      setpoint.active):
            if value is not None:
                known = [name for name, number in zip(
                    self.controlled.names, value.tolist(), strict=True) if number == number]
                refusal = setpoints.refusal(
                    self.controlled.only(known), value[np.isfinite(value)])
                if refusal is not None:
                    return refusal
        return None

    def request_manual_input(self, state: State, value: Array) -> tuple[State, Reason | None]:
        """
        Set the input that manual mode commands; refused in automatic mode.

        :param value: (n_u,) in input units; brought within the limits when commanded.
        :return: as :meth:`request_setpoint`.
        :raises ValueError: for another size.
        """
        if state.mode is not Mode.MANUAL:
            return state, reason(Code.NOT_IN_MANUAL_MODE)
        names = self.model.inputs.names
        value = numbers('manual input', value, names)
        for name, number in zip(names, value.tolist(), strict=True):
            if not math.isfinite(number):
                return state, reason(Code.MANUAL_NOT_FINITE, signal=name, value=number)
        return amended(state, manual_input=_kept(value)), None

    def set_mode(self, state: State, mode: Mode) -> State:
        """
        Hand over between operator and law, without a bump.

        Both modes start from the last command; what a law asks for beside that fades in.
        """
        if mode is state.mode:
            return state
        estimating = self._estimating
        best = amended(state, supervisor=Supervisor())
        try:
            with np.errstate(all='ignore'):
                estimate = estimating.rebase(
                    state.estimate, estimating.level(state), estimating.level(best))
        except BaseException as error:
            contained(error)
            estimate = None  # the next measurement starts it
        return amended(state, mode=mode, manual_input=None, supervisor=Supervisor(),
                       way_back=None, estimate=estimate)

    # What happens to the controller itself.

    def initialise(self, state: State, applied: Array) -> State:
        """
        Start from the input (n_u,) that is applied already, as after a restart.

        Nothing is changed after the first command, nor by what is not finite; another size is a
        ValueError.
        """
        applied = numbers('applied input', applied, self.model.inputs.names)
        if state.command is not None or not np.all(np.isfinite(applied)):
            return state
        return amended(state, command=_kept(self.settings.limits.within(applied)))

    def hand_over(self, predecessor: Controller, state: State) -> State:
        """
        Take the place of a controller with other settings or another model, without a bump.

        What the two laws ask for in the present state differs by an offset that fades; what is
        estimated of the plant's rate stays. The state comes back in this controller's units.
        Where that calculation fails the next measurement starts the estimate and the law.
        """
        try:
            with np.errstate(all='ignore'):
                return self._inherited(predecessor, state)
        except BaseException as error:
            contained(error)
            state = amended(state, **_RESTARTED, accepted=None)
            if self.controlled.names != predecessor.controlled.names:
                state = amended(state, setpoint=setpoints.Setpoint())
            return state

    def _inherited(self, predecessor: Controller, state: State) -> State:
        """Return the state of a predecessor in this controller's units, with an offset."""
        state = self._estimating.inherit(predecessor._estimating, state)
        every = self._best.controls_all and predecessor._best.controls_all
        if not every and self.controlled.names != predecessor.controlled.names:
            # what is measured next is held until there is another request
            state = amended(state, setpoint=setpoints.Setpoint())
        if state.law is None or state.law_input is None or state.estimate is None:
            return state
        level = self.levels.get(state.law)
        if level is None or state.setpoint.active is None:
            return state
        now = level.compute(state.setpoint.active, state.estimate, self.settings.limits, None,
                            _spacing(state), state.target, last=_own_share(state))[1]
        if now.u is None:
            return state
        return amended(state, law_input=now.u, law_memory=now.memory, transfer=shifted(
            state.transfer, state.law_input - now.u))

    def steady_state(self, setpoint: Array) -> Array:
        """Return where (n_x,) the model has a set-point (n_c,) undisturbed; NaN for nowhere."""
        if self._best.controls_all:
            return setpoint
        try:
            with np.errstate(all='ignore'):
                target = self._best.target(
                    setpoint, np.zeros(self.model.n_x), self.settings.limits, None)
        except BaseException as error:
            contained(error)
            target = None
        return np.full(self.model.n_x, np.nan) if target is None else (
            self.model.states.to_physical(target.x))

    def position(self, y: Array) -> Array:
        """Return the state (n_x,) that a measurement (n_y,) is taken for by itself."""
        return self._estimating.position(None, y)

    def try_law(self, x: Array, setpoint: Array) -> Reason | None:
        """Return why the first usable law fails at a state (n_x,), set-point (n_c,); or None."""
        level = self.usable
        estimate = Estimate(self.model.states.to_deviation(x), np.zeros(self.model.n_x))
        with np.errstate(all='ignore'):
            return level.compute(
                setpoint, estimate, self.settings.limits, None, 0.0, None)[1].failure

    # Steps.

    def step(self, state: State, y: Array, time_ns: int, applied: Array | None = None,
             countable: float | None = None) -> tuple[State, Array, Report]:
        """
        Answer one measurement.

        A repeated stamp and one out of order, earlier by at most a second, return the last
        command again; a still earlier stamp starts time afresh. After a gap in the measurements
        ramp and rate limit count twice the interval before it, not the gap. Stamps that return to
        where they were before they went back count from the newest of those.

        :param y: (n_y,) measured, in the signals' units.
        :param applied: (n_u,) the input that was found to act then, where it is measured; see
            :meth:`Estimating.applied`.
        :param countable: largest number of seconds since the last stamp that ramp and rate limit
            count, from another clock; None for any.
        :return: the new state, the command (n_u,) in input units, always finite and within the
            limits, and the report.
        :raises ValueError: for a measurement or an input of another size.
        """
        y = numbers('measurement', y, self.measured.names)
        if applied is not None:
            applied = numbers('applied input', applied, self.model.inputs.names)
        ahead = 1 if state.time_ns is None else time_ns - state.time_ns
        if state.command is not None and -LATE_NANOSECONDS <= ahead <= 0:
            return state, state.command, self._report(
                state, state.supervisor.reason, MeasurementReport(
                    Arrival.LATE if ahead < 0 else Arrival.REPEATED,
                    self._outside(state.estimate, y)))
        back = ahead < 0
        if back:
            state = _afresh(state)
        since_ns = state.commanded_ns
        ahead_of_stamps = since_ns is not None and since_ns > time_ns + LATE_NANOSECONDS
        if ahead_of_stamps:
            # what was commanded in silence was timed by a clock that these stamps do not follow
            since_ns = state.time_ns
        elapsed = 0.0 if since_ns is None else max(0.0, (time_ns - since_ns) / NANOSECONDS)
        # neither a gap nor a burst is the spacing of the samples, nor the first of them
        spacing = min(_spacing(state), elapsed)
        state, seconds, missed = _passed(state, time_ns, elapsed)
        if ahead_of_stamps and state.supervisor.level != HOLD:
            # the command has moved in that time already
            seconds = 0.0
        if countable is not None:
            seconds = min(seconds, countable)
        return self._contained(
            lambda: self._answer(state, y, time_ns, applied, elapsed, seconds, spacing, missed,
                                 back),
            amended(state, time_ns=time_ns),
            MeasurementReport(Arrival.ACCEPTED, np.nan, missed=missed, clock_went_back=back),
            time_ns, time_ns, elapsed, seconds)

    def _answer(self, state: State, y: Array, time_ns: int, applied: Array | None, elapsed: float,
                seconds: float, spacing: float, missed: int, back: bool
                ) -> tuple[State, Array, Report]:
        """Answer a measurement that is news; arguments as those of :meth:`_command`."""
        # a measurement of 1e300 may overflow on its way; the result is checked and limited
        with np.errstate(all='ignore'):
            u, follows = self._estimating.applied(state, applied)
            before = state.estimate
            if self._regular is not None and not self._estimating.lost(state, time_ns):
                regular = self._regular.step(
                    state, y, time_ns, u, elapsed, seconds, spacing, missed, follows)
                if regular is not None:
                    return regular
            state, seen = self._estimating.observe(state, y, time_ns, elapsed, u)
            accepted = seen.verdict.fault is None
            if accepted:
                setpoint = setpoints.advance(
                    state.setpoint, self._best.controlled_of(seen.x), self.controlled,
                    self.settings.setpoint_ramp, time_ns, seconds, self.settings.setpoint_filter)
                if setpoint is not state.setpoint:
                    state = amended(state, setpoint=setpoint)
            measured = MeasurementReport(
                Arrival.ACCEPTED if accepted else Arrival.REJECTED,
                seen.outside if accepted else self._outside(before, y), seen.expected, missed,
                back, follows)
            # without elapsed time the rate limit holds the last command
            return self._command(
                state, seen.verdict, measured, time_ns, time_ns, elapsed, seconds, spacing)

    def hold(self, state: State, time_ns: int, cause: Code | None = Code.NO_MEASUREMENT
             ) -> tuple[State, Array | None, Report]:
        """
        Command without a measurement: hold, and later go to the safe input.

        :param time_ns: up to which nothing came, in the time of the measurements' stamps; before
            the first of them, in that of any clock.
        :param cause: why the command is held; None to command from the estimate, which the model
            carries on.
        :return: as :meth:`step`; the command is None before the first.
        """
        if state.command is None:
            return state, None, self._report(state, None)
        since_ns = time_ns if state.commanded_ns is None else state.commanded_ns
        elapsed = max(0.0, (time_ns - since_ns) / NANOSECONDS)
        # the command stood still all through a longer silence
        seconds = min(elapsed, max(_LONGEST_WATCH, 2.0 * _spacing(state)))
        until_ns = max(time_ns, since_ns)
        return self._contained(
            lambda: self._coasted(state, cause, time_ns, until_ns, elapsed, seconds),
            state, NOTHING_MEASURED, time_ns, until_ns, elapsed, seconds)

    def _coasted(self, state: State, cause: Code | None, time_ns: int, until_ns: int,
                 elapsed: float, seconds: float) -> tuple[State, Array, Report]:
        """Command without a measurement; arguments as those of :meth:`hold`."""
        with np.errstate(all='ignore'):
            state = amended(state, estimate=self._estimating.coast(
                state, elapsed, self._estimating.applied(state)[0]))
            fault, measured = None if cause is None else reason(cause), NOTHING_MEASURED
            if fault is None and state.mode is Mode.AUTOMATIC:
                command = state.command
                assert command is not None
                if state.estimate is None or state.setpoint.active is None:
                    state = amended(state, commanded_ns=until_ns)
                    return state, command, self._report(state, state.supervisor.reason)
                x = self.model.states.to_physical(state.estimate.x)
                measured = MeasurementReport(outside=self.model.distance(x))
                state = amended(state, setpoint=setpoints.advance(
                    state.setpoint, self._best.controlled_of(x), self.controlled,
                    self.settings.setpoint_ramp, time_ns, seconds, self.settings.setpoint_filter))
            return self._command(state, Verdict(state.accepted, fault), measured, time_ns,
                                 until_ns, elapsed, seconds, _spacing(state))

    def _contained(self, calculate: Callable[[], tuple[State, Array, Report]], before: State,
                   measured: MeasurementReport, time_ns: int, commanded_ns: int, elapsed: float,
                   seconds: float) -> tuple[State, Array, Report]:
        """
        Return the result of a calculation; where it fails the command is held, later the safe one.

        This is the one place where a failure of an estimator, or of anything else that a step
        calculates, is caught; that of a law is a reason for the next level (:class:`Level`).

        :param before: the state to hold from; its estimate restarts from the next measurement.
        """
        try:
            state, command, report = calculate()
            if not finite(command):
                raise FloatingPointError(f'the command would be {command.tolist()}')
            if state.estimate is not None:
                state.estimate.check(self.model.n_x)
            return state, command, report
        except BaseException as error:
            fault = reason(Code.CALCULATION_FAILED, error=contained(error))
            return self._command(
                amended(before, **_RESTARTED), Verdict(before.accepted, fault), measured, time_ns,
                commanded_ns, elapsed, seconds)

    def equivalent_bias(self, state: State) -> Array:
        """Return the sensor's error (n_x,) that would explain the disturbance; NaN for none."""
        if state.estimate is None:
            return np.full(self.model.n_x, np.nan)
        model = self._estimating.level(state).model
        try:
            return equivalent_bias(model, state.estimate) * self.model.states.scale
        except np.linalg.LinAlgError:
            return np.full(self.model.n_x, np.nan)

    def _command(self, state: State, verdict: Verdict, measured: MeasurementReport, time_ns: int,
                 commanded_ns: int, elapsed: float, seconds: float, spacing: float = 0.0
                 ) -> tuple[State, Array, Report]:
        """
        Return the command within its limits, with what is known of it.

        Of the `elapsed` seconds since the last one, `seconds` count for the rate limit.
        """
        transfer = state.transfer and state.transfer.after(elapsed, self.settings.transfer_time)
        aim = None
        if state.mode is Mode.MANUAL:
            held = self.model.inputs.center if state.command is None else state.command
            wanted = held if state.manual_input is None else state.manual_input
            changes, done, why = _WITHOUT_LAW, NO_COMMAND, verdict.fault
        else:
            supervisor, target, result = self._choose(
                state, verdict, measured.outside, time_ns, spacing)
            state = self._supervised(state, supervisor, verdict, measured.outside, time_ns)
            changes, wanted, done = self._act(state, result, transfer)
            why = state.supervisor.reason
            aim = None if target is None else self._aim(state, target)
            if target is not None and not self._best.controls_all:
                changes = {**changes, 'target': _kept(np.concatenate((
                    self.model.states.to_physical(target.x),
                    self.model.inputs.to_physical(target.u))))}
        limited = limit(self.settings.limits, wanted, state.command, seconds)
        done = amended(
            done, at_range=done.at_range or limited.at_range, at_rate=limited.at_rate,
            outside=self.model.inputs.violation(limited.u))
        return amended(state, **changes, command=limited.u, commanded_ns=commanded_ns), (
            limited.u), self._report(state, why, measured, aim, done)

    def _aim(self, state: State, target: Target) -> TargetReport | None:
        """Return what is reported of the target of a law."""
        active = state.setpoint.active
        if active is None:
            return None
        return TargetReport(active, self.controlled, self.model, target)

    def _choose(self, state: State, verdict: Verdict, outside: float, time_ns: int,
                spacing: float) -> tuple[Supervisor, Target | None, LawResult | None]:
        """Find the level that acts; also give target and result of the last law tried, if any."""
        settings, estimating = self.settings.supervisor, self._estimating
        if verdict.fault is not None:
            requested = Requested(HOLD, verdict.fault, passing=True)
        else:
            requested = self._usable(state.supervisor.allowed(settings, outside, self._ranges))
        target, result = None, None
        while True:
            supervisor = state.supervisor.at(settings, requested, time_ns)
            level = self.levels.get(supervisor.level or '')
            if level is None or state.estimate is None or state.setpoint.active is None:
                return supervisor, target, result
            estimate = estimating.rebase(state.estimate, estimating.level(state), level)
            assert estimate is not None
            memory = state.law_memory if state.law == level.name else None
            target, result = level.compute(
                state.setpoint.active, estimate, self.settings.limits, memory, spacing,
                state.target, self.settings.deadline, _own_share(state))
            below = settings.below(level.name)
            if result.failure is not None:
                why = reason(Code.LAW_FAILED, level=level.name, cause=result.failure)
            # a poor law is better than none
            elif below in self.levels and level.lost(estimate, target):
                why = reason(Code.LOST_HERE, level=level.name)
            else:
                return supervisor, target, result
            requested = Requested(below, why, result.passing)

    def _usable(self, requested: Requested) -> Requested:
        """Pass over levels whose laws can never act."""
        settings = self.settings.supervisor
        while (level := self.levels.get(requested.level)) and (why := level.unusable) is not None:
            requested = Requested(settings.below(level.name), reason(
                Code.LAW_FAILED, level=level.name, cause=why))
        return requested

    def _supervised(self, state: State, supervisor: Supervisor, verdict: Verdict,
                    outside: float, time_ns: int) -> State:
        """Take over the supervisor's new state."""
        way_back = self._way_back(state, supervisor, verdict, outside, time_ns)
        if way_back is state.way_back and (
                supervisor is state.supervisor or supervisor == state.supervisor):
            return state
        estimating, before = self._estimating, self._estimating.level(state)
        state = amended(state, supervisor=supervisor, way_back=way_back)
        now = estimating.level(state)
        if now is not before:
            state = amended(state, estimate=estimating.rebase(state.estimate, before, now))
        return state

    def _act(self, state: State, result: LawResult | None, transfer: Transfer | None
             ) -> tuple[Mapping[str, object], Array, CommandReport]:
        """Return what changes of the state, and the command before limits with its report."""
        level, command = state.supervisor.level, state.command
        held = self.model.inputs.center if command is None else command
        if result is None or result.u is None:
            done = NO_COMMAND if result is None else CommandReport(
                amended(result.figures, form=''), at_range=result.clipped, plan=result.plan)
            if level == SAFE:
                share = 0.0 if state.way_back is None else state.way_back.share
                if not share:
                    return _WITHOUT_LAW, self.safe_input, done
                wanted = self.safe_input + share * (self._nominal_input - self.safe_input)
                return _WITHOUT_LAW, wanted, amended(done, way_back=share)
            passing = state.supervisor.resumes is not None
            return {} if passing else _LAW_ENDS, held, done
        if state.law != level and command is not None and self.settings.transfer_time:
            # somebody else has commanded so far
            transfer = shifted(None, held - result.u)
        offset = None if transfer is None else transfer.offset
        done = CommandReport(result.figures, offset, at_range=result.clipped, plan=result.plan)
        changes = {'law': level, 'law_input': result.u, 'law_memory': result.memory,
                   'transfer': transfer}
        return changes, result.u if offset is None else result.u + offset, done

    def _way_back(self, state: State, supervisor: Supervisor, verdict: Verdict, outside: float,
                  time_ns: int) -> WayBack | None:
        """Return how far the plant has come back where the safe input keeps it outside."""
        if supervisor.level != SAFE or verdict.fault is not None or verdict.accepted is None:
            return None
        if outside > 0.0 and not leads_home(
                self.model, self._estimating.position(state.estimate, verdict.accepted.value),
                self.safe_input,
                self._nominal_input):
            return None
        if state.way_back is not None:
            return state.way_back.moved(outside, time_ns, self.settings.supervisor.recovery_time)
        # where laws failed, or one may act soon, it is not the distance that keeps them off
        kept_out = supervisor.bad_since_ns is None and supervisor.better_since_ns is None
        return WayBack(outside, outside, time_ns) if kept_out and outside > 0.0 else None

    def _outside(self, known: Estimate | None, y: Array) -> float:
        """Return how far a measurement is from the training data; NaN when it is none."""
        try:
            return self.model.distance(
                self._estimating.position(known, y)) if finite(y) else np.nan
        except np.linalg.LinAlgError:
            return np.nan

    def _report(self, state: State, why: Reason | None,
                measured: MeasurementReport = NOTHING_MEASURED, target: TargetReport | None = None,
                command: CommandReport = NO_COMMAND) -> Report:
        """Return what is known; of the target where it is, if there is no law."""
        active = state.setpoint.active
        if target is None and active is not None:
            target = TargetReport(active, self.controlled, self.model)
        levels, manual = self.settings.supervisor, state.mode is Mode.MANUAL
        depth = len(levels.order) if manual else levels.depth(state.supervisor.level)
        known = None if state.estimate is None else EstimateReport(
            state.estimate, self._estimating.level(state).estimator)
        return Report(state.mode, MANUAL if manual else levels.order[depth], depth, why, measured,
                      known, target, command)


def _passed(state: State, time_ns: int, elapsed: float) -> tuple[State, float, int]:
    """Return the state with its usual interval, the seconds that count, and what was missed."""
    if state.time_ns is None or not elapsed > 0.0:
        return state, 0.0, 0
    since_ns = state.time_ns
    if state.former_ns is not None and since_ns < state.former_ns < time_ns:
        # two sources would count each other's time, but for this
        since_ns = state.former_ns
    since = (time_ns - since_ns) / NANOSECONDS
    missed = 0 if math.isinf(state.interval) else max(0, round(since / state.interval) - 1)
    # the plant stood under the old command all through a gap
    seconds = min(since, 2.0 * state.interval)
    # a burst of measurements does not make the next regular one a gap
    usual = 0.0 if math.isinf(state.interval) else 0.5 * state.interval
    return (amended(state, interval=max(seconds, usual)), min(seconds, elapsed), missed)


def _spacing(state: State) -> float:
    """Return the usual seconds between measurements; 0 before the second."""
    return 0.0 if math.isinf(state.interval) else state.interval


def _own_share(state: State) -> Array | None:
    """Return the last command (n_u,) without what a change of law still added; None for none."""
    if state.command is None or state.transfer is None:
        return state.command
    return state.command - state.transfer.offset


def _afresh(state: State) -> State:
    """Return the state after the clock was set back: what was timed by it has lost its meaning."""
    supervisor = amended(state.supervisor, bad_since_ns=None, better_since_ns=None)
    newest_ns = state.time_ns if state.former_ns is None or state.time_ns is None else max(
        state.time_ns, state.former_ns)
    return amended(state, time_ns=None, former_ns=newest_ns, commanded_ns=None, accepted=None,
                   supervisor=supervisor, way_back=None,
                   setpoint=amended(state.setpoint, scheduled=()))


def _unmeasured(why: Reason | None) -> Reason | None:
    """Return the reason of a hold for want of measurements, which lasts; else None."""
    while why is not None and why.code is Code.HELD_TOO_LONG:
        why = why.cause
    return why if why is not None and why.code in UNMEASURED else None


def _kept(value: Array) -> Array:
    """Return a copy that nobody can change."""
    copy = np.array(value, dtype=np.float64)
    copy.setflags(write=False)
    return copy
