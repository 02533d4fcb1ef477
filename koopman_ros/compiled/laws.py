# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The laws by Riccati equations, and how the error grows under them."""

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import compiled, INTEGERS, MATRIX, NUMBER, VECTOR
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


@compiled(MATRIX, MATRIX, MATRIX, MATRIX, NUMBER)
def solve(A: Array, B: Array, Q: Array, R: Array, interval: float
          ) -> tuple[bool, Array, Array, float, float]:
    """Solve the equation of :func:`koopman_ros.solvers.solve_riccati`; False where not sure."""
    fine, P, K, residual = regulator(A.copy(), B.copy(), Q.copy(), R.copy(), interval)
    return fine, P, K, residual, size(K)


@compiled(INTEGERS, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, NUMBER)
def recentred(sizes: NDArray[np.int64], numbers: Array, x: Array, x_ref: Array, z_ref: Array,
              u_ref: Array, forcing: Array, Q: Array, R: Array, interval: float
              ) -> tuple[bool, Array, Array, Array, float, float, Array, Array]:
    """
    Evaluate the re-centred law of a lift that starts with the state.

    :return: whether it is sure, u, P, K, the residual, the norm of K, and drift and action of the
        error.
    """
    n, n_z = sizes[N_X], sizes[N_Z]
    A, B, slope, readout = matrices(sizes, numbers)
    p = applied(slope, x_ref)
    for i in range(n):
        p[i] = forcing[i] - p[i]
    h, T, S, G = secants(sizes, numbers, x.copy(), x_ref.copy(), p)
    z = lifted(sizes, numbers, h.reshape((len(h), 1)), 0.0)
    for i in range(n_z):
        z[i, 0] = (x[i] if i < n else z[i, 0]) - z_ref[i]
    J, M = lifted(sizes, numbers, T, 1.0), lifted(sizes, numbers, S, 1.0)
    H = combined(1.0, lifted(sizes, numbers, G, 0.0), -1.0, product(J, slope))
    whole, weights = A.copy(), np.zeros((n_z, n_z))
    place(whole, 0, 0, combined(1.0, block(A, 0, 0, n_z, n), 1.0, H), 1.0)
    place(weights, 0, 0, Q, 1.0)
    fine, P, K, residual = regulator(whole, product(J, B), weights, R.copy(), interval)
    if not fine:
        return False, p, P, K, residual, math.inf, P, P
    if sizes[READOUT]:
        motion = combined(1.0, block(readout, 0, 0, n, n), 1.0, product(
            block(readout, 0, n, n, len(h)), S))
    else:
        motion = least_squares(J, combined(1.0, product(A, M), 1.0, H))
    u = applied(K, z[:, 0].copy())
    for i in range(len(u)):
        u[i] = u_ref[i] - u[i]
    action = product(B, product(K, M))
    return fine, u, P, K, residual, size(K), motion, combined(-1.0, action, 0.0, action)


@compiled(INTEGERS, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, NUMBER)
def averaged(sizes: NDArray[np.int64], numbers: Array, x: Array, x_ref: Array, u_ref: Array,
             Q: Array, R: Array, interval: float
             ) -> tuple[bool, Array, Array, Array, float, float, Array, Array]:
    """Evaluate the averaged law of a read-out; returns as :func:`recentred`."""
    n = sizes[N_X]
    _, B, _, readout = matrices(sizes, numbers)
    h, _, S, _ = secants(sizes, numbers, x.copy(), x_ref.copy(), x.copy())
    motion = combined(1.0, block(readout, 0, 0, n, n), 1.0, product(
        block(readout, 0, n, n, len(h)), S))
    fine, P, K, residual = regulator(motion, B, Q.copy(), R.copy(), interval)
    e = np.empty(n)
    for i in range(n):
        e[i] = x[i] - x_ref[i]
    if not fine:
        return False, e, P, K, residual, math.inf, P, P
    u = applied(K, e)
    for i in range(len(u)):
        u[i] = u_ref[i] - u[i]
    action = product(B, K)
    return fine, u, P, K, residual, size(K), motion, combined(-1.0, action, 0.0, action)


@compiled(MATRIX, MATRIX, NUMBER)
def growth(drift: Array, action: Array, interval: float) -> float:
    """Return the growth of two states' error, of which the larger mode counts; NaN for others."""
    n = len(drift)
    # of the state and of an action that is held
    F = np.zeros((2 * n, 2 * n))
    place(F, 0, 0, drift, 1.0)
    place(F, 0, n, action, 1.0)
    if n != 2 or not (interval > 0.0 and math.isfinite(size(F))):
        return math.nan
    D, _ = over_interval(F, identity(2 * n), interval)
    a, b, c, d = D[0, 0] + D[0, 2], D[0, 1] + D[0, 3], D[1, 0] + D[1, 2], D[1, 1] + D[1, 3]
    half, apart = 0.5 * (a + d), (0.5 * (a - d)) ** 2 + b * c
    if apart < 0.0:
        return math.hypot(1.0 + half, math.sqrt(-apart))
    return max(abs(1.0 + half + math.sqrt(apart)), abs(1.0 + half - math.sqrt(apart)))
