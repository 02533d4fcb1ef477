# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The quadratic program of a plan: linearised roll-out and condensing to the inputs, by numba.

Importing this module compiles it, for models of any size at once, or loads it from numba's cache.
That knows a function by the file that holds it, so that all compiled functions are in this one.
"""

from collections.abc import Callable
import math
from typing import Any, NamedTuple, TypeVar

from numba import njit, types
import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array

Function = TypeVar('Function', bound=Callable[..., Any])

_VECTOR, _MATRIX, _CUBE = (types.Array(types.float64, n, 'C', readonly=True) for n in (1, 2, 3))
_SIZES, _EXPONENTS = (types.Array(types.int64, n, 'C', readonly=True) for n in (1, 2))


class ModelArrays(NamedTuple):
    """
    The numbers of a model with dz/dt = A z + J_N(x) B(x) u, z = P phi(x).

    phi are the states and the units of the last hidden layer, or monomials.
    """

    widths: NDArray[np.int64]  #: (n_l,) of the hidden layers of tanh units
    layers: Array  #: of each of them the transposed weights and the biases, in one row
    origin: Array  #: (h,) the last hidden layer at x = 0
    exponents: NDArray[np.int64]  #: (n_phi, n_x) of monomials; no row where there is a network
    lift: Array  #: P (n_z, n_phi)
    A: Array  #: (n_z, n_z)
    readout: Array  #: (n_x, n_phi) of the drift; no row where it is read off the rate of z
    pre_feedback: Array  #: (n_x, n_x) slope that A holds under
    B: Array  #: (n_x, n_u) at x = 0
    input_exponents: NDArray[np.int64]  #: (n_c, n_x) of the monomials of B(x)
    input_terms: Array  #: (n_c, n_x, n_u) coefficients of these


_MODEL = types.NamedTuple(
    (_SIZES, _VECTOR, _VECTOR, _EXPONENTS, _MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX,
     _EXPONENTS, _CUBE), ModelArrays)


def _compiled(*signature: Any) -> Callable[[Function], Function]:
    """Compile a function: now, for arguments of these types, or for those that it is called by."""
    # sums may be taken in another order, several numbers at once; a division by 0 gives infinity
    decorate: Callable[[Function], Function] = njit(
        signature or None, cache=bool(signature), error_model='numpy',
        fastmath={'reassoc', 'contract'})
    return decorate


@_compiled()
def _monomials(exponents: NDArray[np.int64], x: Array, phi: Array) -> None:
    """Write monomials, their first and, where there is room, second derivatives at states."""
    (N, n), count, rows = x.shape, len(exponents), phi.shape[1]
    for c in range(N):
        for a in range(count):
            for row in range(rows):
                # the states by which it is differentiated
                first, second = _differentiated(row, n)
                value = 1.0
                for j in range(n):
                    power = exponents[a, j]
                    for by in (first, second):
                        if by == j:
                            value *= power
                            power -= 1
                    for _ in range(power):
                        value *= x[c, j]
                phi[c, row, a] = value


@_compiled()
def _differentiated(row: int, n: int) -> tuple[int, int]:
    """Return by which states a row of derivatives is: value, n first ones, upper triangle."""
    if row <= n:
        return row - 1, -1
    place = row - 1 - n
    for k in range(n):
        if place < n - k:
            return k, k + place
        place -= n - k
    return -1, -1


@_compiled()
def _network(model: ModelArrays, x: Array, phi: Array) -> None:
    """Write the states and the units of the last hidden layer with their derivatives likewise."""
    (N, n), rows, start = x.shape, phi.shape[1], 0
    Y = np.zeros((N, rows, n))
    for c in range(N):
        for i in range(n):
            Y[c, 0, i] = x[c, i]
            Y[c, 1 + i, i] = 1.0
            phi[c, 0, i] = x[c, i]
            phi[c, 1 + i, i] = 1.0
    for width in model.widths:
        last = Y.shape[2]
        weights = model.layers[start:start + last * width].reshape((last, width))
        bias = model.layers[start + last * width:start + (last + 1) * width]
        start += (last + 1) * width
        Y = np.dot(Y.reshape((N * rows, last)), weights).reshape((N, rows, width))
        for c in range(N):
            for i in range(width):
                Y[c, 0, i] = math.tanh(Y[c, 0, i] + bias[i])
            # second derivatives, which need the first ones before the layer, come first
            for row in range(rows - 1, 0, -1):
                k, j = _differentiated(row, n)
                for i in range(width):
                    t = Y[c, 0, i]
                    bend = 2.0 * t * Y[c, 1 + k, i] * Y[c, 1 + j, i] if j >= 0 else 0.0
                    Y[c, row, i] = (1.0 - t * t) * (Y[c, row, i] - bend)
    if len(model.widths):
        for c in range(N):
            for i in range(Y.shape[2]):
                phi[c, 0, n + i] = Y[c, 0, i] - model.origin[i]
                for row in range(1, rows):
                    phi[c, row, n + i] = Y[c, row, i]


@_compiled()
def _solve(S: Array, X: Array) -> None:
    """Solve S X = X of a symmetric, definite S (n, n), which is overwritten, by L D L'."""
    n, m = X.shape
    for k in range(n):
        for j in range(k):
            S[k, k] -= S[k, j] * S[k, j] * S[j, j]
        for i in range(k + 1, n):
            for j in range(k):
                S[i, k] -= S[i, j] * S[k, j] * S[j, j]
            S[i, k] /= S[k, k]
        for j in range(k):
            for c in range(m):
                X[k, c] -= S[k, j] * X[j, c]
    for k in range(n - 1, -1, -1):
        for c in range(m):
            X[k, c] /= S[k, k]
            for i in range(k + 1, n):
                X[k, c] -= S[i, k] * X[i, c]


@_compiled(_MODEL, _MATRIX)
def drift(model: ModelArrays, x: Array) -> tuple[Array, Array]:
    """
    Evaluate the drift at states (N, n_x) and its Jacobian: (N, n_x), (N, n_x, n_x).

    Without a read-out f solves the normal equations J'J f = J'A z, J = dz/dx, and its Jacobian
    their derivatives; both are not finite where J has not full rank.
    """
    (N, n), read = x.shape, len(model.readout) > 0
    rows = 1 + n if read else 1 + n + n * (n + 1) // 2
    matrix = model.readout if read else model.lift
    phi = np.zeros((N, rows, matrix.shape[1]))
    if len(model.exponents):
        _monomials(model.exponents, x, phi)
    else:
        _network(model, x, phi)
    n_z = len(matrix)
    Z = np.dot(phi.reshape((N * rows, matrix.shape[1])), matrix.T).reshape((N, rows, n_z))
    f, slope = np.empty((N, n)), np.zeros((N, n, n))
    if read:
        for c in range(N):
            for i in range(n):
                f[c, i] = Z[c, 0, i]
                for k in range(n):
                    slope[c, i, k] = Z[c, 1 + k, i]
        return f, slope
    # rates of z and of its derivatives
    rates = np.dot(Z[:, :1 + n].copy().reshape((N * (1 + n), n_z)), model.A.T).reshape(
        (N, 1 + n, n_z))
    square, factors, solution = np.empty((n, n)), np.empty((n, n)), np.empty((n, 1))
    for c in range(N):
        J, rate, of_J = Z[c, 1:1 + n], rates[c, 0], rates[c, 1:]
        for i in range(n):
            solution[i, 0] = 0.0
            for a in range(n_z):
                solution[i, 0] += J[i, a] * rate[a]
            for k in range(n):
                square[i, k] = 0.0
                for a in range(n_z):
                    square[i, k] += J[i, a] * J[k, a]
        factors[:] = square
        _solve(factors, solution)
        for i in range(n):
            f[c, i] = solution[i, 0]
            for a in range(n_z):
                rate[a] -= J[i, a] * f[c, i]
        row = 1 + n
        for k in range(n):
            for i in range(k, n):
                # the derivative of J by one state more, in the rate and in the residual
                bend = Z[c, row]
                row += 1
                total = 0.0
                for a in range(n_z):
                    of_J[k, a] -= bend[a] * f[c, i]
                    if i != k:
                        of_J[i, a] -= bend[a] * f[c, k]
                    total += bend[a] * rate[a]
                slope[c, k, i] += total
                if i != k:
                    slope[c, i, k] += total
        for i in range(n):
            for k in range(n):
                for a in range(n_z):
                    slope[c, i, k] += J[i, a] * of_J[k, a]
        _solve(square, slope[c])
        for i in range(n):
            for k in range(n):
                f[c, i] -= model.pre_feedback[i, k] * x[c, k]
                slope[c, i, k] -= model.pre_feedback[i, k]
    return f, slope


@_compiled()
def _rates(model: ModelArrays, X: Array, u: Array, w: Array) -> Array:
    """Return the rates of states with their derivatives, see :func:`roll_out`."""
    (N, n, _), m, count = X.shape, u.shape[1], len(model.input_exponents)
    x, dX = np.ascontiguousarray(X[:, :, 0]), np.zeros(X.shape)
    f, J = drift(model, x)
    phi, B = np.zeros((N, 1 + n, count)), np.empty((n, m))
    _monomials(model.input_exponents, x, phi)
    for c in range(N):
        for i in range(n):
            for j in range(m):
                B[i, j] = model.B[i, j]
                for a in range(count):
                    B[i, j] += model.input_terms[a, i, j] * phi[c, 0, a]
                    for k in range(n):
                        J[c, i, k] += model.input_terms[a, i, j] * u[c, j] * phi[c, 1 + k, a]
            dX[c, i, 0] = f[c, i] + w[i]
            for j in range(m):
                dX[c, i, 0] += B[i, j] * u[c, j]
                dX[c, i, 1 + n + j] = B[i, j]
            for k in range(n):
                for column in range(1, X.shape[2]):
                    dX[c, i, column] += J[c, i, k] * X[c, k, column]
    return dX


@_compiled()
def _add_cost(cost: Array, X: Array, x_ref: Array, Q: Array, share: Array) -> None:
    """Add the cost of a point of each interval, as a quadratic form of (1, node, input)."""
    N, n, columns = X.shape
    E, QE = np.empty((n, columns)), np.empty((n, columns))
    for c in range(N):
        for i in range(n):
            for column in range(columns):
                E[i, column] = X[c, i, column]
            E[i, 0] -= x_ref[i]
        for i in range(n):
            for column in range(columns):
                QE[i, column] = 0.0
                for k in range(n):
                    QE[i, column] += share[c] * Q[i, k] * E[k, column]
        for row in range(columns):
            for i in range(n):
                for column in range(columns):
                    cost[c, row, column] += E[i, row] * QE[i, column]


@_compiled(_MODEL, _MATRIX, _MATRIX, _VECTOR, _VECTOR, _VECTOR, types.int64, _MATRIX)
def roll_out(model: ModelArrays, u: Array, x: Array, w: Array, x_ref: Array, lengths: Array,
             steps: int, Q: Array) -> tuple[Array, Array]:
    """
    Integrate dx/dt = f(x) + B(x) u + w over intervals, each from a node and under a held input.

    By the Runge-Kutta method of order 4; the cost by Simpson's rule, with the middle of a step
    from the rates at both ends (Hermite).

    Parameters
    ----------
    model
        All in scaled deviations and in its time unit.
    u, x
        (N, n_u) inputs and (N, n_x) nodes.
    w, x_ref
        (n_x,) disturbance of the state's rate, and reference.
    lengths
        (N,) of the intervals.
    steps
        Of the integration in each of them.
    Q
        (n_x, n_x) weight of the state's error.

    Returns
    -------
    ends
        (N, n_x, 1 + n_x + n_u), the states at the ends, and their derivatives by node and input.
    cost
        (N, 1 + n_x + n_u, 1 + n_x + n_u), the integral of e'Q e as a quadratic form of 1 and the
        deviations of node and input.
    """
    (N, n), m = x.shape, u.shape[1]
    X, cost = np.zeros((N, n, 1 + n + m)), np.zeros((N, 1 + n + m, 1 + n + m))
    for c in range(N):
        for i in range(n):
            X[c, i, 0], X[c, i, 1 + i] = x[c, i], 1.0
    h = (lengths / steps).reshape((N, 1, 1))
    share = lengths / (6.0 * steps)
    _add_cost(cost, X, x_ref, Q, share)
    for step in range(steps):
        k1 = _rates(model, X, u, w)
        k2 = _rates(model, X + 0.5 * h * k1, u, w)
        k3 = _rates(model, X + 0.5 * h * k2, u, w)
        k4 = _rates(model, X + h * k3, u, w)
        end = X + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        _add_cost(cost, 0.5 * (X + end) + 0.125 * h * (k1 - k4), x_ref, Q, 4.0 * share)
        X = end
        _add_cost(cost, X, x_ref, Q, share if step == steps - 1 else 2.0 * share)
    return X, cost


@_compiled(_MATRIX, _MATRIX, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _MATRIX, _MATRIX, _CUBE, _CUBE)
def condense(u: Array, x: Array, start: Array, x_ref: Array, u_ref: Array, lengths: Array,
             R: Array, terminal: Array, ends: Array, cost: Array
             ) -> tuple[Array, Array, Array, Array]:
    """
    Express nodes and cost by a change v (N n_u,) of the inputs alone.

    Parameters
    ----------
    u, x
        (N, n_u) inputs and (N + 1, n_x) nodes, about which it is linearised.
    start
        (n_x,) the state at the beginning.
    x_ref, u_ref
        (n_x,) and (n_u,) references.
    lengths
        (N,) of the intervals.
    R, terminal
        (n_u, n_u) and (n_x, n_x) weights of the input and of the error at the end.
    ends, cost
        Of :func:`roll_out`.

    Returns
    -------
    nodes
        (N + 1, n_x) from the start on without a change, and without gaps between the intervals.
    by_inputs
        (N + 1, n_x, N n_u) their derivatives by v.
    H, f
        (N n_u, N n_u) symmetric and (N n_u,) of the cost v'H v / 2 + f'v.
    """
    (N, m), n = u.shape, x.shape[1]
    # columns: without a change, and by each input
    nodes, form = np.zeros((N + 1, n, 1 + N * m)), np.zeros((1 + N * m, 1 + N * m))
    nodes[0, :, 0] = start
    for k in range(N + 1):
        known = 1 + k * m
        if k == N:
            known -= m
        # 1 and the deviations of node and input, by the same columns
        D = np.zeros((1 + n + m, known + m))
        D[0, 0] = 1.0
        for i in range(n):
            for a in range(known if k < N else known + m):
                D[1 + i, a] = nodes[k, i, a]
            D[1 + i, 0] -= x[k, i] if k < N else x_ref[i]
        if k == N:
            weight = np.zeros((1 + n + m, 1 + n + m))
            weight[1:1 + n, 1:1 + n] = terminal
        else:
            weight = cost[k].copy()
            for i in range(m):
                D[1 + n + i, known + i] = 1.0
                for j in range(m):
                    weight[1 + n + i, 1 + n + j] += lengths[k] * R[i, j]
                    weight[1 + n + i, 0] += lengths[k] * R[i, j] * (u[k, j] - u_ref[j])
            for i in range(n):
                for a in range(known + m):
                    for j in range(1, 1 + n + m):
                        nodes[k + 1, i, a] += ends[k, i, j] * D[j, a]
                nodes[k + 1, i, 0] += ends[k, i, 0]
        form[:known + m, :known + m] += np.dot(D.T, np.dot(weight, D))
    H, f = np.empty((N * m, N * m)), form[1:, 0].copy()
    for a in range(N * m):
        for b in range(N * m):
            H[a, b] = 0.5 * (form[1 + a, 1 + b] + form[1 + b, 1 + a])
    return nodes[:, :, 0].copy(), nodes[:, :, 1:].copy(), H, f
