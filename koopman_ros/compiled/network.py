# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A model out of its layout, and its lift with secants."""

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import inner, INTEGERS, SIZE, typed, VECTOR
from koopman_ros.compiled.matrices import identity, product

Weights = tuple[Array, Array, Array, Array, Array]

# Places in the sizes of a layout; widths of the hidden layers follow.
N_X, N_U, N_Z, IDENTITY, READOUT, WIDTHS = range(6)
_TINY = 1e-300  # beside which no difference of a ratio is seen
_FLAT = 40.0  # of 2 |a|, from which on tanh is 1
_LOG2_E = 1.0 / math.log(2.0)
# ln 2 = 0x1.62e42fefa39efp-1, its first digits, of which products with small integers are exact,
# and the rest
_LN2_HIGH, _LN2_LOW = float.fromhex('0x1.62e42fee00000p-1'), float.fromhex('0x1.a39ef35793c76p-33')


@typed(VECTOR, SIZE, SIZE, SIZE)
def matrix(numbers: Array, start: int, rows: int, columns: int) -> Array:
    """Return a matrix among the numbers of a layout, where it is."""
    return numbers[start:start + rows * columns].reshape((rows, columns))


@inner
def widths(sizes: NDArray[np.int64]) -> tuple[int, int]:
    """Return the width of the last hidden layer, and where what follows the layers begins."""
    width, start, before = 0, 0, sizes[N_X]
    for layer in range(WIDTHS, len(sizes)):
        width = sizes[layer]
        start += width * (before + 1)
        before = width
    return width, start


@inner
def weights_of(sizes: NDArray[np.int64], numbers: Array) -> Weights:
    """Return output, A, B, slope of the pre-feedback and read-out of a layout, where they are."""
    n, m, n_z = sizes[N_X], sizes[N_U], sizes[N_Z]
    width, start = widths(sizes)
    output = start + width
    A = output + n_z * width
    B = A + n_z * n_z
    slope = B + n * m
    return (matrix(numbers, output, n_z, width), matrix(numbers, A, n_z, n_z),
            matrix(numbers, B, n, m), matrix(numbers, slope, n, n),
            matrix(numbers, slope + n * n, n, n + width))


@inner
def squash(a: Array, width: int, scale: NDArray[np.int64]) -> None:
    """
    Turn so many numbers into their tanh = (e - 1) / (e + 1) with e = exp(2 |a|) = 2^k exp(r).

    A loop without calls, of which several turns are taken at once; `scale` is room for 2^k.
    """
    for i in range(width):
        scale[i] = (np.int64(math.floor(min(_FLAT, 2.0 * abs(a[i])) * _LOG2_E + 0.5)) + 1023) << 52
    powers = scale.view(np.float64)
    for i in range(width):
        y = 2.0 * abs(a[i])
        if y > _FLAT:
            y = _FLAT
        k = math.floor(y * _LOG2_E + 0.5)
        r = (y - k * _LN2_HIGH) - k * _LN2_LOW
        # of exp(r) - 1, whose digits are all needed where a is small
        q = 1.0 / 6227020800.0
        q = q * r + 1.0 / 479001600.0
        q = q * r + 1.0 / 39916800.0
        q = q * r + 1.0 / 3628800.0
        q = q * r + 1.0 / 362880.0
        q = q * r + 1.0 / 40320.0
        q = q * r + 1.0 / 5040.0
        q = q * r + 1.0 / 720.0
        q = q * r + 1.0 / 120.0
        q = q * r + 1.0 / 24.0
        q = q * r + 1.0 / 6.0
        q = q * r + 0.5
        q = (q * r + 1.0) * r
        less = powers[i] * q + (powers[i] - 1.0)
        t = less / (less + 2.0)
        a[i] = t if a[i] > 0.0 else -t


@typed(INTEGERS, VECTOR, VECTOR, VECTOR, VECTOR)
def secants(sizes: NDArray[np.int64], numbers: Array, x: Array, x_ref: Array, w: Array
            ) -> tuple[Array, Array, Array, Array]:
    """
    Return the last hidden layer (h,) less its value at the origin, and dh/dx (h, n_x).

    Beside them the secants of both.
    """
    n = sizes[N_X]
    h, g, p, start, last = x.copy(), x_ref.copy(), w.copy(), 0, n
    T, S, G = identity(n), identity(n), np.zeros((n, n))
    for layer in range(WIDTHS, len(sizes)):
        width = sizes[layer]
        h_1, g_1, p_1 = np.empty(width), np.empty(width), np.empty(width)
        T_1, S_1, G_1 = np.zeros((width, n)), np.zeros((width, n)), np.zeros((width, n))
        bias = start + width * last
        for i in range(width):
            a = b = numbers[bias + i]
            q = 0.0
            for j in range(last):
                weight = numbers[start + j * width + i]
                a += weight * h[j]
                b += weight * g[j]
                q += weight * p[j]
                for k in range(n):
                    T_1[i, k] += weight * T[j, k]
                    S_1[i, k] += weight * S[j, k]
                    G_1[i, k] += weight * G[j, k]
            t, r = math.tanh(a), math.tanh(b)
            apart = (a - b) + math.copysign(_TINY, a - b)
            slope = math.tanh(apart) / apart * (1.0 - t * r)
            bend, at_x, at_ref = -(t + r) * slope, 1.0 - t * t, 1.0 - r * r
            h_1[i], g_1[i], p_1[i] = t, r, at_x * q
            for k in range(n):
                G_1[i, k] = bend * q * S_1[i, k] + at_ref * G_1[i, k]
                S_1[i, k] *= slope
                T_1[i, k] *= at_x
        h, g, p, T, S, G = h_1, g_1, p_1, T_1, S_1, G_1
        start, last = bias + width, width
    if len(sizes) == WIDTHS:
        empty = np.empty((0, n))
        return np.empty(0), empty, empty, empty
    for i in range(last):
        h[i] -= numbers[start + i]
    return h, T, S, G


@inner
def lifted(sizes: NDArray[np.int64], output: Array, rows: Array, states: float) -> Array:
    """
    Return coordinates (n_z, k) of rows (h, k) of the hidden layer, as far as they are of it.

    Where z starts with the state, those are `states` times the identity matrix.
    """
    n = sizes[N_X]
    found = product(output, rows)
    if sizes[IDENTITY] and states != 0.0:
        for i in range(n):
            found[i, i] = states
    return found
