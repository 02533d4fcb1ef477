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

from koopman_ros.core.arrays import Array

Function = TypeVar('Function', bound=Callable[..., Any])

_VECTOR, _MATRIX, _CUBE = (types.Array(types.float64, n, 'C', readonly=True) for n in (1, 2, 3))
_EXPONENTS = types.Array(types.int64, 2, 'C', readonly=True)


class ModelArrays(NamedTuple):
    """
    The numbers of a model with dz/dt = A z + J_N(x) B(x) u, z = P phi(x).

    phi are the states and hidden units tanh(W x + b) - tanh(b), or monomials.
    """

    W: Array  #: (h, n_x) input weights of the hidden units
    b: Array  #: (h,) their biases
    origin: Array  #: (h,) hidden units at x = 0
    exponents: NDArray[np.int64]  #: (n_phi, n_x) of monomials; no row where there is a network
    lift: Array  #: P (n_z, n_phi)
    A: Array  #: (n_z, n_z)
    readout: Array  #: (n_x, n_phi) of the drift; no row where it is read off the rate of z
    pre_feedback: Array  #: (n_x, n_x) slope that A holds under
    B: Array  #: (n_x, n_u) at x = 0
    input_exponents: NDArray[np.int64]  #: (n_c, n_x) of the monomials of B(x)
    input_terms: Array  #: (n_c, n_x, n_u) coefficients of these


_MODEL = types.NamedTuple(
    (_MATRIX, _VECTOR, _VECTOR, _EXPONENTS, _MATRIX, _MATRIX, _MATRIX, _MATRIX, _MATRIX,
     _EXPONENTS, _CUBE), ModelArrays)


def _compiled(*signature: Any) -> Callable[[Function], Function]:
    """Compile a function: now, for arguments of these types, or for those that it is called by."""
    # sums may be taken in another order, several numbers at once; a division by 0 gives infinity
    decorate: Callable[[Function], Function] = njit(
        signature or None, cache=bool(signature), error_model='numpy',
        fastmath={'reassoc', 'contract'})
    return decorate


@_compiled()
def _monomial(exponents: NDArray[np.int64], x: Array, first: int, second: int) -> float:
    """Return a monomial of a state (n_x,), differentiated by two entries, or -1 for none."""
    value = 1.0
    for j in range(len(x)):
        power = exponents[j]
        for entry in (first, second):
            if entry == j:
                value *= power
                power -= 1
        for _ in range(power):
            value *= x[j]
    return value


@_compiled()
def _monomials(exponents: NDArray[np.int64], x: Array, phi: Array) -> None:
    """Write monomials at states (N, n_x) and their derivatives, see :func:`_features`."""
    N, n = x.shape
    for c in range(N):
        for a in range(len(exponents)):
            phi[c, 0, a] = _monomial(exponents[a], x[c], -1, -1)
            row = 1 + n
            for k in range(n):
                phi[c, 1 + k, a] = _monomial(exponents[a], x[c], k, -1)
                for j in range(k, n if row < phi.shape[1] else 0):
                    phi[c, row, a] = _monomial(exponents[a], x[c], k, j)
                    row += 1


@_compiled()
def _features(model: ModelArrays, x: Array, phi: Array) -> None:
    """
    Write the features at states (N, n_x) and their derivatives.

    :param phi: (N, rows, n_phi): the features, their derivatives by each state and, where there
        are rows for them, by each pair of states, the upper triangle row by row.
    """
    N, n = x.shape
    if len(model.exponents):
        _monomials(model.exponents, x, phi)
        return
    for c in range(N):
        for k in range(n):
            phi[c, 0, k] = x[c, k]
            phi[c, 1 + k, k] = 1.0
        for i in range(len(model.b)):
            a = model.b[i]
            for k in range(n):
                a += model.W[i, k] * x[c, k]
            t = math.tanh(a)
            slope, row = 1.0 - t * t, 1 + n
            phi[c, 0, n + i] = t - model.origin[i]
            for k in range(n):
                phi[c, 1 + k, n + i] = slope * model.W[i, k]
                for j in range(k, n if row < phi.shape[1] else 0):
                    phi[c, row, n + i] = -2.0 * t * slope * model.W[i, k] * model.W[i, j]
                    row += 1


@_compiled()
def _add_product(C: Array, A: Array, B: Array) -> None:
    """Add A B', of as many rows of A as there are in C."""
    for i in range(C.shape[0]):
        for j in range(C.shape[1]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[j, k]
            C[i, j] += total


@_compiled()
def _solve(S: Array, X: Array) -> None:
    """Solve S X = X by L D L' of a definite S (n, n), whose lower half is overwritten."""
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
    _features(model, x, phi)
    n_z = len(matrix)
    Z, rates = np.zeros((N, rows, n_z)), np.zeros((1 + n, n_z))
    for c in range(N):
        _add_product(Z[c], phi[c], matrix)
    f, slope = np.empty((N, n)), np.zeros((N, n, n))
    if read:
        for c in range(N):
            for i in range(n):
                f[c, i] = Z[c, 0, i]
                for k in range(n):
                    slope[c, i, k] = Z[c, 1 + k, i]
        return f, slope
    square, solution = np.empty((n, n)), np.empty((n, 1))
    for c in range(N):
        # A z and A J', the rates of z and of its derivatives
        rates[:, :] = 0.0
        _add_product(rates, Z[c], model.A)
        J, rate, of_J = Z[c, 1:], rates[0], rates[1:]
        for i in range(n):
            total = 0.0
            for a in range(n_z):
                total += J[i, a] * rate[a]
            solution[i, 0] = total
            for k in range(i + 1):
                total = 0.0
                for a in range(n_z):
                    total += J[i, a] * J[k, a]
                square[i, k] = total
        _solve(square.copy(), solution)
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
                total = 0.0
                for a in range(n_z):
                    total += J[i, a] * of_J[k, a]
                slope[c, i, k] += total
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
            E[i, 0] -= x_ref[c, i]
        for i in range(n):
            for column in range(columns):
                total = 0.0
                for k in range(n):
                    total += Q[i, k] * E[k, column]
                QE[i, column] = share[c] * total
        for row in range(columns):
            for i in range(n):
                for column in range(columns):
                    cost[c, row, column] += E[i, row] * QE[i, column]


@_compiled(_MODEL, _MATRIX, _MATRIX, _VECTOR, _MATRIX, _MATRIX, _VECTOR, types.int64, _MATRIX,
           _MATRIX)
def roll_out(model: ModelArrays, u: Array, x: Array, w: Array, x_ref: Array, u_ref: Array,
             lengths: Array, steps: int, Q: Array, R: Array) -> tuple[Array, Array]:
    """
    Integrate dx/dt = f(x) + B(x) u + w over intervals, each from a node and under a held input.

    By the Runge-Kutta method of order 4; the cost by Simpson's rule, with the middle of a step
    from the rates at both ends (Hermite).

    Parameters
    ----------
    model
        All in scaled deviations and in its time unit.
    u, x
        (N, n_u) inputs and (N + 1, n_x) nodes, the last of which is not used.
    w
        (n_x,) disturbance of the state's rate.
    x_ref, u_ref
        (N, n_x) and (N, n_u) references of the intervals.
    lengths
        (N,) of the intervals.
    steps
        Of the integration in each of them.
    Q, R
        (n_x, n_x) and (n_u, n_u) weights.

    Returns
    -------
    ends
        (N, n_x, 1 + n_x + n_u), the states at the ends, and their derivatives by node and input.
    cost
        (N, 1 + n_x + n_u, 1 + n_x + n_u), the integral of e'Q e + v'R v as a quadratic form of 1
        and the deviations of node and input.

    """
    (N, m), n = u.shape, x.shape[1]
    X, cost = np.zeros((N, n, 1 + n + m)), np.zeros((N, 1 + n + m, 1 + n + m))
    for c in range(N):
        for i in range(n):
            X[c, i, 0], X[c, i, 1 + i] = x[c, i], 1.0
        for i in range(m):
            for j in range(m):
                weight, v = lengths[c] * R[i, j], u[c, j] - u_ref[c, j]
                cost[c, 0, 0] += weight * (u[c, i] - u_ref[c, i]) * v
                cost[c, 1 + n + i, 0] += weight * v
                cost[c, 0, 1 + n + i] += weight * v
                cost[c, 1 + n + i, 1 + n + j] = weight
    h, share = np.empty_like(X), lengths / (6.0 * steps)
    for c in range(N):
        h[c] = lengths[c] / steps
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


@_compiled()
def _add_form(total: Array, weight: Array, D: Array) -> None:
    """Add the lower triangle of D' W D, of a symmetric W."""
    row = np.empty(D.shape[1])
    for i in range(len(D)):
        row[:] = 0.0
        for j in range(len(D)):
            for a in range(D.shape[1]):
                row[a] += weight[i, j] * D[j, a]
        for a in range(D.shape[1]):
            if D[i, a] != 0.0:
                for b in range(a + 1):
                    total[a, b] += D[i, a] * row[b]


@_compiled(_MATRIX, _VECTOR, _VECTOR, _CUBE, _CUBE, _MATRIX)
def condense(x: Array, start: Array, x_ref: Array, ends: Array, cost: Array, terminal: Array
             ) -> tuple[Array, Array, Array, Array]:
    """
    Express nodes and cost by a change v (N n_u,) of the inputs alone.

    Parameters
    ----------
    x
        (N + 1, n_x) nodes, about which it is linearised.
    start, x_ref
        (n_x,) state at the beginning, and reference.
    ends, cost
        Of :func:`roll_out`.
    terminal
        (n_x, n_x) weight of the error at the end.

    Returns
    -------
    nodes
        (N + 1, n_x) from the start on without a change, and without gaps between the intervals.
    by_inputs
        (N + 1, n_x, N n_u) their derivatives by v.
    H, f
        (N n_u, N n_u) symmetric and (N n_u,) of the cost v'H v / 2 + f'v.

    """
    (N, n, columns), m = ends.shape, ends.shape[2] - 1 - ends.shape[1]
    count = N * m
    # by 1 and v
    by, total = np.zeros((N + 1, n, 1 + count)), np.zeros((1 + count, 1 + count))
    for i in range(n):
        by[0, i, 0] = start[i]
    for k in range(N):
        # 1 and the deviations of node and input, by 1 and the inputs so far
        D = np.zeros((columns, 1 + (k + 1) * m))
        D[0, 0] = 1.0
        for i in range(n):
            for a in range(1 + k * m):
                D[1 + i, a] = by[k, i, a]
            D[1 + i, 0] -= x[k, i]
        for i in range(m):
            D[1 + n + i, 1 + k * m + i] = 1.0
        for i in range(n):
            for j in range(columns):
                for a in range(D.shape[1]):
                    by[k + 1, i, a] += ends[k, i, j] * D[j, a]
        _add_form(total, cost[k], D)
    error = by[N].copy()
    for i in range(n):
        error[i, 0] -= x_ref[i]
    _add_form(total, terminal, error)
    nodes, by_inputs = np.empty((N + 1, n)), np.empty((N + 1, n, count))
    H, f = np.empty((count, count)), np.empty(count)
    for k in range(N + 1):
        for i in range(n):
            nodes[k, i] = by[k, i, 0]
            for a in range(count):
                by_inputs[k, i, a] = by[k, i, 1 + a]
    for a in range(count):
        f[a] = total[1 + a, 0]
        for b in range(a + 1):
            H[a, b] = H[b, a] = total[1 + a, 1 + b]
    return nodes, by_inputs, H, f
