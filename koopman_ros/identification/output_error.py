# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Output-error estimate: the drift whose predictions fit the measurements."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import torch
from torch import Tensor

from koopman_ros.identification.drift import DriftModel, first_measured, Segments
from koopman_ros.learning.levenberg_marquardt import minimise, NormalEquations
from koopman_ros.plant_data import Array
from koopman_ros.solvers import runge_kutta_step

_MAX_ITERATIONS = 40


def output_error(model: DriftModel, segments: Segments, *, learn_input_matrix: bool,
                 monitor: Callable[[int, float], bool] | None = None) -> DriftModel:
    """
    Refine a drift model, B and the starts of all segments until its predictions fit best.

    The maximum-likelihood estimate where the noise of the measurements is white and nothing else
    disturbs the plant (Ljung 1999, chapter 7). Levenberg-Marquardt with the exact derivatives of
    the Runge-Kutta steps; its normal equations are gathered step by step.

    :param learn_input_matrix: whether B is refined, too.
    :param monitor: called with the step and the cost after each step; True ends it.
    """
    problem = _Problem(model, segments, learn_input_matrix)
    minimum = minimise(problem.add_residuals, problem.start(), max_iterations=_MAX_ITERATIONS,
                       tolerance=1e-6, patience=3, monitor=monitor)
    return problem.split(minimum.theta.numpy())[0]


@dataclass(frozen=True)
class _Problem:
    """The parameters are coefficients, B where it is learned, then the starts."""

    model: DriftModel
    segments: Segments
    learn_input_matrix: bool

    def start(self) -> Tensor:
        x0 = self.model.box.states.to_deviation(first_measured(self.segments))
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
    def _inputs(self) -> Array:
        return self.model.box.inputs.to_deviation(self.segments.u)

    @cached_property
    def _target(self) -> Array:
        return self.model.box.states.to_deviation(self.segments.x)

    @property
    def _n_B(self) -> int:
        return self.model.B.size if self.learn_input_matrix else 0

    def add_residuals(self, theta: Tensor, equations: NormalEquations) -> None:
        """Add the scaled prediction errors at given parameters."""
        model, x = self.split(theta.numpy())
        data, target = self.segments, self._target
        count = int(np.sum(data.measured))
        M, n_x = x.shape
        p = model.coefficients.size + self._n_B
        y, sums = x[..., None], None
        if equations.derivatives:
            sums = _Sums(M, n_x, p)
            # beside the state its change with the model's parameters and with the start
            y = np.concatenate((y, np.zeros((M, n_x, p)),
                                np.broadcast_to(np.eye(n_x), (M, n_x, n_x))), axis=-1)
        cost = 0.0
        with np.errstate(all='ignore'):
            for k in range(len(data.steps) + 1):
                measured = data.measured[k][:, None]
                error = np.where(measured, y[..., 0] - target[k], 0.0)
                cost += 0.5 * float(np.sum(error ** 2)) / count
                if not np.isfinite(cost):
                    equations.add_sums(np.inf)
                    return
                if sums is not None:
                    sums.add(np.where(measured[..., None], y[..., 1:], 0.0), error)
                if k < len(data.steps):
                    y = runge_kutta_step(
                        partial(_rates, model, self._inputs[k], self.learn_input_matrix), y,
                        data.steps[k][:, None, None])
        found = () if sums is None else sums.result()
        equations.add_sums(cost, *(torch.from_numpy(a / count) for a in found))


class _Sums:
    """J' r and J' J, whose rows of starts touch only their own segment."""

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


def _rates(model: DriftModel, v: Array, learn: bool, y: Array) -> Array:
    """Evaluate the rates of states and, beside them, of their sensitivities: (M, n_x, 1 + ...)."""
    x, S = y[..., 0], y[..., 1:]
    n_x = x.shape[1]
    features, inputs = model.features(x), model.regressors(x, v)
    rate = features @ model.coefficients + inputs @ model.B.T
    if not S.shape[-1]:
        return rate[..., None]
    dS = model.scaled_slope(x, v) @ S
    m, n_B = features.shape[1], inputs.shape[1]
    for i in range(n_x):
        dS[:, i, i:m * n_x:n_x] += features
        if learn:
            first = m * n_x + i * n_B
            dS[:, i, first:first + n_B] += inputs
    return np.concatenate((rate[..., None], dS), axis=-1)
