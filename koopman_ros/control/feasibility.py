# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Feasibility of a set-point: whether an input within its range holds it, and the nearest one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from koopman_ros.control.fallback import FallbackLevel
from koopman_ros.control.laws.base import Target
from koopman_ros.control.steady_state import nearest_steady_state, resting_state
from koopman_ros.core.arrays import Array
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.model import Coordinates

_HALVINGS = 24  # to 1e-7 of the way
_MOST_MOVES = 10
_SINGULAR = 1e9  # condition from which on a model has no steady state for each input
# Rounding errors of an input, in scaled deviations, and of a state, in half-ranges.
_SLACK = 1e-6
# With fewer inputs than controlled states a set-point counts as held if a steady state is within
# this distance, in half-ranges of the training box: operators enter rounded values.
_NEAR = 0.01


@dataclass(frozen=True)
class Feasibility:
    """Set-points that a level can hold under a disturbance."""

    level: FallbackLevel  #: whose model tells
    margin: float  #: distance outside the training box, in half-ranges, that is allowed
    w: Array  #: (n_x,) disturbance of the state's rate, scaled
    start: Array | None  #: (n_x + n_u,) where the steady state is looked for, in units

    @property
    def box(self) -> Coordinates:
        """The controlled states."""
        return self.level.controlled_states

    def infeasibility(self, goal: Array, others: Iterable[Array | None], command: Array | None,
                      whole: bool) -> Reason | None:
        """
        Return why a set-point (n_c,), in state units, cannot be held, or None.

        :param goal: NaN for signals without a value.
        :param others: (n_c,) set-points from which on the nearest one that can be held is looked
            for, the first one that is held itself.
        :param command: (n_u,) input that holds another one, in input units, or None.
        :param whole: whether every signal was requested; if not, the others are to stay.
        """
        given = np.isfinite(goal)
        if not given.all():
            kept = tuple(name for name, is_given in zip(self.box.names, given, strict=True)
                         if is_given)
            some = replace(self, level=replace(self.level, controlled=kept))
            return some.infeasibility(goal[given], (), command, whole)
        cause = self._cause(self._target(goal))
        if cause is None:
            return None
        nearest = self._on_the_way(goal, (*others, self.box.center, self._under(command)))
        if nearest is not None and len(goal) > 1 and (whole or self._too_few_inputs):
            nearest = self._nearer(nearest, goal)
        shares = (goal - (self.box.center if nearest is None else nearest)) / (
            self.box.upper - self.box.lower)
        worst = int(np.argmax(np.abs(shares)))
        signal, value = self.box.names[worst], float(goal[worst])
        if nearest is None:
            return reason(StatusCode.NO_SETPOINT_HELD, signal=signal, value=value, cause=cause)
        return reason(StatusCode.SETPOINT_NOT_HELD, signal=signal, value=value, cause=cause,
                      nearest=float(nearest[worst]),
                      held=tuple(zip(self.box.names, nearest.tolist(), strict=True)))

    def yielding(self, goal: Array, asked: Array) -> Array:
        """
        Return a set-point (n_c,) that can be held, in state units; the goal where none is found.

        :param goal: (n_c,) that may not be held.
        :param asked: (n_c,) which of its signals stay; the others go as near to it as they can.
        """
        if self._held(goal):
            return goal
        level = replace(self.level, controlled=tuple(
            name for name, stays in zip(self.box.names, asked, strict=True) if stays))
        target = replace(self, level=level)._target(goal[asked])
        if target is None:
            return goal
        places = self.level.controlled_of(self.level.model.states.to_physical(target.x))
        found = self._on_the_way(goal, (np.where(asked, goal, places),))
        return goal if found is None else found

    def _target(self, setpoint: Array) -> Target | None:
        return self.level.target(setpoint, self.w, self.start)

    def _under(self, command: Array | None) -> Array | None:
        """Return the set-point (n_c,) that a command (n_u,) holds, or the nominal input."""
        model = self.level.model
        u = self.level.limits.within(model.inputs.center if command is None else command)
        start = np.zeros(model.n_x) if self.start is None else (
            model.states.to_deviation(self.start[:model.n_x]))
        x = resting_state(model, model.inputs.to_deviation(u), self.w, start)
        return None if x is None else self.level.controlled_of(model.states.to_physical(x))

    @property
    def _too_few_inputs(self) -> bool:
        """Whether the controlled states outnumber the inputs."""
        return len(self.level.controlled) > self.level.model.n_u

    def _on_the_way(self, goal: Array, others: Iterable[Array | None]) -> Array | None:
        """Return the last set-point that is held on the way to a goal, None where none is."""
        held = next((other for other in others if other is not None and self._held(other)), None)
        if held is None:
            return None
        beyond = goal
        for _ in range(_HALVINGS):
            middle = 0.5 * (held + beyond)
            if self._held(middle):
                held = middle
            else:
                beyond = middle
        return held

    def _nearer(self, held: Array, goal: Array) -> Array:
        """Move the inputs within their range to the least-squares distance from a goal."""
        # in here: it takes longer to import than the rest of the step
        from scipy.optimize import lsq_linear

        model, half = self.level.model, 0.5 * (self.box.upper - self.box.lower)
        lower, upper = (model.inputs.to_deviation(end) for end in (
            self.level.limits.lower, self.level.limits.upper))
        for _ in range(_MOST_MOVES):
            target, left = self._target(held), (goal - held) / half
            assert target is not None  # it is held
            slope = model.drift_jacobian(target.x) + model.forcing_jacobian(target.x, target.u)
            if not np.linalg.cond(slope) < _SINGULAR:
                break
            gain = model.states.scale[:, None] * -np.linalg.solve(
                slope, model.input_matrix(target.x))
            gain = np.array([self.level.controlled_of(column) for column in gain.T]).T
            move = lsq_linear(gain / half[:, None], left, (lower - target.u, upper - target.u),
                              method='bvls').x
            for halving in range(_MOST_MOVES):
                x = resting_state(model, target.u + 0.5 ** halving * move, self.w, target.x)
                if x is None:
                    continue
                found = self.level.controlled_of(model.states.to_physical(x))
                shorter = float(np.linalg.norm(left) - np.linalg.norm((goal - found) / half))
                if shorter > 0.0 and self._held(found):
                    held = found
                    break
            else:
                break
            if shorter < _SLACK:
                break
        return held

    def _held(self, setpoint: Array) -> bool:
        return self.box.violation(setpoint) == 0.0 and self._cause(self._target(setpoint)) is None

    def _cause(self, target: Target | None) -> Reason | None:
        """Return the reason why a target cannot be held, or None."""
        if target is None:
            return reason(StatusCode.NO_STEADY_STATE)
        model, limits = self.level.model, self.level.limits
        states, half = model.states, 0.5 * (model.states.upper - model.states.lower)
        for names, value, lower, upper, slack, code in (
                (model.inputs.names, model.inputs.to_physical(target.u), limits.lower,
                 limits.upper, _SLACK * model.inputs.scale, StatusCode.INPUT_NEEDED),
                (states.names, states.to_physical(target.x), states.lower, states.upper,
                 (self.margin + _SLACK) * half, StatusCode.STATE_LEAVES)):
            within = (lower - slack <= value) & (value <= upper + slack)
            if not within.all():
                i = int(np.argmin(within))
                return reason(code, signal=names[i], value=float(value[i]),
                              lower=float(lower[i]), upper=float(upper[i]))
        if self._too_few_inputs:
            nearest = nearest_steady_state(model, target, self.w)
            if nearest is None or not np.all(
                    np.abs(nearest - target.x) * states.scale <= _NEAR * half):
                return reason(StatusCode.NO_STEADY_STATE)
        return None
