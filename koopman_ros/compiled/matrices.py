# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Small matrices: products, sums, blocks, solutions, in loops.

Libraries take longer to be called than this takes, and array expressions longer to be compiled.
All arrays are contiguous; what is returned is new.
"""

import math

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.compiled.jit import MATRIX, NUMBER, ROOM, SIZE, typed, VECTOR


@typed(MATRIX, MATRIX, ROOM)
def multiply(A: Array, B: Array, C: Array) -> None:
    """Write A B to C."""
    for i in range(A.shape[0]):
        for c in range(B.shape[1]):
            C[i, c] = 0.0
        for j in range(A.shape[1]):
            a = A[i, j]
            for c in range(B.shape[1]):
                C[i, c] += a * B[j, c]


@typed(MATRIX, MATRIX)
def product(A: Array, B: Array) -> Array:
    """Return A B."""
    C = np.empty((A.shape[0], B.shape[1]))
    multiply(A, B, C)
    return C


@typed(MATRIX, MATRIX, ROOM)
def multiply_turned(A: Array, B: Array, C: Array) -> None:
    """Write A' B to C."""
    for i in range(A.shape[1]):
        for c in range(B.shape[1]):
            C[i, c] = 0.0
    for j in range(A.shape[0]):
        for i in range(A.shape[1]):
            a = A[j, i]
            for c in range(B.shape[1]):
                C[i, c] += a * B[j, c]


@typed(MATRIX, VECTOR)
def applied(A: Array, x: Array) -> Array:
    """Return A x."""
    y = np.zeros(A.shape[0])
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            y[i] += A[i, j] * x[j]
    return y


@typed(NUMBER, MATRIX, NUMBER, MATRIX)
def combined(a: float, A: Array, b: float, B: Array) -> Array:
    """Return a A + b B."""
    C = np.empty(A.shape)
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            C[i, j] = a * A[i, j] + b * B[i, j]
    return C


@typed(MATRIX)
def turned(A: Array) -> Array:
    """Return the transpose of A."""
    T = np.empty((A.shape[1], A.shape[0]))
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            T[j, i] = A[i, j]
    return T


@typed(MATRIX, SIZE, SIZE, SIZE, SIZE)
def block(A: Array, row: int, column: int, rows: int, columns: int) -> Array:
    """Return a copy of a block of A."""
    B = np.empty((rows, columns))
    for i in range(rows):
        for j in range(columns):
            B[i, j] = A[row + i, column + j]
    return B


@typed(ROOM, SIZE, SIZE, MATRIX, NUMBER)
def place(A: Array, row: int, column: int, B: Array, factor: float) -> None:
    """Write `factor` times B to a block of A."""
    for i in range(B.shape[0]):
        for j in range(B.shape[1]):
            A[row + i, column + j] = factor * B[i, j]


@typed(SIZE)
def identity(n: int) -> Array:
    """Return the identity matrix."""
    A = np.zeros((n, n))
    for i in range(n):
        A[i, i] = 1.0
    return A


@typed(MATRIX)
def size(A: Array) -> float:
    """Return the Frobenius norm."""
    total = 0.0
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            total += A[i, j] * A[i, j]
    return math.sqrt(total)


@typed(ROOM, ROOM)
def solve_into(U: Array, X: Array) -> bool:
    """Solve U X = X by elimination with partial pivots, which destroys U; False for singular."""
    n, m = U.shape[0], X.shape[1]
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(U[i, k]) > abs(U[best, k]):
                best = i
        if not (abs(U[best, k]) > 0.0 and math.isfinite(U[best, k])):
            return False
        if best != k:
            for j in range(k, n):
                held = U[k, j]
                U[k, j] = U[best, j]
                U[best, j] = held
            for j in range(m):
                held = X[k, j]
                X[k, j] = X[best, j]
                X[best, j] = held
        for i in range(k + 1, n):
            factor = U[i, k] / U[k, k]
            for j in range(k + 1, n):
                U[i, j] -= factor * U[k, j]
            for j in range(m):
                X[i, j] -= factor * X[k, j]
    for k in range(n - 1, -1, -1):
        for i in range(k + 1, n):
            for j in range(m):
                X[k, j] -= U[k, i] * X[i, j]
        for j in range(m):
            X[k, j] /= U[k, k]
    return True


@typed(MATRIX, MATRIX)
def least_squares(J: Array, B: Array) -> Array:
    """Minimise the norm of J X - B, J (n, k) of full rank, by modified Gram-Schmidt."""
    n, k, m = J.shape[0], J.shape[1], B.shape[1]
    Q, R, rest, Y = J.copy(), np.zeros((k, k)), B.copy(), np.zeros((k, m))
    for j in range(k):
        length = 0.0
        for i in range(n):
            length += Q[i, j] * Q[i, j]
        R[j, j] = math.sqrt(length)
        for i in range(n):
            Q[i, j] /= R[j, j]
        for c in range(j + 1, k):
            for i in range(n):
                R[j, c] += Q[i, j] * Q[i, c]
            for i in range(n):
                Q[i, c] -= R[j, c] * Q[i, j]
        for c in range(m):
            for i in range(n):
                Y[j, c] += Q[i, j] * rest[i, c]
            for i in range(n):
                rest[i, c] -= Y[j, c] * Q[i, j]
    for j in range(k - 1, -1, -1):
        for c in range(m):
            for i in range(j + 1, k):
                Y[j, c] -= R[j, i] * Y[i, c]
            Y[j, c] /= R[j, j]
    return Y
