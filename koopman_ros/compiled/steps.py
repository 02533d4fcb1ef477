# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A Runge-Kutta step of the state together with its derivatives."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import inner
from koopman_ros.compiled.network import (
    free_room,
    hidden_into,
    rate_into,
    READOUT,
    room,
)


@inner
def space_of(sizes: NDArray[np.int64]) -> tuple[Any, Any]:
    """Return room for the steps of a model, which each of them takes anew."""
    return room(sizes, not sizes[READOUT]), free_room(sizes)


@inner
def runge_kutta(sizes: NDArray[np.int64], numbers: Array,
                parts: tuple[Array, Array, Array, Array], space: Any, push: Array, forced: Array,
                x: Array, S: Array, h: float) -> tuple[Array, Array, Array, Array, Array, Array]:
    """
    Step x' = f(x) + push and S' = f'(x) S + forced by h.

    :param parts: of :func:`koopman_ros.compiled.network.parts_of`.
    :param space: of :func:`space_of`.
    :return: both then, and the rates of both at the beginning and in the last stage.
    """
    n, c = S.shape
    (layer, before, T, T_before, U, U_before, scale), free_space = space
    y, V, f, J = x.copy(), S.copy(), np.empty(n), np.empty((n, n))
    first, first_S, rate, rate_S = np.empty(n), np.empty((n, c)), np.empty(n), np.empty((n, c))
    total, total_S = np.zeros(n), np.zeros((n, c))
    for stage in range(4):
        hidden_into(sizes, numbers, y, layer, before, T, T_before, U, U_before, scale)
        rate_into(sizes, parts, y, layer, T, U, free_space, f, J)
        weight = 1.0 if stage in (0, 3) else 2.0
        for i in range(n):
            rate[i] = f[i] + push[i]
            total[i] += weight * rate[i]
            for a in range(c):
                moved = forced[i, a]
                for j in range(n):
                    moved += J[i, j] * V[j, a]
                rate_S[i, a] = moved
                total_S[i, a] += weight * moved
        part = 0.5 * h if stage < 2 else h
        for i in range(n):
            if stage == 0:
                first[i] = rate[i]
            y[i] = x[i] + (part * rate[i] if stage < 3 else h / 6.0 * total[i])
            for a in range(c):
                if stage == 0:
                    first_S[i, a] = rate_S[i, a]
                V[i, a] = S[i, a] + (part * rate_S[i, a] if stage < 3
                                     else h / 6.0 * total_S[i, a])
    return y, V, first, first_S, rate, rate_S
