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

"""Held-out figures of a lifted model, invariant where the lift's own objective is not."""

from __future__ import annotations

from dataclasses import dataclass

from koopman_ros.lifting.model import Array, LiftedModel
import numpy as np
from scipy.integrate import solve_ivp

# Beyond it S is singular to working precision, and rw is noise.
_MAX_COND = 1e13


@dataclass(frozen=True)
class Fit:
    """
    How well a lift satisfies dz/dt = A z + J_N(x) B u on samples.

    :param rw: ||(J_N f - A N) S^(-1/2)||^2 / ||J_N f S^(-1/2)||^2 with S = E[z z'], invariant
        under linear maps of z, so that it cannot be lowered by shrinking z.
    :param rx: relative mean-square error of the drift of x that the lift implies.
    :param cond: condition number of S; large when coordinates have collapsed onto each other.
    """

    rw: float
    rx: float
    cond: float


def fit(model: LiftedModel, x: Array, dxdt: Array, u: Array) -> Fit:
    """
    Judge a lift on samples of a plant.

    :param model: the lift.
    :param x: (N, n_x) states, in state units.
    :param dxdt: (N, n_x) their derivatives, in state units per time unit.
    :param u: (N, n_u) inputs, in input units.
    :raises ValueError: when the samples do not tell the coordinates apart.
    """
    xi = model.states.to_deviation(x)
    f = dxdt / model.states.scale - model.inputs.to_deviation(u) @ model.B.T
    z, J = model.lift_and_jacobian(xi)
    dz = (J @ f[..., None])[..., 0]
    S = z.T @ z / len(z)
    cond = float(np.linalg.cond(S))
    if not cond < _MAX_COND:
        raise ValueError(f'{len(z)} samples do not tell {model.n_z} coordinates apart: judge by '
                         'samples that move more, or use a smaller n_z')
    factor = np.linalg.cholesky(S)
    residual = np.linalg.solve(factor, (dz - z @ model.A.T).T)
    reference = np.linalg.solve(factor, dz.T)
    error = model.drift(xi) - f
    return Fit(rw=float(np.sum(residual ** 2) / np.sum(reference ** 2)),
               rx=float(np.sum(error ** 2) / np.sum(f ** 2)),
               cond=cond)


def roll_out(model: LiftedModel, x0: Array, inputs: Array, sample_period: float) -> Array:
    """
    Predict the states under inputs that are held, from the projected drift J^+ A N(x) + B u.

    :param model: the lift.
    :param x0: (n_x,) start, in state units.
    :param inputs: (K, n_u) inputs, each held for one sample period, in input units.
    :param sample_period: in the model's time unit.
    :return: (K + 1, n_x) states at the samples, in state units.
    :raises RuntimeError: when the prediction diverges.
    """
    xi = model.states.to_deviation(np.asarray(x0, dtype=np.float64))
    path = [xi]
    for nu in model.inputs.to_deviation(np.asarray(inputs, dtype=np.float64)) @ model.B.T:
        # a prediction that overflows is reported below
        with np.errstate(all='ignore'):
            solution = solve_ivp(lambda _, y, push=nu: model.drift(y) + push,
                                 (0.0, sample_period), xi, method='DOP853', rtol=1e-9, atol=1e-12)
        xi = solution.y[:, -1]
        if not solution.success or not np.all(np.isfinite(xi)):
            raise RuntimeError(f'the prediction diverged after {len(path)} samples: keep the '
                               'inputs within the training box')
        path.append(xi)
    return model.states.to_physical(np.array(path))
