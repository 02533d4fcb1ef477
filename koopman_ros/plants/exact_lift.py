# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lifts known in closed form: the analytic references that a learned lift is held against."""

from __future__ import annotations

from dataclasses import dataclass

from koopman_ros.plants.system import ArrayFunction, checked_array, FloatArray


@dataclass(frozen=True, eq=False)
class ExactLift:
    """
    A lift z = N(x) under which dz/dt = A z + J(x) B u holds exactly (paper, eq. 27).

    :param A: lifted dynamics (n_z, n_z), in 1 per time unit.
    :param lift: N, states (..., n_x) to lifted states (..., n_z).
    :param jacobian: J = dN/dx, states (..., n_x) to (..., n_z, n_x).
    :raises ValueError: when `A` is not a finite square matrix.
    """

    A: FloatArray
    lift: ArrayFunction
    jacobian: ArrayFunction

    def __post_init__(self) -> None:
        object.__setattr__(self, 'A', checked_array('A', self.A, (len(self.A), len(self.A))))
