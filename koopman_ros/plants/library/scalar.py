# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's motivating example dx/dt = x^2: one state, no input."""

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.plants.system import ControlAffineSystem


def scalar_example() -> ControlAffineSystem:
    """
    Build dx/dt = x^2 (paper, eq. 4), with nominal state 0 and no input.

    It reaches infinity at the finite time 1 / x(0): x(t) = x(0) / (1 - x(0) t).
    """
    return ControlAffineSystem(
        name='scalar example',
        state_names=('x',),
        state_units=('1',),
        input_names=(),
        input_units=(),
        time_unit='s',
        drift=np.square,
        drift_jacobian=_drift_jacobian,
        B=np.zeros((1, 0)),
        nominal_state=np.zeros(1),
        nominal_input=np.zeros(0),
    )


def _drift_jacobian(x: Array) -> Array:
    return 2.0 * x[..., None]
