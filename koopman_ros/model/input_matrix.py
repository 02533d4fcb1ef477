# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""An input matrix that depends on the state, as a polynomial."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import itertools
import math

import numpy as np

from koopman_ros.core.arrays import Array, frozen, short_repr
from koopman_ros.model.observables import PolynomialObservables


@dataclass(frozen=True, eq=False)
class InputTerms:
    """
    The state-dependent part of an input matrix: B(x) = B + sum_k phi_k(x) C_k.

    phi are the monomials of the scaled deviations from degree 1 to a degree, so that B(0) = B.

    :raises ValueError: when the coefficients are not those of all monomials up to some degree.
    """

    coefficients: Array  #: (n_phi, n_x, n_u) in scaled coordinates, 1/time unit

    __repr__ = short_repr

    def __post_init__(self) -> None:
        C = frozen(self.coefficients, 'input terms', (None, None, None))
        object.__setattr__(self, 'coefficients', C)
        if not C.shape[1] or _count(C.shape[1], self.degree) != len(C):
            raise ValueError(f'incompatible input terms: {len(C)} is not the number of monomials '
                             f'of {C.shape[1]} states from degree 1 to another')

    @staticmethod
    def regressors(x: Array, u: Array, degree: int) -> Array:
        """
        Return the regressors whose weights are B and its terms: u, phi_1(x) u, phi_2(x) u, ...

        :param x: (..., n_x) and u (..., n_u), scaled deviations.
        :param degree: of the terms; 0 for u alone.
        :return: (..., n_u (1 + n_phi)).
        """
        if not degree:
            return u
        phi = PolynomialObservables.total_degree(x.shape[-1], degree).lift(x)
        products = phi[..., :, None] * u[..., None, :]
        # -1 is ambiguous for an array without rows
        count = phi.shape[-1] * u.shape[-1]
        return np.concatenate([u, products.reshape(*u.shape[:-1], count)], axis=-1)

    @staticmethod
    def split(weights: Array, n_u: int) -> tuple[Array, InputTerms | None]:
        """Return B (n_x, n_u) and its terms of weights (n_x, n_u (1 + n_phi)) of regressors."""
        blocks = weights.reshape(len(weights), -1, n_u).swapaxes(0, 1) if n_u else weights[None]
        return blocks[0], InputTerms(blocks[1:]) if len(blocks) > 1 else None

    @cached_property
    def degree(self) -> int:
        """Highest total degree of the monomials."""
        count, n_x, _ = self.coefficients.shape
        return next(d for d in itertools.count(1) if not n_x or _count(n_x, d) >= count)

    @cached_property
    def _monomials(self) -> PolynomialObservables:
        return PolynomialObservables.total_degree(self.coefficients.shape[1], self.degree)

    def matrix(self, x: Array) -> Array:
        """Evaluate the terms at states: (..., n_x) -> (..., n_x, n_u)."""
        found: Array = np.tensordot(self._monomials.lift(x), self.coefficients, 1)
        return found

    def jacobian(self, x: Array, u: Array) -> Array:
        """Differentiate the terms times u by x: (..., n_x), (..., n_u) -> (..., n_x, n_x)."""
        J = self._monomials.lift_and_jacobian(x)[1]
        return np.einsum('kij,...j,...kl->...il', self.coefficients, u, J)

    def averaged_jacobian(self, x: Array, x_ref: Array, u: Array) -> Array:
        """Average that Jacobian along the segment from x_ref to x, (n_x,) each, exactly."""
        M = self._monomials.secants(x, x_ref, x)[1]
        return np.einsum('kij,j,kl->il', self.coefficients, u, M)


def _count(n_x: int, degree: int) -> int:
    """Return the number of monomials of n_x states from degree 1 to a degree."""
    return math.comb(n_x + degree, degree) - 1
