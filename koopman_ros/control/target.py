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

"""The steady state of the lifted model that holds a set-point."""

from __future__ import annotations

from dataclasses import dataclass

from koopman_ros.lifting import LiftedModel
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Target:
    """
    A set-point with the input that holds it, in scaled deviations.

    :param x: (n_x,) reference state.
    :param z: (n_z,) z_ref = N(x_ref) (paper, section on the optimal control problem).
    :param u: (n_u,) input that balances the model's drift there.
    :param mismatch: size of the drift that no input balances; 0 where x is a steady state.
    """

    x: Array
    z: Array
    u: Array
    mismatch: float


def steady_state_target(model: LiftedModel, x_ref: Array) -> Target:
    """
    Solve J_N(x_ref)^+ A N(x_ref) + B u_ref = 0 for u_ref by least squares.

    The feed-forward comes from the lifted model: the linearisation's would leave an offset of
    kelvins far from the nominal point.

    :param model: the lift.
    :param x_ref: (n_x,) scaled deviation.
    """
    drift = model.drift(x_ref)
    u: Array = np.linalg.lstsq(model.B, -drift, rcond=None)[0].astype(np.float64)
    return Target(x_ref, model.lift(x_ref), u, float(np.linalg.norm(drift + model.B @ u)))
