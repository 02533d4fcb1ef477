# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's two-state example, linear in (x1, x2, x1^2)."""

from functools import partial
import math

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.plants.system import ControlAffineSystem


def two_state_example(mu: float = -0.1, lambda_: float = 1.0) -> ControlAffineSystem:
    """
    Build dx1/dt = mu x1, dx2/dt = lambda (x2 - x1^2) + u (paper, eq. 32), nominal at the origin.

    :param mu: growth rate of the first state, in 1/s; by default the paper's, stable.
    :param lambda_: that of the second state, in 1/s; by default the paper's, unstable.
    :raises ValueError: when a rate is not finite.
    """
    for name, rate in (('mu', mu), ('lambda_', lambda_)):
        if not math.isfinite(rate):
            raise ValueError(f'{name} is {rate} 1/s, must be finite')
    return ControlAffineSystem(
        name='two-state example',
        state_names=('x1', 'x2'),
        state_units=('1', '1'),
        input_names=('u',),
        input_units=('1/s',),
        time_unit='s',
        drift=partial(_drift, mu, lambda_),
        drift_jacobian=partial(_drift_jacobian, mu, lambda_),
        B=np.array([[0.0], [1.0]]),
        nominal_state=np.zeros(2),
        nominal_input=np.zeros(1),
    )


def _drift(mu: float, lambda_: float, x: Array) -> Array:
    x1, x2 = x[..., 0], x[..., 1]
    return np.stack([mu * x1, lambda_ * (x2 - x1 * x1)], axis=-1)


def _drift_jacobian(mu: float, lambda_: float, x: Array) -> Array:
    jacobian = np.zeros((*x.shape, 2))
    jacobian[..., 0, 0] = mu
    jacobian[..., 1, 0] = -2.0 * lambda_ * x[..., 0]
    jacobian[..., 1, 1] = lambda_
    return jacobian
