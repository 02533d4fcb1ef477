# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The quadratic program of a plan: its course, condensed to the inputs, and its cost."""

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.drifts import drifts, space_of
from koopman_ros.compiled.jit import compiled, inner, INTEGERS, MATRIX, NUMBER, SIZE, VECTOR
from koopman_ros.compiled.network import N_U, N_X
from koopman_ros.compiled.steps import advance, room_of

_LANES = 8  # columns that a processor takes at once, or twice as many as it does


@compiled(INTEGERS, VECTOR, VECTOR)
def slope(sizes: NDArray[np.int64], numbers: Array, x: Array) -> Array:
    """Return the Jacobian of the drift at a state, (n_x, n_x)."""
    n = len(x)
    J = np.empty((n, n, 1))
    drifts(sizes, numbers, x.copy().reshape((n, 1)), space_of(sizes, numbers, 1),
           np.empty((n, 1)), J)
    return J.reshape((n, n))


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
def _condensed(u: Array, x: Array, start: Array, x_ref: Array, u_ref: Array, lengths: Array,
               R: Array, terminal: Array, X: Array, M: Array, g: Array
               ) -> tuple[bool, Array, Array, Array, Array]:
    """Return what :func:`program` does, of the ends X of all intervals and their costs M and g."""
    (N, m), n = u.shape, x.shape[1]
    count = N * m
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
    c, part = n + m, 1.0 / (6.0 * steps)
    # all intervals at once, side by side in columns; the last one again until their number suits
    # the processor. Nodes come first in X, and become where the intervals end, and after them the
    # derivatives of that by node and input.
    columns = N + (-N) % _LANES
    space = space_of(sizes, numbers, columns)
    _, _, B, _, _ = space[1]
    X, push, held = np.zeros((1 + c, n, columns)), np.empty((n, columns)), np.empty(columns)
    forced = np.zeros((n, c))
    for i in range(n):
        for j in range(m):
            forced[i, n + j] = B[i, j]
    for k in range(columns):
        one = min(k, N - 1)
        held[k] = lengths[one]
        for i in range(n):
            X[0, i, k], X[1 + i, i, k], push[i, k] = x[one, i], 1.0, w[i]
            for j in range(m):
                push[i, k] += B[i, j] * u[one, j]
    M, g, QS = np.zeros((c, c, columns)), np.zeros((c, columns)), np.empty((n, columns))
    rooms = room_of(X)
    _, _, middle, _, _ = rooms
    _weigh(M, g, Q, part, held, X, x_ref, QS)
    for step in range(steps):
        advance(sizes, numbers, space, push, forced, held, 1.0 / steps, X, rooms)
        _weigh(M, g, Q, 4.0 * part, held, middle, x_ref, QS)
        _weigh(M, g, Q, part if step == steps - 1 else 2.0 * part, held, X, x_ref, QS)
    return _condensed(u, x, start, x_ref, u_ref, lengths, R, terminal, X, M, g)
