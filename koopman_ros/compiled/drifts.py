# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The drift with its Jacobian at many states at once; see :mod:`koopman_ros.compiled.rows`."""

import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import inner
from koopman_ros.compiled.network import (
    IDENTITY,
    N_U,
    N_X,
    N_Z,
    READOUT,
    squash,
    widest,
    WIDTHS,
    widths,
)
from koopman_ros.compiled.rows import (
    add,
    add_product,
    add_weighted,
    factor_rows,
    fill,
    solve_rows,
)

#: Two layers in turns with their first and second derivatives, 2^k, z and what follows of it,
#: a row of the layer twice, J_N and J_N'J_N.
Space = tuple[Array, Array, Array, Array, Array, Array, NDArray[np.int64], Array, Array, Array,
              Array, Array]


@inner
def space_of(sizes: NDArray[np.int64], N: int) -> Space:
    """Return room for :func:`drifts` of N states."""
    n, n_z, width = sizes[N_X], sizes[N_Z], widest(sizes)
    pairs = 0 if sizes[READOUT] else n * (n + 1) // 2
    return (np.empty((width, N)), np.empty((width, N)),
            np.empty((n * width, N)), np.empty((n * width, N)),
            np.empty((pairs * width, N)), np.empty((pairs * width, N)),
            np.empty(width * N, np.int64), np.empty((3 * n_z, N)), np.empty((width, N)),
            np.empty((width, N)), np.empty((n_z * n, N)), np.empty((n * n, N)))


@inner
def _layers(sizes: NDArray[np.int64], numbers: Array, x: Array, space: Space
            ) -> tuple[Array, Array, Array]:
    """
    Return the last hidden layer h less its value at the origin, its derivatives T and those of T.

    Rows of unit i are i of h, k h + i of T by state k, and p h + i of the last, of pairs j <= k of
    states p = k (k + 1) / 2 + j; these are there where there is no read-out.
    """
    n, N, start, last = sizes[N_X], x.shape[1], 0, sizes[N_X]
    h, T, U, before, T_before, U_before, scale = (
        space[0], space[2], space[4], space[1], space[3], space[5], space[6])
    pairs = 0 if sizes[READOUT] else n * (n + 1) // 2
    for layer in range(WIDTHS, len(sizes)):
        width, first = sizes[layer], layer == WIDTHS
        bias = start + width * last
        h, before = before, h
        T, T_before = T_before, T
        U, U_before = U_before, U
        values = x if first else before
        for i in range(width):
            fill(h, i, numbers[bias + i])
            add_weighted(h, i, numbers, start + i, width, values, 0, last)
            for k in range(n):
                fill(T, k * width + i, numbers[start + k * width + i] if first else 0.0)
                if not first:
                    add_weighted(T, k * width + i, numbers, start + i, width, T_before, k * last,
                                 last)
            for p in range(pairs):
                fill(U, p * width + i, 0.0)
                if not first:
                    add_weighted(U, p * width + i, numbers, start + i, width, U_before, p * last,
                                 last)
        squash(h.reshape(h.size), width * N, scale)
        for i in range(width):
            for k in range(n if pairs else 0):
                for j in range(k + 1):
                    p, a, b = (k * (k + 1) // 2 + j) * width + i, k * width + i, j * width + i
                    for c in range(N):
                        t = h[i, c]
                        U[p, c] = (1.0 - t * t) * (U[p, c] - 2.0 * t * T[a, c] * T[b, c])
            for k in range(n):
                a = k * width + i
                for c in range(N):
                    T[a, c] *= 1.0 - h[i, c] * h[i, c]
        start, last = bias + width, width
    if len(sizes) > WIDTHS:
        for i in range(last):
            for c in range(N):
                h[i, c] -= numbers[start + i]
    return h, T, U


@inner
def drifts(sizes: NDArray[np.int64], numbers: Array, x: Array, space: Space, f: Array, J: Array
           ) -> None:
    """
    Write the drift at states (n_x, N) to f, and its Jacobian (n_x^2, N) to J; NaN for none.

    Without a read-out by the normal equations J_N'J_N f = J_N'A z and their derivatives by each
    state.

    :param space: of :func:`space_of`.
    """
    n, N = sizes[N_X], x.shape[1]
    n_z, identity = sizes[N_Z], sizes[IDENTITY]
    width, start = widths(sizes)
    h, T, U = _layers(sizes, numbers, x, space)
    output = start + width
    A = output + n_z * width
    slope = A + n_z * n_z + n * sizes[N_U]
    if sizes[READOUT]:
        readout = slope + n * n
        for i in range(n):
            row = readout + i * (n + width)
            fill(f, i, 0.0)
            add_weighted(f, i, numbers, row, 1, x, 0, n)
            add_weighted(f, i, numbers, row + n, 1, h, 0, width)
            for j in range(n):
                fill(J, i * n + j, numbers[row + j])
                add_weighted(J, i * n + j, numbers, row + n, 1, T, j * width, width)
        return
    of_z, turn, bend, L, square = space[7], space[8], space[9], space[10], space[11]
    # z, then what is left of A z, then what A makes of J_N less how that turns the rate
    rest, bent = n_z, 2 * n_z
    for a in range(n_z):
        own = identity != 0 and a < n
        fill(of_z, a, 0.0)
        if own:
            add(of_z, a, 1.0, x, a)
        else:
            add_weighted(of_z, a, numbers, output + a * width, 1, h, 0, width)
        for k in range(n):
            fill(L, a * n + k, 1.0 if own and a == k else 0.0)
            if not own:
                add_weighted(L, a * n + k, numbers, output + a * width, 1, T, k * width, width)
    for k in range(n):
        fill(f, k, 0.0)
        for j in range(k + 1):
            fill(square, k * n + j, 0.0)
    for a in range(n_z):
        fill(of_z, rest + a, 0.0)
        add_weighted(of_z, rest + a, numbers, A + a * n_z, 1, of_z, 0, n_z)
        for k in range(n):
            add_product(f, k, 1.0, L, a * n + k, of_z, rest + a)
            for j in range(k + 1):
                add_product(square, k * n + j, 1.0, L, a * n + k, L, a * n + j)
    factor_rows(square, n)
    solve_rows(square, n, f, 1)
    for a in range(n_z):
        for k in range(n):
            add_product(of_z, rest + a, -1.0, L, a * n + k, f, k)
    for i in range(width):
        fill(turn, i, 0.0)
        add_weighted(turn, i, numbers, output + i, width, of_z, rest, n_z)
    for k in range(n):
        for i in range(width):
            fill(bend, i, 0.0)
            for j in range(n):
                p = (k * (k + 1) // 2 + j if j <= k else j * (j + 1) // 2 + k) * width + i
                add_product(bend, i, -1.0, U, p, f, j)
        for a in range(n_z):
            fill(of_z, bent + a, 0.0)
            for b in range(n_z):
                add(of_z, bent + a, numbers[A + a * n_z + b], L, b * n + k)
            add_weighted(of_z, bent + a, numbers, output + a * width, 1, bend, 0, width)
        for j in range(n):
            fill(J, j * n + k, 0.0)
            for a in range(n_z):
                add_product(J, j * n + k, 1.0, L, a * n + j, of_z, bent + a)
    for k in range(n):
        for j in range(k + 1):
            p = (k * (k + 1) // 2 + j) * width
            fill(bend, 0, 0.0)
            for i in range(width):
                add_product(bend, 0, 1.0, turn, i, U, p + i)
            add(J, j * n + k, 1.0, bend, 0)
            if j < k:
                add(J, k * n + j, 1.0, bend, 0)
    solve_rows(square, n, J, n)
    for k in range(n):
        for j in range(n):
            add(f, k, -numbers[slope + k * n + j], x, j)
            for c in range(N):
                J[k * n + j, c] -= numbers[slope + k * n + j]
        for c in range(N):
            # beside its own definite matrix there is no rate
            if not 0.0 < square[k * n + k, c] < math.inf:
                f[0, c] = math.nan
