# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Steady states of a model, and the target of a set-point for some of its states."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.laws.base import Target
from koopman_ros.core.arrays import Array
from koopman_ros.model import LiftedModel

_MOST_STEPS = 30
# A step is no longer than this, in scaled deviations: Newton's method far out overshoots.
_LONGEST_STEP = 0.5
# The equation is solved if the remaining rate corresponds to so small a deviation.
_RESOLUTION = 1e-9
# With inputs to spare the nearest solution is found when a step is no longer than this.
_STILL = 1e-6
_SLACK = 1e-6  # rounding error of an input or a state, in scaled deviations
# Weight of the states against the inputs where the nearest steady state is wanted.
_REACH = 1e3


def equilibrium(model: LiftedModel, w: Array, start: Array, free: NDArray[np.bool_],
                anchor: Array, reach: Array, *, compromise: bool = False) -> Array | None:
    """
    Solve f(x) + B(x) u + w = 0 for some of y = (x, u) by Gauss-Newton steps.

    Of several solutions it is one nearest to the anchor: each step goes to the solution of the
    linearised equation that is.

    :param w: (n_x,) disturbance of the state's rate.
    :param start: (n_x + n_u,) scaled deviations; components that are not free stay there.
    :param free: (n_x + n_u,) whether a component is solved for.
    :param anchor: (n_x + n_u,) scaled deviations.
    :param reach: (n_x + n_u,) units in which the distance from it is measured.
    :param compromise: whether the least rate is wanted, where too few components are free.
    :return: (n_x + n_u,), or None where no solution was found.
    """
    n, y = model.n_x, start
    settles = int(np.count_nonzero(free)) > n
    anchor, reach = anchor[free], reach[free]
    try:
        rate = model.drift(y[:n]) + model.forcing(y[:n], y[n:]) + w
        for _ in range(_MOST_STEPS):
            J = np.concatenate((model.drift_jacobian(y[:n]) + model.forcing_jacobian(y[:n], y[n:]),
                                model.input_matrix(y[:n])), axis=1)[:, free]
            if not (np.isfinite(J).all() and np.isfinite(rate).all()):
                return None
            wanted = J.dot(y[free] - anchor) - rate
            step = anchor + reach * np.linalg.lstsq(J * reach, wanted, rcond=None)[0] - y[free]
            length = float(np.max(np.abs(step), initial=0.0))
            y = y.copy()
            y[free] += step * min(1.0, _LONGEST_STEP / length) if length > 0.0 else step
            rate = model.drift(y[:n]) + model.forcing(y[:n], y[n:]) + w
            if length <= _STILL if compromise else (
                    np.linalg.norm(rate) <= _RESOLUTION * np.linalg.norm(J) and (
                        length <= _STILL or not settles)):
                return y
    except np.linalg.LinAlgError:
        # a model that gives no numbers
        pass
    return None


def partial_target(model: LiftedModel, controlled: NDArray[np.intp], setpoint: Array, w: Array,
                   lower: Array, upper: Array, start: Array) -> Target | None:
    """
    Find the steady state that holds some of the states at a set-point.

    Where there are inputs to spare it is the one nearest to the nominal point that keeps their
    range, if there is one; else the range does not count. Of more states than inputs it has the
    least rate.

    :param controlled: (n_c,) indices of the states with a set-point.
    :param setpoint: (n_c,) scaled deviations, as all that follows.
    :param w: (n_x,) disturbance of the state's rate.
    :param lower: (n_u,) range of the inputs, to `upper` (n_u,).
    :param start: (n_x + n_u,) state and input to begin from.
    :return: None where no steady state was found.
    """
    n = model.n_x
    anchor, reach = np.zeros(n + model.n_u), np.ones(n + model.n_u)
    free = np.ones(n + model.n_u, dtype=np.bool_)
    free[controlled] = False
    y = start.copy()
    y[controlled] = setpoint
    unlimited = found = equilibrium(
        model, w, y, free, anchor, reach, compromise=len(controlled) > model.n_u)
    while found is not None and np.count_nonzero(free) > n:
        excess = np.maximum(lower - found[n:], found[n:] - upper)
        worst = int(np.argmax(excess))
        if not excess[worst] > 0.0:
            return _target(model, found, w)
        # the other inputs compensate for the saturated one
        free[n + worst] = False
        y = found.copy()
        y[n + worst] = min(max(y[n + worst], lower[worst]), upper[worst])
        found = equilibrium(model, w, y, free, anchor, reach)
    if found is None or np.any(
            (found[n:] < lower - _RESOLUTION) | (found[n:] > upper + _RESOLUTION)):
        found = unlimited
    return None if found is None else _target(model, found, w)


def reachable_target(model: LiftedModel, controlled: NDArray[np.intp], target: Target, w: Array,
                     lower: Array, upper: Array) -> Target | None:
    """
    Find the steady state nearest to a target that inputs within their range hold.

    Nearest is where the states with a set-point are; the others go where they have to.

    :param controlled: (n_c,) indices of the states with a set-point.
    :param w: (n_x,) disturbance of the state's rate.
    :param lower: (n_u,) range of the inputs, to `upper` (n_u,), in scaled deviations.
    :return: the target itself where it is within; None where nothing was found near it.
    """
    n, states = model.n_x, model.states
    # a steady state further off than the box is wide is on another branch
    far = (states.upper - states.lower) / states.scale
    y = anchor = np.concatenate((target.x, target.u))
    free, reach = np.ones(len(y), dtype=np.bool_), np.full(len(y), _REACH)
    reach[controlled] = 1.0
    for _ in range(model.n_u + 1):
        excess = np.maximum(lower - y[n:], y[n:] - upper)
        worst = int(np.argmax(excess))
        if not excess[worst] > _SLACK:
            return target if y is anchor else _target(model, y, w)
        y = y.copy()
        y[n + worst] = min(max(y[n + worst], lower[worst]), upper[worst])
        free[n + worst] = False
        found = equilibrium(model, w, y, free, anchor, reach)
        if found is None or not np.all(np.abs(found[:n] - target.x) <= far + _SLACK):
            return None
        y = found
    return None


def nearest_steady_state(model: LiftedModel, target: Target, w: Array) -> Array | None:
    """Return the steady state (n_x,) nearest to a target's, whatever input holds it, or None."""
    y = np.concatenate((target.x, target.u))
    found = equilibrium(model, w, y, np.ones(len(y), dtype=np.bool_), y,
                        np.where(np.arange(len(y)) < model.n_x, 1.0, _REACH))
    return None if found is None else found[:model.n_x]


def resting_state(model: LiftedModel, u: Array, w: Array, start: Array) -> Array | None:
    """Return where (n_x,) an input (n_u,) holds the model, looked for from (n_x,), or None."""
    y = np.concatenate((start, u))
    found = equilibrium(model, w, y, np.arange(len(y)) < model.n_x, y, np.ones(len(y)))
    return None if found is None else found[:model.n_x]


def held_at(model: LiftedModel, x: Array, held: NDArray[np.bool_]) -> Array | None:
    """Return the steady state (n_x,), whatever input keeps it, with some numbers of x, or None."""
    y = np.concatenate((x, np.zeros(model.n_u)))
    free = np.concatenate((~held, np.ones(model.n_u, dtype=np.bool_)))
    found = equilibrium(model, np.zeros(model.n_x), y, free, np.zeros(len(y)), np.ones(len(y)))
    return None if found is None else found[:model.n_x]


def _target(model: LiftedModel, y: Array, w: Array) -> Target:
    x, u = y[:model.n_x], y[model.n_x:]
    forcing = model.forcing(x, u) + w
    return Target(x, u, forcing, float(np.linalg.norm(model.drift(x) + forcing)))
