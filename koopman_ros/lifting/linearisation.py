# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The linearisation of a plant, as a lifted model without hidden layers."""

from __future__ import annotations

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.lifting.coordinates import Coordinates
from koopman_ros.lifting.model import LiftedModel, Provenance
from koopman_ros.lifting.observables import NetworkObservables


def linearised_model(jacobian: Array, B: Array, states: Coordinates, inputs: Coordinates,
                     time_unit: str, provenance: Provenance) -> LiftedModel:
    """
    Build the linear model dx/dt = (df/dx)(x - x_0) + B (u - u_0) as a lift with N(x) = x.

    Every controller and every study can then treat it as just another model.

    :param jacobian: (n_x, n_x) df/dx at the nominal point, in units.
    :param B: (n_x, n_u) input matrix, in units.
    :param states: whose center is the nominal state.
    :param inputs: whose center is the nominal input.
    :param time_unit: ``'s'`` or ``'min'``.
    :param provenance: the plant it belongs to.
    """
    n_x = len(states)
    A = np.asarray(jacobian) * states.scale / states.scale[:, None]
    scaled_B = np.asarray(B) * inputs.scale / states.scale[:, None]
    itself = NetworkObservables((), np.zeros((0, n_x)), identity=True)
    return LiftedModel(itself, A, scaled_B, states, inputs, time_unit, provenance)
