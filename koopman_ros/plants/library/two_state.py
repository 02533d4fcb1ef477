# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's two-state example, linear in (x1, x2, x1^2)."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from koopman_ros.core.arrays import along_last, Array
from koopman_ros.plants.constants import constant, Constants
from koopman_ros.plants.system import ControlAffineSystem


@dataclass(frozen=True)
class TwoStateExample(Constants):
    """
    Two states of which the square of one drives the other (paper, eq. 32).

    :raises ValueError: when a rate is not a number or outside its range.
    """

    mu: float = constant(-0.1, '1/s', -1e6, 1e6, 'growth rate of the first state')
    lambda_: float = constant(1.0, '1/s', -1e6, 1e6, 'growth rate of the second state')

    def system(self) -> ControlAffineSystem:
        """Build dx1/dt = mu x1, dx2/dt = lambda (x2 - x1^2) + u, nominal at the origin."""
        return ControlAffineSystem(
            name='two-state example',
            state_names=('x1', 'x2'),
            state_units=('1', '1'),
            input_names=('u',),
            input_units=('1/s',),
            time_unit='s',
            drift=partial(_drift, self.mu, self.lambda_),
            drift_jacobian=partial(_drift_jacobian, self.mu, self.lambda_),
            B=np.array([[0.0], [1.0]]),
            nominal_state=np.zeros(2),
            nominal_input=np.zeros(1),
        )


def two_state_example(mu: float = -0.1, lambda_: float = 1.0) -> ControlAffineSystem:
    """Build :class:`TwoStateExample` with other rates than the paper's, in 1/s."""
    return TwoStateExample(mu, lambda_).system()


def _drift(mu: float, lambda_: float, x: Array) -> Array:
    x1, x2 = x[..., 0], x[..., 1]
    return along_last(mu * x1, lambda_ * (x2 - x1 * x1))


def _drift_jacobian(mu: float, lambda_: float, x: Array) -> Array:
    jacobian = np.zeros((*x.shape, 2))
    jacobian[..., 0, 0] = mu
    jacobian[..., 1, 0] = -2.0 * lambda_ * x[..., 0]
    jacobian[..., 1, 1] = lambda_
    return jacobian
