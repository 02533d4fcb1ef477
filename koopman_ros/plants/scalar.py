# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's motivating example dx/dt = x^2: one state, no input."""

from __future__ import annotations

import numpy as np

from koopman_ros.plants.exact_lift import ExactLift
from koopman_ros.plants.system import ControlAffineSystem, FloatArray


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


def scalar_exact_lift() -> ExactLift:
    """
    Build the eigenfunction z = exp(-1/x) of dx/dt = x^2, with eigenvalue 1 (paper, eq. 5 and 6).

    It is defined for x >= 0, with its limit 0 at x = 0; both its functions raise ValueError below.
    """
    return ExactLift(A=np.eye(1), lift=_eigenfunction, jacobian=_eigenfunction_jacobian)


def _drift_jacobian(x: FloatArray) -> FloatArray:
    return 2.0 * x[..., None]


def _eigenfunction(x: FloatArray) -> FloatArray:
    return np.exp(-_reciprocal(x))


def _eigenfunction_jacobian(x: FloatArray) -> FloatArray:
    reciprocal = _reciprocal(x)
    # exp(-r) vanishes faster than r^2 grows; beyond r = 1e150 the square alone would overflow.
    slope = np.exp(-reciprocal) * np.square(np.minimum(reciprocal, 1e150))
    return slope[..., None]


def _reciprocal(x: FloatArray) -> FloatArray:
    if np.any(x < 0.0):
        raise ValueError(
            f'x is {np.min(x)}, must be >= 0: exp(-1/x) is no continuous function through x = 0')
    # Below 1e-300 the lift is zero in float64 anyway.
    return 1.0 / np.maximum(x, 1e-300)
