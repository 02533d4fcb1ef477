# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The quadratic program of a plan: its course, condensed to the inputs, and its cost."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import compiled, inner, INTEGERS, MATRIX, SIZE, VECTOR
from koopman_ros.compiled.matrices import applied
from koopman_ros.compiled.network import drift_and_jacobian, matrices, N_U, N_X, parts_of
from koopman_ros.compiled.steps import runge_kutta, space_of


@inner
def _weigh(M: Array, g: Array, share: float, Q: Array, S: Array, error: Array) -> None:
    """Add the share of S' Q S to M, and of S' Q error to g."""
    n, c = S.shape
    for i in range(n):
        for j in range(n):
            q = share * Q[i, j]
            for a in range(c):
                left = q * S[i, a]
                g[a] += left * error[j]
                for b in range(c):
                    M[a, b] += left * S[j, b]


@inner
def _interval(sizes: NDArray[np.int64], numbers: Array,
              parts: tuple[Array, Array, Array, Array], space: Any, push: Array, forced: Array,
              x: Array, x_ref: Array, Q: Array, length: float, steps: int
              ) -> tuple[Array, Array, Array, Array]:
    """
    Follow one interval.

    :return: where it ends, the derivative of that by node and input, and what it costs: Hessian
        and gradient by node and input.
    """
    n, m = sizes[N_X], sizes[N_U]
    S, h = np.zeros((n, n + m)), length / steps
    for i in range(n):
        S[i, i] = 1.0
    M, g, error = np.zeros((n + m, n + m)), np.zeros(n + m), np.empty(n)
    middle, points = np.empty((n, n + m)), length / (6.0 * steps)
    for i in range(n):
        error[i] = x[i] - x_ref[i]
    _weigh(M, g, points, Q, S, error)
    for step in range(steps):
        y, T, k1, s1, k4, s4 = runge_kutta(
            sizes, numbers, parts, space, push, forced, x, S, h)
        # the middle by the rates at both ends (Hermite), for Simpson's rule
        for i in range(n):
            error[i] = 0.5 * (x[i] + y[i]) + 0.125 * h * (k1[i] - k4[i]) - x_ref[i]
            for j in range(n + m):
                middle[i, j] = 0.5 * (S[i, j] + T[i, j]) + 0.125 * h * (s1[i, j] - s4[i, j])
        _weigh(M, g, 4.0 * points, Q, middle, error)
        for i in range(n):
            error[i] = y[i] - x_ref[i]
        _weigh(M, g, points if step == steps - 1 else 2.0 * points, Q, T, error)
        x, S = y, T
    return x, S, M, g


@inner
def _add(H: Array, f: Array, M: Array, g: Array, by_node: Array, gap: Array, width: int, n: int,
         m: int) -> None:
    """Add what an interval costs to the lower half of H, and to f, whose node the inputs move."""
    c = n + m
    slope = g.copy()
    for a in range(c):
        for j in range(n):
            slope[a] += M[a, j] * gap[j]
    row = np.empty(n)
    for a in range(width):
        # what the change of the node by an input costs beside each part of the interval
        for j in range(n):
            row[j] = 0.0
            for i in range(n):
                row[j] += by_node[i, a] * M[i, j]
            f[a] += by_node[j, a] * slope[j]
        for b in range(a + 1):
            for j in range(n):
                H[a, b] += row[j] * by_node[j, b]
        for j in range(m):
            for i in range(n):
                H[width + j, a] += M[n + j, i] * by_node[i, a]
    for i in range(m):
        f[width + i] += slope[n + i]
        for j in range(i + 1):
            H[width + i, width + j] += M[n + i, n + j]


@compiled(INTEGERS, VECTOR, VECTOR)
def slope(sizes: NDArray[np.int64], numbers: Array, x: Array) -> Array:
    """Return the Jacobian of the drift at a state, (n_x, n_x)."""
    return drift_and_jacobian(sizes, numbers, parts_of(sizes, numbers), x.copy())[1]


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
    _, B, _, _ = matrices(sizes, numbers)
    parts, space = parts_of(sizes, numbers), space_of(sizes)
    Q, terminal = Q.copy(), terminal.copy()
    nodes, by_inputs = np.empty((N + 1, n)), np.zeros((N + 1, n, N * m))
    H, f = np.zeros((N * m, N * m)), np.zeros(N * m)
    forced, gap, total = np.zeros((n, n + m)), np.empty(n), 0.0
    for i in range(n):
        nodes[0, i] = start[i]
        for j in range(m):
            forced[i, n + j] = B[i, j]
    for k in range(N):
        push = applied(B, u[k].copy())
        for i in range(n):
            push[i] += w[i]
            gap[i] = nodes[k, i] - x[k, i]
        end, S, M, g = _interval(sizes, numbers, parts, space, push, forced, x[k].copy(), x_ref,
                                 Q, lengths[k], steps)
        width = k * m
        for i in range(n):
            nodes[k + 1, i] = end[i]
            for j in range(n):
                nodes[k + 1, i] += S[i, j] * gap[j]
                for c in range(width):
                    by_inputs[k + 1, i, c] += S[i, j] * by_inputs[k, j, c]
            for j in range(m):
                by_inputs[k + 1, i, width + j] = S[i, n + j]
            total += nodes[k + 1, i] + S[i, i]
        _add(H, f, M, g, by_inputs[k], gap, width, n, m)
        for i in range(m):
            for j in range(m):
                H[width + i, width + j] += lengths[k] * R[i, j]
                f[width + i] += lengths[k] * R[i, j] * (u[k, j] - u_ref[j])
    for i in range(n):
        gap[i] = nodes[N, i] - x_ref[i]
    for i in range(n):
        for j in range(n):
            for a in range(N * m):
                left = terminal[i, j] * by_inputs[N, i, a]
                f[a] += left * gap[j]
                for b in range(a + 1):
                    H[a, b] += left * by_inputs[N, j, b]
    for a in range(N * m):
        for b in range(a):
            H[b, a] = H[a, b]
    return math.isfinite(total), nodes, by_inputs, H, f
