# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lifts z = N(x) with exact derivatives: of a network, and of monomials."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import combinations_with_replacement
from typing import final, Self

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array, frozen, short_repr


class Observables(ABC):
    """
    A lift z = N(x) in scaled deviations, with N(0) = 0.

    Each subclass has `identity` as a field: whether z starts with the state.
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
    def secants(self, x: Array, x_ref: Array, w: Array) -> tuple[Array, Array, Array]:
        """
        Evaluate J_N(x), and the secants of N and of J_N w between two states, exactly.

        With e = x - x_ref the secants satisfy N(x) - N(x_ref) = M e and
        J_N(x) w - J_N(x_ref) w = H e; no digits cancel as e goes to 0.

        :param x: (n_x,) state.
        :param x_ref: (n_x,) reference.
        :param w: (n_x,) constant direction, e.g. B u_ref.
        :return: J_N(x), M and H, (n_z, n_x) each.
        """

    @property
    @abstractmethod
    def features(self) -> 'Observables':
        """The functions phi that a read-out weighs: as a lift, the states first."""


@final
@dataclass(frozen=True, eq=False)
class NetworkObservables(Observables):
    """
    A network with one hidden layer, N(x) = [x; V (h(x) - h(0))] with h(x) = tanh(W x + b).

    Without `identity` the rows of x are missing.

    :raises ValueError: naming the array that does not fit and both shapes.
    """

    W: Array  #: (h, n_x) input weights
    b: Array  #: (h,) biases
    V: Array  #: (n_z - n_x, h) output weights with `identity`, else (n_z, h)
    identity: bool  #: whether z starts with the state

    __repr__ = short_repr

    def __post_init__(self) -> None:
        W = frozen(self.W, 'W', (None, None))
        for name, value in (('W', W), ('b', frozen(self.b, 'b', (len(W),))),
                            ('V', frozen(self.V, 'V', (None, len(W))))):
            object.__setattr__(self, name, value)
        if len(self.V) and not len(W):
            raise ValueError('a lift with free coordinates needs hidden units')
        if not self.n_z:
            raise ValueError('a lift needs coordinates: set identity, or give rows of V')

    @classmethod
    def linear(cls, n_x: int) -> Self:
        """Return the lift z = x."""
        return cls(np.zeros((0, n_x)), np.zeros(0), np.zeros((0, 0)), identity=True)

    @cached_property
    def n_x(self) -> int:
        """Number of states."""
        return self.W.shape[1]

    @cached_property
    def n_z(self) -> int:
        """Number of lifted coordinates."""
        return len(self.V) + (self.n_x if self.identity else 0)

    @cached_property
    def features(self) -> Observables:
        """The states and the hidden units, less their values at the origin."""
        return NetworkObservables(self.W, self.b, np.eye(len(self.W)), identity=True)

    @cached_property
    def value_at_zero(self) -> Array:
        """The hidden layer h(0) at the origin, (h,)."""
        return np.tanh(self.b)

    def lift(self, x: Array) -> Array:
        """Evaluate z = N(x): (..., n_x) -> (..., n_z)."""
        free = (self._hidden(x) - self.value_at_zero).dot(self.V.T)
        return np.concatenate((x, free), axis=-1) if self.identity else np.asarray(free)

    def lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate N(x) and J_N(x); shapes as in the interface."""
        h = self._hidden(x)
        z: Array = (h - self.value_at_zero).dot(self.V.T)
        J = (1.0 - h * h).dot(self._products).reshape(*x.shape[:-1], self.n_z, self.n_x)
        return np.concatenate((x, z), axis=-1) if self.identity else z, J + self._of_states

    def lift_and_derivatives(self, x: Array) -> tuple[Array, Array, Array]:
        """Evaluate N(x), J_N(x) and the derivatives of J_N; shapes as in the interface."""
        h, n = self._hidden(x), self.n_x
        products = (self.W[:, :, None] * self.W[:, None, :]).reshape(-1, n * n)
        bend = (self.V * (-2.0 * h * (1.0 - h * h))[..., None, :]) @ products
        states = np.zeros((*x.shape[:-1], self.n_z - len(self.V), n, n))
        return *self.lift_and_jacobian(x), np.concatenate(
            (states, bend.reshape(*bend.shape[:-1], n, n)), axis=-3)

    def secants(self, x: Array, x_ref: Array, w: Array) -> tuple[Array, Array, Array]:
        """Evaluate the secants, by divided differences of tanh and of its slope."""
        h, h_ref, apart = self._hidden(x), self._hidden(x_ref), self.W.dot(x - x_ref)
        # tanh a - tanh r = tanh(a - r) (1 - tanh a tanh r); the offset makes the ratio 1 at 0
        apart += np.copysign(1e-300, apart)
        secant = np.tanh(apart) / apart * (1.0 - h * h_ref)
        J, M, H = np.array((
            1.0 - h * h, secant, -(h + h_ref) * secant * self.W.dot(w))
            ).dot(self._products).reshape(3, self.n_z, self.n_x)
        return J + self._of_states, M + self._of_states, H

    def _hidden(self, x: Array) -> Array:
        return np.tanh(x.dot(self.W.T) + self.b)

    @cached_property
    def _of_states(self) -> Array:
        return np.eye(self.n_z, self.n_x) if self.identity else np.zeros((self.n_z, self.n_x))

    @cached_property
    def _products(self) -> Array:
        """V_ik W_kj (h, n_z n_x), 0 in the rows of the states."""
        V = np.concatenate((np.zeros((self.n_z - len(self.V), len(self.W))), self.V))
        return (V.T[:, :, None] * self.W[:, None, :]).reshape(len(self.W), self.n_z * self.n_x)


@final
@dataclass(frozen=True, eq=False)
class PolynomialObservables(Observables):
    """
    Monomials of the states, the states first: the lift of extended DMD.

    :raises TypeError: when the exponents are not integers.
    :raises ValueError: when a row is negative, constant or repeated, or the states do not come
        first.
    """

    exponents: NDArray[np.int64]  #: (n_z, n_x); row i is the monomial prod_j x_j^exponents[i, j]
    identity: bool = field(default=True, init=False)

    __repr__ = short_repr

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
            raise ValueError('a row of exponents is a constant, which N(0) = 0 excludes: remove '
                             'it')
        rows, counts = np.unique(E, axis=0, return_counts=True)
        if np.any(counts > 1):
            raise ValueError(f'the row {rows[np.argmax(counts)].tolist()} of exponents occurs '
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
    def degree(self) -> int:
        """Highest total degree of a monomial."""
        return int(np.max(np.sum(self.exponents, axis=1)))

    @cached_property
    def _derivatives(self) -> tuple['Monomials', 'Monomials', 'Monomials']:
        own = Monomials(np.ones(self.n_z), self.exponents)
        first = own.differentiated()
        return own, first, first.differentiated()

    @cached_property
    def _quadrature(self) -> tuple[Array, Array]:
        """Shares of a segment and their weights, exact for the derivatives."""
        nodes, weights = np.polynomial.legendre.leggauss((self.degree + 1) // 2)
        return 0.5 * (1.0 + nodes[:, None]), 0.5 * weights

    def lift(self, x: Array) -> Array:
        """Evaluate z = N(x): (..., n_x) -> (..., n_z)."""
        return self._derivatives[0].at(x)

    def lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate N(x) and J_N(x); shapes as in the interface."""
        own, first, _ = self._derivatives
        return own.at(x), first.at(x)

    def lift_and_derivatives(self, x: Array) -> tuple[Array, Array, Array]:
        """Evaluate N(x), J_N(x) and the derivatives of J_N; shapes as in the interface."""
        own, first, second = self._derivatives
        return own.at(x), first.at(x), second.at(x)

    def secants(self, x: Array, x_ref: Array, w: Array) -> tuple[Array, Array, Array]:
        """Evaluate the secants as means along the segment, by exact quadrature."""
        shares, weights = self._quadrature
        points = x_ref + shares * (x - x_ref)
        _, first, second = self._derivatives
        M = np.tensordot(weights, first.at(points), 1)
        # the weights add up to 1 but for rounding
        M[:self.n_x] = np.eye(self.n_x)
        return first.at(x), M, np.tensordot(weights, second.at(points) @ w, 1)


@dataclass(frozen=True, eq=False)
class Monomials:
    """Factors (*shape) times prod_j x_j^exponents[..., j], of exponents (*shape, n_x)."""

    factors: Array
    exponents: NDArray[np.int64]

    def differentiated(self) -> 'Monomials':
        """Return their derivatives by each state, in an axis added."""
        E = self.exponents
        # the factor is 0 where an exponent would turn negative; x^-1 must not be evaluated at 0
        lowered = np.maximum(E[..., None, :] - np.eye(E.shape[-1], dtype=np.int64), 0)
        return Monomials(self.factors[..., None] * E, lowered)

    @cached_property
    def _factors(self) -> tuple[int, list[NDArray[np.int64]]]:
        """Return the highest power, and where the powers are that each row is a product of."""
        E = self.exponents
        degree = int(np.max(E, initial=1))
        # states with an exponent first, in their order: x^0 of the others need not be multiplied
        order = np.argsort(E == 0, axis=-1, kind='stable')
        places = order * (degree + 1) + np.take_along_axis(E, order, axis=-1)
        most = int(np.max(np.count_nonzero(E, axis=-1), initial=1))
        return degree, list(np.ascontiguousarray(np.moveaxis(places[..., :most], -1, 0)))

    def at(self, x: Array) -> Array:
        """Evaluate them: (..., n_x) -> (..., *shape)."""
        degree, factors = self._factors
        # each power once: numpy's own power of many numbers takes twenty times as long
        powers = np.ones((*x.shape, degree + 1))
        for k in range(degree):
            np.multiply(powers[..., k], x, out=powers[..., k + 1])
        powers, found = powers.reshape(*x.shape[:-1], x.shape[-1] * (degree + 1)), self.factors
        for places in factors:
            found = found * powers.take(places, axis=-1)
        return found
