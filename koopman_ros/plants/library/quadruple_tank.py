# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The quadruple-tank process: four tanks, two pumps that each fill a lower and an upper one."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.plants.constants import constant, Constants
from koopman_ros.plants.library.outflow import (
    level_with_outflow,
    LOWEST_LEVEL,
    outflow,
    outflow_slope,
)
from koopman_ros.plants.system import ControlAffineSystem

# V
_NOMINAL_PUMPS = np.array([3.0, 3.0])
# flow into tanks 1 and 2 of what leaves each tank: 3 drains into 1, 4 into 2, 1 and 2 outside
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
        through = np.linalg.solve(_INTO, -inflow @ _NOMINAL_PUMPS)
        return ControlAffineSystem(
            name='quadruple tank',
            state_names=('level_1', 'level_2', 'level_3', 'level_4'),
            state_units=('m',) * 4,
            input_names=('pump_1', 'pump_2'),
            input_units=('V', 'V'),
            time_unit='s',
            drift=self._drift,
            drift_jacobian=self._drift_jacobian,
            B=inflow / self._areas[:, None],
            nominal_state=level_with_outflow(self._orifices, through),
            nominal_input=_NOMINAL_PUMPS,
            state_lower=np.full(4, LOWEST_LEVEL),
        )

    @cached_property
    def _areas(self) -> Array:
        return np.array([self.tank_area_1, self.tank_area_2, self.tank_area_3, self.tank_area_4])

    @cached_property
    def _orifices(self) -> Array:
        return np.array([self.orifice_1, self.orifice_2, self.orifice_3, self.orifice_4])

    def _drift(self, x: Array) -> Array:
        rate: Array = outflow(self._orifices, x) @ _INTO.T / self._areas
        return rate

    def _drift_jacobian(self, x: Array) -> Array:
        slope = outflow_slope(self._orifices, x)
        jacobian: Array = _INTO * slope[..., None, :] / self._areas[:, None]
        return jacobian
