# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
