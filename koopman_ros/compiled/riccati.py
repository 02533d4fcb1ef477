# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The sampled regulator by a structure-preserving doubling algorithm.

Whatever is near to a border, where the Schur form of :mod:`koopman_ros.solvers` decides whether
there is a gain, is left to it.
"""

import math

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import compiled, inner, MATRIX, NUMBER
from koopman_ros.compiled.matrices import (
    block,
    combined,
    identity,
    multiply,
    multiply_turned,
    place,
    product,
    size,
    solve_into,
    turned,
)

_TERMS = 24  # of a power series, at most
_NOTHING = 1e-18  # relative size of the first term that is left out
_MOST_DOUBLINGS = 20  # until then the slowest mode would be near the border
_STILL = 1e-9  # relative change after which the next one is below rounding, as they are squared
_DECAYED = 1e-4  # of what is left of all modes, likewise: one that stays would never come to it
_SHIFT = 0.4  # of the mean size of the modes: so the slow ones take fewer doublings
_SURE = 1e-12  # of a residual; what is larger the reference looks at
_LONGEST = 8.0  # norm of A and B times the interval, beyond which digits are lost


@inner
def over_interval(F: Array, weight: Array, interval: float) -> tuple[Array, Array]:
    """
    Integrate a state and its cost over an interval.

    :return: with x' = F x the D of x(interval) = (I + D) x(0), and the integral W of the cost.
    """
    N, length, amount = len(F), size(F) * interval, size(weight)
    doublings = max(0, math.frexp(length)[1] + 2)
    part = math.ldexp(interval, -doublings)
    F = combined(part, F, 0.0, F)
    # the rate of the cost X goes with X' = F'X + X F: two power series
    power, X, by_F, W = identity(N), weight.copy(), weight.copy(), weight.copy()
    D, after = np.zeros((N, N)), np.empty((N, N))
    for k in range(1, _TERMS):
        multiply(power, F, after)
        multiply(X, F, by_F)
        left = 0.0
        for i in range(N):
            for j in range(N):
                power[i, j] = after[i, j] / k
                D[i, j] += power[i, j]
                left += power[i, j] * power[i, j]
                X[i, j] = (by_F[i, j] + by_F[j, i]) / k
                W[i, j] += X[i, j] / (k + 1)
        if math.sqrt(left) <= _NOTHING * length and size(X) <= _NOTHING * amount:
            break
    W = combined(part, W, 0.0, W)
    DW, DWD = np.empty((N, N)), np.empty((N, N))
    for _ in range(doublings):
        # over twice the time
        multiply_turned(D, W, DW)
        multiply(DW, D, DWD)
        multiply(D, D, after)
        for i in range(N):
            for j in range(N):
                D[i, j] = 2.0 * D[i, j] + after[i, j]
        for i in range(N):
            for j in range(N):
                W[i, j] = 2.0 * W[i, j] + DWD[i, j] + DW[i, j] + DW[j, i]
    return D, W


@inner
def _stable_solution(A: Array, G: Array, Q: Array) -> tuple[bool, Array]:
    """
    Solve A'X + X A - X G X + Q = 0 for its stabilising X.

    See E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, "A structure-preserving doubling algorithm for
    continuous-time algebraic Riccati equations", Linear Algebra Appl. 396 (2005).
    """
    n = len(A)
    eye = identity(n)
    gamma = _SHIFT * math.sqrt((size(A) ** 2 + size(G) * size(Q)) / n)
    inverse, W_inverse = identity(n), identity(n)
    shifted = combined(1.0, A, -gamma, eye)
    if not (gamma > 0.0 and solve_into(shifted.copy(), inverse)):
        return False, Q
    QA = product(Q, inverse)
    W = combined(1.0, turned(shifted), 1.0, product(QA, G))
    if not solve_into(W, W_inverse):
        return False, Q
    E = combined(1.0, eye, 2.0 * gamma, turned(W_inverse))
    X = product(W_inverse, QA)
    X = combined(gamma, X, gamma, turned(X))
    G = product(product(inverse, G), W_inverse)
    G = combined(gamma, G, gamma, turned(G))
    whole, found, step = np.empty((n, n)), np.empty((n, 2 * n)), np.empty((n, n))
    by_E, by_G, EG, XE = (np.empty((n, n)), np.empty((n, n)), np.empty((n, n)),
                          np.empty((n, n)))
    for _ in range(_MOST_DOUBLINGS):
        multiply(G, X, whole)
        for i in range(n):
            whole[i, i] += 1.0
        place(found, 0, 0, E, 1.0)
        place(found, 0, n, G, 1.0)
        if not solve_into(whole, found):
            return False, X
        for i in range(n):
            for j in range(n):
                by_E[i, j], by_G[i, j] = found[i, j], found[i, n + j]
        multiply(X, by_E, XE)
        multiply_turned(E, XE, step)
        change = 0.0
        amount = 0.0
        for i in range(n):
            for j in range(n):
                add = 0.5 * (step[i, j] + step[j, i])
                X[i, j] += add
                change += add * add
                amount += X[i, j] * X[i, j]
        if not math.isfinite(amount):
            return False, X
        # what is left of E tells that no mode stays, weighted or not
        if math.sqrt(change) <= _STILL * math.sqrt(amount) and size(E) ** 2 <= _DECAYED:
            return True, X
        multiply(E, by_G, EG)
        multiply(EG, turned(E), step)
        for i in range(n):
            for j in range(n):
                G[i, j] += 0.5 * (step[i, j] + step[j, i])
        multiply(E, by_E, step)
        E, step = step, E
    return False, X


@compiled(MATRIX, MATRIX, MATRIX, MATRIX, NUMBER)
def regulator(A: Array, B: Array, Q: Array, R: Array, interval: float
              ) -> tuple[bool, Array, Array, float, float]:
    """
    Solve the equation of :func:`koopman_ros.solvers.solve_riccati`, over an interval.

    :param Q: of the first coordinates, however many.
    :return: whether this is sure, P, K, the residual and the Frobenius norm of K.
    """
    n, m = B.shape
    F, weight = np.zeros((n + m, n + m)), np.zeros((n + m, n + m))
    place(F, 0, 0, A, 1.0)
    place(F, 0, n, B, 1.0)
    place(weight, 0, 0, Q, 1.0)
    place(weight, n, n, R, 1.0)
    if not (size(F) * interval <= _LONGEST and math.isfinite(size(weight))):
        return False, weight, F, math.inf, math.inf
    D, W = over_interval(F, weight, interval)
    step, push = block(D, 0, 0, n, n), block(D, 0, n, n, m)
    Q_d, N, R_d = block(W, 0, 0, n, n), block(W, 0, n, n, m), block(W, n, n, m, m)
    push_t, N_t = turned(push), turned(N)
    by_R = np.empty((m, 2 * n))
    place(by_R, 0, 0, push_t, 1.0)
    place(by_R, 0, n, N_t, 1.0)
    if not solve_into(R_d.copy(), by_R):
        return False, W, D, math.inf, math.inf
    G, across = product(push, block(by_R, 0, 0, m, n)), block(by_R, 0, n, m, n)
    rest = combined(1.0, step, -1.0, product(push, across))
    Q_rest = combined(1.0, Q_d, -1.0, product(N, across))
    size_Q, size_G = size(Q_rest), size(G)
    if not (size_Q > 0.0 and size_G > 0.0):
        return False, W, D, math.inf, math.inf
    scale = math.sqrt(size_Q / size_G)
    # (S + I)^-1 (S - I) of the symplectic pencil, which is a Hamiltonian matrix
    less, more = np.empty((2 * n, 2 * n)), np.empty((2 * n, 2 * n))
    place(less, 0, 0, rest, 1.0)
    place(less, 0, n, G, -scale)
    place(less, n, 0, Q_rest, -1.0 / scale)
    place(less, n, n, turned(rest), -1.0)
    for i in range(2 * n):
        for j in range(2 * n):
            more[i, j] = less[i, j] if j < n else -less[i, j]
        more[i, i] += 2.0
    if not solve_into(more, less):
        return False, W, D, math.inf, math.inf
    for i in range(n):
        for j in range(n):
            G[i, j], Q_rest[i, j] = -less[i, n + j], -less[n + i, j]
    fine, P = _stable_solution(block(less, 0, 0, n, n), G, Q_rest)
    P = combined(0.5 * scale, P, 0.5 * scale, turned(P))
    P_step, P_push = product(P, step), product(P, push)
    right = combined(1.0, N_t, 1.0, turned(P_push))
    right = combined(1.0, right, 1.0, product(push_t, P_step))
    K = right.copy()
    solvable = solve_into(combined(1.0, R_d, 1.0, product(push_t, P_push)), K)
    square, feedback = np.empty((n, n)), np.empty((n, n))
    multiply_turned(step, P_step, square)
    multiply_turned(right, K, feedback)
    total = 0.0
    for i in range(n):
        for j in range(n):
            total += (P_step[i, j] + P_step[j, i] + square[i, j] + Q_d[i, j]
                      - feedback[i, j]) ** 2
    terms = size(Q_d) + 2.0 * size(P_step) + size(square) + size(feedback)
    residual = math.sqrt(total) / terms
    return fine and solvable and residual <= _SURE, P, K, residual, size(K)
