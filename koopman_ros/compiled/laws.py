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
    N_X,
    N_Z,
    READOUT,
    secants,
    weights_of,
)
from koopman_ros.compiled.riccati import over_interval, regulator

LAW = 3  # figures before the input in what `law` returns
OVERFLOW = 709.0  # of an exponent, near what a float64 holds


@compiled(MATRIX, MATRIX, NUMBER)
def growth(drift: Array, action: Array, interval: float) -> float:
    """Return the growth of the error of one state or two in an interval; NaN for others."""
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


@inner
def _pack(found: Array, start: int, M: Array) -> int:
    """Write a matrix to a row of numbers; return where it ends."""
    columns = M.shape[1]
    for i in range(M.shape[0]):
        for j in range(columns):
            found[start + i * columns + j] = M[i, j]
    return start + M.shape[0] * columns


@compiled(INTEGERS, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, NUMBER, SIZE)
def law(sizes: NDArray[np.int64], numbers: Array, x: Array, x_ref: Array, z_ref: Array,
        u_ref: Array, forcing: Array, Q: Array, R: Array, interval: float, recentred: int
        ) -> Array:
    """
    Evaluate the re-centred law of a lift that starts with the state, or the averaged one.

    The latter is that of a read-out.

    :return: in one row, since each array that is returned takes as long as some products: the
        residual of the Riccati equation, infinite where it is not sure, the norm of K, the growth
        of the error, u, P, K, and drift and action of the error.
    """
    n = sizes[N_X]
    output, A, B, slope, readout = weights_of(sizes, numbers)
    p = applied(slope, x_ref)
    for i in range(n):
        p[i] = forcing[i] - p[i]
    h, T, S, G = secants(sizes, numbers, x, x_ref, p)
    motion = block(readout, 0, 0, n, n)
    if sizes[READOUT]:
        motion = combined(1.0, motion, 1.0, product(block(readout, 0, n, n, len(h)), S))
    if recentred:
        k = sizes[N_Z]
        z = lifted(sizes, output, h.reshape((len(h), 1)), 0.0)
        J, M = lifted(sizes, output, T, 1.0), lifted(sizes, output, S, 1.0)
        H = combined(1.0, lifted(sizes, output, G, 0.0), -1.0, product(J, slope))
        if not sizes[READOUT]:
            motion = least_squares(J, combined(1.0, product(A, M), 1.0, H))
        whole, push, e = A.copy(), product(J, B), np.empty(k)
        for i in range(k):
            e[i] = (x[i] if i < n else z[i, 0]) - z_ref[i]
            for j in range(n):
                whole[i, j] += H[i, j]
    else:
        k, whole, push, M, e = n, motion, B, identity(n), np.empty(n)
        for i in range(n):
            e[i] = x[i] - x_ref[i]
    fine, P, K, residual, gain = regulator(whole, push, Q, R, interval)
    m = B.shape[1]
    found = np.empty(LAW + m + k * k + m * k + 2 * n * n)
    found[0] = residual if fine else math.inf
    if not fine:
        return found
    action = product(B, product(K, M))
    action = combined(-1.0, action, 0.0, action)
    found[1], found[2] = gain, growth(motion, action, interval)
    u = applied(K, e)
    for i in range(m):
        found[LAW + i] = u_ref[i] - u[i]
    _pack(found, _pack(found, _pack(found, _pack(found, LAW + m, P), K), motion), action)
    return found
