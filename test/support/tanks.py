# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Two tanks and two pumps, and linear models of them."""

from pathlib import Path

import numpy as np

from koopman_ros.model import Coordinates, linearised_model, Provenance, save
from koopman_ros.plants.library.two_tanks import TwoTanks

TANKS = TwoTanks().system()
LEVELS, PUMPS = TANKS.state_names, TANKS.input_names


def linear(folder: Path, gain: float = 1.0) -> Path:
    """Write a linear model of the tanks, whose pumps are so much stronger than they are."""
    span = 0.4 * TANKS.nominal_state, 2.0 * TANKS.nominal_state
    boxes = (Coordinates.spanning(LEVELS, ('m', 'm'), *span, TANKS.nominal_state),
             Coordinates.spanning(PUMPS, ('V', 'V'), np.zeros(2), np.array([12.0, 6.0]),
                                  TANKS.nominal_input))
    save(linearised_model(TANKS.drift_jacobian(TANKS.nominal_state), gain * TANKS.B, *boxes, 's',
                          Provenance('two tanks')), folder / 'linear.safetensors')
    return folder / 'linear.safetensors'
