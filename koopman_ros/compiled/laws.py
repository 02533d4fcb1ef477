# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The laws by Riccati equations, and how the error grows under them."""

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import compiled, inner, INTEGERS, MATRIX, NUMBER, SIZE, VECTOR
from koopman_ros.compiled.matrices import (
    applied,
    block,
    combined,
    identity,
    least_squares,
    place,
    product,
    size,
)
from koopman_ros.compiled.network import (
    lifted,
    matrices,
    N_X,
    N_Z,
    READOUT,
    secants,
)
from koopman_ros.compiled.riccati import over_interval, regulator

LAW = 3  # figures before the input in what `law` returns
OVERFLOW = 709.0  # of an exponent, near what a float64 holds


@compiled(MATRIX, MATRIX, MATRIX, MATRIX, NUMBER)
def solve(A: Array, B: Array, Q: Array, R: Array, interval: float
          ) -> tuple[bool, Array, Array, float, float]:
    """Solve the equation of :func:`koopman_ros.solvers.solve_riccati`; False where not sure."""
    fine, P, K, residual = regulator(A.copy(), B.copy(), Q.copy(), R.copy(), interval)
    return fine, P, K, residual, size(K)


@inner
def growth_of(drift: Array, action: Array, interval: float) -> float:
    """Return the growth of the error of one state or two; NaN for others."""
    n = len(drift)
    if n == 1:
        a, held = drift[0, 0], interval
        if not a * interval < OVERFLOW:
            return math.nan if math.isnan(a) else math.inf
        if a != 0.0:
            held = math.expm1(a * interval) / a
        return abs(math.exp(a * interval) + held * action[0, 0])
    # of the state and of an action that is held
    F = np.zeros((2 * n, 2 * n))
    place(F, 0, 0, drift, 1.0)
    place(F, 0, n, action, 1.0)
    if n != 2 or not math.isfinite(size(F)):
        return math.nan
    D, _ = over_interval(F, identity(2 * n), interval)
    a, b, c, d = D[0, 0] + D[0, 2], D[0, 1] + D[0, 3], D[1, 0] + D[1, 2], D[1, 1] + D[1, 3]
    half, apart = 0.5 * (a + d), (0.5 * (a - d)) ** 2 + b * c
    if apart < 0.0:
        return math.hypot(1.0 + half, math.sqrt(-apart))
    return max(abs(1.0 + half + math.sqrt(apart)), abs(1.0 + half - math.sqrt(apart)))


@compiled(MATRIX, MATRIX, NUMBER)
def growth(drift: Array, action: Array, interval: float) -> float:
    """Return the growth of the error of one state or two in an interval; NaN for others."""
    return growth_of(drift.copy(), action.copy(), interval)


@inner
def _pack(found: Array, start: int, M: Array) -> int:
    """Write a matrix to a row of numbers; return where it ends."""
    columns = M.shape[1]
    for i in range(M.shape[0]):
        for j in range(columns):
            found[start + i * columns + j] = M[i, j]
    return start + M.shape[0] * columns


@inner
def evaluated(sizes: NDArray[np.int64], numbers: Array, x: Array, x_ref: Array, z_ref: Array,
              u_ref: Array, forcing: Array, Q: Array, R: Array, interval: float, recentred: int
              ) -> tuple[bool, float, Array, Array, Array, Array, Array]:
    """
    Evaluate the re-centred law of a lift that starts with the state, or the averaged one.

    The latter is that of a read-out.

    :return: whether the solution of the Riccati equation is sure, its residual, P, K, drift and
        action of the error, and u.
    """
    n = sizes[N_X]
    A, B, slope, readout = matrices(sizes, numbers)
    p = applied(slope, x_ref)
    for i in range(n):
        p[i] = forcing[i] - p[i]
    h, T, S, G = secants(sizes, numbers, x.copy(), x_ref.copy(), p)
    motion = combined(1.0, block(readout, 0, 0, n, n), 0.0, block(readout, 0, 0, n, n))
    if sizes[READOUT]:
        motion = combined(1.0, motion, 1.0, product(block(readout, 0, n, n, len(h)), S))
    if recentred:
        k = sizes[N_Z]
        z = lifted(sizes, numbers, h.reshape((len(h), 1)), 0.0)
        J, M = lifted(sizes, numbers, T, 1.0), lifted(sizes, numbers, S, 1.0)
        H = combined(1.0, lifted(sizes, numbers, G, 0.0), -1.0, product(J, slope))
        if not sizes[READOUT]:
            motion = least_squares(J, combined(1.0, product(A, M), 1.0, H))
        whole, push = A, product(J, B)
        place(whole, 0, 0, combined(1.0, block(A, 0, 0, k, n), 1.0, H), 1.0)
        e = np.empty(k)
        for i in range(k):
            e[i] = (x[i] if i < n else z[i, 0]) - z_ref[i]
    else:
        k, whole, push, M, e = n, motion, B, identity(n), np.empty(n)
        for i in range(n):
            e[i] = x[i] - x_ref[i]
    weights = np.zeros((k, k))
    place(weights, 0, 0, Q, 1.0)
    fine, P, K, residual = regulator(whole, push, weights, R.copy(), interval)
    action = product(B, product(K, M))
    action = combined(-1.0, action, 0.0, action)
    u = applied(K, e)
    for i in range(len(u)):
        u[i] = u_ref[i] - u[i]
    return fine, residual, P, K, motion, action, u


@compiled(INTEGERS, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, NUMBER, SIZE)
def law(sizes: NDArray[np.int64], numbers: Array, x: Array, x_ref: Array, z_ref: Array,
        u_ref: Array, forcing: Array, Q: Array, R: Array, interval: float, recentred: int
        ) -> Array:
    """
    Evaluate a law, as :func:`evaluated`, and how the error grows.

    :return: in one row, since each array that is returned takes as long as some products: the
        residual of the Riccati equation, infinite where it is not sure, the norm of K, the growth
        of the error, u, P, K, and drift and action of the error.
    """
    fine, residual, P, K, motion, action, u = evaluated(
        sizes, numbers, x, x_ref, z_ref, u_ref, forcing, Q, R, interval, recentred)
    n, m, k = len(motion), K.shape[0], K.shape[1]
    found = np.empty(LAW + m + k * k + m * k + 2 * n * n)
    found[0] = residual if fine else math.inf
    if not fine:
        return found
    found[1], found[2] = size(K), growth_of(motion, action, interval)
    for i in range(m):
        found[LAW + i] = u[i]
    _pack(found, _pack(found, _pack(found, _pack(found, LAW + m, P), K), motion), action)
    return found
