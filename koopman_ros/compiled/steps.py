# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A Runge-Kutta step of the state of a read-out together with its derivatives."""

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import inner
from koopman_ros.compiled.network import drift_and_jacobian, N_X


@inner
def _rates(sizes: NDArray[np.int64], numbers: Array, readout: Array, push: Array, forced: Array,
           x: Array, S: Array) -> tuple[Array, Array]:
    f, J = drift_and_jacobian(sizes, numbers, readout, x)
    T = forced.copy()
    for i in range(len(f)):
        f[i] += push[i]
        for j in range(len(f)):
            for c in range(S.shape[1]):
                T[i, c] += J[i, j] * S[j, c]
    return f, T


@inner
def _ahead(x: Array, S: Array, h: float, k: Array, s: Array) -> tuple[Array, Array]:
    y, T = np.empty(len(x)), np.empty(S.shape)
    for i in range(len(x)):
        y[i] = x[i] + h * k[i]
        for j in range(S.shape[1]):
            T[i, j] = S[i, j] + h * s[i, j]
    return y, T


@inner
def runge_kutta(sizes: NDArray[np.int64], numbers: Array, readout: Array, push: Array,
                forced: Array, x: Array, S: Array, h: float
                ) -> tuple[Array, Array, Array, Array, Array, Array]:
    """
    Step x' = f(x) + push and S' = f'(x) S + forced by h.

    :return: both then, and the rates of both at the beginning and in the last stage.
    """
    k1, s1 = _rates(sizes, numbers, readout, push, forced, x, S)
    y, T = _ahead(x, S, 0.5 * h, k1, s1)
    k2, s2 = _rates(sizes, numbers, readout, push, forced, y, T)
    y, T = _ahead(x, S, 0.5 * h, k2, s2)
    k3, s3 = _rates(sizes, numbers, readout, push, forced, y, T)
    y, T = _ahead(x, S, h, k3, s3)
    k4, s4 = _rates(sizes, numbers, readout, push, forced, y, T)
    for i in range(sizes[N_X]):
        y[i] = x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
        for j in range(S.shape[1]):
            T[i, j] = S[i, j] + h / 6.0 * (s1[i, j] + 2.0 * s2[i, j] + 2.0 * s3[i, j] + s4[i, j])
    return y, T, k1, s1, k4, s4
