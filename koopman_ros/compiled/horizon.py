# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The quadratic program of a plan: its course, condensed to the inputs, and its cost."""

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.drifts import drifts, space_of
from koopman_ros.compiled.jit import compiled, inner, INTEGERS, MATRIX, SIZE, VECTOR
from koopman_ros.compiled.network import matrices, N_U, N_X
from koopman_ros.compiled.rows import add, add_product, fill


@compiled(INTEGERS, VECTOR, VECTOR)
def slope(sizes: NDArray[np.int64], numbers: Array, x: Array) -> Array:
    """Return the Jacobian of the drift at a state, (n_x, n_x)."""
    n = len(x)
    f, J = np.empty((n, 1)), np.empty((n * n, 1))
    drifts(sizes, numbers, x.copy().reshape((n, 1)), space_of(sizes, 1), f, J)
    return J.reshape((n, n))


@inner
def _weigh(M: Array, g: Array, Q: Array, factor: float, lengths: Array, X: Array, x_ref: Array,
           QS: Array) -> None:
    """Add what a point costs to the lower half of M, S' Q S, and to g, S' Q (x - x_ref)."""
    n, c, N = len(Q), g.shape[0], g.shape[1]
    for b in range(c):
        for i in range(n):
            fill(QS, i, 0.0)
            for j in range(n):
                if Q[i, j] != 0.0:
                    q = factor * Q[i, j]
                    for k in range(N):
                        QS[i, k] += q * lengths[k] * X[n + j * c + b, k]
        for i in range(n):
            for k in range(N):
                g[b, k] += QS[i, k] * (X[i, k] - x_ref[i])
            for a in range(b, c):
                add_product(M, a * c + b, 1.0, QS, i, X, n + i * c + a)


@inner
def _intervals(sizes: NDArray[np.int64], numbers: Array, B: Array, X: Array, push: Array,
               x_ref: Array, Q: Array, lengths: Array, steps: int) -> tuple[Array, Array]:
    """
    Follow all intervals at once by Runge-Kutta steps x' = f(x) + push, S' = f'(x) S + [0, B].

    :param X: (n_x + n_x c, N), with c = n_x + n_u, nodes x in its first rows, which become where
        the intervals end, and below them S (n_x, c), the derivatives of that by node and input.
    :param push: (n_x, N).
    :return: what the intervals cost: Hessian (c^2, N), its lower half, and gradient (c, N), by
        node and input.
    """
    n, c, N = sizes[N_X], sizes[N_X] + sizes[N_U], len(lengths)
    space, rows, part = space_of(sizes, N), len(X), 1.0 / (6.0 * steps)
    M, g, QS, J = np.zeros((c * c, N)), np.zeros((c, N)), np.empty((n, N)), np.empty((n * n, N))
    rate, total, middle, ahead = (np.empty((rows, N)), np.empty((rows, N)), np.empty((rows, N)),
                                  X.copy())
    for i in range(n):
        for a in range(c):
            fill(X, n + i * c + a, 1.0 if i == a else 0.0)
            fill(ahead, n + i * c + a, 1.0 if i == a else 0.0)
    _weigh(M, g, Q, part, lengths, X, x_ref, QS)
    for step in range(steps):
        for stage in range(4):
            drifts(sizes, numbers, ahead, space, rate, J)
            for i in range(n):
                add(rate, i, 1.0, push, i)
                for a in range(c):
                    row = n + i * c + a
                    fill(rate, row, B[i, a - n] if a >= n else 0.0)
                    for j in range(n):
                        add_product(rate, row, 1.0, J, i * n + j, ahead, n + j * c + a)
            share = (0.5 if stage < 2 else 1.0) / steps
            for i in range(rows):
                for k in range(N):
                    if stage == 0:
                        total[i, k] = middle[i, k] = rate[i, k]
                    elif stage < 3:
                        total[i, k] += 2.0 * rate[i, k]
                    if stage < 3:
                        ahead[i, k] = X[i, k] + share * lengths[k] * rate[i, k]
                    else:
                        # the middle by the rates at both ends (Hermite), for Simpson's rule
                        ahead[i, k] = X[i, k] + part * lengths[k] * (total[i, k] + rate[i, k])
                        middle[i, k] = 0.5 * (X[i, k] + ahead[i, k]) + 0.125 / steps * lengths[
                            k] * (middle[i, k] - rate[i, k])
                        X[i, k] = ahead[i, k]
        _weigh(M, g, Q, 4.0 * part, lengths, middle, x_ref, QS)
        _weigh(M, g, Q, part if step == steps - 1 else 2.0 * part, lengths, X, x_ref, QS)
    return M, g


@inner
def _blend(target: Array, i: int, factor: float, source: Array, j: int, columns: int) -> None:
    """Add to a row a factor times another, both as far as a column."""
    for a in range(columns):
        target[i, a] += factor * source[j, a]


@compiled(INTEGERS, VECTOR, MATRIX, MATRIX, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, SIZE, MATRIX,
          MATRIX, MATRIX)
def program(sizes: NDArray[np.int64], numbers: Array, u: Array, x: Array, start: Array, w: Array,
            x_ref: Array, u_ref: Array, lengths: Array, steps: int, Q: Array, R: Array,
            terminal: Array) -> tuple[bool, Array, Array, Array, Array]:
    """
    Linearise a course of inputs (N, n_u) and nodes (N + 1, n_x), with what a change of it costs.

    :return: whether all is finite, nodes and their derivatives by the inputs, and H and f; see
        :class:`koopman_ros.control.laws.shooting.Program`.
    """
    n, m, N = sizes[N_X], sizes[N_U], len(u)
    c, all_inputs = n + m, N * m
    _, B, _, _ = matrices(sizes, numbers)
    X, push = np.empty((n + n * c, N)), np.empty((n, N))
    for k in range(N):
        for i in range(n):
            X[i, k], push[i, k] = x[k, i], w[i]
            for j in range(m):
                push[i, k] += B[i, j] * u[k, j]
    M, g = _intervals(sizes, numbers, B, X, push, x_ref.copy(), Q.copy(), lengths.copy(), steps)
    nodes, by_inputs = np.empty((N + 1, n)), np.zeros((N + 1, n, all_inputs))
    gap, total = np.empty((n, N)), 0.0
    for i in range(n):
        nodes[0, i] = start[i]
    for k in range(N):
        for i in range(n):
            gap[i, k] = nodes[k, i] - x[k, i]
        for i in range(n):
            row = n + i * c
            nodes[k + 1, i] = X[i, k]
            for j in range(n):
                nodes[k + 1, i] += X[row + j, k] * gap[j, k]
                _blend(by_inputs[k + 1], i, X[row + j, k], by_inputs[k], j, k * m)
            for j in range(m):
                by_inputs[k + 1, i, k * m + j] = X[row + n + j, k]
            total += nodes[k + 1, i] + X[row + i, k]
    # back from the end: what a change of each node costs from there on, and its derivative by
    # the inputs before it
    H, f, cost, by_end = (np.zeros((all_inputs, all_inputs)), np.empty(all_inputs), np.zeros(n),
                          np.zeros((n, all_inputs)))
    before, by_before = np.empty(n), np.empty((n, all_inputs))
    for i in range(n):
        for j in range(n):
            cost[i] += terminal[i, j] * (nodes[N, j] - x_ref[j])
            _blend(by_end, i, terminal[i, j], by_inputs[N], j, all_inputs)
    for k in range(N - 1, -1, -1):
        width = k * m
        for j in range(m):
            own = width + j
            f[own] = g[n + j, k]
            for i in range(m):
                weight = lengths[k] * R[j, i]
                f[own] += weight * (u[k, i] - u_ref[i])
                if i <= j:
                    H[own, width + i] = weight + M[(n + j) * c + n + i, k]
            for i in range(n):
                by_node, across = X[n + i * c + n + j, k], M[(n + j) * c + i, k]
                f[own] += by_node * cost[i] + across * gap[i, k]
                _blend(H, own, by_node, by_end, i, own + 1)
                _blend(H, own, across, by_inputs[k], i, width)
        for i in range(n):
            before[i] = g[i, k]
            for a in range(width):
                by_before[i, a] = 0.0
            for j in range(n):
                by_node, own_cost = X[n + j * c + i, k], M[
                    i * c + j if j <= i else j * c + i, k]
                before[i] += by_node * cost[j] + own_cost * gap[j, k]
                _blend(by_before, i, by_node, by_end, j, width)
                _blend(by_before, i, own_cost, by_inputs[k], j, width)
        cost, before, by_end, by_before = before, cost, by_before, by_end
    for a in range(all_inputs):
        for b in range(a):
            H[b, a] = H[a, b]
    return math.isfinite(total), nodes, by_inputs, H, f
