# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Runge-Kutta steps of states together with their derivatives."""

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.drifts import drifts, Space
from koopman_ros.compiled.jit import inner

Rooms = tuple[Array, Array, Array, Array, Array]


@inner
def room_of(X: Array) -> Rooms:
    """Return what :func:`advance` needs, the third of it for the middle of a step."""
    n, N = X.shape[1:]
    return (np.empty(X.shape), np.empty(X.shape), np.empty(X.shape), X.copy(),
            np.empty((n, n, N)))


@inner
def _go_on(stage: int, lengths: Array, share: float, X: Array, rate: Array, total: Array,
           middle: Array, ahead: Array) -> None:
    """
    Go on from a stage of a Runge-Kutta step, which is a share of each interval.

    After the last one X is its end, and `middle` the middle by the rates at both ends (Hermite).
    """
    for a in range(X.shape[0]):
        for i in range(X.shape[1]):
            if stage == 0:
                for k in range(X.shape[2]):
                    r = rate[a, i, k]
                    total[a, i, k] = middle[a, i, k] = r
                    ahead[a, i, k] = X[a, i, k] + 0.5 * share * lengths[k] * r
            elif stage < 3:
                part = 0.5 * share if stage == 1 else share
                for k in range(X.shape[2]):
                    r = rate[a, i, k]
                    total[a, i, k] += 2.0 * r
                    ahead[a, i, k] = X[a, i, k] + part * lengths[k] * r
            else:
                for k in range(X.shape[2]):
                    r, h = rate[a, i, k], share * lengths[k]
                    end = X[a, i, k] + h / 6.0 * (total[a, i, k] + r)
                    middle[a, i, k] = 0.5 * (X[a, i, k] + end) + 0.125 * h * (
                        middle[a, i, k] - r)
                    X[a, i, k] = ahead[a, i, k] = end


@inner
def advance(sizes: NDArray[np.int64], numbers: Array, space: Space, push: Array, forced: Array,
            lengths: Array, share: float, X: Array, rooms: Rooms) -> None:
    """
    Step x' = f(x) + push and S' = f'(x) S + forced by a share of each interval.

    :param space: of :func:`koopman_ros.compiled.drifts.space_of`.
    :param push: (n_x, N).
    :param forced: (n_x, c).
    :param lengths: (N,) of the intervals.
    :param X: (1 + c, n_x, N), the states and after them their derivatives S.
    :param rooms: of :func:`room_of`, kept from step to step.
    """
    rate, total, middle, ahead, J = rooms
    n, c = forced.shape
    N = len(lengths)
    for stage in range(4):
        drifts(sizes, numbers, ahead[0], space, rate[0], J)
        for i in range(n):
            for k in range(N):
                rate[0, i, k] += push[i, k]
            for a in range(c):
                force = forced[i, a]
                for k in range(N):
                    rate[1 + a, i, k] = force
                for j in range(n):
                    for k in range(N):
                        rate[1 + a, i, k] += J[i, j, k] * ahead[1 + a, j, k]
        _go_on(stage, lengths, share, X, rate, total, middle, ahead)
