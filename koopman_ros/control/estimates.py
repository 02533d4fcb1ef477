# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""State estimation in the loop: sensor checks, the estimator of the acting level, hand-over."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from koopman_ros.control.fallback import FallbackLevel
from koopman_ros.control.state import State
from koopman_ros.control.supervisor import Supervisor
from koopman_ros.control.timing import StepTime
from koopman_ros.core.arrays import all_finite, Array
from koopman_ros.core.signals import Outputs
from koopman_ros.core.status import reason, StatusCode
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation import (
    Analysis,
    check,
    check_disturbances,
    Estimate,
    Estimator,
    History,
    Instant,
    MeasuredDisturbances,
    Pieces,
    Standstill,
    Verdict,
    with_applied,
)
from koopman_ros.model import LiftedModel
from koopman_ros.model.steady_state import held_at
from koopman_ros.tuning import Tuning


class Observation(NamedTuple):
    """A measurement as it was taken into account."""

    verdict: Verdict  #: whether it is accepted
    expected: Array | None  #: (n_y,) its prediction, or None
    x: Array  #: (n_x,) state that it is taken for, in state units
    outside: float  #: its distance from the training data, in half-ranges


UNCERTAIN = 1  #: quality of a measurement; better is 0, worse are bad


@dataclass(frozen=True)
class EstimationSettings:
    """When an estimate starts again, and values where the tuning gives none."""

    #: time constants of the observer without an accepted measurement after which the state is
    #: not known
    lost: float = 2.0
    gap: float = 1.5  #: usual intervals between measurements that are a gap
    #: standard deviation of a late value, as a share of the trained range
    analysis_noise: float = 0.01


@dataclass(frozen=True)
class StateEstimation:
    """
    The estimators of all levels behind the checks of the measurements.

    While another level acts its model takes the better one's place, and the disturbance makes up
    for the difference, so that the plant's estimated rate stays.
    """

    model: LiftedModel  #: the lift
    outputs: Outputs  #: its measured outputs
    tuning: Tuning  #: for these signals
    levels: dict[str, FallbackLevel]  #: by name, best first
    settings: EstimationSettings = EstimationSettings()

    def level(self, supervisor: Supervisor) -> FallbackLevel:
        """Return the level in terms of whose model the estimate is: without a law, the last."""
        name = supervisor.resumes or supervisor.level
        if name is None:
            return next(iter(self.levels.values()))
        found = self.levels.get(name)
        return self.levels[next(reversed(self.levels))] if found is None else found

    @cached_property
    def dead_ns(self) -> tuple[int, ...]:
        """The dead time (n_u,) of each input in ns."""
        return tuple(round(seconds * NANOSECONDS)
                     for seconds in self.tuning.dead_times(self.model).tolist())

    def assumed(self, state: State) -> float:
        """Return the time in s for which assumed inputs, e.g. from before a start, still act."""
        return state.applied.assumed(state.commanded_ns or 0, self.dead_ns)

    def acting(self, state: State, time_ns: int) -> Array:
        """Return the input (n_u,) that acts from a time on, in scaled deviations; 0 at first."""
        if state.command is None:
            return np.zeros(self.model.n_u)
        return self.model.inputs.to_deviation(state.applied.acting(time_ns, self.dead_ns))

    def applied(self, state: State, measured: Array | None = None) -> tuple[State, bool]:
        """
        Take the input into account that has been applied since the last command.

        That is the command, unless a measurement (n_u,) of the input says that it was not
        reached: at a limit of the actuator, or behind its lag, nothing may wind up. Differences
        below `tracking_tolerance` count for nothing: a bias would come into the loop.

        :return: the state, and whether the applied input follows the command.
        """
        command, tolerance = state.command, self.tuning.tracking_tolerance
        if command is None or measured is None or not all_finite(measured):
            return state, True
        u = np.minimum(np.maximum(command, measured - tolerance), measured + tolerance)
        follows = u.tolist() == command.tolist()
        if follows and state.applied.values[-1] is command:
            return state, True
        return state._replace(applied=state.applied.corrected(u)), follows

    def feed_forward(self, state: State) -> Array | None:
        """Return the rate (n_x,) due to the measured disturbances; None without any."""
        return None if state.disturbances is None else (
            self.model.disturbance_rate(state.disturbances.value))

    def disturbed(self, state: State, values: Array | None, ages: Array | None, time_ns: int
                  ) -> State:
        """
        Check measured disturbances (n_d,), which act from the last sample on.

        After a sensor was lost for longer than the time constant of the observer, the change to
        the new value is already part of the estimated disturbance, and is subtracted there.
        """
        signals = self.model.disturbances
        if not signals.names:
            return state
        before = state.disturbances or MeasuredDisturbances(signals.center, (None,) * len(signals))
        values = np.full(len(signals), np.nan) if values is None else values
        found = check_disturbances(
            self.tuning.disturbances, signals, before, values,
            np.where(np.isnan(values), np.inf, 0.0) if ages is None else ages, time_ns)
        state, estimate = state._replace(disturbances=found), state.estimate
        if estimate is None:
            return state
        lost = before.lost_for(signals.names, time_ns) * self.tuning.observer_bandwidth > 1.0
        change = np.where(lost, found.value - before.value, 0.0)
        if not change.any():
            return state
        level = self.level(state.supervisor)
        return state._replace(estimate=level.estimator.transferred(
            estimate, level.model.drift(estimate.x)
            - self.model.disturbance_rate(signals.center + change)))

    def observe(self, state: State, estimator: Estimator, y: Array, time: StepTime,
                quality: tuple[int, ...] | None) -> tuple[State, Observation]:
        """
        Check a measurement (n_y,) and take it into account.

        :param estimator: of the level that acts.
        :param quality: (n_y,) as of :class:`~koopman_ros.control.Measurement`.
        :return: the state with measurement, time and estimate, and the outcome of the measurement.
        """
        before, last, history = state.estimate, state.accepted, state.history
        predicted = self._predict(state, estimator, time)
        x = x_measured = self.position(predicted, y)
        outside, states = self.model.distance(x), self.model.states
        deviation = states.to_deviation(x)
        expected = None if predicted is None else self.outputs.of(states.to_physical(predicted.x))
        w = np.zeros(self.model.n_x) if before is None else before.w

        def travel(then: Standstill) -> Array:
            if before is None or outside > 0.0 or state.recovery is not None:
                # the model hardly predicts its motion; under the safe input even a
                # plant that it does not expect to may rest there
                return np.zeros_like(y)
            assert last is not None
            # from where the model has come to, which it may settle at
            x = states.to_deviation(self.outputs.state(
                last.value + then.travel, states.to_physical(before.x)))
            moved = self._predict(
                state._replace(estimate=replace(before, x=x, w=then.w)), estimator, time)
            assert moved is not None
            return self.outputs.of((moved.x - x) * states.scale)

        bad = [] if quality is None else [
            name for name, level in zip(self.outputs.names, quality, strict=False)
            if level > UNCERTAIN]
        verdict = Verdict(last, reason(StatusCode.BAD_QUALITY, signal=bad[0])) if bad else check(
            self.tuning.sensor, self.outputs, last, y, time.now_ns, w, travel,
            max(self.dead_ns, default=0))
        if verdict.fault is None:
            # restart if the plant, not only the estimate, is outside the training data
            far = outside > 0.0 and self._beyond(outside) and (
                self.outputs.determine_state
                or self._beyond(self.model.distance(self.position(None, y))))
            fresh = (predicted is None or verdict.moved or not time.elapsed > 0.0 or far
                     or self._lost(state, time))
            predicted = self._corrected(
                state, estimator, predicted, deviation, time, fresh, quality)
            if not isinstance(predicted, Estimate):
                raise TypeError(f'the estimator returned {type(predicted).__name__}, '
                                'not Estimate')
            if not self.outputs.determine_state:
                # the measurement has changed the unmeasured states, too
                x = self.position(predicted, y)
                outside = self.model.distance(x)
            if fresh:
                history = History()
        elif (verdict.fault.code is StatusCode.FROZEN and predicted is not None
                and last is not None):
            # the estimate from a frozen sensor is no disturbance
            predicted, history = replace(predicted, w=last.standstill.w), History()
        accepted = verdict.accepted
        if before is None and predicted is not None and accepted is not None:
            # what holds the plant at first is no motion
            accepted = replace(accepted, standstill=replace(accepted.standstill, w=predicted.w))
        now = state._replace(accepted=accepted, time_ns=time.now_ns, estimate=predicted,
                      history=history)
        if self._longest_ns:
            now = self._remembering(
                now, state, time, x_measured if verdict.fault is None else None, quality)
        return now, Observation(verdict, expected, x, outside)

    def _beyond(self, outside: float) -> bool:
        """Whether no law acts at a distance from the training data."""
        return outside > self._farthest

    @cached_property
    def _farthest(self) -> float:
        return max(level.law.margin for level in self.levels.values())

    def position(self, known: Estimate | None, y: Array) -> Array:
        """
        Return the state (n_x,), in state units, that goes with a measurement (n_y,).

        States that it does not determine are those of the estimate, or of a steady state.
        """
        outputs, states = self.outputs, self.model.states
        if outputs.determine_state:
            return outputs.state(y, states.center)
        if known is not None:
            return outputs.state(y, states.to_physical(known.x))
        return self._resting(outputs.state(y, states.center))

    def _resting(self, x: Array) -> Array:
        """Return the steady state with the outputs of a state (n_x,), or that state."""
        measured = np.any(self.outputs.C != 0.0, axis=0)
        if np.count_nonzero(measured) == len(self.outputs.C) and np.isfinite(x).all():
            found = held_at(
                self.model, self.model.states.to_deviation(x), measured, self._farthest)
            if found is not None:
                return self.model.states.to_physical(found)
        return x

    def _corrected(self, state: State, estimator: Estimator, predicted: Estimate | None, xi: Array,
                   time: StepTime, fresh: bool, quality: tuple[int, ...] | None) -> Estimate:
        """
        Return the estimate with a measurement that is accepted.

        :param xi: (n_x,) scaled deviation of the state that the measurement is taken for.
        :param fresh: whether it starts from the measurement, as the prediction is worth nothing.
        """
        if quality is not None:
            estimator = estimator.with_noise(self._factor(quality))
        if predicted is None:
            # the input that acts, it is assumed, held the plant where it is
            return self._started(
                state, xi, None if state.command is None else self.acting(state, time.now_ns))
        return estimator.restart(predicted, xi, None) if fresh else (
            estimator.correct(predicted, xi, time.elapsed))

    def _started(self, state: State, xi: Array, u: Array | None) -> Estimate:
        """Return the first estimate, at a state (n_x,) that (n_u,) inputs are taken to hold."""
        estimator, model = self.level(state.supervisor).estimator, self.model
        if u is not None and model.lagged:
            xi = with_applied(model, xi, u, {
                j: i for j, i in model.lagged.items() if not self.outputs.C[:, i].any()})
        started, forward = estimator.restart(None, xi, u), self.feed_forward(state)
        if forward is None or u is None:
            return started
        # measured disturbances are part of the holding input
        return estimator.transferred(started, estimator.model.drift(started.x) - forward)

    def _factor(self, quality: tuple[int, ...]) -> Array:
        """Return the factor (n_y,) of the noise."""
        return np.where(np.equal(quality, UNCERTAIN), self.tuning.uncertain_noise_factor, 1.0)

    def _remembering(self, now: State, before: State, time: StepTime, x: Array | None = None,
                     quality: tuple[int, ...] | None = None) -> State:
        """Return a state with its estimate in its history, if there may be late values."""
        if now.estimate is None:
            return now
        pieces = () if before.command is None or not time.elapsed > 0.0 else (
            self._pieces(before, time))
        return now._replace(history=now.history.followed_by(
            Instant(time.now_ns, now.estimate, pieces, self.feed_forward(before),
                    None if x is None else self.model.states.to_deviation(x),
                    None if quality is None else self._factor(quality)), self._longest_ns))

    @cached_property
    def _longest_ns(self) -> int:
        return round(float(np.max(self.tuning.analysis_delay)) * NANOSECONDS)

    def predicted(self, state: State, estimator: Estimator, time: StepTime) -> State:
        """Return the state at a time without a measurement, by the estimator of a level."""
        now = state._replace(estimate=self._predict(state, estimator, time))
        return self._remembering(now, state, time) if self._longest_ns else now

    def corrected(self, state: State, index: int, value: float, stamp_ns: int) -> State | None:
        """Return the state corrected by a late value of a state; None if it is too late."""
        states, noise = self.model.states, float(self.tuning.analysis_noise[index])
        x = states.to_physical(np.zeros(len(states)))
        x[index] = value
        history = state.history.corrected(stamp_ns, Analysis(
            index, float(states.to_deviation(x)[index]), noise / float(states.scale[index]) or (
                self.settings.analysis_noise * 2.0 * float(states.half_widths[index]))),
            self.level(state.supervisor).estimator)
        return None if history is None else state._replace(
            history=history, estimate=history.instants[-1].estimate)

    def _lost(self, state: State, time: StepTime) -> bool:
        """Whether the state is unknown, because no measurement was accepted for too long."""
        if state.accepted is None:
            return False
        seconds = (time.now_ns - state.accepted.time_ns) / NANOSECONDS
        # where measurements are always that rare, they are all there is
        return seconds * self.tuning.observer_bandwidth > self.settings.lost and (
            seconds > self.settings.gap * time.interval)

    def _predict(self, state: State, estimator: Estimator, time: StepTime) -> Estimate | None:
        """
        Predict the estimate up to a time without a measurement.

        Where the model does not reach that far, the state is as uncertain as at first, and the
        disturbance is kept.
        """
        if state.estimate is None or state.command is None or not time.elapsed > 0.0:
            return state.estimate
        try:
            predicted = estimator.predict_over(
                state.estimate, self._pieces(state, time),
                None if state.disturbances is None else self.feed_forward(state))
        except np.linalg.LinAlgError:
            predicted = None  # the drift overflows this far outside the training data
        return predicted if predicted is not None and predicted.finite else replace(
            state.estimate, covariance=None)

    def _pieces(self, state: State, time: StepTime) -> Pieces:
        """Return the inputs that acted since the last measurement, with the time of each in s."""
        found: Pieces = ()
        for seconds, u in state.applied.pieces(
                time.now_ns - round(time.elapsed * NANOSECONDS), time.now_ns, self.dead_ns):
            found += (seconds, self.model.inputs.to_deviation(u)),
        return found

    def transfer_estimate(self, estimate: Estimate, before: FallbackLevel,
                          now: FallbackLevel) -> Estimate:
        """Transfer an estimate from the model of one level to that of another."""
        if before.model is now.model or not now.estimator.remembers:
            return estimate
        return now.estimator.transferred(estimate, before.model.drift(estimate.x))

    def take_over(self, predecessor: StateEstimation, state: State) -> State:
        """Carry an estimate over from other settings or another model."""
        estimate, old, new = state.estimate, predecessor.model, self.model
        before = predecessor.feed_forward(state)
        if old.disturbances.names != new.disturbances.names:
            state = state._replace(disturbances=None)
        if estimate is None:
            return state
        now_ns = state.commanded_ns or 0  # the time of the estimate
        estimator = self.level(state.supervisor).estimator
        if not estimator.remembers:
            estimate = Estimate(estimate.x, np.zeros_like(estimate.w))
        if old is new:
            # the level that acts may be gone, and its model with it
            return state._replace(estimate=self.transfer_estimate(
                estimate, predecessor.level(state.supervisor), self.level(state.supervisor)))
        x = old.states.to_physical(estimate.x)
        if old.states.names != new.states.names:
            # the new model has its own estimate of the unmeasured states
            x = self.position(None, predecessor.outputs.of(x))
            return state._replace(accepted=None, recovery=None, estimate=self._started(
                state, new.states.to_deviation(x), self.acting(state, now_ns)))
        # the rates that the old model estimated, per second, which all models share
        former = predecessor.level(state.supervisor).model
        rate = estimate.under(before).w + former.drift(estimate.x) + (
            old.forcing(estimate.x, predecessor.acting(state, now_ns)))
        factor = (old.states.scale / old.seconds_per_time_unit
                  / (new.states.scale / new.seconds_per_time_unit))
        x_new = new.states.to_deviation(x)
        covariance = estimate.covariance
        if covariance is not None:
            change = np.concatenate((old.states.scale / new.states.scale, factor))
            covariance = covariance * change * change[:, None]
        moved = Estimate(
            x_new, factor * rate - new.forcing(x_new, self.acting(state, now_ns)), covariance)
        forward = self.feed_forward(state)
        moved = estimator.transferred(moved, np.zeros_like(moved.w) if forward is None
                                      else -forward)
        # its disturbance is in the old model's units, and distances refer to its data
        return state._replace(estimate=moved, accepted=None, recovery=None)
