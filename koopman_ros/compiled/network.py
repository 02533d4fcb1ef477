# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A model out of its layout, its lift and secants, and its drift with the Jacobian."""

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import inner
from koopman_ros.compiled.matrices import (
    applied,
    block,
    factor_into,
    identity,
    least_squares,
    product,
    solve_factored,
)

# Places in the sizes of a layout; widths of the hidden layers follow.
N_X, N_U, N_Z, IDENTITY, READOUT, WIDTHS = range(6)
_TINY = 1e-300  # beside which no difference of a ratio is seen
_FLAT = 40.0  # of 2 |a|, from which on tanh is 1
_LOG2_E = 1.0 / math.log(2.0)
# ln 2 = 0x1.62e42fefa39efp-1, its first digits, of which products with small integers are exact,
# and the rest
_LN2_HIGH, _LN2_LOW = float.fromhex('0x1.62e42fee00000p-1'), float.fromhex('0x1.a39ef35793c76p-33')


@inner
def _matrix(numbers: Array, start: int, rows: int, columns: int) -> Array:
    found = np.empty((rows, columns))
    for i in range(rows):
        for j in range(columns):
            found[i, j] = numbers[start + i * columns + j]
    return found


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
def matrices(sizes: NDArray[np.int64], numbers: Array) -> tuple[Array, Array, Array, Array]:
    """Return A, B, the slope of the pre-feedback and the read-out of a layout."""
    n, m, n_z = sizes[N_X], sizes[N_U], sizes[N_Z]
    width, start = widths(sizes)
    start += width * (1 + n_z)
    A = _matrix(numbers, start, n_z, n_z)
    start += n_z * n_z
    B = _matrix(numbers, start, n, m)
    start += n * m
    slope = _matrix(numbers, start, n, n)
    return A, B, slope, _matrix(numbers, start + n * n, n, n + width)


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


@inner
def room(sizes: NDArray[np.int64], curved: bool
         ) -> tuple[Array, Array, Array, Array, Array, Array, NDArray[np.int64]]:
    """
    Return room for :func:`hidden_into`: two layers in turns with their derivatives, and 2^k.

    :param curved: whether the second derivatives are wanted, too.
    """
    n, width = sizes[N_X], 0
    for layer in range(WIDTHS, len(sizes)):
        width = max(width, sizes[layer])
    pairs = n * n if curved else 0
    return (np.empty(width), np.empty(width), np.empty((n, width)), np.empty((n, width)),
            np.empty((pairs, width)), np.empty((pairs, width)), np.empty(width, np.int64))


@inner
def free_room(sizes: NDArray[np.int64]) -> tuple[Array, Array, Array, Array]:
    """Return room for :func:`free`: rows of z, rows of states, two rows of the layer, J_N."""
    n, n_z = sizes[N_X], sizes[N_Z]
    width, _ = widths(sizes)
    return np.empty((3, n_z)), np.empty((n + 1, n)), np.empty((2, width)), np.empty((n_z, n))


@inner
def hidden_into(sizes: NDArray[np.int64], numbers: Array, x: Array, h: Array, before: Array,
                T: Array, T_before: Array, U: Array, U_before: Array, scale: NDArray[np.int64]
                ) -> None:
    """
    Write the last hidden layer, less its value at the origin, to h, and dh/dx (n_x, h) to T.

    Where there is room for them, the second derivatives go to U (n_x^2, h).
    """
    n, start, last = sizes[N_X], 0, sizes[N_X]
    curved = len(U) > 0
    for layer in range(WIDTHS, len(sizes)):
        width = sizes[layer]
        bias, first = start + width * last, layer == WIDTHS
        if not first:
            for i in range(last):
                before[i] = h[i]
            for k in range(n):
                for i in range(last):
                    T_before[k, i] = T[k, i]
            for k in range(len(U)):
                for i in range(last):
                    U_before[k, i] = U[k, i]
        for i in range(width):
            h[i] = numbers[bias + i]
        for k in range(n):
            for i in range(width):
                T[k, i] = 0.0
        for k in range(len(U)):
            for i in range(width):
                U[k, i] = 0.0
        for j in range(last):
            row = start + j * width
            value = x[j] if first else before[j]
            for i in range(width):
                h[i] += numbers[row + i] * value
            for k in range(n):
                slope = (1.0 if j == k else 0.0) if first else T_before[k, j]
                for i in range(width):
                    T[k, i] += numbers[row + i] * slope
            if not first:
                for k in range(len(U)):
                    bend = U_before[k, j]
                    for i in range(width):
                        U[k, i] += numbers[row + i] * bend
        squash(h, width, scale)
        if curved:
            for k in range(n):
                for j in range(n):
                    for i in range(width):
                        U[k * n + j, i] = (1.0 - h[i] * h[i]) * (
                            U[k * n + j, i] - 2.0 * h[i] * T[k, i] * T[j, i])
        for k in range(n):
            for i in range(width):
                T[k, i] *= 1.0 - h[i] * h[i]
        start, last = bias + width, width
    if len(sizes) > WIDTHS:
        for i in range(last):
            h[i] -= numbers[start + i]


@inner
def hidden(sizes: NDArray[np.int64], numbers: Array, x: Array) -> tuple[Array, Array]:
    """Return the last hidden layer (h,) less its value at the origin, and dh/dx (n_x, h)."""
    h, before, T, T_before, U, U_before, scale = room(sizes, False)
    hidden_into(sizes, numbers, x, h, before, T, T_before, U, U_before, scale)
    width = sizes[len(sizes) - 1] if len(sizes) > WIDTHS else 0
    return h[:width].copy(), block(T, 0, 0, sizes[N_X], width)


@inner
def secants(sizes: NDArray[np.int64], numbers: Array, x: Array, x_ref: Array, w: Array
            ) -> tuple[Array, Array, Array, Array]:
    """Return the hidden layer as :func:`hidden`, and secants of it and its derivative (h, n_x)."""
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
def output_of(sizes: NDArray[np.int64], numbers: Array) -> Array:
    """Return the output (n_z, h) of a layout."""
    width, start = widths(sizes)
    return _matrix(numbers, start + width, sizes[N_Z], width)


@inner
def parts_of(sizes: NDArray[np.int64], numbers: Array) -> tuple[Array, Array, Array, Array]:
    """Return A, slope of the pre-feedback, read-out and output of a layout."""
    A, _, slope, readout = matrices(sizes, numbers)
    return A, slope, readout, output_of(sizes, numbers)


@inner
def lifted(sizes: NDArray[np.int64], numbers: Array, rows: Array, states: float) -> Array:
    """
    Return coordinates (n_z, k) of rows (h, k) of the hidden layer, as far as they are of it.

    Where z starts with the state, those are `states` times the identity matrix.
    """
    n = sizes[N_X]
    found = product(output_of(sizes, numbers), rows)
    if sizes[IDENTITY] and states != 0.0:
        for i in range(n):
            found[i, i] = states
    return found


@inner
def drift(sizes: NDArray[np.int64], numbers: Array, A: Array, slope: Array, readout: Array,
          x: Array) -> Array:
    """Return the drift (n_x,) at a state."""
    n = sizes[N_X]
    h, T = hidden(sizes, numbers, x)
    if sizes[READOUT]:
        return applied(readout, np.concatenate((x, h)))
    n_z = len(A)
    width, start = widths(sizes)
    z, J = np.empty(n_z), np.empty((n_z, n))
    for a in range(n_z):
        row, states = start + width * (1 + a), sizes[IDENTITY] and a < n
        total = 0.0
        for i in range(width):
            total += numbers[row + i] * h[i]
        z[a] = x[a] if states else total
        for k in range(n):
            total = 0.0
            for i in range(width):
                total += numbers[row + i] * T[k, i]
            J[a, k] = (1.0 if a == k else 0.0) if states else total
    rate, by_slope = least_squares(J, applied(A, z).reshape((n_z, 1))), applied(slope, x)
    for i in range(n):
        by_slope[i] = rate[i, 0] - by_slope[i]
    return by_slope


@inner
def read_out(readout: Array, x: Array, h: Array, T: Array, f: Array, J: Array) -> None:
    """Write the drift of a read-out to f, and its Jacobian to J, of what `hidden_into` gave."""
    n = len(f)
    width = readout.shape[1] - n
    for i in range(n):
        total = 0.0
        for k in range(width):
            total += readout[i, n + k] * h[k]
        for j in range(n):
            total += readout[i, j] * x[j]
        f[i] = total
        for j in range(n):
            total = readout[i, j]
            for k in range(width):
                total += readout[i, n + k] * T[j, k]
            J[i, j] = total


@inner
def free(A: Array, slope: Array, output: Array, identity: int, x: Array, h: Array, T: Array,
         U: Array, space: tuple[Array, Array, Array, Array], f: Array, J: Array) -> bool:
    """
    Write the drift without a read-out to f, and its Jacobian to J; False where it has none.

    By the normal equations J_N'J_N f = J_N'A z and their derivatives by each state.

    :param identity: whether z starts with the state; h, T and U are of `hidden_into`.
    """
    n, n_z, width = len(f), len(A), output.shape[1]
    of_z, of_x, of_layer, L = space
    z, rest, bent, turn, bend = of_z[0], of_z[1], of_z[2], of_layer[0], of_layer[1]
    square, rate = of_x[:n], of_x[n].reshape((n, 1))
    for a in range(n_z):
        total = 0.0
        for i in range(width):
            total += output[a, i] * h[i]
        z[a] = x[a] if identity and a < n else total
        for k in range(n):
            total = 0.0
            for i in range(width):
                total += output[a, i] * T[k, i]
            L[a, k] = total
    if identity:
        for a in range(n):
            for k in range(n):
                L[a, k] = 1.0 if a == k else 0.0
    for k in range(n):
        rate[k, 0] = 0.0
        for j in range(n):
            square[k, j] = 0.0
    for a in range(n_z):
        total = 0.0
        for b in range(n_z):
            total += A[a, b] * z[b]
        rest[a] = total
        for k in range(n):
            rate[k, 0] += L[a, k] * total
            for j in range(n):
                square[k, j] += L[a, k] * L[a, j]
    fine = factor_into(square)
    solve_factored(square, rate)
    for a in range(n_z):
        for k in range(n):
            rest[a] -= L[a, k] * rate[k, 0]
    for i in range(width):
        turn[i] = 0.0
    for a in range(n_z):
        for i in range(width):
            turn[i] += output[a, i] * rest[a]
    for k in range(n):
        for i in range(width):
            bend[i] = 0.0
        for j in range(n):
            for i in range(width):
                bend[i] += U[k * n + j, i] * rate[j, 0]
        for a in range(n_z):
            # what A makes of the state's direction, less how J_N turns the rate
            total = 0.0
            for b in range(n_z):
                total += A[a, b] * L[b, k]
            for i in range(width):
                total -= output[a, i] * bend[i]
            bent[a] = total
        for j in range(n):
            total = 0.0
            for a in range(n_z):
                total += L[a, j] * bent[a]
            for i in range(width):
                total += turn[i] * U[k * n + j, i]
            J[j, k] = total
    solve_factored(square, J)
    for j in range(n):
        f[j] = rate[j, 0]
        for k in range(n):
            f[j] -= slope[j, k] * x[k]
            J[j, k] -= slope[j, k]
    return fine


@inner
def rate_into(sizes: NDArray[np.int64], parts: tuple[Array, Array, Array, Array], x: Array,
              h: Array, T: Array, U: Array, space: tuple[Array, Array, Array, Array], f: Array,
              J: Array) -> None:
    """
    Write the drift to f, and its Jacobian to J, of what `hidden_into` gave; NaN for none.

    :param parts: of :func:`parts_of`.
    :param space: of :func:`free_room`.
    """
    A, slope, readout, output = parts
    if sizes[READOUT]:
        read_out(readout, x, h, T, f, J)
    elif not free(A, slope, output, sizes[IDENTITY], x, h, T, U, space, f, J):
        f[0] = J[0, 0] = math.nan


@inner
def drift_and_jacobian(sizes: NDArray[np.int64], numbers: Array,
                       parts: tuple[Array, Array, Array, Array], x: Array) -> tuple[Array, Array]:
    """Return the drift and its Jacobian (n_x, n_x); see :func:`rate_into`."""
    h, before, T, T_before, U, U_before, scale = room(sizes, not sizes[READOUT])
    hidden_into(sizes, numbers, x, h, before, T, T_before, U, U_before, scale)
    f, J = np.empty(len(x)), np.empty((len(x), len(x)))
    rate_into(sizes, parts, x, h, T, U, free_room(sizes), f, J)
    return f, J
