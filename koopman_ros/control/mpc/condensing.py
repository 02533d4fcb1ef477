# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The quadratic program of a plan: linearised roll-out, and condensing to the inputs."""

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import integrate
from koopman_ros.model import LiftedModel


def roll_out(model: LiftedModel, u: Array, x: Array, w: Array, x_ref: Array, u_ref: Array,
             lengths: Array, steps: int, Q: Array, R: Array) -> tuple[Array, Array]:
    """
    Integrate dx/dt = f(x) + B(x) u + w over intervals, each from a node and under a held input.

    By Runge-Kutta steps of the state, its sensitivities and the cost. All in scaled deviations and
    the model's time unit.

    :param u: (N, n_u) inputs.
    :param x: (N + 1, n_x) nodes, the last of which is not used.
    :param w: (n_x,) disturbance of the state's rate.
    :param x_ref: (N, n_x) and `u_ref` (N, n_u), references of the intervals.
    :param lengths: (N,) of the intervals.
    :param steps: of the integration in each of them.
    :param Q: (n_x, n_x) and `R` (n_u, n_u), weights.
    :return: the states at the ends and their derivatives by node and input (N, n_x, 1 + n_x +
        n_u), and the integral of e'Q e + v'R v as a quadratic form (N, 1 + n_x + n_u, 1 + n_x +
        n_u) of 1 and the deviations of node and input; both not finite where it diverges.
    :raises LinAlgError: where the model gives no rate.
    """
    (N, m), n = u.shape, x.shape[1]
    # the state with its sensitivities in the first n rows, the cost below
    start = np.zeros((N, 1 + 2 * n + m, 1 + n + m))
    start[:, :n, 0], start[:, :n, 1:1 + n] = x[:-1], np.eye(n)
    v = np.zeros((N, m, 1 + n + m))
    v[:, :, 0], v[:, :, 1 + n:] = u - u_ref, np.eye(m)
    effort = v.swapaxes(1, 2) @ R @ v

    def rates(Y: Array) -> Array:
        X, at = Y[:, :n], Y[:, :n, 0]
        rate, slope = model.rate_and_slope(at, u)
        dX = slope @ X
        dX[:, :, 0] = rate + w
        dX[:, :, 1 + n:] += model.input_matrix(at)
        error = X.copy()
        error[:, :, 0] -= x_ref
        return np.concatenate((dX, error.swapaxes(1, 2) @ Q @ error + effort), axis=1)

    with np.errstate(all='ignore'):
        end = integrate(rates, start, lengths[:, None, None], steps)
    return end[:, :n], end[:, n:]


def condense(x: Array, start: Array, x_ref: Array, ends: Array, cost: Array, terminal: Array
             ) -> tuple[Array, Array, Array, Array]:
    """
    Express nodes and cost by a change v (N n_u,) of the inputs alone.

    :param x: (N + 1, n_x) nodes, about which it is linearised.
    :param start: (n_x,) state at the beginning, and `x_ref` (n_x,) reference.
    :param ends: like `cost` of :func:`roll_out`.
    :param terminal: (n_x, n_x) weight of the error at the end.
    :return: nodes (N + 1, n_x) from the start on without a change and without gaps between the
        intervals, their derivatives (N + 1, n_x, N n_u) by v, and H (N n_u, N n_u) and f (N n_u,)
        of the cost v'H v / 2 + f'v.
    """
    N, n, columns = ends.shape
    m = columns - 1 - n
    # by 1 and v: the nodes, and (1, deviation of the node, change of the input) of each interval
    by, D = np.zeros((N + 1, n, 1 + N * m)), np.zeros((N, columns, 1 + N * m))
    by[0, :, 0], D[:, 0, 0] = start, 1.0
    for k in range(N):
        D[k, 1:1 + n] = by[k]
        D[k, 1:1 + n, 0] -= x[k]
        D[k, 1 + n:, 1 + k * m:1 + (k + 1) * m] = np.eye(m)
        by[k + 1] = ends[k] @ D[k]
    error = by[N].copy()
    error[:, 0] -= x_ref
    total = np.tensordot(D, cost @ D, ((0, 1), (0, 1))) + error.T @ terminal @ error
    H = total[1:, 1:]
    return by[..., 0], by[..., 1:], 0.5 * (H + H.T), total[1:, 0].copy()
