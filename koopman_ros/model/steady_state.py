# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Steady states of a model: f(x) + B(x) u + w = 0, in scaled deviations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.steady_state import Goal, NO_GOAL, steady_state
from koopman_ros.model.lifted_model import LiftedModel


def model_steady_state(model: LiftedModel, w: Array | float, start: Array, lower: Array,
                       upper: Array, goal: Goal = NO_GOAL, anchor: Array | None = None
                       ) -> Array | None:
    """
    Find the steady state y = (x, u) nearest to a goal; see :func:`~koopman_ros.core.steady_state`.

    :param w: (n_x,) disturbance of the state's rate.
    :param start: (n_x + n_u,), as limits and anchor.
    """
    n = model.n_x

    def rate(y: Array) -> Array:
        return model.drift(y[:n]) + model.forcing(y[:n], y[n:]) + w

    def slope(y: Array) -> Array:
        return np.concatenate((
            model.drift_jacobian(y[:n]) + model.forcing_jacobian(y[:n], y[n:]),
            model.input_matrix(y[:n])), axis=1)

    return steady_state(rate, slope, start, lower, upper, goal, anchor)


def resting_state(model: LiftedModel, u: Array, w: Array | float, start: Array) -> Array | None:
    """Return where (n_x,) an input (n_u,) holds the model, nearest to (n_x,), or None."""
    y, endless = np.concatenate((start, u)), np.full(model.n_x, np.inf)
    found = model_steady_state(model, w, y, np.concatenate((-endless, u)),
                               np.concatenate((endless, u)), anchor=y)
    return None if found is None else found[:model.n_x]


def held_at(model: LiftedModel, x: Array, held: NDArray[np.bool_], margin: float) -> Array | None:
    """
    Return the steady state (n_x,), whatever input keeps it, with some numbers of x, or None.

    :param margin: distance outside the training box, in half-ranges, up to which the other numbers
        are looked for.
    """
    y, half = np.concatenate((x, np.zeros(model.n_u))), model.states.half_widths
    endless = np.full(model.n_u, np.inf)
    lower, upper = (np.concatenate((np.where(held, x, corner + sign * margin * half),
                                    sign * endless))
                    for corner, sign in zip(model.states.corners, (-1.0, 1.0), strict=True))
    found = model_steady_state(model, 0.0, y, lower, upper)
    return None if found is None else found[:model.n_x]
