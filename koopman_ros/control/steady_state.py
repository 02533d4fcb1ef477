# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The target of a set-point: the steady state that the law leads to, and its input."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.laws.base import Target
from koopman_ros.core.arrays import Array
from koopman_ros.core.steady_state import Goal, SteadyStateSettings
from koopman_ros.estimation.base import LOST
from koopman_ros.model import LiftedModel
from koopman_ros.model.steady_state import model_steady_state

_TOLERANCE = SteadyStateSettings().tolerance


def steady_state_target(model: LiftedModel, setpoint: Array, w: Array | None = None, *,
                        controlled: NDArray[np.intp] | None = None,
                        limits: tuple[Array, Array] | None = None, start: Array | None = None
                        ) -> Target | None:
    """
    Find the steady state nearest to a set-point under a disturbance; all in scaled deviations.

    Its states are within the bounds of a prediction. Of several that are as near it is the one
    nearest to the nominal point. Where the inputs would have to leave their range it is the
    nearest that inputs within the range hold. If there is none, or only one input, the target
    keeps an input out of range: saturated, the law comes as near as it can.

    :param setpoint: (n_c,).
    :param w: (n_x,) disturbance of the state's rate, none by default.
    :param controlled: (n_c,) indices of the states with a set-point, all by default.
    :param limits: lower and upper ends (n_u,) of the inputs, none by default.
    :param start: (n_x + n_u,) state and input, the nominal point by default. The search begins
        with the set-point in place of its states and, where that fails within the limits, there.
    :return: None where no steady state was found.
    """
    n, n_u, target = model.n_x, model.n_u, None
    w = np.zeros(n) if w is None else w
    start = np.zeros(n + n_u) if start is None else start
    y = start.copy()
    if controlled is None or len(controlled) == n:
        # linear in the input, which is all that is left to find
        controlled, f = np.arange(n), model.drift(setpoint)
        y[n:] = u = -model.input_inverse(setpoint).dot(f + w)
        forcing = model.forcing(setpoint, u) + w
        residual = math.hypot(*(f + forcing).tolist())
        if residual <= _TOLERANCE:
            target = Target(setpoint, u, forcing, residual)
            if limits is None or n_u == 1 or ((limits[0] <= u) & (u <= limits[1])).all():
                return target
    y[controlled] = setpoint
    goal, ends = Goal(controlled, setpoint), np.outer((-LOST, LOST), model.states.half_widths)
    if limits is not None and n_u > 1:
        lower, upper = np.concatenate((ends, limits), axis=1)
        for place in (y, start):
            found = model_steady_state(model, w, place, lower, upper, goal)
            if found is not None:
                return Target.at(model, found, w)
    if target is None:
        endless = np.full(n_u, np.inf)
        found = model_steady_state(model, w, y, np.concatenate((ends[0], -endless)),
                                   np.concatenate((ends[1], endless)), goal)
        target = None if found is None else Target.at(model, found, w)
    return target
