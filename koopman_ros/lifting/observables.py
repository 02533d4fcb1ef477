# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The functions of the state that make up a lift: of a network, or of a dictionary."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import combinations_with_replacement
from typing import final, Self

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array, brief, frozen
from koopman_ros.lifting.activations import Activation, activation_named


class Observables(ABC):
    """
    A lift z = N(x) in scaled deviations, with N(0) = 0; its derivatives are exact.

    `identity` says whether the first n_x coordinates of z are the state itself. It is a field of
    each subclass, since a dataclass would take an abstract property for the field's default.
    """

    identity: bool

    @property
    @abstractmethod
    def n_x(self) -> int:
        """Number of states."""

    @property
    @abstractmethod
    def n_z(self) -> int:
        """Number of lifted coordinates."""

    @abstractmethod
    def lift(self, x: Array) -> Array:
        """Evaluate z = N(x): (..., n_x) -> (..., n_z)."""

    @abstractmethod
    def lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate N(x) and J_N(x) = dN/dx: (..., n_x) -> (..., n_z), (..., n_z, n_x)."""

    @abstractmethod
    def lift_and_derivatives(self, x: Array) -> tuple[Array, Array, Array]:
        """Evaluate N(x), J_N(x) and the derivatives of J_N: the last (..., n_z, n_x, n_x)."""

    @abstractmethod
    def lift_and_secants(self, x: Array, x_ref: Array, w: Array
                         ) -> tuple[Array, Array, Array, Array]:
        """
        Evaluate N(x) and J_N(x), and the secants of N and of J_N w between two states, exactly.

        With e = x - x_ref the secants satisfy N(x) - N(x_ref) = M e and
        J_N(x) w - J_N(x_ref) w = H e; nothing cancels as e goes to 0.

        :param x: (n_x,) state.
        :param x_ref: (n_x,) reference.
        :param w: (n_x,) constant direction, e.g. B u_ref.
        :return: (n_z,), (n_z, n_x), M (n_z, n_x) and H (n_z, n_x).
        """

    @property
    @abstractmethod
    def features(self) -> 'Observables':
        """The functions phi that a drift is read out of: as a lift, the states first."""


@final
@dataclass(frozen=True, eq=False)
class NetworkObservables(Observables):
    """
    The outputs of a fully connected network, less their values at the origin.

    Without hidden layers and with `identity` this is the linear lift z = x.

    :raises ValueError: naming the array that does not fit and both shapes, or the activations.
    """

    #: (weight (h_i, h_{i-1}), bias (h_i,)) of each hidden layer, h_0 = n_x
    hidden: tuple[tuple[Array, Array], ...]
    output: Array  #: (n_z - n_x, h) with `identity`, else (n_z, h): weights of the last layer
    identity: bool  #: whether z starts with the state
    activation: str = 'tanh'  #: of every hidden layer, a name in ``ACTIVATIONS``

    __repr__ = brief

    def __post_init__(self) -> None:
        activation_named(self.activation)
        width = _columns(self.hidden[0][0] if self.hidden else self.output)
        layers = []
        for i, (weight, bias) in enumerate(self.hidden):
            h = np.shape(bias)[0] if np.ndim(bias) == 1 else -1
            layers.append((frozen(weight, f'weight of hidden layer {i}', (h, width)),
                           frozen(bias, f'bias of hidden layer {i}', (h,))))
            width = h
        object.__setattr__(self, 'hidden', tuple(layers))
        free = np.shape(self.output)[0] if np.ndim(self.output) == 2 else -1
        object.__setattr__(self, 'output', frozen(self.output, 'output', (free, width)))
        if free > 0 and not self.hidden:
            raise ValueError('a lift with free coordinates needs a hidden layer')
        if self.n_z == 0:
            raise ValueError('a lift needs coordinates: set identity, or give rows of output')

    @property
    def n_x(self) -> int:
        """Number of states."""
        return _columns(self.hidden[0][0] if self.hidden else self.output)

    @property
    def n_z(self) -> int:
        """Number of lifted coordinates."""
        return self.output.shape[0] + (self.n_x if self.identity else 0)

    @cached_property
    def features(self) -> Observables:
        """The states and the units of the last hidden layer, less their values at the origin."""
        if not self.hidden:
            return self
        units = np.eye(self.output.shape[1])
        return NetworkObservables(self.hidden, units, identity=True, activation=self.activation)

    @cached_property
    def _activation(self) -> Activation:
        return activation_named(self.activation)

    @cached_property
    def value_at_zero(self) -> Array:
        """The last hidden layer (h,) at the origin."""
        h = np.zeros(self.n_x)
        for weight, bias in self.hidden:
            h = self._activation.value(weight @ h + bias)
        return h

    @cached_property
    def rows(self) -> Array:
        """The output (n_z, h) with rows of zeros where the state goes."""
        states = self.n_z - self.output.shape[0]
        return np.concatenate((np.zeros((states, self.output.shape[1])), self.output))

    @cached_property
    def _identity_rows(self) -> Array:
        return frozen(np.eye(self.n_x), 'identity', (self.n_x, self.n_x))

    @cached_property
    def _zero_rows(self) -> Array:
        return frozen(np.zeros((self.n_x, self.n_x)), 'zero', (self.n_x, self.n_x))

    def lift(self, x: Array) -> Array:
        """Evaluate z = N(x): (..., n_x) -> (..., n_z)."""
        if not self.hidden:
            return np.array(x)
        h, value = x, self._activation.value
        for weight, bias in self.hidden:
            h = value(_product(h, weight.T) + bias)
        return self._with_states(x, _product(h - self.value_at_zero, self.rows.T))

    def lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate N(x) and J_N(x) in one forward pass; shapes as in the interface."""
        eye = self._identity_rows
        if x.ndim > 1:
            eye = np.broadcast_to(eye, (*x.shape, self.n_x))
        if not self.hidden:
            return x, eye
        # T is the transpose of dh/dx
        h, T, f = x, eye, self._activation
        for weight, bias in self.hidden:
            a = _product(h, weight.T) + bias
            h = f.value(a)
            T = f.slope(a, h)[..., None, :] * (weight.T if T is eye else _product(T, weight.T))
        z = _product(h - self.value_at_zero, self.rows.T)
        J = _product(T, self.rows.T)
        return self._with_states(x, z), self._with_states(eye, J).swapaxes(-1, -2)

    def lift_and_derivatives(self, x: Array) -> tuple[Array, Array, Array]:
        """Evaluate N(x), J_N(x) and the derivatives of J_N in one forward pass."""
        n, eye = self.n_x, np.broadcast_to(self._identity_rows, (*x.shape, self.n_x))
        if not self.hidden:
            return x, eye, np.zeros((*x.shape, n, n))
        # T is the transpose of dh/dx, and U holds that of d2h/dx2 in its last axis but two and one
        h, T, f = x, eye, self._activation
        U = np.zeros((*x.shape[:-1], n, n, n))
        for weight, bias in self.hidden:
            a = _product(h, weight.T) + bias
            h = f.value(a)
            # the difference of a slope between a and itself is its derivative
            bend = f.divided_differences(a, a, h, h)[1][..., None, None, :]
            T, slope = T @ weight.T, f.slope(a, h)[..., None, :]
            U = bend * T[..., :, None, :] * T[..., None, :, :] + slope[..., None, :] * (
                U @ weight.T)
            T = slope * T
        rows = self.rows.T
        z, J = _product(h - self.value_at_zero, rows), T @ rows
        return (self._with_states(x, z), self._with_states(eye, J).swapaxes(-1, -2),
                np.moveaxis(U @ rows, -1, -3))

    def lift_and_secants(self, x: Array, x_ref: Array, w: Array
                         ) -> tuple[Array, Array, Array, Array]:
        """Evaluate the lift and, by the chain rule of divided differences, the secants."""
        eye, zero, f = self._identity_rows, self._zero_rows, self._activation
        if not self.hidden:
            return x, eye, eye, zero
        # both states pass the layers at once; T, S and G are transposes of what is wanted
        h, p, T, S, G = np.array((x, x_ref)), w, eye, eye, zero
        for weight, bias in self.hidden:
            W = weight.T
            a = h.dot(W) + bias
            h = f.value(a)
            at_x, at_ref = f.slope(a, h)
            slope, slope_of_slope = f.divided_differences(a[0], a[1], h[0], h[1])
            q, first = p.dot(W), T is eye
            T, S = (W, W) if first else (T.dot(W), S.dot(W))
            bent = slope_of_slope * q * S
            G = bent if first else bent + at_ref * G.dot(W)
            S = slope * S
            T = at_x * T
            p = at_x * q
        rows = self.rows.T
        return (self._with_states(x, (h[0] - self.value_at_zero).dot(rows)),
                self._with_states(eye, T.dot(rows)).T, self._with_states(eye, S.dot(rows)).T,
                G.dot(rows).T)

    def _with_states(self, states: Array, rows: Array) -> Array:
        """Fill in what the coordinates (..., n_z) of `rows` begin with where z does."""
        if self.identity:
            rows[..., :states.shape[-1]] = states
        return rows


@final
@dataclass(frozen=True, eq=False)
class PolynomialObservables(Observables):
    """
    A dictionary of monomials, the states first: the lift of extended DMD.

    :param exponents: (n_z, n_x) integers; row i is the monomial prod_j x_j^exponents[i, j].
    :raises TypeError: when they are not integers.
    :raises ValueError: when a row is negative, constant or repeated, or the states do not come
        first.
    """

    exponents: NDArray[np.int64]
    identity: bool = field(default=True, init=False)

    __repr__ = brief

    def __post_init__(self) -> None:
        given = np.asarray(self.exponents)
        if given.dtype.kind not in 'iu':
            raise TypeError(f'exponents must be integers, got {given.dtype}')
        if given.ndim != 2 or given.shape[1] == 0:
            raise ValueError(f'incompatible exponents: expected (n_z, n_x), got {given.shape}')
        E = np.array(given, dtype=np.int64)
        n_x = E.shape[1]
        if np.any(E < 0):
            raise ValueError(f'exponents must be at least 0, got {np.min(E)}')
        if not np.array_equal(E[:n_x], np.eye(n_x)):
            raise ValueError(f'the first {n_x} rows of exponents must be the states, the identity '
                             f'matrix, got {E[:n_x].tolist()}')
        if np.any(E.sum(axis=1) == 0):
            raise ValueError('a row of exponents is a constant, which N(0) = 0 rules out: drop it')
        rows, counts = np.unique(E, axis=0, return_counts=True)
        if np.any(counts > 1):
            raise ValueError(f'the row {rows[np.argmax(counts)].tolist()} of exponents comes '
                             f'{np.max(counts)} times: keep one')
        E.setflags(write=False)
        object.__setattr__(self, 'exponents', E)

    @classmethod
    @lru_cache(maxsize=64)
    def total_degree(cls, n_x: int, degree: int) -> Self:
        """Return the monomials of n_x states from degree 1 on; raise ValueError below 1."""
        if n_x < 1 or degree < 1:
            raise ValueError(f'n_x and degree must be at least 1, got {n_x} and {degree}')
        return cls(np.array([np.bincount(factors, minlength=n_x)
                             for d in range(1, degree + 1)
                             for factors in combinations_with_replacement(range(n_x), d)]))

    @property
    def n_x(self) -> int:
        """Number of states."""
        return self.exponents.shape[1]

    @property
    def n_z(self) -> int:
        """Number of lifted coordinates."""
        return self.exponents.shape[0]

    @property
    def features(self) -> Observables:
        """The monomials."""
        return self

    @cached_property
    def _own(self) -> 'Monomials':
        return Monomials(np.ones(self.n_z), self.exponents)

    @cached_property
    def _first(self) -> 'Monomials':
        return self._own.differentiated

    @cached_property
    def _second(self) -> 'Monomials':
        return self._first.differentiated

    @cached_property
    def _quadrature(self) -> tuple[Array, Array]:
        """Return nodes on [0, 1] and weights, exact for the degree of J_N along a segment."""
        degree = int(np.max(np.sum(self.exponents, axis=1)))
        nodes, weights = np.polynomial.legendre.leggauss((degree + 1) // 2)
        return 0.5 * (1.0 + nodes), 0.5 * weights

    def lift(self, x: Array) -> Array:
        """Evaluate z = N(x): (..., n_x) -> (..., n_z)."""
        return self._own.at(x)

    def lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate N(x) and J_N(x); shapes as in the interface."""
        return self.lift(x), self._first.factors * self._first.at(x)

    def lift_and_derivatives(self, x: Array) -> tuple[Array, Array, Array]:
        """Evaluate N(x), J_N(x) and the derivatives of J_N; shapes as in the interface."""
        return *self.lift_and_jacobian(x), self._second.factors * self._second.at(x)

    def lift_and_secants(self, x: Array, x_ref: Array, w: Array
                         ) -> tuple[Array, Array, Array, Array]:
        """Evaluate the lift, and the secants as means along the segment, by exact quadrature."""
        nodes, weights = self._quadrature
        points = x_ref + nodes[:, None] * (x - x_ref)
        first, second = self._first, self._second
        M = _weighted(weights, first.factors * first.at(points))
        # the weights add up to 1 but for rounding
        M[:self.n_x] = np.eye(self.n_x)
        H = _weighted(weights, second.factors * second.at(points) @ w)
        return *self.lift_and_jacobian(x), M, H


def _weighted(weights: Array, values: Array) -> Array:
    """Add up values (n, ...) times weights (n,), in a sixth of tensordot's time."""
    total: Array = weights.dot(values.reshape(len(weights), -1)).reshape(values.shape[1:])
    return total


def _product(rows: Array, matrix: Array) -> Array:
    """Multiply (..., n) by (n, m); one state's few numbers take `dot` a third of the time of @."""
    product: Array = rows.dot(matrix) if rows.ndim <= 2 else rows @ matrix
    return product


def _columns(array: Array) -> int:
    return np.shape(array)[1] if np.ndim(array) == 2 else -1


@dataclass(frozen=True, eq=False)
class Monomials:
    """Factors (*shape) times prod_j x_j^exponents[..., j], of exponents (*shape, n_x)."""

    factors: Array
    exponents: NDArray[np.int64]

    @cached_property
    def differentiated(self) -> 'Monomials':
        """Their derivatives by each state, in an axis added."""
        E = self.exponents
        # the factor is 0 where an exponent would turn negative; x^-1 must not be evaluated at 0
        lowered = np.maximum(E[..., None, :] - np.eye(E.shape[-1], dtype=np.int64), 0)
        return Monomials(self.factors[..., None] * E, lowered)

    @cached_property
    def _columns(self) -> tuple[int, list[NDArray[np.int64]]]:
        E = self.exponents
        return int(np.max(E, initial=1)), [np.ascontiguousarray(E[..., j])
                                           for j in range(E.shape[-1])]

    def at(self, x: Array) -> Array:
        """Evaluate them without their factors: (..., n_x) -> (..., *shape)."""
        degree, columns = self._columns
        # each power once; numpy's own power of many numbers takes twenty times as long
        powers = np.empty((*x.shape, degree + 1))
        powers[..., 0], powers[..., 1] = 1.0, x
        for k in range(2, degree + 1):
            np.multiply(powers[..., k - 1], x, out=powers[..., k])
        found: Array = powers[..., 0, :].take(columns[0], axis=-1)
        for j in range(1, len(columns)):
            found *= powers[..., j, :].take(columns[j], axis=-1)
        return found
