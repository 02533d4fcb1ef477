# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""A polynomial model of a plant's drift, linear in what is estimated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopman_ros.identification.records import Array, Record
from koopman_ros.lifting import PolynomialObservables


@dataclass(frozen=True)
class Box:
    """
    The range of states and inputs that a drift is estimated over; deviations are its [-1, 1].

    :param state_lower: (n_x,) in state units.
    :param state_upper: (n_x,) in state units.
    :param input_lower: (n_u,) in input units.
    :param input_upper: (n_u,) in input units.
    """

    state_lower: Array
    state_upper: Array
    input_lower: Array
    input_upper: Array

    @classmethod
    def of(cls, records: Sequence[Record]) -> Box:
        """
        Return the range of the records.

        :raises ValueError: when a state or an input never moves.
        """
        x = np.concatenate([record.x for record in records])
        u = np.concatenate([record.u for record in records])
        for kind, values in (('state', x), ('input', u)):
            still = np.flatnonzero(values.min(axis=0) == values.max(axis=0))
            if len(still):
                raise ValueError(f'{kind} {still[0]} never moves from '
                                 f'{values[0, still[0]]:.6g}: excite the plant')
        return cls(x.min(axis=0), x.max(axis=0), u.min(axis=0), u.max(axis=0))

    @property
    def state_scale(self) -> Array:
        """Half the width (n_x,), in state units."""
        return 0.5 * (self.state_upper - self.state_lower)

    @property
    def input_scale(self) -> Array:
        """Half the width (n_u,), in input units."""
        return 0.5 * (self.input_upper - self.input_lower)

    def state_deviation(self, x: Array) -> Array:
        """Scale states (..., n_x)."""
        return (x - 0.5 * (self.state_lower + self.state_upper)) / self.state_scale

    def input_deviation(self, u: Array) -> Array:
        """Scale inputs (..., n_u)."""
        return (u - 0.5 * (self.input_lower + self.input_upper)) / self.input_scale


@dataclass(frozen=True)
class DriftModel:
    """
    dx/dt = f(x) + B u with f a polynomial, in deviations within a box.

    :param box: the deviations' origin and scale.
    :param degree: highest total degree of the monomials.
    :param coefficients: (1 + m, n_x) of 1 and of the m monomials, in scale units a time unit.
    :param B: (n_x, n_u) likewise.
    """

    box: Box
    degree: int
    coefficients: Array
    B: Array

    @cached_property
    def monomials(self) -> PolynomialObservables:
        """The monomials from degree 1 on."""
        return PolynomialObservables.total_degree(self.B.shape[0], self.degree)

    def features(self, xi: Array) -> Array:
        """Evaluate 1 and the monomials: (..., n_x) -> (..., 1 + m)."""
        return np.concatenate((np.ones((*xi.shape[:-1], 1)), self.monomials.lift(xi)), axis=-1)

    def scaled_rate(self, xi: Array, v: Array) -> Array:
        """Evaluate the rate in deviations: (..., n_x) and (..., n_u) -> (..., n_x)."""
        return self.features(xi) @ self.coefficients + v @ self.B.T

    def rate(self, x: Array, u: Array) -> Array:
        """Evaluate dx/dt in units: (..., n_x) and (..., n_u) -> (..., n_x)."""
        return self.box.state_scale * self.scaled_rate(
            self.box.state_deviation(x), self.box.input_deviation(u))

    def slope(self, x: Array) -> Array:
        """Evaluate df/dx (n_x, n_x) at a state (n_x,), in 1/time unit for equal units."""
        scale = self.box.state_scale
        return scale[:, None] * self.scaled_slope(self.box.state_deviation(x)) / scale

    def scaled_slope(self, xi: Array) -> Array:
        """Evaluate the Jacobian of the scaled drift: (..., n_x) -> (..., n_x, n_x)."""
        J = self.monomials.lift_and_jacobian(xi)[1]
        return np.einsum('ji,...jl->...il', self.coefficients[1:], J)

    @property
    def input_matrix(self) -> Array:
        """B (n_x, n_u) in state units per input and time unit."""
        return self.box.state_scale[:, None] * self.B / self.box.input_scale


def scaled_input_matrix(box: Box, B: Array) -> Array:
    """Scale B (n_x, n_u) from units to deviations."""
    return np.asarray(B) * box.input_scale / box.state_scale[:, None]


def regress(box: Box, degree: int, features: Array, pushes: Array, rates: Array,
            B: Array | None) -> DriftModel:
    """
    Fit rates = features @ coefficients + pushes @ B' by linear least squares.

    :param box: the deviations.
    :param degree: of the monomials in `features`.
    :param features: (K, 1 + m) features, or integrals of them.
    :param pushes: (K, n_u) inputs, or integrals of them.
    :param rates: (K, n_x) rates, or integrals of them.
    :param B: (n_x, n_u) scaled, where it is known; None to fit it.
    :raises ValueError: when the samples do not determine the coefficients.
    """
    if B is not None:
        left, right = features, rates - pushes @ B.T
    else:
        left, right = np.hstack([features, pushes]), rates
    # columns of integrals differ in size with their monomial's degree
    norms = np.linalg.norm(left, axis=0)
    if len(left) < left.shape[1] or np.any(norms == 0.0):
        raise ValueError(f'{len(left)} equations do not determine {left.shape[1]} coefficients: '
                         'record more, or choose a lower degree')
    solution = np.linalg.lstsq(left / norms, right, rcond=1e-12)[0] / norms[:, None]
    m = features.shape[1]
    return DriftModel(box, degree, solution[:m], solution[m:].T if B is None else B)
