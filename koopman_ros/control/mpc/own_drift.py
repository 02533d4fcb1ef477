# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Roll-out of a model with a drift of its own, such as a plant's equations, by its methods."""

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.model import LiftedModel


def roll_out(model: LiftedModel, u: Array, x: Array, w: Array, x_ref: Array, u_ref: Array,
             lengths: Array, steps: int, Q: Array, R: Array) -> tuple[Array, Array]:
    """Return the same as :func:`koopman_ros.control.mpc.condensing.roll_out`."""
    (N, m), n = u.shape, x.shape[1]
    X, cost = np.zeros((N, n, 1 + n + m)), np.zeros((N, 1 + n + m, 1 + n + m))
    X[:, :, 0], X[:, :, 1:1 + n] = x[:-1], np.eye(n)
    v = np.zeros((N, m, 1 + n + m))
    v[:, :, 0], v[:, :, 1 + n:] = u - u_ref, np.eye(m)
    cost += lengths[:, None, None] * (v.swapaxes(1, 2) @ R @ v)
    h = (lengths / steps)[:, None, None]

    def rates(X: Array) -> Array:
        at = X[:, :, 0]
        f, J = model.drift_and_jacobian(at)
        dX = (J + model.forcing_jacobian(at, u)) @ X
        dX[:, :, 0] = f + model.forcing(at, u) + w
        dX[:, :, 1 + n:] += model.input_matrix(at)
        return np.asarray(dX)

    def weighed(X: Array) -> Array:
        error = X.copy()
        error[:, :, 0] -= x_ref
        return np.asarray(h / 6.0 * (error.swapaxes(1, 2) @ Q @ error))

    for _ in range(steps):
        k1 = rates(X)
        k2 = rates(X + 0.5 * h * k1)
        k3 = rates(X + 0.5 * h * k2)
        k4 = rates(X + h * k3)
        end = X + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        middle = 0.5 * (X + end) + 0.125 * h * (k1 - k4)
        cost += weighed(X) + 4.0 * weighed(middle) + weighed(end)
        X = end
    return X, cost
