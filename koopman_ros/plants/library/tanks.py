# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Tanks that pumps fill and that drain into each other through orifices, after Torricelli."""

from dataclasses import dataclass

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.plants.system import ControlAffineSystem

GRAVITY = 9.81  # m/s^2
# An empty tank stays empty; integrating into the kink of the root undershoots by far less, in m.
LOWEST_LEVEL = -1e-3


@dataclass(frozen=True, eq=False)
class Tanks:
    """Tanks A dh/dt = M q(h) + K u, in which q = a sqrt(2 g h) flows out of each."""

    areas: Array  #: (n,) cross-sections A, in m^2
    orifices: Array  #: (n,) cross-sections a of the outlets, in m^2
    into: Array  #: (n, n) M: share of the outflow of each tank that flows into each tank
    inflow: Array  #: (n, m) K: flow of each pump into each tank, in m^3/(s V)

    def system(self, name: str, pumps: Array) -> ControlAffineSystem:
        """Build the system, nominal where voltages (m,) hold it; levels in m, pumps in V."""
        n, m = self.inflow.shape
        through = np.linalg.solve(self.into, -self.inflow @ pumps)
        return ControlAffineSystem(
            name=name,
            state_names=tuple(f'level_{i + 1}' for i in range(n)),
            state_units=('m',) * n,
            input_names=tuple(f'pump_{i + 1}' for i in range(m)),
            input_units=('V',) * m,
            time_unit='s',
            drift=self._drift,
            drift_jacobian=self._drift_jacobian,
            B=self.inflow / self.areas[:, None],
            nominal_state=np.square(through / self.orifices) / (2.0 * GRAVITY),
            nominal_input=pumps,
            state_lower=np.full(n, LOWEST_LEVEL),
        )

    def _drift(self, x: Array) -> Array:
        outflow = self.orifices * np.sqrt(2.0 * GRAVITY * np.maximum(x, 0.0))
        rate: Array = outflow @ self.into.T / self.areas
        return rate

    def _drift_jacobian(self, x: Array) -> Array:
        filled = x > 0.0
        # it rises without bound towards an empty tank
        slope = np.where(
            filled, self.orifices * np.sqrt(0.5 * GRAVITY / np.where(filled, x, 1.0)), 0.0)
        jacobian: Array = self.into * slope[..., None, :] / self.areas[:, None]
        return jacobian
