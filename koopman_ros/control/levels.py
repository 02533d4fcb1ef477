# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control levels, a law and an estimator each, and what is estimated whichever acts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.control.laws import Figures, Law, LawResult, LAWS, Plan, Tuning, Weights
from koopman_ros.control.laws.base import steady_state_target, Target
from koopman_ros.control.limits import finite, InputLimits
from koopman_ros.control.settings import Settings
from koopman_ros.control.state import State
from koopman_ros.control.target import held_at, partial_target, reachable_target
from koopman_ros.estimation import (
    check,
    Estimate,
    Estimator,
    ESTIMATORS,
    EstimatorTuning,
    FrozenCheck,
    Verdict,
)
from koopman_ros.lifting import Coordinates, LiftedModel
from koopman_ros.plugs import contained, plugged
from koopman_ros.reasons import Code, Reason, reason
from koopman_ros.signals import Outputs
from koopman_ros.units import NANOSECONDS
from koopman_ros.values import amended, record


@dataclass(frozen=True)
class Level:
    """One level."""

    name: str  #: of its law
    law: Law  #: with its model
    estimator: Estimator  #: on the same model
    controlled: tuple[str, ...]  #: (n_c,) names of the states with a set-point
    #: the last set-point, and where it leads undisturbed
    _last: list[Any] = field(default_factory=lambda: [None, None], init=False, compare=False)

    @property
    def model(self) -> LiftedModel:
        """The model of law and estimator."""
        return self.law.model

    @cached_property
    def unusable(self) -> Reason | None:
        """Why its law can never act, which it may say itself; None where it can."""
        try:
            found: Reason | None = getattr(self.law, 'unusable', None)
        except BaseException as error:
            return reason(Code.LAW_RAISED, error=contained(error))
        return found

    @cached_property
    def model_free(self) -> bool:
        """Whether its law goes to the set-point, wherever the model has its steady states."""
        return bool(getattr(self.law, 'model_free', False))

    @cached_property
    def controls_all(self) -> bool:
        """Whether every state has a set-point."""
        return len(self.controlled) == self.model.n_x

    @cached_property
    def controlled_states(self) -> Coordinates:
        """The states with a set-point."""
        return self.model.states.only(self.controlled)

    @cached_property
    def _indices(self) -> NDArray[np.intp]:
        return np.array([self.model.states.names.index(name) for name in self.controlled],
                        dtype=np.intp)

    def controlled_of(self, x: Array) -> Array:
        """Return the part (n_c,) of a state (n_x,) that has a set-point."""
        return x if self.controls_all else x[self._indices]

    def controlling(self, names: tuple[str, ...]) -> Level:
        """Return the level with set-points for these states alone."""
        return Level(self.name, self.law, self.estimator, names)

    def target(self, setpoint: Array, w: Array, limits: InputLimits, start: Array | None
               ) -> Target | None:
        """
        Find where a set-point (n_c,), in state units, leads under a disturbance (n_x,).

        :param start: (n_x + n_u,) where a steady state is looked for, in units; the nominal point
            by default.
        :return: None where there is no steady state.
        """
        model = self.model
        if self.model_free:
            x = np.zeros(model.n_x)
            x[self._indices] = self.controlled_states.to_deviation(setpoint)
            none = np.zeros(model.n_x)
            return Target(x, np.zeros(model.n_z), none, np.zeros(model.n_u), none, 0.0)
        if self.controls_all:
            known = self.reference(setpoint)
            return steady_state_target(model, known.x, w, known=known)
        n, inputs = model.n_x, model.inputs
        y = np.zeros(n + model.n_u) if start is None else np.concatenate(
            (model.states.to_deviation(start[:n]), inputs.to_deviation(start[n:])))
        return partial_target(
            model, self._indices, self.controlled_states.to_deviation(setpoint), w,
            inputs.to_deviation(limits.lower), inputs.to_deviation(limits.upper), y)

    def reference(self, setpoint: Array) -> Target:
        """
        Return the target of a set-point (n_x,) for all states, without a disturbance.

        The last one is kept; what comes out does not depend on it.
        """
        asked, known = self._last
        if known is None or asked is not setpoint:
            known = steady_state_target(
                self.model, self.model.states.to_deviation(setpoint), known=known)
            self._last[:] = setpoint, known
        return known

    def compute(self, setpoint: Array, estimate: Estimate, limits: InputLimits, memory: object,
                interval: float, start: Array | None, deadline: float = math.inf,
                last: Array | None = None) -> tuple[Target | None, LawResult]:
        """
        Evaluate the law towards a target, see :meth:`target`, for an estimate of its model.

        Whatever it raises is a failure, and so is a result that is not a law's.
        """
        target = None
        try:
            target = self.target(setpoint, estimate.w, limits, start)
            if target is None:
                return None, LawResult(None, reason(Code.NO_STEADY_STATE))
            target = self.within_reach(target, estimate.w, limits)
            result = self.law.compute(estimate, target, limits, memory, interval, deadline, last)
            return target, self._checked(result)
        except BaseException as error:
            return target, LawResult(None, reason(Code.LAW_RAISED, error=contained(error)))

    def _checked(self, result: LawResult) -> LawResult:
        """Return a law's result if its input (n_u,), or its failure, can be used."""
        for value, kind in ((result, LawResult), (result.figures, Figures),
                            (result.plan, Plan | None), (result.failure, Reason | None)):
            if not isinstance(value, kind):
                raise TypeError(f'it returned {type(value).__name__}, where {kind} is expected')
        result = amended(result, clipped=bool(result.clipped), passing=bool(result.passing))
        if result.failure is not None:
            return amended(result, u=None)
        u = np.asarray(result.u, dtype=np.float64)
        if u.shape != (self.model.n_u,):
            raise ValueError(f'it returned an input of shape {u.shape}, not ({self.model.n_u},)')
        return amended(result, u=u) if finite(u) else LawResult(
            None, reason(Code.COMMAND_NOT_FINITE))

    def within_reach(self, target: Target, w: Array, limits: InputLimits) -> Target:
        """Return the target, or what is nearest to it where the inputs do not suffice."""
        model = self.model
        # a single one at its end goes there by itself
        if self.model_free or model.n_u == 1 or len(self.controlled) > model.n_u:
            return target
        u = model.inputs.to_physical(target.u)
        if ((u >= limits.lower) & (u <= limits.upper)).all():
            return target
        return reachable_target(
            model, self._indices, target, w, model.inputs.to_deviation(limits.lower),
            model.inputs.to_deviation(limits.upper)) or target

    def lost(self, estimate: Estimate, target: Target | None) -> bool:
        """Tell whether the law was lost between such a state and target when it was checked."""
        return target is not None and self.model.lost_at(estimate.x, target.x)


def levels_of(model: LiftedModel, outputs: Outputs, settings: Settings) -> dict[str, Level]:
    """
    Build the levels that the settings name, best first.

    :raises ValueError: for a law or an estimator that there is not, or one that cannot do with
        what is measured.
    """
    weights = Weights.physical(model, settings.state_weight, settings.input_weight)
    lower, upper = (model.states.to_deviation(bound) if len(bound) else bound
                    for bound in (settings.state_lower, settings.state_upper))
    tuning = Tuning(weights, settings.max_gain, settings.max_residual, lower, upper,
                    pi_gain=settings.pi_gain, pi_time=settings.pi_time)
    estimator = settings.estimator or (
        'extended_kalman_filter' if not outputs.determine_state else
        'disturbance_observer' if settings.observer_bandwidth > 0.0 else 'measured_state')
    noise, wander, error = settings.uncertainty(model, outputs)
    estimating = EstimatorTuning(
        outputs, settings.observer_bandwidth, settings.max_disturbance / model.inputs.scale,
        noise, wander / model.inputs.scale, error / model.states.scale)
    levels = {}
    for level in settings.supervisor.levels:
        law = plugged(level.law, 'law', LAWS, (model, replace(tuning, margin=level.margin)),
                      ('model', 'compute'))
        if not isinstance(law.model, LiftedModel):
            raise ValueError(f'the law {level.law!r} has a {type(law.model).__name__} for its '
                             'model, must be a LiftedModel: correct its class')
        levels[level.law] = Level(
            level.law, law, plugged(estimator, 'estimator', ESTIMATORS, (law.model, estimating),
                                    ('model', 'predict', 'correct', 'restart')),
            settings.controlled or model.states.names)
    return levels


@record
class Observation:
    """What became of a measurement."""

    verdict: Verdict  #: whether it is accepted
    expected: Array | None  #: (n_y,) what was expected of it; None when nothing was
    x: Array  #: (n_x,) state that it is taken for, in state units
    outside: float  #: its distance from the training data, in half widths


# After so many time constants without an accepted measurement the state is not known.
_LOST = 2.0
# So many intervals between measurements are a gap.
_GAP = 1.5


@dataclass(frozen=True)
class Estimating:
    """
    The estimators of all levels behind the checks of the measurements.

    While another level acts its model takes the better one's place, and the disturbance makes up
    for the difference, so that the plant's estimated rate stays.
    """

    model: LiftedModel  #: the lift
    outputs: Outputs  #: what is measured of its states
    settings: Settings  #: the tuning
    levels: dict[str, Level]  #: by name, best first

    def level(self, state: State) -> Level:
        """Return the level in terms of whose model the estimate is: without a law, the last."""
        name = state.supervisor.settled
        if name is None:
            return next(iter(self.levels.values()))
        found = self.levels.get(name)
        return self.levels[next(reversed(self.levels))] if found is None else found

    def applied(self, state: State, measured: Array | None = None) -> tuple[Array, bool]:
        """
        Return the input that has acted since the last command, as far as it is known.

        That is the command, unless a measurement (n_u,) of the input says that it was not
        reached: at a limit of the actuator, or behind its lag, nothing may wind up. Differences
        below `input_tolerance` count for nothing: a bias would come into the loop.

        :return: (n_u,) in scaled deviations, and whether it follows the command.
        """
        if state.command is None:
            return np.zeros(self.model.n_u), True
        u, tolerance = state.command, self.settings.input_tolerance
        if measured is None or not finite(measured):
            return self.model.inputs.to_deviation(u), True
        u = np.minimum(np.maximum(u, measured - tolerance), measured + tolerance)
        return self.model.inputs.to_deviation(u), bool((u == state.command).all())

    def observe(self, state: State, y: Array, time_ns: int, elapsed: float, u: Array
                ) -> tuple[State, Observation]:
        """
        Check a measurement (n_y,) and take it into account.

        :param elapsed: seconds since the last command.
        :param u: (n_u,) what has acted since then, in scaled deviations.
        :return: the state with measurement, time and estimate, and what became of the measurement.
        """
        before, last, estimator = state.estimate, state.accepted, self.level(state).estimator
        predicted = self._coasted(estimator, state, elapsed, u)
        x = self.position(predicted, y)
        outside = self.model.distance(x)
        w = np.zeros(self.model.n_x) if before is None else before.w

        def travel(then: FrozenCheck) -> Array:
            if outside > 0.0 or state.way_back is not None:
                # what the model says of its motion is worth little; under the safe input even a
                # plant that it does not expect to may rest there
                return np.zeros_like(y)
            frozen = None if before is None else replace(before, w=then.w)
            moved = self._coasted(
                estimator, amended(state, estimate=frozen), elapsed, u)
            if before is None or moved is None:
                return np.zeros_like(y)
            return self.outputs.of((moved.x - before.x) * self.model.states.scale)

        verdict = check(self.settings.sensor, self.outputs, last, y, time_ns, w, travel)
        expected = None if predicted is None else self.outputs.of(
            self.model.states.to_physical(predicted.x))
        if verdict.fault is None:
            far = outside > self.settings.supervisor.largest_margin
            predicted = self._corrected(
                estimator, state, predicted, verdict, x, elapsed,
                far or self.lost(state, time_ns))
            if not isinstance(predicted, Estimate):
                raise TypeError(f'the estimator returned {type(predicted).__name__}, '
                                'not Estimate')
            if not self.outputs.determine_state:
                # the measurement has changed what it leaves open, too
                x = self.position(predicted, y)
                outside = self.model.distance(x)
        elif verdict.fault.code is Code.FROZEN and predicted is not None and last is not None:
            # what the observer made of a sensor that does not move is no disturbance
            predicted = replace(predicted, w=last.frozen.w)
        return amended(
            state, accepted=verdict.accepted, time_ns=time_ns, estimate=predicted
        ), Observation(verdict, expected, x, outside)

    def position(self, known: Estimate | None, y: Array) -> Array:
        """
        Return the state (n_x,), in state units, that goes with a measurement (n_y,).

        What the measurement leaves open is as it is known, or where it may rest.
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
        if np.count_nonzero(measured) == len(self.outputs.C) and finite(x):
            found = held_at(self.model, self.model.states.to_deviation(x), measured)
            if found is not None:
                return self.model.states.to_physical(found)
        return x

    def _corrected(self, estimator: Estimator, state: State, predicted: Estimate | None,
                   verdict: Verdict, x: Array, elapsed: float, lost: bool) -> Estimate:
        """
        Return the estimate with a measurement that is accepted.

        :param lost: whether the model's prediction is worth nothing, after so long or so far out.
        """
        xi = self.model.states.to_deviation(x)
        if predicted is None:
            # taken over from somebody who, it is supposed, held the plant where it is
            return estimator.restart(None, xi, None if state.command is None else (
                self.model.inputs.to_deviation(state.command)))
        if verdict.moved or not elapsed > 0.0 or lost:
            return estimator.restart(predicted, xi, None)
        return estimator.correct(predicted, xi, elapsed)

    def lost(self, state: State, time_ns: int) -> bool:
        """Tell whether no measurement was accepted for so long that the state is not known."""
        if state.accepted is None:
            return False
        seconds = (time_ns - state.accepted.time_ns) / NANOSECONDS
        # where measurements are always that rare, they are all there is
        return seconds * self.settings.observer_bandwidth > _LOST and (
            seconds > _GAP * state.interval)

    def coast(self, state: State, elapsed: float, u: Array) -> Estimate | None:
        """
        Carry the estimate forward without a measurement.

        Arguments as in :meth:`observe`.
        """
        return self._coasted(self.level(state).estimator, state, elapsed, u)

    def _coasted(self, estimator: Estimator, state: State, elapsed: float, u: Array
                 ) -> Estimate | None:
        if state.estimate is None or state.command is None or not elapsed > 0.0:
            return state.estimate
        try:
            predicted = estimator.predict(state.estimate, u, elapsed)
        except np.linalg.LinAlgError:
            predicted = None  # so far out that the model gives no rate
        if predicted is None or not predicted.finite:
            # after so long, or from so far out, the state is as uncertain as at first; the
            # disturbance is kept
            return amended(state.estimate, covariance=None)
        return predicted

    def rebase(self, estimate: Estimate | None, before: Level, now: Level) -> Estimate | None:
        """Carry an estimate over from the model of one level to that of another."""
        if estimate is None or before is now or not now.estimator.remembers:
            return estimate
        return now.estimator.rebased(estimate, before.model.drift(estimate.x))

    def inherit(self, predecessor: Estimating, state: State) -> State:
        """Carry an estimate over from other settings or another model."""
        estimate, old, new = state.estimate, predecessor.model, self.model
        if estimate is None:
            return state
        estimator = self.level(state).estimator
        if not estimator.remembers:
            estimate = Estimate(estimate.x, np.zeros_like(estimate.w))
        if old is new:
            return amended(state, estimate=estimate)
        x = old.states.to_physical(estimate.x)
        if old.states.names != new.states.names:
            # of what is not measured the new model has a view of its own
            x = self.position(None, predecessor.outputs.of(x))
            return amended(state, accepted=None, way_back=None, estimate=estimator.restart(
                None, new.states.to_deviation(x), _command(new, state)))
        # the rates that the old model estimated, per second, which all models share
        rate = estimate.w + predecessor.level(state).model.drift(estimate.x) + (
            old.forcing(estimate.x, _command(old, state)))
        factor = (old.states.scale / old.seconds_per_time_unit
                  / (new.states.scale / new.seconds_per_time_unit))
        x_new = new.states.to_deviation(x)
        covariance = estimate.covariance
        if covariance is not None:
            change = np.concatenate((old.states.scale / new.states.scale, factor))
            covariance = covariance * change * change[:, None]
        moved = Estimate(
            x_new, factor * rate - new.forcing(x_new, _command(new, state)), covariance)
        moved = estimator.rebased(moved, np.zeros_like(moved.w))
        # what it holds of the disturbance is in the old model's units, and distances from its data
        return amended(state, estimate=moved, accepted=None, way_back=None)


def _command(model: LiftedModel, state: State) -> Array:
    """Return the last command in a model's scaled deviations; the nominal one at first."""
    if state.command is None:
        return np.zeros(model.n_u)
    return model.inputs.to_deviation(state.command)
