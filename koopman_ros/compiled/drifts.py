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
    matrix,
    N_X,
    N_Z,
    READOUT,
    squash,
    Weights,
    weights_of,
    WIDTHS,
    widths,
)

Layers = tuple[Array, Array, Array, Array, NDArray[np.int64]]
Space = tuple[Layers, Weights, tuple[Array, Array, Array, Array]]


@inner
def space_of(sizes: NDArray[np.int64], numbers: Array, N: int) -> Space:
    """
    Return what :func:`drifts` of N states needs.

    Of all hidden layers, one after the other, h (h, N) and the derivatives P (h, n_x, N) of what
    goes into their tanh, of the first of them filled in; room for a layer and its derivatives,
    twice each, and for 2^k. What :func:`weights_of` gives. Room for z, J_N, and what follows of
    it.
    """
    n, n_z, count, most = sizes[N_X], sizes[N_Z], 0, 0
    for layer in range(WIDTHS, len(sizes)):
        count += sizes[layer]
        most = max(most, sizes[layer])
    P = np.empty((count, n, N))
    for i in range(sizes[WIDTHS] if count else 0):
        for k in range(n):
            for c in range(N):
                P[i, k, c] = numbers[k * sizes[WIDTHS] + i]
    return ((np.empty((count, N)), P, np.empty((2, most, N)), np.empty((2, most, n, N)),
             np.empty(most * N, np.int64)),
            weights_of(sizes, numbers),
            (np.empty((2 * n_z, N)), np.empty((n_z, n, N)), np.empty((n_z, n, N)),
             np.empty((n, n, N))))


@inner
def _flat(A: Array) -> Array:
    """Return (a, b, N) as (a, b N)."""
    return A.reshape((A.shape[0], A.shape[1] * A.shape[2]))


@inner
def _clear(A: Array) -> None:
    for i in range(A.shape[0]):
        for c in range(A.shape[1]):
            A[i, c] = 0.0


@inner
def _add_weighted(target: Array, weights: Array, source: Array, count: int) -> None:
    """Add the last columns of weights times the first rows of another array, so many."""
    first = weights.shape[1] - count
    for i in range(weights.shape[0]):
        for k in range(0, count, 4):
            # four at once; of what there is not, the first by 0
            p, q, r, s, second, third, fourth = weights[i, first + k], 0.0, 0.0, 0.0, k, k, k
            if k + 1 < count:
                second, q = k + 1, weights[i, first + k + 1]
            if k + 2 < count:
                third, r = k + 2, weights[i, first + k + 2]
            if k + 3 < count:
                fourth, s = k + 3, weights[i, first + k + 3]
            for c in range(target.shape[1]):
                target[i, c] += (p * source[k, c] + q * source[second, c]) + (
                    r * source[third, c] + s * source[fourth, c])


@inner
def _add_turned(target: Array, weights: Array, source: Array) -> None:
    """Add the transpose of weights times as many rows of another array as they have."""
    count = weights.shape[0]
    for i in range(weights.shape[1]):
        for k in range(0, count, 2):
            p, q, second = weights[k, i], 0.0, k
            if k + 1 < count:
                second, q = k + 1, weights[k + 1, i]
            for c in range(target.shape[1]):
                target[i, c] += p * source[k, c] + q * source[second, c]


@inner
def _layers(sizes: NDArray[np.int64], numbers: Array, x: Array, space: Layers) -> int:
    """
    Evaluate the hidden layers.

    :return: in which of the room for two layers the derivatives of the last one are.
    """
    h, P, _, slopes, scale = space
    n, N = x.shape
    start, last, row, turn = 0, n, 0, 0
    for layer in range(WIDTHS, len(sizes)):
        width = sizes[layer]
        bias, own = start + width * last, h[row:row + width]
        weights = matrix(numbers, start, last, width)
        for i in range(width):
            for c in range(N):
                own[i, c] = numbers[bias + i]
        if layer > WIDTHS:
            into = _flat(P[row:row + width])
            _clear(into)
            _add_turned(into, weights, _flat(slopes[turn]))
        _add_turned(own, weights, h[row - last:row] if layer > WIDTHS else x)
        squash(own.reshape(own.size), width * N, scale)
        turn = 1 - turn
        for i in range(width):
            for k in range(n):
                for c in range(N):
                    slopes[turn, i, k, c] = (1.0 - own[i, c] * own[i, c]) * P[row + i, k, c]
        start, last, row = bias + width, width, row + width
    return turn


@inner
def _turned(sizes: NDArray[np.int64], numbers: Array, f: Array, space: Layers) -> int:
    """
    Derive -dh/dx f of the last layer by the state, under an f (n_x, N) that is held.

    :return: in which of the room for two layers that is.
    """
    h, P, rooms, slopes, _ = space
    n, N = f.shape
    start, last, row, turn, along, slope = 0, n, 0, 0, rooms[0], rooms[1]
    for layer in range(WIDTHS, len(sizes)):
        width, turn = sizes[layer], 1 - turn
        if layer > WIDTHS:
            _clear(_flat(slopes[turn]))
            _add_turned(_flat(slopes[turn]), matrix(numbers, start, last, width),
                        _flat(slopes[1 - turn]))
        for i in range(width):
            for c in range(N):
                along[0, c] = 0.0
            for k in range(n):
                for c in range(N):
                    along[0, c] += P[row + i, k, c] * f[k, c]
            for c in range(N):
                t = h[row + i, c]
                slope[0, c] = 1.0 - t * t
                along[0, c] *= 2.0 * t * slope[0, c]
            for k in range(n):
                if layer == WIDTHS:
                    for c in range(N):
                        slopes[turn, i, k, c] = along[0, c] * P[row + i, k, c]
                else:
                    for c in range(N):
                        slopes[turn, i, k, c] = (slope[0, c] * slopes[turn, i, k, c]
                                                 + along[0, c] * P[row + i, k, c])
        start, last, row = start + width * (last + 1), width, row + width
    return turn


@inner
def _add_bend(sizes: NDArray[np.int64], numbers: Array, space: Layers, J: Array) -> None:
    """
    Add to J the second derivatives of a weighted sum of the last layer, from that back.

    Its weights are in the first of the room for two layers.
    """
    h, P, adjoint, _, _ = space
    n, N = J.shape[1:]
    row, turn = len(h), 0
    _, start = widths(sizes)
    for layer in range(len(sizes) - 1, WIDTHS - 1, -1):
        width, last = sizes[layer], sizes[layer - 1] if layer > WIDTHS else n
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
            _clear(adjoint[1 - turn])
            _add_weighted(adjoint[1 - turn], matrix(numbers, start, last, width), adjoint[turn],
                          width)
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

    Of an empty J only the drift is wanted. Without a read-out by the normal equations
    J_N'J_N f = J_N'A z and their derivatives by each state.

    :param space: of :func:`space_of`.
    """
    n, N = x.shape
    n_z, identity = sizes[N_Z], sizes[IDENTITY]
    layers, (output, A, _, slope, readout), (of_z, L, bent, square) = space
    h, slopes, layer = layers[0], layers[3], layers[2][0]
    last = slopes[_layers(sizes, numbers, x, layers)]
    width, start = widths(sizes)
    for i in range(width):
        for c in range(N):
            layer[i, c] = h[len(h) - width + i, c] - numbers[start + i]
    if sizes[READOUT]:
        _clear(f)
        for i in range(n):
            for j in range(n):
                for c in range(N):
                    f[i, c] += readout[i, j] * x[j, c]
        _add_weighted(f, readout, layer, width)
        if len(J):
            for i in range(n):
                for j in range(n):
                    for c in range(N):
                        J[i, j, c] = readout[i, j]
            _add_weighted(_flat(J), readout, _flat(last), width)
        return
    # in the second half of the first A z, then what J_N f leaves of it
    rest = of_z[n_z:]
    _clear(of_z)
    _add_weighted(of_z, output, layer, width)
    _clear(_flat(L))
    _add_weighted(_flat(L), output, _flat(last), width)
    if identity:
        for i in range(n):
            for c in range(N):
                of_z[i, c] = x[i, c]
            for k in range(n):
                for c in range(N):
                    L[i, k, c] = 1.0 if i == k else 0.0
    _add_weighted(rest, A, of_z, n_z)
    for k in range(n):
        for c in range(N):
            f[k, c] = 0.0
        for a in range(n_z):
            for c in range(N):
                f[k, c] += L[a, k, c] * rest[a, c]
        for j in range(k + 1):
            for c in range(N):
                square[k, j, c] = 0.0
            for a in range(n_z):
                for c in range(N):
                    square[k, j, c] += L[a, k, c] * L[a, j, c]
    _factor(square)
    _solve(square, f.reshape((n, 1, N)))
    if n > 1 or len(J):
        for a in range(n_z):
            for k in range(n):
                for c in range(N):
                    rest[a, c] -= L[a, k, c] * f[k, c]
    if n > 1 and len(J) == 0:
        # the digits that the square of J_N has lost
        more = of_z[:n]
        _clear(more)
        for k in range(n):
            for a in range(n_z):
                for c in range(N):
                    more[k, c] += L[a, k, c] * rest[a, c]
        _solve(square, more.reshape((n, 1, N)))
        for k in range(n):
            for c in range(N):
                f[k, c] += more[k, c]
    if len(J):
        _clear(_flat(J))
        # how the rest turns with J_N; of as many coordinates as states there is none
        if n_z > n:
            _clear(layer)
            _add_turned(layer, output, rest)
            _add_bend(sizes, numbers, layers, J)
        # what A makes of J_N, less how that turns the rate
        last = slopes[_turned(sizes, numbers, f, layers)]
        _clear(_flat(bent))
        _add_weighted(_flat(bent), output, _flat(last), width)
        _add_weighted(_flat(bent), A, _flat(L), n_z)
        for j in range(n):
            for k in range(n):
                for a in range(n_z):
                    for c in range(N):
                        J[j, k, c] += L[a, j, c] * bent[a, k, c]
        _solve(square, J)
    for k in range(n):
        for j in range(n):
            for c in range(N):
                f[k, c] -= slope[k, j] * x[j, c]
        for j in range(n if len(J) else 0):
            for c in range(N):
                J[k, j, c] -= slope[k, j]
        for c in range(N):
            # beside a definite matrix there is no rate
            if not 0.0 < square[k, k, c] < math.inf:
                f[0, c] = math.nan
                if len(J):
                    J[0, 0, c] = math.nan
