# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The drift with its Jacobian at many states at once.

The last axis of all arrays is that of the states, so that the innermost loops, of which several
turns are taken at once, are as long as there are states, however few numbers one has. What is
multiplied by weights has its derivatives side by side in one row.
"""

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
    WIDTHS,
    widths,
)

# Where what a weighted sum begins with does not lie among the weights.
_NOTHING, _ADD = -1, -2

Space = tuple[Array, Array, Array, Array, NDArray[np.int64], tuple[Array, Array, Array, Array]]


@inner
def space_of(sizes: NDArray[np.int64], numbers: Array, N: int) -> Space:
    """
    Return room for :func:`drifts` of N states.

    All hidden layers (h, N), one after the other, the derivatives (h, n_x, N) of what goes into
    their tanh, of the first of them filled in, a layer with its derivatives twice, 2^k, and z, J_N
    and what follows of it.
    """
    n, n_z, count, width = sizes[N_X], sizes[N_Z], 0, 0
    for layer in range(WIDTHS, len(sizes)):
        count += sizes[layer]
        width = max(width, sizes[layer])
    P = np.empty((count, n, N))
    for i in range(sizes[WIDTHS] if count else 0):
        for k in range(n):
            for c in range(N):
                P[i, k, c] = numbers[k * sizes[WIDTHS] + i]
    return (np.empty((count, N)), P, np.empty((2, width, N)),
            np.empty((2, width, n, N)), np.empty(width * N, np.int64),
            (np.empty((2 * n_z, N)), np.empty((n_z, n, N)), np.empty((n_z, n, N)),
             np.empty((n, n, N))))


@inner
def _flat(A: Array) -> Array:
    """Return (a, b, N) as (a, b N)."""
    return A.reshape((A.shape[0], A.shape[1] * A.shape[2]))


@inner
def _weighted(target: Array, rows: int, weights: Array, start: int, down: int, across: int,
              source: Array, count: int, begin: int) -> None:
    """
    Write to so many rows the weighted sums of the first `count` rows of another array.

    :param start: where the weights begin, which lie `down` apart by row and `across` by column.
    :param begin: where what each row begins with does, `_NOTHING` for 0, or `_ADD` to go on.
    """
    for i in range(rows):
        if begin != _ADD:
            first = weights[begin + i] if begin >= 0 else 0.0
            for c in range(target.shape[1]):
                target[i, c] = first
        for k in range(0, count, 4):
            # four at once; of what there is not, the last by 0
            at = start + i * down + k * across
            second, third, fourth = k + 1, k + 2, k + 3
            p, q, r, s = weights[at], 0.0, 0.0, 0.0
            if second < count:
                q = weights[at + across]
            else:
                second = k
            if third < count:
                r = weights[at + 2 * across]
            else:
                third = k
            if fourth < count:
                s = weights[at + 3 * across]
            else:
                fourth = k
            for c in range(target.shape[1]):
                target[i, c] += (p * source[k, c] + q * source[second, c]) + (
                    r * source[third, c] + s * source[fourth, c])


@inner
def _layers(sizes: NDArray[np.int64], numbers: Array, x: Array, h: Array, P: Array,
            slopes: Array, scale: NDArray[np.int64]) -> int:
    """
    Write the hidden layers to h, and the derivatives of what goes into them to P.

    :param slopes: room for those of two layers.
    :return: which of these is that of the last layer.
    """
    n, N = x.shape
    start, last, row, turn = 0, n, 0, 0
    for layer in range(WIDTHS, len(sizes)):
        width = sizes[layer]
        bias, own = start + width * last, h[row:row + width]
        if layer == WIDTHS:
            _weighted(own, width, numbers, start, 1, width, x, last, bias)
        else:
            _weighted(own, width, numbers, start, 1, width, h[row - last:row], last, bias)
            _weighted(_flat(P[row:row + width]), width, numbers, start, 1, width,
                      _flat(slopes[turn]), last, _NOTHING)
        squash(own.reshape(own.size), width * N, scale)
        turn = 1 - turn
        for i in range(width):
            for k in range(n):
                for c in range(N):
                    slopes[turn, i, k, c] = (1.0 - own[i, c] * own[i, c]) * P[row + i, k, c]
        start, last, row = bias + width, width, row + width
    return turn


@inner
def _turned(sizes: NDArray[np.int64], numbers: Array, h: Array, P: Array, f: Array,
            slopes: Array) -> int:
    """
    Write the derivatives by the state of -dh/dx f of the last layer, under an f that is held.

    :param slopes: room as of :func:`_layers`.
    :return: which of these is that of the last layer.
    """
    n, N = f.shape
    start, last, row, turn, along, slope = 0, n, 0, 0, np.empty(N), np.empty(N)
    for layer in range(WIDTHS, len(sizes)):
        width, turn = sizes[layer], 1 - turn
        if layer > WIDTHS:
            _weighted(_flat(slopes[turn]), width, numbers, start, 1, width,
                      _flat(slopes[1 - turn]), last, _NOTHING)
        for i in range(width):
            for c in range(N):
                along[c] = 0.0
            for k in range(n):
                for c in range(N):
                    along[c] += P[row + i, k, c] * f[k, c]
            for c in range(N):
                t = h[row + i, c]
                slope[c] = 1.0 - t * t
                along[c] *= 2.0 * t * slope[c]
            for k in range(n):
                if layer == WIDTHS:
                    for c in range(N):
                        slopes[turn, i, k, c] = along[c] * P[row + i, k, c]
                else:
                    for c in range(N):
                        slopes[turn, i, k, c] = (
                            slope[c] * slopes[turn, i, k, c] + along[c] * P[row + i, k, c])
        start, last, row = start + width * (last + 1), width, row + width
    return turn


@inner
def _add_bend(sizes: NDArray[np.int64], numbers: Array, h: Array, P: Array, adjoint: Array,
              J: Array) -> None:
    """
    Add to J the second derivatives of a weighted sum of the last layer, from that back.

    :param adjoint: its weights in the first of two rooms of a layer.
    """
    n, N = J.shape[1:]
    row, turn = len(h), 0
    width, start = widths(sizes)
    for layer in range(len(sizes) - 1, WIDTHS - 1, -1):
        width = sizes[layer]
        last = sizes[layer - 1] if layer > WIDTHS else n
        row -= width
        start -= width * (last + 1)
        for i in range(width):
            for c in range(N):
                adjoint[turn, i, c] *= 1.0 - h[row + i, c] * h[row + i, c]
            for k in range(n):
                for j in range(n):
                    for c in range(N):
                        J[j, k, c] -= 2.0 * adjoint[turn, i, c] * h[row + i, c] * P[
                            row + i, k, c] * P[row + i, j, c]
        if layer > WIDTHS:
            _weighted(adjoint[1 - turn], last, numbers, start, width, 1, adjoint[turn], width,
                      _NOTHING)
        turn = 1 - turn


@inner
def _factor(S: Array) -> None:
    """Turn symmetric, definite (n, n, N) into the L D L' of themselves."""
    n, N = S.shape[0], S.shape[2]
    for k in range(n):
        for j in range(k):
            for c in range(N):
                S[k, k, c] -= S[k, j, c] * S[k, j, c] * S[j, j, c]
        for i in range(k + 1, n):
            for j in range(k):
                for c in range(N):
                    S[i, k, c] -= S[i, j, c] * S[k, j, c] * S[j, j, c]
            for c in range(N):
                S[i, k, c] /= S[k, k, c]


@inner
def _solve(S: Array, X: Array) -> None:
    """Solve L D L' X = X (n, m, N) of what :func:`_factor` gave."""
    n, m, N = X.shape
    for k in range(n):
        for i in range(k):
            for j in range(m):
                for c in range(N):
                    X[k, j, c] -= S[k, i, c] * X[i, j, c]
    for k in range(n - 1, -1, -1):
        for j in range(m):
            for c in range(N):
                X[k, j, c] /= S[k, k, c]
        for i in range(k + 1, n):
            for j in range(m):
                for c in range(N):
                    X[k, j, c] -= S[i, k, c] * X[i, j, c]


@inner
def drifts(sizes: NDArray[np.int64], numbers: Array, x: Array, space: Space, f: Array, J: Array
           ) -> None:
    """
    Write the drift at states (n_x, N) to f, and its Jacobian to J (n_x, n_x, N); NaN for none.

    Without a read-out by the normal equations J_N'J_N f = J_N'A z and their derivatives by each
    state.

    :param space: of :func:`space_of`.
    """
    n, N = x.shape
    n_z, identity = sizes[N_Z], sizes[IDENTITY]
    width, start = widths(sizes)
    h, P, adjoint, slopes, scale, (of_z, L, bent, square) = space
    last = slopes[_layers(sizes, numbers, x, h, P, slopes, scale)]
    layer = adjoint[0]
    for i in range(width):
        for c in range(N):
            layer[i, c] = h[len(h) - width + i, c] - numbers[start + i]
    output = start + width
    A = output + n_z * width
    slope = A + n_z * n_z + n * sizes[N_U]
    if sizes[READOUT]:
        down, readout = n + width, slope + n * n
        _weighted(f, n, numbers, readout, down, 1, x, n, _NOTHING)
        _weighted(f, n, numbers, readout + n, down, 1, layer, width, _ADD)
        for i in range(n):
            for j in range(n):
                for c in range(N):
                    J[i, j, c] = numbers[readout + i * down + j]
        _weighted(_flat(J), n, numbers, readout + n, down, 1, _flat(last), width, _ADD)
        return
    # in the second half of the first A z, then what J_N f leaves of it
    rest = of_z[n_z:]
    _weighted(of_z, n_z, numbers, output, width, 1, layer, width, _NOTHING)
    _weighted(_flat(L), n_z, numbers, output, width, 1, _flat(last), width, _NOTHING)
    if identity:
        for i in range(n):
            for c in range(N):
                of_z[i, c] = x[i, c]
            for k in range(n):
                for c in range(N):
                    L[i, k, c] = 1.0 if i == k else 0.0
    _weighted(rest, n_z, numbers, A, n_z, 1, of_z, n_z, _NOTHING)
    for k in range(n):
        for c in range(N):
            f[k, c] = 0.0
        for a in range(n_z):
            for c in range(N):
                f[k, c] += L[a, k, c] * rest[a, c]
        for j in range(n):
            for c in range(N):
                J[k, j, c] = 0.0
        for j in range(k + 1):
            for c in range(N):
                square[k, j, c] = 0.0
            for a in range(n_z):
                for c in range(N):
                    square[k, j, c] += L[a, k, c] * L[a, j, c]
    _factor(square)
    _solve(square, f.reshape((n, 1, N)))
    # how the rest turns with J_N; of as many coordinates as states there is none
    if n_z > n:
        for a in range(n_z):
            for k in range(n):
                for c in range(N):
                    rest[a, c] -= L[a, k, c] * f[k, c]
        _weighted(layer, width, numbers, output, 1, width, rest, n_z, _NOTHING)
        _add_bend(sizes, numbers, h, P, adjoint, J)
    # what A makes of J_N, less how that turns the rate
    last = slopes[_turned(sizes, numbers, h, P, f, slopes)]
    _weighted(_flat(bent), n_z, numbers, output, width, 1, _flat(last), width, _NOTHING)
    _weighted(_flat(bent), n_z, numbers, A, n_z, 1, _flat(L), n_z, _ADD)
    for j in range(n):
        for k in range(n):
            for a in range(n_z):
                for c in range(N):
                    J[j, k, c] += L[a, j, c] * bent[a, k, c]
    _solve(square, J)
    for k in range(n):
        for j in range(n):
            part = numbers[slope + k * n + j]
            for c in range(N):
                f[k, c] -= part * x[j, c]
                J[k, j, c] -= part
        for c in range(N):
            # beside a definite matrix there is no rate
            if not 0.0 < square[k, k, c] < math.inf:
                f[0, c] = math.nan
