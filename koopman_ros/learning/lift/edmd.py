# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models by linear least squares: linearisation, and extended dynamic mode decomposition."""

from dataclasses import dataclass

import numpy as np

from koopman_ros import __version__
from koopman_ros.core.datasets import Array, DriftSamples, PlantDescription
from koopman_ros.learning.lift.input_model import InputModel
from koopman_ros.learning.lift.residuals import deviations
from koopman_ros.model import (
    Box,
    LiftedModel,
    linearised_model,
    PolynomialObservables,
    Provenance,
)


@dataclass(frozen=True)
class Linearisation:
    """The linearisation at the nominal point."""

    jacobian: Array  #: (n_x, n_x) df/dx there, in units

    def learn(self, plant: PlantDescription, samples: DriftSamples,
              box: Box | None = None) -> LiftedModel:
        """Return the model in a box, the samples' by default; ValueError when B is unknown."""
        box = box or Box.of(plant, samples.x, samples.u)
        B = plant.input_matrix(plant.nominal_state)
        return linearised_model(self.jacobian, B, box.states, box.inputs,
                                box.time_unit, _provenance(plant, samples))


@dataclass(frozen=True)
class Edmd:
    """
    Extended dynamic mode decomposition of the generator, with inputs, on monomials.

    dz/dt = A z + J(x) B(x) u by linear least squares on J (dx/dt - B(x) u), z all monomials of the
    scaled states up to a degree; degree 1 is the linear model that fits the samples best. The
    drift is read off the rows of the states, which are a fit to dx/dt by itself. Where B is not
    known it comes from them, too. (Williams, Kevrekidis, Rowley 2015;
    generator with control-affine inputs: Peitz, Otto, Rowley 2020.)
    """

    degree: int = 3  #: highest total degree of the monomials

    def learn(self, plant: PlantDescription, samples: DriftSamples,
              box: Box | None = None) -> LiftedModel:
        """Fit the model in the coordinates of a box, the samples' by default."""
        box = box or Box.of(plant, samples.x, samples.u)
        x, rate, u = deviations(box, samples)
        observables = PolynomialObservables.total_degree(x.shape[1], self.degree)
        z, J = observables.lift_and_jacobian(x)
        inputs = InputModel.of(plant, box, samples.x)
        drift, regressors = inputs.apart(x, rate, u)
        learned = None
        if regressors is not None:
            both = np.linalg.lstsq(np.hstack([z, regressors]), rate, rcond=None)[0]
            learned = both[z.shape[1]:].T.astype(np.float64)
            drift = rate - regressors @ learned.T
        B, terms = inputs.matrix(learned)
        z_rate = (J @ drift[..., None])[..., 0]
        A = np.linalg.lstsq(z, z_rate, rcond=None)[0].T.astype(np.float64)
        return LiftedModel(observables, A, B, box.states, box.inputs, box.time_unit,
                           _provenance(plant, samples), readout=A[:x.shape[1]],
                           input_terms=terms)


def _provenance(plant: PlantDescription, samples: DriftSamples) -> Provenance:
    return Provenance(plant.name, None, samples.digest(), {}, __version__)
