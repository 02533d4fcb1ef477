# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A pendulum with friction and a motor in its pivot, upright."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopman_ros.core.arrays import along_last, Array
from koopman_ros.plants.constants import constant, Constants
from koopman_ros.plants.system import ControlAffineSystem


@dataclass(frozen=True)
class Pendulum(Constants):
    """
    A mass on a rod: m l^2 d2a/dt2 = m g l sin(a) - b da/dt + u, a from upright.

    The equation is that of Khalil, *Nonlinear Systems*, section 1.2.1, counted from above.
    """

    mass: float = constant(1.0, 'kg', 1e-3, 1e3, 'mass m at the end of the rod')
    length: float = constant(0.5, 'm', 1e-2, 100.0, 'length l of the rod')
    friction: float = constant(0.1, 'N m s', 0.0, 1e3, 'viscous friction b of the pivot')
    gravity: float = constant(9.81, 'm/s^2', 0.0, 100.0, 'acceleration g of gravity')

    def system(self) -> ControlAffineSystem:
        """Build it, nominal upright at rest."""
        return ControlAffineSystem(
            name='pendulum',
            state_names=('angle', 'rate'),
            state_units=('rad', 'rad/s'),
            input_names=('torque',),
            input_units=('N m',),
            time_unit='s',
            drift=self._drift,
            drift_jacobian=self._drift_jacobian,
            B=np.array([[0.0], [1.0 / self._inertia]]),
            nominal_state=np.zeros(2),
            nominal_input=np.zeros(1),
        )

    @cached_property
    def _inertia(self) -> float:
        return self.mass * self.length ** 2

    def _drift(self, x: Array) -> Array:
        angle, rate = x[..., 0], x[..., 1]
        return along_last(rate, self.gravity / self.length * np.sin(angle)
                          - self.friction / self._inertia * rate)

    def _drift_jacobian(self, x: Array) -> Array:
        jacobian = np.zeros((*x.shape, 2))
        jacobian[..., 0, 1] = 1.0
        jacobian[..., 1, 0] = self.gravity / self.length * np.cos(x[..., 0])
        jacobian[..., 1, 1] = -self.friction / self._inertia
        return jacobian
