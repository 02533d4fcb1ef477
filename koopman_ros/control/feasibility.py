# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Feasibility of a set-point: whether an input within its range holds it, and the nearest one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.fallback import FallbackLevel
from koopman_ros.core.arrays import Array
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.core.steady_state import Goal
from koopman_ros.model import Coordinates
from koopman_ros.model.steady_state import model_steady_state


@dataclass(frozen=True)
class FeasibilitySettings:
    """Tolerances of the check, in half-ranges of the training box."""

    #: distance of the nearest steady state at which a set-point counts as held: rounding errors
    rounding: float = 1e-6
    #: the same with fewer inputs than controlled states: operators enter rounded values
    compromise: float = 0.01


@dataclass(frozen=True)
class Feasibility:
    """Set-points that a level can hold under a disturbance."""

    level: FallbackLevel  #: whose model tells
    margin: float  #: distance outside the training box, in half-ranges, that is allowed
    w: Array  #: (n_x,) disturbance of the state's rate, scaled
    start: Array | None  #: (n_x + n_u,) where the steady state is looked for, in units
    settings: FeasibilitySettings = FeasibilitySettings()

    @property
    def box(self) -> Coordinates:
        """The controlled states."""
        return self.level.controlled_states

    def infeasibility(self, goal: Array, asked: NDArray[np.bool_]) -> Reason | None:
        """
        Return why a set-point (n_c,), in state units, cannot be held, or None.

        :param goal: NaN for signals without a value.
        :param asked: (n_c,) which signals were requested: the nearest values that can be held
            leave the others as they are, if possible.
        """
        given = np.isfinite(goal)
        if not given.all():
            kept = tuple(name for name, is_given in zip(self.box.names, given, strict=True)
                         if is_given)
            some = replace(self, level=replace(self.level, controlled=kept))
            return some.infeasibility(goal[given], asked[given])
        level, states = self.level, self.level.model.states
        too_few = len(goal) > level.model.n_u
        if level.law.model_free:
            return None
        found = self._nearest(goal, np.ones_like(asked))
        if found is not None and self._distance(found, goal) <= (
                self.settings.compromise if too_few else self.settings.rounding):
            return None
        if not (asked.all() or too_few):
            alone = self._nearest(goal, asked)
            found = found if alone is None else alone
        cause = self._cause(goal)
        held = self.box.center if found is None else (
            states.to_physical(found[:len(states)])[level.indices])
        worst = int(np.argmax(np.abs(goal - held) / (self.box.upper - self.box.lower)))
        signal, value = self.box.names[worst], float(goal[worst])
        if found is None:
            return reason(StatusCode.NO_SETPOINT_HELD, signal=signal, value=value, cause=cause)
        return reason(StatusCode.SETPOINT_NOT_HELD, signal=signal, value=value, cause=cause,
                      nearest=float(held[worst]),
                      held=tuple(zip(self.box.names, held.tolist(), strict=True)))

    def yielding(self, goal: Array, asked: NDArray[np.bool_]) -> Array:
        """
        Return a set-point (n_c,) that can be held, in state units; the goal where none is found.

        :param goal: (n_c,) that may not be held.
        :param asked: (n_c,) which of its signals stay; the others go as near to it as they can.
        """
        found = self._nearest(goal, ~asked)
        if found is None or self._distance(found, goal) <= self.settings.rounding:
            return goal
        states = self.level.model.states
        return np.where(asked, goal, states.to_physical(found[:len(states)])[self.level.indices])

    def _nearest(self, goal: Array, moving: NDArray[np.bool_]) -> Array | None:
        """Return the steady state (n_x + n_u,) within range that is nearest to a set-point."""
        model, places = self.level.model, self.level.indices
        wanted, outside = self.box.to_deviation(goal), self.margin * model.states.half_widths
        ends: list[Array] = []
        for corner, sign, end in zip(
                model.states.corners, (-1.0, 1.0), self.level.input_range, strict=True):
            states = corner + sign * outside
            # set-points are within the box itself
            states[places] = np.where(moving, corner[places], wanted)
            ends.append(np.concatenate((states, end)))
        return model_steady_state(model, self.w, self._begin(wanted), ends[0], ends[1],
                                  Goal(places, wanted))

    def _begin(self, wanted: Array) -> Array:
        model, y = self.level.model, np.zeros(self.level.model.n_x + self.level.model.n_u)
        if self.start is not None:
            y = np.concatenate((model.states.to_deviation(self.start[:model.n_x]),
                                model.inputs.to_deviation(self.start[model.n_x:])))
        y[self.level.indices] = wanted
        return y

    def _distance(self, found: Array, goal: Array) -> float:
        """Return the largest distance of a steady state from a set-point, in half-ranges."""
        places = self.level.indices
        return float(np.max(np.abs(found[places] - self.box.to_deviation(goal))
                            / self.level.model.states.half_widths[places]))

    def _cause(self, goal: Array) -> Reason:
        """Return which signal would have to leave its range, or that there is no steady state."""
        model, limits, states = self.level.model, self.level.limits, self.level.model.states
        wanted, endless = self.box.to_deviation(goal), np.full(model.n_x + model.n_u, np.inf)
        found = model_steady_state(model, self.w, self._begin(wanted), -endless, endless,
                                   Goal(self.level.indices, wanted))
        half = 0.5 * (states.upper - states.lower)
        rounding = self.settings.rounding
        for signals, value, lower, upper, slack, code in () if found is None else (
                (model.inputs, found[model.n_x:], limits.lower, limits.upper,
                 rounding * model.inputs.scale, StatusCode.INPUT_NEEDED),
                (states, found[:model.n_x], states.lower, states.upper,
                 (self.margin + rounding) * half, StatusCode.STATE_LEAVES)):
            value = signals.to_physical(value)
            within = (lower - slack <= value) & (value <= upper + slack)
            if not within.all():
                i = int(np.argmin(within))
                return reason(code, signal=signals.names[i], value=float(value[i]),
                              lower=float(lower[i]), upper=float(upper[i]))
        return reason(StatusCode.NO_STEADY_STATE)
