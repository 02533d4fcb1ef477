# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The drift read out of a lift's features, by linear least squares."""

from dataclasses import replace

import numpy as np

from koopman_ros.lifting import LiftedModel
from koopman_ros.plant_data import Samples

# Directions of the features smaller than this beside the largest are left out of a fit: their
# weights would be as large as the inverse. What that loses and gains depends on the data.
SMALLEST = (1e-9, 1e-6, 1e-3)


def with_readout(model: LiftedModel, samples: Samples, smallest: float = SMALLEST[0]
                 ) -> LiftedModel:
    """
    Read the drift off the features phi of the lift: f(x) = readout phi(x), by least squares.

    phi(0) = 0, so that f(0) = 0 whatever the weights are.

    :param smallest: share of the largest singular value below which a direction is left out.
    """
    phi = model.observables.features.lift(model.states.to_deviation(samples.x))
    f = samples.dxdt / model.states.scale - model.inputs.to_deviation(samples.u) @ model.B.T
    # each feature in units of its size; one that is 0 on all samples gets no weight
    size = np.sqrt(np.mean(phi ** 2, axis=0))
    unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    weights = np.linalg.lstsq(phi * unit, f, rcond=smallest)[0].T
    return replace(model, readout=weights * unit)
