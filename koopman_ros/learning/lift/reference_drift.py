# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A drift with corrections that need not be affine in the inputs, from samples of the rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.core.datasets import DriftSamples
from koopman_ros.evaluation.closed_loop_test import Rate
from koopman_ros.learning.legendre_basis import Correction, LegendreBasis
from koopman_ros.model import Box


@dataclass(frozen=True)
class CorrectionSettings:
    """When a drift is corrected: it lacks a function of the states and inputs."""

    degree: int = 5  #: of the corrections; kinks of an input need at least as much
    most_coefficients: int = 400  #: the degree is reduced to so many
    samples: int = 5  #: of each correction, at least
    noticeable: float = 0.02  #: least error without corrections, as a share of the motion
    improvement: float = 0.5  #: largest error with corrections, as a share of that without


@dataclass(frozen=True)
class CorrectedRate:
    """A rate with corrections by Legendre products of states and inputs."""

    rate: Rate
    correction: Correction

    __repr__ = short_repr

    def __call__(self, x: Array, u: Array) -> Array:
        """Evaluate dx/dt in units: (..., n_x) and (..., n_u) -> (..., n_x)."""
        return self.rate(x, u) + self.correction(x, u)

    @property
    def cause(self) -> str:
        """The missing structure in words, where it is an effect of the inputs."""
        squares = np.sum(self.correction.coefficients ** 2, axis=1)
        nonlinear = self.correction.basis.degrees[1] > 1
        if squares[nonlinear].sum() < squares[~nonlinear].sum():
            return ''
        names = ' or '.join(self.correction.box.inputs.names)
        return (f'the effect of {names} is nonlinear: use the quantity that acts as the input, '
                'or a narrower range')


def corrected(rate: Rate, box: Box, training: DriftSamples, validation: DriftSamples,
              settings: CorrectionSettings = CorrectionSettings()) -> Rate:
    """Return a rate with corrections where it lacks much that they explain, else itself."""
    scale = box.states.scale

    def left(one: Rate, part: DriftSamples) -> Array:
        return np.asarray((part.dxdt - one(part.x, part.u)) / scale)

    def size(values: Array) -> float:
        return float(np.sqrt(np.mean(values ** 2)))

    error = size(left(rate, validation))
    basis = LegendreBasis.of(len(scale), len(box.inputs), settings.degree,
                             settings.most_coefficients)
    if not error > settings.noticeable * size(validation.dxdt / scale) or (
            len(training) < settings.samples * len(basis.exponents)):
        return rate
    phi = basis(box.states.to_deviation(training.x), box.inputs.to_deviation(training.u))
    coefficients: Array = np.asarray(np.linalg.lstsq(
        phi, left(rate, training), rcond=None)[0], dtype=np.float64)
    found = CorrectedRate(rate, Correction(box, basis, coefficients))
    return found if size(left(found, validation)) < settings.improvement * error else rate
