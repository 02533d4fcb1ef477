# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""From measurements to an estimate: which are believed, and what is known between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.limits import finite
from koopman_ros.control.observer import Estimate, Observer
from koopman_ros.control.sensor import judge, Sensed, Verdict
from koopman_ros.control.setpoint import NANOSECONDS, Show
from koopman_ros.control.state import amended, Settings, State
from koopman_ros.lifting import LiftedModel

Array = NDArray[np.float64]

# After so many time constants without a measurement that is believed the state is not known.
_LOST = 2.0
# So many intervals between measurements are a gap.
_GAP = 1.5


@dataclass(frozen=True)
class Estimator:
    """
    The disturbance observer behind the measurement watchdog.

    While the linear law is in force its model takes the learned one's place, and the disturbance
    makes up for the difference, so that the plant's rate stays as believed.

    :param model: the lift.
    :param settings: the tuning.
    :param show: how values of the state are written in reasons.
    """

    model: LiftedModel
    settings: Settings
    show: Show

    @cached_property
    def _observers(self) -> tuple[Observer, Observer]:
        bound = self.settings.max_disturbance / float(np.max(self.model.inputs.scale))
        bandwidth = self.settings.observer_bandwidth
        return (Observer(self.model, bandwidth, bound),
                Observer(self.model.linearised, bandwidth, bound))

    def observer(self, linear: bool) -> Observer:
        """Return the observer with the linear model or the learned one; they share their units."""
        return self._observers[linear]

    def in_force(self, state: State, acting: Array | None = None) -> tuple[Array, bool]:
        """
        Return the input that has acted since the last command, as far as it is known.

        That is the command, unless a measurement of the input says that it was not reached: at
        a limit of the actuator, or behind its lag, nothing may wind up. Differences below
        `input_tolerance` count for nothing, since a biased measurement of the input would bring
        its bias into the loop.

        :param acting: (n_u,) measured, in input units, or None.
        :return: (n_u,) in scaled deviations, and whether it follows the command.
        """
        if state.command is None:
            return np.zeros(self.model.n_u), True
        u, tolerance = state.command, self.settings.input_tolerance
        if acting is not None and finite(acting):
            u = np.minimum(np.maximum(u, acting - tolerance), acting + tolerance)
        return self.model.inputs.to_deviation(u), bool((u == state.command).all())

    def observe(self, state: State, x: Array, time_ns: int, elapsed: float, u: Array
                ) -> tuple[State, Verdict, Array | None]:
        """
        Judge a measurement and take it into account.

        :param state: before it.
        :param x: (n_x,) measured, in state units.
        :param time_ns: its stamp.
        :param elapsed: seconds since the last command.
        :param u: (n_u,) what has acted since then, in scaled deviations.
        :return: the state with sensor, time and estimate, what became of the measurement, and
            what was expected of it in state units, None when nothing was.
        """
        before, sensed = state.estimate, state.sensed
        predicted = self.coast(state, elapsed, u).estimate
        w = np.zeros(self.model.n_x) if before is None else before.w

        def motion(then: Sensed) -> Array:
            if self._far_out(x) or state.way_back is not None:
                # what the model says of its motion is worth nothing; under the safe input even a
                # plant that it does not expect to may rest there
                return np.zeros_like(x)
            frozen = None if before is None else Estimate(before.x, then.w)
            moved = self.coast(amended(state, estimate=frozen), elapsed, u).estimate
            if before is None or moved is None:
                return np.zeros_like(x)
            return (moved.x - before.x) * self.model.states.scale

        verdict = judge(self.settings.sensor, self.model.states, sensed, x, time_ns, w, motion,
                        self.show)
        expected = None if predicted is None else self.model.states.to_physical(predicted.x)
        if not verdict.fault:
            predicted = self._corrected(state, predicted, verdict, x, time_ns, elapsed)
        elif verdict.frozen and predicted is not None and sensed is not None:
            # what the observer made of a sensor that does not move is no disturbance
            predicted = Estimate(predicted.x, sensed.w)
        return (amended(state, sensed=verdict.sensed, time_ns=time_ns, estimate=predicted),
                verdict, expected)

    def _corrected(self, state: State, predicted: Estimate | None, verdict: Verdict, x: Array,
                   time_ns: int, elapsed: float) -> Estimate:
        """Return the estimate with a measurement that is believed."""
        xi = self.model.states.to_deviation(x)
        observer = self.observer(state.linear)
        if not observer.bandwidth > 0.0:
            return Estimate(xi, np.zeros_like(xi))
        if predicted is None:
            if state.command is None:
                return Estimate(xi, np.zeros_like(xi))
            # taken over from somebody who, it is supposed, held the plant where it is
            return observer.at_rest(xi, self.model.inputs.to_deviation(state.command))
        afresh = (
            verdict.moved or not elapsed > 0.0
            or self._lost(state, time_ns)
            # out there the model's prediction is worth nothing
            or self._far_out(x))
        return Estimate(xi, predicted.w) if afresh else observer.correct(predicted, xi, elapsed)

    def _far_out(self, x: Array) -> bool:
        """Tell whether not even the linear law is to act at a state (n_x,) in state units."""
        return self.model.distance(x) > self.settings.ladder.linear_margin

    def _lost(self, state: State, time_ns: int) -> bool:
        """Tell whether no measurement was believed for so long that the state is not known."""
        if state.sensed is None:
            return False
        seconds = (time_ns - state.sensed.time_ns) / NANOSECONDS
        # where measurements are always that rare, they are all there is
        return seconds * self.settings.observer_bandwidth > _LOST and (
            seconds > _GAP * state.interval)

    def coast(self, state: State, elapsed: float, u: Array) -> State:
        """
        Carry the estimate forward without a measurement.

        :param elapsed: seconds since the last command.
        :param u: (n_u,) what has acted since then, in scaled deviations.
        """
        if state.estimate is None or state.command is None or not elapsed > 0.0:
            return state
        predicted = self.observer(state.linear).predict(state.estimate, u, elapsed)
        if predicted is None or not finite(predicted.x):
            # after so long, or from so far out, nothing is known; the disturbance is kept
            return state
        return amended(state, estimate=predicted)

    def rebase(self, estimate: Estimate | None, was_linear: bool, linear: bool
               ) -> Estimate | None:
        """Carry an estimate over from the learned model to the linear one, or back."""
        if estimate is None or was_linear == linear or not self.settings.observer_bandwidth > 0.0:
            return estimate
        return self.observer(linear).rebased(
            estimate, self.observer(was_linear).model.drift(estimate.x))

    def inherit(self, predecessor: Estimator, state: State) -> State:
        """Carry an estimate over from other settings or another model."""
        estimate, old, new = state.estimate, predecessor.model, self.model
        if estimate is None:
            return state
        if not self.settings.observer_bandwidth > 0.0:
            estimate = Estimate(estimate.x, np.zeros_like(estimate.w))
        if old is new:
            return amended(state, estimate=estimate)
        x = old.states.to_physical(estimate.x)
        # the rates that the old model believed, per second, which all models share
        believed = estimate.w + predecessor.observer(state.linear).model.drift(estimate.x) + (
            old.B @ _command(old, state))
        factor = (old.states.scale / old.seconds_per_time_unit
                  / (new.states.scale / new.seconds_per_time_unit))
        moved = Estimate(new.states.to_deviation(x),
                         factor * believed - new.B @ _command(new, state))
        if self.settings.observer_bandwidth > 0.0:
            moved = self.observer(state.linear).rebased(moved, np.zeros_like(moved.w))
        else:
            moved = Estimate(moved.x, np.zeros_like(moved.w))
        # what it holds of the disturbance is in the old model's units, and distances from its data
        return amended(state, estimate=moved, sensed=None, way_back=None)


def _command(model: LiftedModel, state: State) -> Array:
    """Return the command in force in a model's scaled deviations; the nominal one at first."""
    if state.command is None:
        return np.zeros(model.n_u)
    return model.inputs.to_deviation(state.command)
