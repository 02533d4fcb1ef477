# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control step: one pure function of state, measurement and time, replayable bit for bit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.choice import LawChoice
from koopman_ros.control.estimation import Estimator
from koopman_ros.control.ladder import Rung, Standing
from koopman_ros.control.laws import Weights
from koopman_ros.control.limits import finite, limit
from koopman_ros.control.observer import equivalent_bias, Estimate
from koopman_ros.control.sensor import Verdict
from koopman_ros.control.setpoint import NANOSECONDS
from koopman_ros.control.state import amended, Mode, Report, Settings, State
from koopman_ros.control.transfer import Transfer
from koopman_ros.control.way_back import leads_home, Rest, rest_under, WayBack
from koopman_ros.lifting import LiftedModel

Array = NDArray[np.float64]


# A measurement earlier than the last by no more than this is out of order; one that is earlier
# still means that time itself was set back.
LATE_NANOSECONDS = NANOSECONDS


@dataclass(frozen=True)
class Controller:
    """
    A lifted model with its tuning; every method is pure and returns a new state.

    :param model: the lift.
    :param settings: the tuning.
    :param show: how values of the state are written in reasons.
    """

    model: LiftedModel
    settings: Settings
    show: setpoints.Show = setpoints.in_state_units

    @cached_property
    def _estimator(self) -> Estimator:
        return Estimator(self.model, self.settings, self.show)

    @cached_property
    def _laws(self) -> LawChoice:
        return LawChoice(self._estimator)

    @property
    def weights(self) -> Weights:
        """The cost in the model's scaled deviations."""
        return self._laws.weights

    @cached_property
    def safe_input(self) -> Array:
        """What is commanded when nothing else can be, (n_u,) in input units."""
        given = self.settings.safe_input
        return _kept(self.settings.limits.within(
            self.model.inputs.center if given is None else given))

    @cached_property
    def _nominal_input(self) -> Array:
        return _kept(self.settings.limits.within(self.model.inputs.center))

    @cached_property
    def rest(self) -> Rest:
        """Where the safe input leads the plant, as far as the model tells."""
        return rest_under(self.model, self.safe_input, self.settings.ladder.return_margin)

    # What the operator asks for.

    def request_setpoint(self, state: State, value: Array, effective_ns: int = 0
                         ) -> tuple[State, str]:
        """
        Ask for a set-point, at once or from a later time on.

        :param state: the present state.
        :param value: (n_x,) in state units.
        :param effective_ns: stamp from which it holds; see :func:`setpoint.request`.
        :return: the new state with an empty string, or the old one with the reason of refusal.
        """
        reason = setpoints.refusal(self.model, value, self.show)
        if reason:
            return state, reason
        if (len(state.setpoint.scheduled) >= setpoints.MAX_SCHEDULED
                and setpoints.lies_ahead(effective_ns, state.time_ns)):
            return state, (f'{setpoints.MAX_SCHEDULED} set-points are scheduled already: wait '
                           'until some have taken effect, or send this one with stamp 0')
        return amended(state, setpoint=setpoints.request(
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
        return amended(state, manual_input=_kept(value)), ''

    def set_mode(self, state: State, mode: Mode) -> State:
        """
        Hand over between operator and law, without a bump.

        Manual mode starts from the last command, and so does automatic mode: what its law asks
        for beside that fades in.
        """
        if mode is state.mode:
            return state
        return amended(state, mode=mode, manual_input=None, standing=Standing(), way_back=None,
                       estimate=self._estimator.rebase(state.estimate, state.linear, False))

    # What happens to the controller itself.

    def take_over(self, state: State, command: Array) -> State:
        """
        Start from the input that is in force already, as after a restart.

        :param state: before its first command; afterwards nothing is changed.
        :param command: (n_u,) in input units; ignored when not finite.
        """
        if state.command is not None or not np.all(np.isfinite(command)):
            return state
        return amended(state, command=_kept(self.settings.limits.within(command)))

    def succeed(self, predecessor: Controller, state: State) -> State:
        """
        Take the place of a controller with other settings or another model, without a bump.

        What the two laws ask for in the present state differs by an offset that fades; what is
        believed of the plant's rate stays.

        :param predecessor: that has been in force.
        :param state: the state it left.
        :return: the state in this controller's units.
        """
        state = self._estimator.inherit(predecessor._estimator, state)
        if state.law_in_force is None or state.law_input is None or state.estimate is None:
            return state
        now = self._laws.attempt(state, state.law_in_force, state.estimate)
        if now.u is None:
            return state
        return amended(state, law_input=now.u, transfer=_shifted(
            state.transfer, state.law_input - now.u))

    def try_law(self, x: Array, setpoint: Array) -> str:
        """
        Say why the learned law cannot act at a state (n_x,) towards a set-point (n_x,).

        :return: an empty string when it can.
        """
        state = amended(State(), setpoint=setpoints.Setpoint(setpoint, setpoint))
        estimate = Estimate(self.model.states.to_deviation(x), np.zeros(self.model.n_x))
        with np.errstate(all='ignore'):
            return self._laws.attempt(state, Rung.LEARNED, estimate).problem

    # Steps.

    def step(self, state: State, measurement: Array, time_ns: int, acting: Array | None = None
             ) -> tuple[State, Array, Report]:
        """
        Answer one measurement.

        A repeated stamp and one out of order, earlier by at most a second, return the last
        command again; a still earlier stamp starts time afresh. After a gap in the measurements
        ramp and rate limit count twice the interval before it, not the gap.

        :param state: as returned by the step before.
        :param measurement: (n_x,) measured state, in state units.
        :param time_ns: its stamp.
        :param acting: (n_u,) the input that was found in force then, where it is measured; see
            :meth:`Estimator.in_force`.
        :return: the new state, the command (n_u,) in input units, always finite and within the
            limits, and the report.
        """
        ahead = 1 if state.time_ns is None else time_ns - state.time_ns
        if state.command is not None and -LATE_NANOSECONDS <= ahead <= 0:
            report = self._report(state, state.standing.rung, state.standing.reason)
            return state, state.command, amended(
                report, outside=self._outside(measurement), late=ahead < 0,
                clock_stood_still=ahead == 0)
        back = ahead < 0
        if back:
            state = _afresh(state)
        since_ns = state.commanded_ns
        if since_ns is not None and since_ns > time_ns + LATE_NANOSECONDS:
            # what was commanded in silence was timed by a clock that these stamps do not follow
            since_ns = state.time_ns
        elapsed = 0.0 if since_ns is None else max(0.0, (time_ns - since_ns) / NANOSECONDS)
        # neither a gap nor a burst is the spacing of the samples, nor the first of them
        spacing = 0.0 if math.isinf(state.interval) else min(state.interval, elapsed)
        state, seconds, missed = _passed(state, time_ns, elapsed)
        # a measurement of 1e300 may overflow on its way; the result is checked and limited
        with np.errstate(all='ignore'):
            u, follows = self._estimator.in_force(state, acting)
            state, verdict, predicted = self._estimator.observe(
                state, measurement, time_ns, elapsed, u)
            if not verdict.fault:
                state = amended(state, setpoint=setpoints.advance(
                    state.setpoint, measurement, self.model, self.settings.setpoint_ramp,
                    time_ns, seconds, self.settings.setpoint_filter))
            outside = self._outside(measurement)
            state, wanted, report = self._wanted(
                state, verdict, outside, time_ns, elapsed, spacing)
        # without elapsed time the rate limit holds the last command
        limited = limit(self.settings.limits, wanted, state.command, seconds)
        state = amended(state, command=limited.u, commanded_ns=time_ns)
        return state, limited.u, amended(
            report, outside=outside, at_range=report.at_range or limited.at_range,
            at_rate=limited.at_rate,
            input_outside=self.model.inputs.violation(limited.u), missed=missed,
            predicted=predicted, clock_went_back=back, follows=follows,
            believed=not verdict.fault)

    def watch(self, state: State, time_ns: int) -> tuple[State, Array | None, Report]:
        """
        Answer that nothing has been measured: hold the command, later go to the safe input.

        :param state: as returned by the step before.
        :param time_ns: up to which nothing came, in the time of the measurements' stamps.
        :return: as :meth:`step`; the command is None before the first.
        """
        since_ns = state.commanded_ns
        if state.command is None or state.time_ns is None or since_ns is None:
            return state, None, Report(state.mode)
        elapsed = max(0.0, (time_ns - since_ns) / NANOSECONDS)
        with np.errstate(all='ignore'):
            state = self._estimator.coast(state, elapsed, self._estimator.in_force(state)[0])
            state, wanted, report = self._wanted(state, Verdict(
                state.sensed, 'no measurement arrives: check sensor and plant'),
                np.nan, time_ns, elapsed)
        limited = limit(self.settings.limits, wanted, state.command, elapsed)
        state = amended(state, command=limited.u, commanded_ns=max(time_ns, since_ns))
        return state, limited.u, amended(report, at_range=limited.at_range,
                                         at_rate=limited.at_rate)

    def equivalent_bias(self, state: State) -> Array:
        """
        Return the error (n_x,) of the sensor that would explain the disturbance, in state units.

        NaN where nothing is known, or no error would.
        """
        if state.estimate is None:
            return np.full(self.model.n_x, np.nan)
        model = self._estimator.observer(state.linear).model
        return equivalent_bias(model, state.estimate) * self.model.states.scale

    def _wanted(self, state: State, verdict: Verdict, outside: float, time_ns: int,
                elapsed: float, spacing: float = 0.0) -> tuple[State, Array, Report]:
        """Return the command before limits with what is known of it."""
        held = self.model.inputs.center if state.command is None else state.command
        transfer = state.transfer and state.transfer.after(elapsed, self.settings.transfer_time)
        if state.mode is Mode.MANUAL:
            wanted = held if state.manual_input is None else state.manual_input
            state = amended(state, law_in_force=None, law_input=None, transfer=None)
            return state, wanted, self._report(state, Rung.LEARNED, verdict.fault)
        standing, attempt = self._laws.choose(state, verdict, outside, time_ns, spacing)
        was_linear = state.linear
        state = amended(state, standing=standing, way_back=self._way_back(
            state, standing, verdict, outside, time_ns))
        if state.linear != was_linear:
            state = amended(state, estimate=self._estimator.rebase(
                state.estimate, was_linear, state.linear))
        report = self._report(state, standing.rung, standing.reason)
        if attempt is not None and attempt.found is not None:
            riccati = attempt.found.riccati
            report = amended(report, residual=riccati.residual, gain=riccati.gain,
                             growth=attempt.growth, mismatch=attempt.target.mismatch,
                             law=None if attempt.u is None else attempt.found.law,
                             at_range=attempt.clipped)
        if attempt is None or attempt.u is None or attempt.found is None:
            if standing.rung is Rung.SAFE:
                state = amended(state, law_in_force=None, law_input=None, transfer=None)
                share = 0.0 if state.way_back is None else state.way_back.share
                if not share:
                    return state, self.safe_input, report
                wanted = self.safe_input + share * (self._nominal_input - self.safe_input)
                return state, wanted, amended(report, way_back=share)
            passing = standing.resumes is not None
            return (state if passing else amended(state, law_in_force=None, law_input=None),
                    held, report)
        if state.law_in_force is not standing.rung and state.command is not None:
            # somebody else has commanded so far
            transfer = _shifted(None, held - attempt.u)
        state = amended(state, law_in_force=standing.rung, law_input=attempt.u,
                        transfer=transfer)
        if transfer is None:
            return state, attempt.u, report
        return state, attempt.u + transfer.offset, amended(report, transfer=transfer.offset)

    def _way_back(self, state: State, standing: Standing, verdict: Verdict, outside: float,
                  time_ns: int) -> WayBack | None:
        """Return how far the plant has come back where the safe input keeps it outside."""
        if standing.rung is not Rung.SAFE or verdict.fault or verdict.sensed is None:
            return None
        if outside > 0.0 and not leads_home(self.model, verdict.sensed.value, self.safe_input,
                                            self._nominal_input):
            return None
        if state.way_back is not None:
            return state.way_back.moved(outside, time_ns, self.settings.ladder.recovery_time)
        # where laws failed, or one may act soon, it is not the distance that keeps them off
        kept_out = standing.bad_since_ns is None and standing.better_since_ns is None
        return WayBack(outside, outside, time_ns) if kept_out and outside > 0.0 else None

    def _outside(self, x: Array) -> float:
        """Return how far a measurement is from the training data; NaN when it is none."""
        return self.model.distance(x) if finite(x) else np.nan

    def _report(self, state: State, rung: Rung, reason: str) -> Report:
        """Return what is known without a law."""
        estimate, active = state.estimate, state.setpoint.active
        outside = np.nan if active is None else self.model.states.violation(active)
        if estimate is None:
            return Report(state.mode, rung, reason, active_setpoint=active,
                          setpoint_outside=outside)
        observer = self._estimator.observer(state.linear)
        disturbance = observer.as_input(estimate.w)
        return Report(
            state.mode, rung, reason, active_setpoint=active, setpoint_outside=outside,
            estimate=self.model.states.to_physical(estimate.x),
            disturbance=disturbance * self.model.inputs.scale,
            at_bound=math.sqrt(disturbance.dot(disturbance)) >= (
                observer.max_disturbance * (1.0 - 1e-9)))


def _passed(state: State, time_ns: int, elapsed: float) -> tuple[State, float, int]:
    """
    Count the time since the last command.

    :return: the state with its usual interval, the seconds that count for ramp and rate limit,
        and the measurements missed.
    """
    if state.time_ns is None or not elapsed > 0.0:
        return state, 0.0, 0
    since = (time_ns - state.time_ns) / NANOSECONDS
    missed = 0 if math.isinf(state.interval) else max(0, round(since / state.interval) - 1)
    # the plant stood under the old command all through a gap
    seconds = min(since, 2.0 * state.interval)
    # a burst of measurements does not make the next regular one a gap
    usual = 0.0 if math.isinf(state.interval) else 0.5 * state.interval
    return (amended(state, interval=max(seconds, usual)), min(seconds, elapsed), missed)


def _afresh(state: State) -> State:
    """Return the state after the clock was set back: what was timed by it has lost its meaning."""
    standing = amended(state.standing, bad_since_ns=None, better_since_ns=None)
    return amended(state, time_ns=None, commanded_ns=None, sensed=None, standing=standing,
                   way_back=None, setpoint=amended(state.setpoint, scheduled=()))


def _shifted(transfer: Transfer | None, by: Array) -> Transfer:
    return Transfer(by, by) if transfer is None else transfer.shifted(by)


def _kept(value: Array) -> Array:
    """Return a copy that nobody can change."""
    copy = np.array(value, dtype=np.float64)
    copy.setflags(write=False)
    return copy
