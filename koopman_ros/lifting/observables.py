# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The functions of the state that make up a lift: of a network, or of a dictionary."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations_with_replacement
from typing import final

from koopman_ros.lifting.activations import Activation, activation_named
from koopman_ros.lifting.arrays import Array, frozen
import numpy as np
from numpy.typing import NDArray


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
    def secants(self, x: Array, x_ref: Array, w: Array) -> tuple[Array, Array]:
        """
        Evaluate the secants of N and of J_N w between two states, exactly.

        With e = x - x_ref they satisfy N(x) - N(x_ref) = M e and
        J_N(x) w - J_N(x_ref) w = H e, also where e is tiny or zero.

        :param x: (n_x,) state.
        :param x_ref: (n_x,) reference.
        :param w: (n_x,) constant direction, e.g. B u_ref.
        :return: M (n_z, n_x) and H (n_z, n_x).
        """


@final
@dataclass(frozen=True, eq=False)
class NetworkObservables(Observables):
    """
    The outputs of a fully connected network, less their values at the origin.

    Without hidden layers and with `identity` this is the linear lift z = x.

    :param hidden: (weight (h_i, h_{i-1}), bias (h_i,)) of each hidden layer, h_0 = n_x.
    :param output: (n_z - n_x, h) with `identity`, else (n_z, h): weights of the last layer.
    :param identity: whether z starts with the state.
    :param activation: of every hidden layer, a name in ``ACTIVATIONS``.
    :raises ValueError: naming the array that does not fit and both shapes, or the activations.
    """

    hidden: tuple[tuple[Array, Array], ...]
    output: Array
    identity: bool
    activation: str = 'tanh'

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
    def _activation(self) -> Activation:
        return activation_named(self.activation)

    @cached_property
    def _value_at_zero(self) -> Array:
        h = np.zeros(self.n_x)
        for weight, bias in self.hidden:
            h = self._activation.value(weight @ h + bias)
        return h

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
            h = value(h @ weight.T + bias)
        free: Array = (h - self._value_at_zero) @ self.output.T
        return np.concatenate((x, free), axis=-1) if self.identity else free

    def lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate N(x) and J_N(x) in one forward pass; shapes as in the interface."""
        eye = np.broadcast_to(self._identity_rows, (*x.shape, x.shape[-1]))
        if not self.hidden:
            return x, eye
        h, T, f = x, eye, self._activation
        for weight, bias in self.hidden:
            a = h @ weight.T + bias
            h = f.value(a)
            T = f.slope(a, h)[..., None] * (weight @ T)
        free = (h - self._value_at_zero) @ self.output.T
        J = self.output @ T
        if self.identity:
            return np.concatenate((x, free), axis=-1), np.concatenate((eye, J), axis=-2)
        return free, J

    def secants(self, x: Array, x_ref: Array, w: Array) -> tuple[Array, Array]:
        """
        Evaluate the secants of the interface by the chain rule of divided differences.

        With one hidden layer M is the mean of J_N along the segment.
        """
        h, h_ref, p = x, x_ref, w
        T, G, f = self._identity_rows, self._zero_rows, self._activation
        for weight, bias in self.hidden:
            a, a_ref = weight @ h + bias, weight @ h_ref + bias
            h, h_ref = f.value(a), f.value(a_ref)
            slope, slope_of_slope = f.divided_differences(a, a_ref, h, h_ref)
            q = weight @ p
            T = weight @ T
            G = (slope_of_slope * q)[:, None] * T + f.slope(a_ref, h_ref)[:, None] * (weight @ G)
            T = slope[:, None] * T
            p = f.slope(a, h) * q
        if not self.hidden:
            return T, G
        M, H = self.output @ T, self.output @ G
        if self.identity:
            M = np.concatenate((self._identity_rows, M))
            H = np.concatenate((self._zero_rows, H))
        return M, H


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
    def total_degree(cls, n_x: int, degree: int) -> PolynomialObservables:
        """
        Return all monomials of n_x states from degree 1 to `degree`, by rising degree.

        :raises ValueError: when either is less than 1.
        """
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

    @cached_property
    def _first(self) -> tuple[Array, NDArray[np.int64]]:
        return _differentiated(np.ones(self.n_z), self.exponents)

    @cached_property
    def _second(self) -> tuple[Array, NDArray[np.int64]]:
        return _differentiated(*self._first)

    @cached_property
    def _quadrature(self) -> tuple[Array, Array]:
        """Return nodes on [0, 1] and weights, exact for the degree of J_N along a segment."""
        degree = int(np.max(np.sum(self.exponents, axis=1)))
        nodes, weights = np.polynomial.legendre.leggauss((degree + 1) // 2)
        return 0.5 * (1.0 + nodes), 0.5 * weights

    def lift(self, x: Array) -> Array:
        """Evaluate z = N(x): (..., n_x) -> (..., n_z)."""
        return _monomials(x, self.exponents)

    def lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate N(x) and J_N(x); shapes as in the interface."""
        factors, exponents = self._first
        return self.lift(x), factors * _monomials(x, exponents)

    def secants(self, x: Array, x_ref: Array, w: Array) -> tuple[Array, Array]:
        """
        Evaluate the secants of the interface as means along the segment.

        M is the mean of J_N and H that of d(J_N w)/dx, by Gauss-Legendre quadrature, which is
        exact for polynomials.
        """
        nodes, weights = self._quadrature
        points = x_ref + nodes[:, None] * (x - x_ref)
        first, exponents = self._first
        M: Array = np.tensordot(weights, first * _monomials(points, exponents), 1)
        # the weights add up to 1 but for rounding
        M[:self.n_x] = np.eye(self.n_x)
        second, exponents = self._second
        H: Array = np.tensordot(weights, second * _monomials(points, exponents) @ w, 1)
        return M, H


def _columns(array: Array) -> int:
    return np.shape(array)[1] if np.ndim(array) == 2 else -1


def _differentiated(factors: Array, exponents: NDArray[np.int64]
                    ) -> tuple[Array, NDArray[np.int64]]:
    """
    Differentiate monomials by each state.

    :param factors: (...) that multiply the monomials.
    :param exponents: (..., n_x).
    :return: factors (..., n_x) and exponents (..., n_x, n_x), by each state in the axis added.
    """
    n_x = exponents.shape[-1]
    # the factor is 0 where an exponent would turn negative, and x^-1 must not be evaluated at 0
    lowered = np.maximum(exponents[..., None, :] - np.eye(n_x, dtype=np.int64), 0)
    return factors[..., None] * exponents, lowered


def _monomials(x: Array, exponents: NDArray[np.int64]) -> Array:
    """Evaluate prod_j x_j^exponents[..., j]: (..., n_x) and (*shape, n_x) -> (..., *shape)."""
    axes = tuple(range(-exponents.ndim, -1))
    powers: Array = np.expand_dims(x, axes) ** exponents
    return powers.prod(axis=-1)
