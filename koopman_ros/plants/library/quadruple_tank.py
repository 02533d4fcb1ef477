# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The quadruple-tank process: four tanks, two pumps that each fill a lower and an upper one."""

from dataclasses import dataclass

import numpy as np

from koopman_ros.plants.constants import constant, Constants
from koopman_ros.plants.library.tanks import Tanks
from koopman_ros.plants.system import ControlAffineSystem

# share of the outflow of each tank that enters tanks 1 and 2: 3 drains into 1, 4 into 2
_INTO = np.array([[-1.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 1.0],
                  [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class QuadrupleTank(Constants):
    """
    The process of Johansson, *IEEE Trans. Control Systems Technology* 8 (2000), 456-465.

    Tanks 3 and 4 drain into 1 and 2 below them; pump 1 fills tanks 1 and 4, pump 2 tanks 2 and 3,
    as its valve splits the flow. The defaults are those of its minimum-phase operating point P-.
    """

    tank_area_1: float = constant(28e-4, 'm^2', 1e-5, 100.0, 'cross-section A1 of tank 1')
    tank_area_2: float = constant(32e-4, 'm^2', 1e-5, 100.0, 'cross-section A2 of tank 2')
    tank_area_3: float = constant(28e-4, 'm^2', 1e-5, 100.0, 'cross-section A3 of tank 3')
    tank_area_4: float = constant(32e-4, 'm^2', 1e-5, 100.0, 'cross-section A4 of tank 4')
    orifice_1: float = constant(
        0.071e-4, 'm^2', 1e-8, 1.0, 'cross-section a1 of the outlet of tank 1')
    orifice_2: float = constant(
        0.057e-4, 'm^2', 1e-8, 1.0, 'cross-section a2 of the outlet of tank 2')
    orifice_3: float = constant(
        0.071e-4, 'm^2', 1e-8, 1.0, 'cross-section a3 of the outlet of tank 3')
    orifice_4: float = constant(
        0.057e-4, 'm^2', 1e-8, 1.0, 'cross-section a4 of the outlet of tank 4')
    pump_gain_1: float = constant(3.33e-6, 'm^3/(s V)', 1e-9, 1.0, 'flow k1 of pump 1 per volt')
    pump_gain_2: float = constant(3.35e-6, 'm^3/(s V)', 1e-9, 1.0, 'flow k2 of pump 2 per volt')
    split_1: float = constant(
        0.70, '1', 0.0, 1.0, 'share gamma1 of pump 1 that goes to tank 1, the rest to tank 4')
    split_2: float = constant(
        0.60, '1', 0.0, 1.0, 'share gamma2 of pump 2 that goes to tank 2, the rest to tank 3')

    def system(self) -> ControlAffineSystem:
        """Build it, nominal where 3 V on both pumps hold it; levels in m, pumps in V."""
        inflow = np.array([
            [self.split_1, 0.0], [0.0, self.split_2],
            [0.0, 1.0 - self.split_2], [1.0 - self.split_1, 0.0],
        ]) * [self.pump_gain_1, self.pump_gain_2]
        return Tanks(
            np.array([self.tank_area_1, self.tank_area_2, self.tank_area_3, self.tank_area_4]),
            np.array([self.orifice_1, self.orifice_2, self.orifice_3, self.orifice_4]),
            _INTO, inflow).system('quadruple tank', np.array([3.0, 3.0]))
