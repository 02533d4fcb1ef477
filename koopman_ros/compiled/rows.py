# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Small matrices of many states at once: each number of a state is a row, with one column a state.

So the loops within run over states, side by side, however few numbers a state has.
"""

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import inner


@inner
def fill(target: Array, row: int, value: float) -> None:
    """Write a number to a row."""
    for c in range(target.shape[1]):
        target[row, c] = value


@inner
def add(target: Array, row: int, factor: float, source: Array, at: int) -> None:
    """Add to a row a factor times another."""
    for c in range(target.shape[1]):
        target[row, c] += factor * source[at, c]


@inner
def add_product(target: Array, row: int, factor: float, A: Array, a: int, B: Array, b: int
                ) -> None:
    """Add to a row a factor times the product of two others."""
    for c in range(target.shape[1]):
        target[row, c] += factor * A[a, c] * B[b, c]


@inner
def add_weighted(target: Array, row: int, weights: Array, start: int, stride: int, source: Array,
                 first: int, count: int) -> None:
    """Add to a row so many rows from the first on, by weights from a start on, so far apart."""
    whole = count - count % 4
    for k in range(0, whole, 4):
        at, i = start + k * stride, first + k
        p, q, r, s = (weights[at], weights[at + stride], weights[at + 2 * stride],
                      weights[at + 3 * stride])
        for c in range(target.shape[1]):
            target[row, c] += (p * source[i, c] + q * source[i + 1, c]) + (
                r * source[i + 2, c] + s * source[i + 3, c])
    for k in range(whole, count):
        add(target, row, weights[start + k * stride], source, first + k)


@inner
def factor_rows(S: Array, n: int) -> None:
    """Turn symmetric, definite (n, n) into the L D L' of themselves."""
    for k in range(n):
        for j in range(k):
            for c in range(S.shape[1]):
                S[k * n + k, c] -= S[k * n + j, c] * S[k * n + j, c] * S[j * n + j, c]
        for i in range(k + 1, n):
            for j in range(k):
                for c in range(S.shape[1]):
                    S[i * n + k, c] -= S[i * n + j, c] * S[k * n + j, c] * S[j * n + j, c]
            for c in range(S.shape[1]):
                S[i * n + k, c] /= S[k * n + k, c]


@inner
def solve_rows(S: Array, n: int, X: Array, m: int) -> None:
    """Solve L D L' X = X (n, m) of what :func:`factor_rows` gave."""
    for k in range(n):
        for i in range(k):
            for j in range(m):
                add_product(X, k * m + j, -1.0, S, k * n + i, X, i * m + j)
    for k in range(n - 1, -1, -1):
        for j in range(m):
            for c in range(X.shape[1]):
                X[k * m + j, c] /= S[k * n + k, c]
        for i in range(k + 1, n):
            for j in range(m):
                add_product(X, k * m + j, -1.0, S, i * n + k, X, i * m + j)
