# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Two coupled tanks, one above the other, each filled by a pump of its own."""

from dataclasses import dataclass

import numpy as np

from koopman_ros.plants.constants import constant, Constants
from koopman_ros.plants.library.tanks import Tanks
from koopman_ros.plants.system import ControlAffineSystem


@dataclass(frozen=True)
class TwoTanks(Constants):
    """
    Tank 1 drains into tank 2 and that one into the basin; pump 1 fills tank 1, pump 2 tank 2.

    A dh1/dt = k u1 - a1 sqrt(2 g h1), A dh2/dt = a1 sqrt(2 g h1) - a2 sqrt(2 g h2) + k u2. The
    sizes are those of the coupled tanks of Quanser's laboratory; the second pump is added.
    """

    tank_area: float = constant(15.52e-4, 'm^2', 1e-5, 100.0, 'cross-section A of both tanks')
    orifice_1: float = constant(
        0.1781e-4, 'm^2', 1e-8, 1.0, 'cross-section a1 of the outlet of tank 1',
        estimated=(0.05e-4, 0.5e-4))
    orifice_2: float = constant(
        0.1781e-4, 'm^2', 1e-8, 1.0, 'cross-section a2 of the outlet of tank 2',
        estimated=(0.05e-4, 0.5e-4))
    pump_gain: float = constant(
        3.3e-6, 'm^3/(s V)', 1e-9, 1.0, 'flow k of each pump per volt', estimated=(1e-6, 1e-5))

    def system(self) -> ControlAffineSystem:
        """Build it, nominal where 6 V and 2 V hold it; levels in m, pumps in V."""
        return Tanks(
            np.full(2, self.tank_area), np.array([self.orifice_1, self.orifice_2]),
            np.array([[-1.0, 0.0], [1.0, -1.0]]), self.pump_gain * np.eye(2),
        ).system('two tanks', np.array([6.0, 2.0]))
