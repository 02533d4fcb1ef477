# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drifts dx/dt = f(x, u): additional functions of inputs, with factors that depend on x."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from koopman_ros.core.arrays import short_repr
from koopman_ros.core.datasets import Array, Episode
from koopman_ros.core.solvers import differences
from koopman_ros.learning.identification.drift import Drift, DriftModel
from koopman_ros.model import Coordinates, PolynomialObservables


@dataclass(frozen=True)
class InputFunctions(ABC):
    """Functions of some inputs, as further inputs."""

    inputs: Coordinates  #: all inputs

    @property
    @abstractmethod
    def arguments(self) -> Sequence[frozenset[int]]:
        """The inputs on which each function depends, by index."""

    @abstractmethod
    def values(self, u: Array) -> Array:
        """Evaluate the functions of inputs (..., n_u): (..., k)."""

    @property
    def names(self) -> tuple[str, ...]:
        """The inputs that have functions."""
        some = frozenset[int]().union(*self.arguments)
        return tuple(self.inputs.names[j] for j in sorted(some))

    def appended(self, u: Array) -> Array:
        """Return inputs (..., n_u) and after them the functions of them."""
        return np.concatenate((u, self.values(u)), axis=-1)

    def added(self, episode: Episode) -> Episode:
        """Return an episode with the functions as further inputs."""
        linear = episode.linear or (False,) * len(self.inputs)
        return replace(episode, u=self.appended(episode.u), linear=(*linear, *(
            all(linear[j] for j in some) for some in self.arguments)))

    def coordinates(self) -> Coordinates:
        """Return the coordinates of the inputs and of the functions of them."""
        count = len(self.arguments)
        return self.inputs.followed_by(Coordinates.spanning(
            tuple(f'function {k}' for k in range(count)), ('1',) * count, np.zeros(count),
            np.ones(count)))


@dataclass(frozen=True)
class Hats(InputFunctions):
    """Functions that are 1 at one knot, 0 at the others and linear between them."""

    knots: Mapping[str, Array]  #: by input, rising; the ends have no function

    @property
    def arguments(self) -> Sequence[frozenset[int]]:
        """The one input on which each function depends."""
        return [frozenset((self.inputs.names.index(name),)) for name, own in self.knots.items()
                for _ in own[1:-1]]

    def values(self, u: Array) -> Array:
        """Evaluate the functions; see :class:`InputFunctions`."""
        return np.stack([np.interp(u[..., self.inputs.names.index(name)], own, row)
                         for name, own in self.knots.items()
                         for row in np.eye(len(own))[1:-1]], axis=-1)


@dataclass(frozen=True)
class Legendre(InputFunctions):
    """
    Products of Legendre polynomials, from the second degree on, of scaled deviations of inputs.

    Unlike their powers, inputs spread over their range do not move them together.
    """

    degrees: NDArray[np.int64]  #: (k, n_u) of the factors

    @staticmethod
    def of(inputs: Coordinates, names: Sequence[str], degree: int) -> Legendre:
        """Return those of some inputs, to a total degree."""
        rows = [inputs.names.index(name) for name in names]
        some = PolynomialObservables.total_degree(len(rows), degree).exponents
        some = some[some.sum(axis=1) > 1]
        degrees = np.zeros((len(some), len(inputs)), dtype=np.int64)
        degrees[:, rows] = some
        return Legendre(replace(inputs, characteristics={}), degrees)

    @property
    def arguments(self) -> Sequence[frozenset[int]]:
        """The inputs of each product."""
        return [frozenset(np.flatnonzero(row).tolist()) for row in self.degrees]

    def values(self, u: Array) -> Array:
        """Evaluate the products; see :class:`InputFunctions`."""
        each = legvander(self.inputs.to_deviation(u), int(np.max(self.degrees)))
        return np.prod([each[..., j, own] for j, own in enumerate(self.degrees.T)], axis=0)


@dataclass(frozen=True)
class NonAffineDrift(Drift):
    """A drift that is not affine in its inputs."""

    drift: DriftModel  #: of the inputs and functions of them
    functions: InputFunctions
    #: of a law that does not control it
    remedy: ClassVar[str] = ('set as_state of the input, use the quantity that acts as the input, '
                             'or record a narrower range of the inputs')

    __repr__ = short_repr

    @property
    def form(self) -> str:
        """The kind of model, in words."""
        return f'{self.drift.form}, not affine in {", ".join(self.functions.names)}'

    @property
    def varying_input_matrix(self) -> bool:
        """Whether B depends on the state."""
        return True

    def _with_functions(self, v: Array) -> Array:
        return self.drift.box.inputs.to_deviation(
            self.functions.appended(self.box.inputs.to_physical(v)))

    def scaled_rate(self, xi: Array, v: Array) -> Array:
        """Evaluate the rate in deviations; see :class:`Drift`."""
        return self.drift.scaled_rate(xi, self._with_functions(v))

    def scaled_slope(self, xi: Array, v: Array | None = None) -> Array:
        """Evaluate the Jacobian of the scaled rate; see :class:`Drift`."""
        return self.drift.scaled_slope(xi, None if v is None else self._with_functions(v))

    def scaled_input_matrix(self, xi: Array) -> Array:
        """Evaluate the part of B(x) that is linear in the inputs; see :class:`Drift`."""
        return self.drift.scaled_input_matrix(xi)[..., :len(self.box.inputs)]

    def scaled_input_slope(self, xi: Array, v: Array) -> Array:
        """Evaluate the Jacobian of the scaled rate by the inputs; see :class:`Drift`."""
        return np.asarray(self.drift.scaled_input_matrix(xi) @ differences(
            self._with_functions, v, np.ones(v.shape[-1])))
