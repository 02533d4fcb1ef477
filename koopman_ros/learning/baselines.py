# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Baselines: linearisation and polynomial EDMD from the same samples."""

from dataclasses import dataclass

import numpy as np

from koopman_ros import __version__
from koopman_ros.learning.scaled import deviations
from koopman_ros.lifting import (
    Box,
    LiftedModel,
    linearised_model,
    PolynomialObservables,
    Provenance,
)
from koopman_ros.plant_data import Array, Plant, Samples


@dataclass(frozen=True)
class Linearisation:
    """The linearisation at the nominal point."""

    jacobian: Array  #: (n_x, n_x) df/dx there, in units

    def learn(self, plant: Plant, samples: Samples, box: Box | None = None
              ) -> LiftedModel:
        """
        Return the model.

        :param box: its coordinates; by default from the range of the samples.
        :raises ValueError: when B is not known.
        """
        if plant.B is None:
            raise ValueError('a linearisation needs the B of the plant')
        box = box or Box.of(plant, samples.x, samples.u)
        return linearised_model(self.jacobian, plant.B, box.states, box.inputs,
                                box.time_unit, _provenance(plant, samples))


@dataclass(frozen=True)
class Edmd:
    """
    Extended dynamic mode decomposition of the generator, with inputs, on monomials.

    dz/dt = A z + J(x) B u by linear least squares on J (dx/dt - B u), z all monomials of the
    scaled states up to a degree; degree 1 is the linear model that fits the samples best. The
    drift is read off the rows of the states, which are a fit to dx/dt by itself. Where B is not
    known it comes from them, too. (Williams, Kevrekidis, Rowley 2015;
    generator with control-affine inputs: Peitz, Otto, Rowley 2020.)
    """

    degree: int = 3  #: highest total degree of the monomials

    def learn(self, plant: Plant, samples: Samples, box: Box | None = None
              ) -> LiftedModel:
        """
        Fit the model.

        :param box: its coordinates; by default from the range of the samples.
        """
        box = box or Box.of(plant, samples.x, samples.u)
        x, rate, u = deviations(box, samples)
        observables = PolynomialObservables.total_degree(x.shape[1], self.degree)
        z, J = observables.lift_and_jacobian(x)
        if plant.B is None:
            both = np.linalg.lstsq(np.hstack([z, u]), rate, rcond=None)[0]
            B = both[z.shape[1]:].T
        else:
            B = box.input_matrix(plant.B)
        drift = (J @ (rate - u @ B.T)[..., None])[..., 0]
        A = np.linalg.lstsq(z, drift, rcond=None)[0].T
        return LiftedModel(observables, A.astype(np.float64), B.astype(np.float64),
                           box.states, box.inputs, box.time_unit,
                           _provenance(plant, samples))


def _provenance(plant: Plant, samples: Samples) -> Provenance:
    return Provenance(plant.name, None, samples.digest(), {}, __version__)
