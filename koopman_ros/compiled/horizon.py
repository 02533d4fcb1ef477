# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The quadratic program of a plan: its course, condensed to the inputs, and its cost."""

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.drifts import drifts, space_of
from koopman_ros.compiled.jit import compiled, inner, INTEGERS, MATRIX, NUMBER, SIZE, VECTOR
from koopman_ros.compiled.network import drift_and_jacobian, matrices, N_U, N_X, parts_of

_LANES = 8  # columns that a processor takes at once, or twice as many as it does


@compiled(INTEGERS, VECTOR, VECTOR)
def slope(sizes: NDArray[np.int64], numbers: Array, x: Array) -> Array:
    """Return the Jacobian of the drift at a state, (n_x, n_x)."""
    return drift_and_jacobian(sizes, numbers, parts_of(sizes, numbers), x.copy())[1]


@compiled(MATRIX, MATRIX, VECTOR, MATRIX, NUMBER)
def distances(x: Array, corners: Array, half: Array, states: Array, fill: float) -> Array:
    """
    Measure how far states (N, n_x) are from a box and from training states, in half widths.

    :param states: (M, n_x), none where they are not known.
    :param fill: their fill distance.
    """
    (N, n), found = x.shape, np.empty(len(x))
    for k in range(N):
        outside, nearest, known = 0.0, math.inf, True
        for i in range(n):
            outside = max(outside, (corners[0, i] - x[k, i]) / half[i],
                          (x[k, i] - corners[1, i]) / half[i])
            known = known and math.isfinite(x[k, i])
        for row in range(len(states)):
            apart = 0.0
            for i in range(n):
                apart = max(apart, abs(states[row, i] - x[k, i]) / half[i])
            nearest = min(nearest, apart)
        if len(states):
            outside = max(outside, nearest - fill)
        found[k] = outside if known else math.inf
    return found


@inner
def _weigh(M: Array, g: Array, Q: Array, factor: float, lengths: Array, X: Array, x_ref: Array,
           QS: Array) -> None:
    """Add what a point costs to the lower half of M, S' Q S, and to g, S' Q (x - x_ref)."""
    (c, N), n = g.shape, len(Q)
    for b in range(c):
        for i in range(n):
            for k in range(N):
                QS[i, k] = 0.0
            for j in range(n):
                if Q[i, j] != 0.0:
                    q = factor * Q[i, j]
                    for k in range(N):
                        QS[i, k] += q * lengths[k] * X[1 + b, j, k]
        for i in range(n):
            for k in range(N):
                g[b, k] += QS[i, k] * (X[0, i, k] - x_ref[i])
            for a in range(b, c):
                for k in range(N):
                    M[a, b, k] += QS[i, k] * X[1 + a, i, k]


@inner
def _intervals(sizes: NDArray[np.int64], numbers: Array, B: Array, X: Array, push: Array,
               x_ref: Array, Q: Array, lengths: Array, steps: int) -> tuple[Array, Array]:
    """
    Follow all intervals at once by Runge-Kutta steps x' = f(x) + push, S' = f'(x) S + [0, B].

    :param X: (1 + c, n_x, N), with c = n_x + n_u: nodes x, which become where the intervals end,
        and after them the columns of S, the derivatives of that by node and input.
    :param push: (n_x, N).
    :return: what the intervals cost: Hessian (c, c, N), its lower half, and gradient (c, N), by
        node and input.
    """
    count, n, N = X.shape
    c, space, part = count - 1, space_of(sizes, numbers, N), 1.0 / (6.0 * steps)
    M, g, QS, J = np.zeros((c, c, N)), np.zeros((c, N)), np.empty((n, N)), np.empty((n, n, N))
    for a in range(c):
        for i in range(n):
            for k in range(N):
                X[1 + a, i, k] = 1.0 if i == a else 0.0
    rate, total, middle, ahead = (
        np.empty(X.shape), np.empty(X.shape), np.empty(X.shape), X.copy())
    _weigh(M, g, Q, part, lengths, X, x_ref, QS)
    for step in range(steps):
        for stage in range(4):
            drifts(sizes, numbers, ahead[0], space, rate[0], J)
            share = (0.5 if stage < 2 else 1.0) / steps
            for a in range(count):
                for i in range(n):
                    if a == 0:
                        for k in range(N):
                            rate[a, i, k] += push[i, k]
                    else:
                        forced = B[i, a - 1 - n] if a > n else 0.0
                        for k in range(N):
                            rate[a, i, k] = forced
                        for j in range(n):
                            for k in range(N):
                                rate[a, i, k] += J[i, j, k] * ahead[a, j, k]
            for a in range(count):
                for i in range(n):
                    if stage == 0:
                        for k in range(N):
                            total[a, i, k] = middle[a, i, k] = rate[a, i, k]
                    elif stage < 3:
                        for k in range(N):
                            total[a, i, k] += 2.0 * rate[a, i, k]
                    if stage < 3:
                        for k in range(N):
                            ahead[a, i, k] = X[a, i, k] + share * lengths[k] * rate[a, i, k]
                    else:
                        # the middle by the rates at both ends (Hermite), for Simpson's rule
                        for k in range(N):
                            r = rate[a, i, k]
                            end = X[a, i, k] + part * lengths[k] * (total[a, i, k] + r)
                            middle[a, i, k] = 0.5 * (X[a, i, k] + end) + 0.125 / steps * lengths[
                                k] * (middle[a, i, k] - r)
                            ahead[a, i, k] = X[a, i, k] = end
        _weigh(M, g, Q, 4.0 * part, lengths, middle, x_ref, QS)
        _weigh(M, g, Q, part if step == steps - 1 else 2.0 * part, lengths, X, x_ref, QS)
    return M, g


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
    count = N * m
    _, B, _, _ = matrices(sizes, numbers)
    # the last one again until their number suits the processor
    columns = N + (-N) % _LANES
    X, push, held = np.empty((1 + n + m, n, columns)), np.empty((n, columns)), np.empty(columns)
    for column in range(columns):
        k = min(column, N - 1)
        held[column] = lengths[k]
        for i in range(n):
            X[0, i, column], push[i, column] = x[k, i], w[i]
            for j in range(m):
                push[i, column] += B[i, j] * u[k, j]
    M, g = _intervals(sizes, numbers, B, X, push, x_ref.copy(), Q.copy(), held, steps)
    nodes, by_inputs = np.empty((N + 1, n)), np.zeros((N + 1, n, count))
    gap, total = np.empty((n, N)), 0.0
    for i in range(n):
        nodes[0, i] = start[i]
    for k in range(N):
        width = k * m
        for i in range(n):
            gap[i, k] = nodes[k, i] - x[k, i]
        for i in range(n):
            nodes[k + 1, i] = X[0, i, k]
            for j in range(n):
                by_node = X[1 + j, i, k]
                nodes[k + 1, i] += by_node * gap[j, k]
                for a in range(width):
                    by_inputs[k + 1, i, a] += by_node * by_inputs[k, j, a]
            for j in range(m):
                by_inputs[k + 1, i, width + j] = X[1 + n + j, i, k]
            total += nodes[k + 1, i] + X[1 + i, i, k]
    # back from the end: what a change of each node costs from there on, and the derivative of
    # that by the inputs before it
    H, f, cost, by_end = (
        np.zeros((count, count)), np.empty(count), np.zeros(n), np.zeros((n, count)))
    before, by_before = np.empty(n), np.empty((n, count))
    for i in range(n):
        for j in range(n):
            cost[i] += terminal[i, j] * (nodes[N, j] - x_ref[j])
            for a in range(count):
                by_end[i, a] += terminal[i, j] * by_inputs[N, j, a]
    for k in range(N - 1, -1, -1):
        width = k * m
        for j in range(m):
            own = width + j
            f[own] = g[n + j, k]
            for i in range(m):
                weight = lengths[k] * R[j, i]
                f[own] += weight * (u[k, i] - u_ref[i])
                if i <= j:
                    H[own, width + i] = weight + M[n + j, n + i, k]
            for i in range(n):
                by_input, across = X[1 + n + j, i, k], M[n + j, i, k]
                f[own] += by_input * cost[i] + across * gap[i, k]
                for a in range(own + 1):
                    H[own, a] += by_input * by_end[i, a]
                for a in range(width):
                    H[own, a] += across * by_inputs[k, i, a]
        for i in range(n):
            before[i] = g[i, k]
            for a in range(width):
                by_before[i, a] = 0.0
            for j in range(n):
                by_node, here = X[1 + i, j, k], M[max(i, j), min(i, j), k]
                before[i] += by_node * cost[j] + here * gap[j, k]
                for a in range(width):
                    by_before[i, a] += by_node * by_end[j, a] + here * by_inputs[k, j, a]
        cost, before, by_end, by_before = before, cost, by_before, by_end
    for a in range(count):
        for b in range(a):
            H[b, a] = H[a, b]
    return math.isfinite(total), nodes, by_inputs, H, f
