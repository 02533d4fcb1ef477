# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The effect of inputs on the rates of samples, known or to be learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import PlantDescription
from koopman_ros.model import Box, InputTerms

# A function B(x) is replaced by a polynomial of at most this degree, whose root mean square error
# over the samples may be at most this share of it; one so small is rounding.
_HIGHEST_DEGREE = 5
_MOST_ERROR, _ROUNDING = 1e-3, 1e-12


@dataclass(frozen=True)
class InputModel:
    """B(x) u of a plant, as weights of u and of its products with monomials of the state."""

    n_u: int  #: number of inputs
    degree: int  #: of the monomials; 0 where B is constant
    weights: Array | None  #: (n_x, n_u (1 + n_phi)) scaled, where they are known

    @staticmethod
    def of(plant: PlantDescription, box: Box, x: Array) -> InputModel:
        """
        Return the input model of a plant, in the coordinates of a box.

        :param x: (N, n_x) states, in state units, at which a function B(x) is fitted.
        :raises ValueError: for a B of another shape, or a function that is not a polynomial there.
        """
        n_u = len(box.inputs)
        if plant.B is None:
            # nothing is left to learn without inputs
            return InputModel(n_u, plant.input_matrix_degree, None if n_u else np.zeros(
                (len(box.states), 0)))
        nominal = box.input_matrix(plant.input_matrix(box.states.center))
        if not callable(plant.B):
            return InputModel(n_u, 0, nominal)
        deviation = box.states.to_deviation(x)
        target = box.input_matrix(plant.input_matrix(x)) - nominal
        size = float(np.sqrt(np.mean(target ** 2 + nominal ** 2)))
        error = float(np.sqrt(np.mean(target ** 2)))
        if error <= _ROUNDING * size:
            return InputModel(n_u, 0, nominal)
        for degree in range(1, _HIGHEST_DEGREE + 1):
            # the regressors of an input of 1
            phi = InputTerms.regressors(deviation, np.ones((len(x), 1)), degree)[:, 1:]
            flat = target.reshape(len(x), -1)
            terms = np.linalg.lstsq(phi, flat, rcond=None)[0]
            error = float(np.sqrt(np.mean((phi @ terms - flat) ** 2)))
            if error <= _ROUNDING * size:
                break
        if error > _MOST_ERROR * size:
            raise ValueError(
                f'B(x) differs from a polynomial of degree {_HIGHEST_DEGREE} by '
                f'{error / size:.2g} of its size, at most {_MOST_ERROR:g} is allowed: narrow the '
                'range of the states, or use another input')
        blocks = [nominal, *terms.reshape(-1, *nominal.shape)]
        return InputModel(n_u, degree, np.hstack(blocks))

    def apart(self, x: Array, rate: Array, u: Array) -> tuple[Array, Array | None]:
        """
        Subtract the known effect of the inputs from the rates.

        :param x: (N, n_x), and rates (N, n_x) and inputs (N, n_u), all scaled deviations.
        :return: the residual (N, n_x), and the regressors of the unknown weights (N, n_u (1 +
            n_phi)), None where they are known.
        """
        regressors = InputTerms.regressors(x, u, self.degree)
        if self.weights is None:
            return rate, regressors
        return rate - regressors @ self.weights.T, None

    def matrix(self, learned: Array | None) -> tuple[Array, InputTerms | None]:
        """Return B (n_x, n_u) and its terms, of the known weights or of learned ones."""
        weights = self.weights if learned is None else learned
        assert weights is not None
        return InputTerms.split(weights, self.n_u)
