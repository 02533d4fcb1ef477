# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""An electric oven that loses heat by convection and by radiation."""

from dataclasses import dataclass

import numpy as np

from koopman_ros.plants import constant, Constants, ControlAffineSystem

STEFAN_BOLTZMANN = 5.670374419e-8  # W/(m^2 K^4)
ROOM = 293.15  # K


@dataclass(frozen=True)
class Oven(Constants):
    """C dT/dt = P - h A (T - T_room) - e s A (T^4 - T_room^4)."""

    capacity: float = constant(900.0, 'J/K', 10.0, 1e6, 'heat capacity C')
    area: float = constant(0.1, 'm^2', 1e-3, 100.0, 'surface A that loses heat')
    convection: float = constant(12.0, 'W/(m^2 K)', 0.0, 1e3, 'heat transfer coefficient h')
    emissivity: float = constant(0.8, '1', 0.0, 1.0, 'emissivity e of the surface')

    def system(self):
        """Build it, nominal at 600 K and the power that holds it."""
        return ControlAffineSystem(
            name='oven',
            state_names=('temperature',), state_units=('K',),
            input_names=('power',), input_units=('W',),
            time_unit='s',
            drift=lambda T: -self.loss(T) / self.capacity,
            drift_jacobian=lambda T: -self.loss_slope(T)[..., None] / self.capacity,
            B=np.array([[1.0 / self.capacity]]),
            nominal_state=np.array([600.0]),
            nominal_input=self.loss(np.array([600.0])),
            state_lower=np.array([0.0]))

    def loss(self, T):
        """Return the heat loss in W at temperatures (..., 1) in K."""
        return self.area * (self.convection * (T - ROOM)
                            + self.emissivity * STEFAN_BOLTZMANN * (T ** 4 - ROOM ** 4))

    def loss_slope(self, T):
        """Return its derivative in W/K."""
        return self.area * (self.convection + 4.0 * self.emissivity * STEFAN_BOLTZMANN * T ** 3)
