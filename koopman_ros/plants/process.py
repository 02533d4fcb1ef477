# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A plant that is advanced to given instants under a held input."""

from __future__ import annotations

from dataclasses import dataclass, replace

from koopman_ros.plants.simulation import advance
from koopman_ros.plants.system import ControlAffineSystem, FloatArray
from koopman_ros.units import NANOSECONDS


@dataclass(frozen=True, eq=False)
class Process:
    """
    A running plant: its equations, present time and state, and the held input.

    :param system: the plant.
    :param time_ns: present time, in integer nanoseconds so that instants repeat exactly.
    :param x: present state (n_x,).
    :param u: held input (n_u,).
    """

    system: ControlAffineSystem
    time_ns: int
    x: FloatArray
    u: FloatArray

    def commanded(self, command: FloatArray, time_ns: int) -> Process:
        """Return the process under another input from a time on, which is the present one."""
        return replace(self.until(time_ns), u=command)

    def until(self, time_ns: int) -> Process:
        """
        Return the process at a later time; an earlier one returns it unchanged.

        :raises IntegrationError: when the state leaves the bounds of the system, e.g. because
            the reactor ran away.
        """
        if time_ns <= self.time_ns:
            return self
        seconds = (time_ns - self.time_ns) / NANOSECONDS
        x = advance(self.system, self.x, self.u, seconds / self.system.seconds_per_time_unit)
        return replace(self, time_ns=time_ns, x=x)
