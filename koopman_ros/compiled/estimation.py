# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Prediction by observer and Kalman filter, its correction, and steady states."""

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.drifts import drifts, space_of
from koopman_ros.compiled.jit import compiled, INTEGERS, MATRIX, NUMBER, SIZE, VECTOR
from koopman_ros.compiled.matrices import applied, combined, product, solve_into, turned
from koopman_ros.compiled.network import N_X
from koopman_ros.compiled.steps import advance, room_of


@compiled(INTEGERS, VECTOR, VECTOR, VECTOR, VECTOR, NUMBER, SIZE)
def moved(sizes: NDArray[np.int64], numbers: Array, x: Array, w: Array, u: Array, h: float,
          steps: int) -> Array:
    """Integrate the model under a held input by so many of Heun's steps."""
    n, space, no_slope = sizes[N_X], space_of(sizes, numbers, 1), np.empty((0, 0, 1))
    now, ahead, first, second = x.copy(), np.empty((n, 1)), np.empty((n, 1)), np.empty((n, 1))
    _, _, B, _, _ = space[1]
    push = applied(B, u)
    for _ in range(steps):
        drifts(sizes, numbers, now.reshape((n, 1)), space, first, no_slope)
        for i in range(n):
            first[i, 0] += push[i] + w[i]
            ahead[i, 0] = now[i] + h * first[i, 0]
        drifts(sizes, numbers, ahead, space, second, no_slope)
        for i in range(n):
            now[i] += 0.5 * h * (first[i, 0] + second[i, 0] + push[i] + w[i])
    return now


@compiled(INTEGERS, VECTOR, VECTOR, VECTOR, MATRIX, VECTOR, NUMBER, SIZE)
def propagated(sizes: NDArray[np.int64], numbers: Array, x: Array, w: Array, P: Array, u: Array,
               h: float, steps: int) -> tuple[Array, Array]:
    """Return state and covariance of an extended Kalman filter after so many steps of h."""
    n, space = sizes[N_X], space_of(sizes, numbers, 1)
    _, _, B, _, _ = space[1]
    push = applied(B, u).reshape((n, 1))
    # the state, and its derivatives by what state and disturbance were
    X, forced, lengths = np.zeros((1 + 2 * n, n, 1)), np.zeros((n, 2 * n)), np.empty(1)
    lengths[0] = h
    for i in range(n):
        push[i, 0] += w[i]
        X[0, i, 0], X[1 + i, i, 0], forced[i, n + i] = x[i], 1.0, 1.0
    rooms = room_of(X)
    for _ in range(steps):
        advance(sizes, numbers, space, push, forced, lengths, 1.0, X, rooms)
    F = np.zeros((2 * n, 2 * n))
    for i in range(n):
        F[n + i, n + i] = 1.0
        for j in range(2 * n):
            F[i, j] = X[1 + j, i, 0]
    return X[0].copy().reshape(n), product(product(F, P), turned(F))


@compiled(MATRIX, MATRIX, MATRIX, VECTOR)
def corrected(H: Array, R: Array, P: Array, difference: Array
              ) -> tuple[bool, Array, Array, Array, Array, float]:
    """
    Correct by the outputs of a difference (n_x,) from a prediction, in the form of Joseph.

    :return: whether there is a gain, the step (2 n_x,) of state and disturbance, the covariance,
        the innovation, its standard deviations, and its square by its covariance.
    """
    n_y, n = H.shape
    N = 2 * n
    innovation = applied(H, difference)
    HP = np.zeros((n_y, N))
    for i in range(n_y):
        for j in range(n):
            for k in range(N):
                HP[i, k] += H[i, j] * P[k, j]
    S, right, deviation = R.copy(), np.empty((n_y, N + 1)), np.empty(n_y)
    for i in range(n_y):
        for j in range(n_y):
            for k in range(n):
                S[i, j] += H[i, k] * HP[j, k]
        deviation[i] = math.sqrt(S[i, i])
        for k in range(N):
            right[i, k] = HP[i, k]
        right[i, N] = innovation[i]
    fine = solve_into(S, right)
    step, keep, gain = np.zeros(N), np.zeros((N, N)), np.empty((N, n_y))
    square = 0.0
    for i in range(n_y):
        square += innovation[i] * right[i, N]
    for i in range(N):
        keep[i, i] = 1.0
        for j in range(n_y):
            gain[i, j] = right[j, i]
            step[i] += gain[i, j] * innovation[j]
            for k in range(n):
                keep[i, k] -= gain[i, j] * H[j, k]
    P = product(product(keep, P), turned(keep))
    P = combined(1.0, P, 1.0, product(product(gain, R), turned(gain)))
    return fine, step, combined(0.5, P, 0.5, turned(P)), innovation, deviation, square


@compiled(INTEGERS, VECTOR, VECTOR, VECTOR, INTEGERS, SIZE, NUMBER, NUMBER)
def equilibrium(sizes: NDArray[np.int64], numbers: Array, w: Array, start: Array,
                free: NDArray[np.int64], most: int, longest: float, resolution: float
                ) -> tuple[bool, Array]:
    """
    Solve f(x) + B u + w = 0 of a read-out for as many of (x, u) as there are states.

    :param free: (n_x,) their places.
    :param most: steps; see :mod:`koopman_ros.control.target` for what the others are.
    """
    n = sizes[N_X]
    space = space_of(sizes, numbers, 1)
    _, _, B, _, _ = space[1]
    f, J = np.empty((n, 1)), np.empty((n, n, 1))
    y, slope, rate = start.copy(), np.empty((n, n)), np.empty((n, 1))
    size_of_slope = 0.0
    for step in range(most + 1):
        drifts(sizes, numbers, y[:n].reshape((n, 1)), space, f, J)
        push, left = applied(B, y[n:]), 0.0
        for i in range(n):
            rate[i, 0] = -(f[i, 0] + push[i] + w[i])
            left += rate[i, 0] ** 2
        if step and math.sqrt(left) <= resolution * math.sqrt(size_of_slope):
            return True, y
        size_of_slope = 0.0
        for j in range(n):
            for i in range(n):
                slope[i, j] = J[i, free[j], 0] if free[j] < n else B[i, free[j] - n]
                size_of_slope += slope[i, j] ** 2
        if not (math.isfinite(left) and solve_into(slope, rate)):
            return False, y
        length = 0.0
        for i in range(n):
            length = max(length, abs(rate[i, 0]))
        if not math.isfinite(length):
            return False, y
        share = min(1.0, longest / length) if length > 0.0 else 1.0
        for i in range(n):
            y[free[i]] += share * rate[i, 0]
    return False, y
