# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Two coupled tanks, one above the other, each filled by a pump of its own."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopman_ros.core.arrays import along_last, Array
from koopman_ros.plants.constants import constant, Constants
from koopman_ros.plants.library.outflow import (
    level_with_outflow,
    LOWEST_LEVEL,
    outflow,
    outflow_slope,
)
from koopman_ros.plants.system import ControlAffineSystem

# V
_NOMINAL_PUMPS = np.array([6.0, 2.0])


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
        flow = self.pump_gain * np.cumsum(_NOMINAL_PUMPS)
        return ControlAffineSystem(
            name='two tanks',
            state_names=('level_1', 'level_2'),
            state_units=('m', 'm'),
            input_names=('pump_1', 'pump_2'),
            input_units=('V', 'V'),
            time_unit='s',
            drift=self._drift,
            drift_jacobian=self._drift_jacobian,
            B=self.pump_gain / self.tank_area * np.eye(2),
            nominal_state=level_with_outflow(self._orifices, flow),
            nominal_input=_NOMINAL_PUMPS,
            state_lower=np.full(2, LOWEST_LEVEL),
        )

    @cached_property
    def _orifices(self) -> Array:
        return np.array([self.orifice_1, self.orifice_2])

    def _drift(self, x: Array) -> Array:
        flow = outflow(self._orifices, x) / self.tank_area
        return along_last(-flow[..., 0], flow[..., 0] - flow[..., 1])

    def _drift_jacobian(self, x: Array) -> Array:
        slope = outflow_slope(self._orifices, x) / self.tank_area
        jacobian = np.zeros((*x.shape, 2))
        jacobian[..., 0, 0] = -slope[..., 0]
        jacobian[..., 1, 0] = slope[..., 0]
        jacobian[..., 1, 1] = -slope[..., 1]
        return jacobian
