# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimates of a drift by the errors of its predictions, from the start on or of the next one."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

from koopman_ros.identification.drift import DriftModel, Segments
from koopman_ros.learning.levenberg_marquardt import minimise, normal_equations, NormalEquations
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
    return problem.split(problem.solution(monitor))[0]


def innovations_form(model: DriftModel, gain: Array, segments: Segments, starts: Array,
                     deviation: Array, *, settling: int, learn_input_matrix: bool,
                     monitor: Callable[[int, float], bool] | None = None
                     ) -> tuple[DriftModel, Array, float]:
    """
    Refine a drift model, B and a filter's gain until the next measurement is foreseen best.

    dx/dt = f(x) + B u, and at each measurement y of the first n_y states x becomes
    x + K (y - C x), C = [1 0] (the innovations form, Ljung 1999, section 4.3). The predictor is
    stable where the plant is not, and the other states need not be measured: their coordinates
    are what they come out as.

    :param gain: (n_x, n_y) K to begin with, in deviations.
    :param segments: with n_y columns of measurements.
    :param starts: (M, n_x) what is foreseen for the first samples, in deviations, not refined: a
        filter that is to find the state from there cannot do without its gain.
    :param deviation: (n_y,) standard deviations of the innovations by which outputs are weighed,
        in deviations.
    :param settling: first samples of a segment whose innovations do not count.
    :return: the drift, K, and half the mean square of the weighed innovations of one output.
    """
    problem = _Problem(model, segments, learn_input_matrix,
                       _Filter(gain, starts, deviation, settling))
    theta = problem.solution(monitor)
    refined, _, K = problem.split(theta)
    cost = normal_equations(problem.add_residuals, torch.from_numpy(theta), derivatives=False).cost
    return refined, K, cost


@dataclass(frozen=True)
class _Filter:
    """How measurements correct the state on the way."""

    gain: Array
    starts: Array
    deviation: Array
    settling: int


@dataclass(frozen=True)
class _Problem:
    """The parameters are coefficients, B where it is learned, then the starts or, filtered, K."""

    model: DriftModel
    segments: Segments
    learn_input_matrix: bool
    filtered: _Filter | None = None

    def start(self) -> Tensor:
        B = self.model.B.ravel()[:self._n_B]
        last = self._target[0] if self.filtered is None else self.filtered.gain
        return torch.from_numpy(
            np.concatenate((self.model.coefficients.ravel(), B, last.ravel())))

    def solution(self, monitor: Callable[[int, float], bool] | None) -> Array:
        """Return the parameters of the least cost."""
        # less tells nothing beside the noise that a filter leaves
        tolerance = 1e-6 if self.filtered is None else 1e-4
        found: Array = minimise(
            self.add_residuals, self.start(), max_iterations=_MAX_ITERATIONS, tolerance=tolerance,
            patience=3, monitor=monitor).theta.numpy()
        return found

    def split(self, theta: Array) -> tuple[DriftModel, Array, Array]:
        """Return the model, the scaled starts (M, n_x) and K (n_x, n_y), which is 0 without."""
        n, n_B = self.model.coefficients.size, self._n_B
        B = theta[n:n + n_B].reshape(self.model.B.shape) if n_B else self.model.B
        model = replace(self.model, B=B,
                        coefficients=theta[:n].reshape(self.model.coefficients.shape))
        last = theta[n + n_B:].reshape(-1, self.segments.x.shape[2])
        if self.filtered is None:
            return model, last, np.zeros((len(B), len(B)))
        return model, self.filtered.starts, last

    @cached_property
    def _inputs(self) -> Array:
        return self.model.box.inputs.to_deviation(self.segments.u)

    @cached_property
    def _target(self) -> Array:
        states = self.model.box.states
        return states.only(states.names[:self.segments.x.shape[2]]).to_deviation(self.segments.x)

    @cached_property
    def _counted(self) -> NDArray[np.bool_]:
        """(K + 1, M, 1) where an error counts."""
        measured, settling = self.segments.measured, (
            0 if self.filtered is None else self.filtered.settling)
        counted: NDArray[np.bool_] = measured & (np.cumsum(measured, axis=0) > settling)
        return counted[..., None]

    @property
    def _n_B(self) -> int:
        return self.model.B.size if self.learn_input_matrix else 0

    def add_residuals(self, theta: Tensor, equations: NormalEquations) -> None:
        """Add the scaled prediction errors at given parameters."""
        model, x, K = self.split(theta.numpy())
        data, target = self.segments, self._target
        count = int(np.sum(self._counted))
        M, n_x = x.shape
        n_y = target.shape[2]
        fixed = self.filtered is not None
        p = model.coefficients.size + self._n_B + (K.size if fixed else 0)
        weight = np.ones(n_y) if self.filtered is None else 1.0 / self.filtered.deviation
        y, sums = x[..., None], None
        if equations.derivatives:
            starts = 0 if fixed else n_x
            sums = _Sums(M, p, starts)
            # beside the state its change with the model's parameters and with the start
            y = np.concatenate((y, np.zeros((M, n_x, p)),
                                np.broadcast_to(np.eye(n_x, starts), (M, n_x, starts))), axis=-1)
        cost = 0.0
        with np.errstate(all='ignore'):
            for k in range(len(data.steps) + 1):
                counted = self._counted[k]
                seen = y[:, :n_y]
                error = seen[..., 0] - target[k]
                weighed = np.where(counted, weight * error, 0.0)
                cost += 0.5 * float(np.sum(weighed ** 2)) / count
                if not np.isfinite(cost):
                    equations.add_sums(np.inf)
                    return
                if sums is not None:
                    sums.add(np.where(counted[..., None], weight[:, None] * seen[..., 1:], 0.0),
                             weighed)
                if fixed:
                    measured = data.measured[k][:, None]
                    correction = K @ np.concatenate((error[..., None], seen[..., 1:]), axis=-1)
                    if sums is not None:
                        for i in range(n_x):
                            first = 1 + p - K.size + i * n_y
                            correction[:, i, first:first + n_y] += error
                    y = y - np.where(measured[..., None], correction, 0.0)
                if k < len(data.steps):
                    y = runge_kutta_step(
                        partial(_rates, model, self._inputs[k], self.learn_input_matrix), y,
                        data.steps[k][:, None, None])
        found = () if sums is None else sums.result()
        equations.add_sums(cost, *(torch.from_numpy(a / count) for a in found))


class _Sums:
    """J' r and J' J, whose rows of starts touch only their own segment."""

    def __init__(self, M: int, p: int, starts: int) -> None:
        self._p = p
        self._gradient = np.zeros((M, p + starts))
        self._matrix = np.zeros((M, p + starts, p + starts))

    def add(self, S: Array, error: Array) -> None:
        self._gradient += (S.transpose(0, 2, 1) @ error[..., None])[..., 0]
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
