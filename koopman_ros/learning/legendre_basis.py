# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Orthonormal products of Legendre polynomials, by which rates are corrected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.model import Box


@dataclass(frozen=True)
class LegendreBasis:
    """Products of normalised Legendre polynomials in scaled deviations of states and inputs."""

    exponents: NDArray[np.int64]  #: (p, n_x + n_u) degree of each factor
    n_x: int
    edge: float = 1.05  #: deviations beyond count as this one, just outside the box

    __repr__ = short_repr

    @classmethod
    def of(cls, n_x: int, n_u: int, degree: int, most: int) -> LegendreBasis:
        """Return those up to a total degree, lower where all states have over `most` of them."""
        while degree > 1 and n_x * math.comb(n_x + n_u + degree, degree) > most:
            degree -= 1
        return cls(np.array(_exponents(n_x + n_u, degree)), n_x)

    def __call__(self, xi: Array, v: Array) -> Array:
        """Evaluate the products: (..., n_x) and (..., n_u) -> (..., p)."""
        y = np.clip(np.concatenate((xi, v), axis=-1), -self.edge, self.edge)
        top = int(self.exponents.max())
        # orthonormal for a uniform distribution on [-1, 1]
        each = legvander(y, top) * np.sqrt(2.0 * np.arange(top + 1) + 1.0)
        found: Array = each[..., 0, self.exponents[:, 0]]
        for j in range(1, y.shape[-1]):
            found = found * each[..., j, self.exponents[:, j]]
        return found

    @property
    def degrees(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Degree of each product in the states (p,), and in the inputs (p,)."""
        return (self.exponents[:, :self.n_x].sum(axis=1), self.exponents[:, self.n_x:].sum(axis=1))


@dataclass(frozen=True)
class Correction:
    """An addition to a rate, by Legendre products of states and inputs."""

    box: Box
    basis: LegendreBasis
    coefficients: Array  #: (p, n_x) in scaled deviations

    __repr__ = short_repr

    def __call__(self, x: Array, u: Array) -> Array:
        """Evaluate the addition in units: (..., n_x) and (..., n_u) -> (..., n_x)."""
        states, inputs = self.box.states, self.box.inputs
        phi = self.basis(states.to_deviation(x), inputs.to_deviation(u))
        return np.asarray(states.scale * (phi @ self.coefficients))


def _exponents(count: int, degree: int) -> Sequence[tuple[int, ...]]:
    """Return all exponents of `count` factors up to a total degree, the constant first."""
    if count == 1:
        return [(k,) for k in range(degree + 1)]
    return [(k, *rest) for k in range(degree + 1) for rest in _exponents(count - 1, degree - k)]
