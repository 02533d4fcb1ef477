# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""Output error: the drift whose predictions, not whose derivatives, fit what was measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from koopman_ros.identification.drift import DriftModel
from koopman_ros.identification.records import Array
from koopman_ros.identification.stretches import first_measured, runge_kutta, Stretches
from koopman_ros.learning.levenberg_marquardt import minimise
from koopman_ros.learning.residuals import NormalEquations

_MAX_ITERATIONS = 40


def output_error(model: DriftModel, stretches: Stretches, *, learn_input_matrix: bool,
                 monitor: Callable[[int, float], bool] | None = None) -> DriftModel:
    """
    Refine a drift model, B and the starts of all stretches until its predictions fit best.

    The maximum-likelihood estimate where the noise of the measurements is white and nothing else
    disturbs the plant (Ljung 1999, chapter 7). Levenberg-Marquardt with the exact derivatives of
    the Runge-Kutta steps; its normal equations are gathered step by step.

    :param model: where to start from.
    :param stretches: measured stretches.
    :param learn_input_matrix: whether B is refined, too.
    :param monitor: called with the step and the cost after each step; True ends it.
    """
    problem = _Problem(model, stretches, learn_input_matrix)
    minimum = minimise(problem.evaluate, problem.start(), max_iterations=_MAX_ITERATIONS,
                       tolerance=1e-6, patience=3, monitor=monitor)
    return problem.split(minimum.theta.numpy())[0]


@dataclass(frozen=True)
class _Problem:
    """The parameters are coefficients, B where it is learned, then the starts."""

    model: DriftModel
    stretches: Stretches
    learn_input_matrix: bool

    def start(self) -> Tensor:
        x0 = self.model.box.state_deviation(first_measured(self.stretches))
        B = self.model.B.ravel()[:self._n_B]
        return torch.from_numpy(np.concatenate((self.model.coefficients.ravel(), B, x0.ravel())))

    def split(self, theta: Array) -> tuple[DriftModel, Array]:
        """Return the model and the scaled starts (M, n_x)."""
        n, n_B = self.model.coefficients.size, self._n_B
        B = theta[n:n + n_B].reshape(self.model.B.shape) if n_B else self.model.B
        model = replace(self.model, B=B,
                        coefficients=theta[:n].reshape(self.model.coefficients.shape))
        return model, theta[n + n_B:].reshape(-1, len(self.model.B))

    @cached_property
    def _pushes(self) -> Array:
        return self.model.box.input_deviation(self.stretches.u)

    @cached_property
    def _target(self) -> Array:
        return self.model.box.state_deviation(self.stretches.x)

    @property
    def _n_B(self) -> int:
        return self.model.B.size if self.learn_input_matrix else 0

    def evaluate(self, theta: Tensor, *, derivatives: bool = True) -> NormalEquations:
        """Return cost, gradient and Gauss-Newton matrix of the scaled prediction errors."""
        model, x = self.split(theta.numpy())
        data, target = self.stretches, self._target
        count = int(np.sum(data.measured))
        M, n_x = x.shape
        p = model.coefficients.size + self._n_B
        sums = _Sums(M, n_x, p) if derivatives else None
        # S: change of the state with the model's parameters and with the start
        S = np.concatenate((np.zeros((M, n_x, p)), np.broadcast_to(np.eye(n_x), (M, n_x, n_x))),
                           axis=-1)
        cost = 0.0
        with np.errstate(all='ignore'):
            for k in range(len(data.steps) + 1):
                error = np.where(data.measured[k][:, None], x - target[k], 0.0)
                cost += 0.5 * float(np.sum(error ** 2)) / count
                if not np.isfinite(cost):
                    return NormalEquations(np.inf)
                if sums is not None:
                    sums.add(np.where(data.measured[k][:, None, None], S, 0.0), error)
                if k == len(data.steps):
                    break
                v, h = self._pushes[k], data.steps[k][:, None]
                if derivatives:
                    x, S = _step(model, x, S, v, h, self.learn_input_matrix)
                else:
                    x = runge_kutta(model.scaled_rate, x, v, h)
        if sums is None:
            return NormalEquations(cost)
        return NormalEquations(cost, *(torch.from_numpy(a / count) for a in sums.result()))


class _Sums:
    """J' r and J' J, whose rows of starts touch only their own stretch."""

    def __init__(self, M: int, n_x: int, p: int) -> None:
        self._p = p
        self._gradient = np.zeros((M, p + n_x))
        self._matrix = np.zeros((M, p + n_x, p + n_x))

    def add(self, S: Array, error: Array) -> None:
        self._gradient += np.einsum('mip,mi->mp', S, error)
        self._matrix += S.transpose(0, 2, 1) @ S

    def result(self) -> tuple[Array, Array]:
        p, (M, size) = self._p, self._gradient.shape
        n_x = size - p
        gradient = np.concatenate((self._gradient[:, :p].sum(axis=0),
                                   self._gradient[:, p:].ravel()))
        matrix = np.zeros((len(gradient), len(gradient)))
        matrix[:p, :p] = self._matrix[:, :p, :p].sum(axis=0)
        for m in range(M):
            rows = slice(p + m * n_x, p + (m + 1) * n_x)
            matrix[rows, rows] = self._matrix[m, p:, p:]
            matrix[rows, :p] = self._matrix[m, p:, :p]
            matrix[:p, rows] = self._matrix[m, :p, p:]
        return gradient, matrix


def _step(model: DriftModel, x: Array, S: Array, v: Array, h: Array, learn: bool
          ) -> tuple[Array, Array]:
    """Take the Runge-Kutta step of the states (M, n_x) together with their sensitivities."""
    ends, slopes = [], []
    dx: Array | float = 0.0
    dS: Array | float = 0.0
    for fraction in (0.0, 0.5, 0.5, 1.0):
        dx, dS = _rates(model, x + fraction * h * dx, S + fraction * h[..., None] * dS, v, learn)
        ends.append(dx)
        slopes.append(dS)
    return (x + h / 6.0 * (ends[0] + 2.0 * ends[1] + 2.0 * ends[2] + ends[3]),
            S + h[..., None] / 6.0 * (slopes[0] + 2.0 * slopes[1] + 2.0 * slopes[2] + slopes[3]))


def _rates(model: DriftModel, x: Array, S: Array, v: Array, learn: bool) -> tuple[Array, Array]:
    """Evaluate the rates (M, n_x) and those of the sensitivities (M, n_x, p + n_x)."""
    n_x = x.shape[1]
    features = model.features(x)
    rate = features @ model.coefficients + v @ model.B.T
    dS = model.scaled_slope(x) @ S
    m, n_u = features.shape[1], v.shape[1]
    for i in range(n_x):
        dS[:, i, i:m * n_x:n_x] += features
        if learn:
            first = m * n_x + i * n_u
            dS[:, i, first:first + n_u] += v
    return rate, dS
