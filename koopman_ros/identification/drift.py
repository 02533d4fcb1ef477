# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A polynomial model of a plant's drift, linear in what is estimated."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopman_ros.lifting import Box, PolynomialObservables
from koopman_ros.plant_data import Array, Episode, Plant


def box_of(plant: Plant, episodes: Sequence[Episode]) -> Box:
    """
    Return the range of some episodes, with deviations from its middle.

    :raises ValueError: when a state or an input never moves.
    """
    return Box.of(plant, np.concatenate([episode.x for episode in episodes]),
                  np.concatenate([episode.u for episode in episodes]), nominal=False)


@dataclass(frozen=True)
class DriftModel:
    """dx/dt = f(x) + B u with f a polynomial, in deviations within a box."""

    box: Box  #: the deviations' origin and scale
    degree: int  #: highest total degree of the monomials
    coefficients: Array  #: (1 + m, n_x) of 1 and of the m monomials, in scale units a time unit
    B: Array  #: (n_x, n_u) likewise

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
        return self.box.states.scale * self.scaled_rate(
            self.box.states.to_deviation(x), self.box.inputs.to_deviation(u))

    def slope(self, x: Array) -> Array:
        """Evaluate df/dx (n_x, n_x) at a state (n_x,), in 1/time unit for equal units."""
        scale = self.box.states.scale
        return scale[:, None] * self.scaled_slope(self.box.states.to_deviation(x)) / scale

    def scaled_slope(self, xi: Array) -> Array:
        """Evaluate the Jacobian of the scaled drift: (..., n_x) -> (..., n_x, n_x)."""
        J = self.monomials.lift_and_jacobian(xi)[1]
        return np.einsum('ji,...jl->...il', self.coefficients[1:], J)

    @property
    def input_matrix(self) -> Array:
        """B (n_x, n_u) in state units per input and time unit."""
        return self.box.states.scale[:, None] * self.B / self.box.inputs.scale


def regress(box: Box, degree: int, features: Array, inputs: Array, rates: Array,
            B: Array | None) -> DriftModel:
    """
    Fit rates = features @ coefficients + inputs @ B' by linear least squares.

    :param box: the deviations.
    :param degree: of the monomials in `features`.
    :param features: (K, 1 + m) features, or integrals of them.
    :param inputs: (K, n_u) inputs, or integrals of them.
    :param rates: (K, n_x) rates, or integrals of them.
    :param B: (n_x, n_u) scaled, where it is known; None to fit it.
    :raises ValueError: when the samples do not determine the coefficients.
    """
    if B is not None:
        left, right = features, rates - inputs @ B.T
    else:
        left, right = np.hstack([features, inputs]), rates
    # columns of integrals differ in size with their monomial's degree
    norms = np.linalg.norm(left, axis=0)
    if len(left) < left.shape[1] or np.any(norms == 0.0):
        raise ValueError(f'{len(left)} equations do not determine {left.shape[1]} coefficients: '
                         'record more, or choose a lower degree')
    solution = np.linalg.lstsq(left / norms, right, rcond=1e-12)[0] / norms[:, None]
    m = features.shape[1]
    return DriftModel(box, degree, solution[:m], solution[m:].T if B is None else B)
