# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimates of a drift by the errors of its predictions, from the start on or of the next one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

from koopman_ros.core.datasets import Array
from koopman_ros.core.solvers import runge_kutta_step
from koopman_ros.learning.identification.drift import Drift, DriftModel, Segments
from koopman_ros.learning.lift.levenberg_marquardt import (
    minimise,
    normal_equations,
    NormalEquations,
)

_MAX_ITERATIONS = 40


class Refinable(Protocol):
    """A drift with parameters that can be refined, as a value."""

    @property
    def drift(self) -> Drift:
        """The drift at its parameters."""

    @property
    def theta(self) -> Array:
        """The parameters (p,)."""

    def at(self, theta: Array) -> Self:
        """Return the same with other parameters."""

    def rates(self, xi: Array, v: Array, S: Array) -> tuple[Array, Array]:
        """
        Evaluate the scaled rate, (M, n_x) and (M, n_u) -> (M, n_x), and those of sensitivities.

        :param S: (M, n_x, p or more) of the states, by the parameters first, or (M, n_x, 0).
        """


@dataclass(frozen=True)
class PolynomialCoefficients:
    """A polynomial drift whose coefficients are refined, and B where it is learned."""

    drift: DriftModel
    learn_input_matrix: bool

    @property
    def theta(self) -> Array:
        """Coefficients, then B where it is learned."""
        return np.concatenate((self.drift.coefficients.ravel(), self.drift.B.ravel()[:self._n_B]))

    def at(self, theta: Array) -> PolynomialCoefficients:
        """Return the same with other weights."""
        drift = self.drift
        n = drift.coefficients.size
        B = theta[n:].reshape(drift.B.shape) if self.learn_input_matrix else drift.B
        return replace(self, drift=replace(
            drift, B=B, coefficients=theta[:n].reshape(drift.coefficients.shape)))

    def rates(self, xi: Array, v: Array, S: Array) -> tuple[Array, Array]:
        """Evaluate rates of states and sensitivities; see :class:`Refinable`."""
        drift, n_x = self.drift, xi.shape[1]
        features, inputs = drift.features(xi), drift.regressors(xi, v)
        rate = drift.rate_of(features, inputs)
        if not S.shape[-1]:
            return rate, S
        dS = drift.slope_of(features, xi, v) @ S
        m, n_B = features.shape[1], inputs.shape[1]
        for i in range(n_x):
            dS[:, i, i:m * n_x:n_x] += features
            if self.learn_input_matrix:
                first = m * n_x + i * n_B
                dS[:, i, first:first + n_B] += inputs
        return rate, dS

    @property
    def _n_B(self) -> int:
        return self.drift.B.size if self.learn_input_matrix else 0


_Model = TypeVar('_Model', bound=Refinable)


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
    n_x = len(model.box.states)
    # without a gain a predictor never corrects its state: its prediction is a simulation
    return innovations_form(
        PolynomialCoefficients(model, learn_input_matrix), np.zeros((n_x, n_x)), segments,
        model.box.states.to_deviation(segments.x[0]), np.ones(n_x), smooth=True,
        tolerance=1e-6, monitor=monitor).model.drift


@dataclass(frozen=True)
class Refined(Generic[_Model]):
    """The result of :func:`innovations_form`."""

    model: _Model  #: the drift
    gain: Array  #: (n_x, n_y) K, in deviations
    starts: Array  #: (M, n_x) predictions of the first samples, in deviations
    cost: float  #: half the mean square of the weighed innovations of one output
    _problem: _Problem[_Model]
    _theta: Array

    @property
    def count(self) -> int:
        """Samples whose innovations count."""
        return self._problem.count

    def information(self) -> Array:
        """
        Return J'J (q, q) of the weighed innovations.

        By the p parameters of the drift, then by K row by row, or by the starts.
        """
        found = normal_equations(self._problem.add_residuals, torch.from_numpy(self._theta))
        matrix: Array = found.matrix.numpy() * self._problem.count
        return matrix


def innovations_form(model: _Model, gain: Array, segments: Segments, starts: Array,
                     deviation: Array, *, settling: int = 0, smooth: bool = False,
                     tolerance: float = 1e-4, penalty: Array | None = None,
                     iterations: int = _MAX_ITERATIONS,
                     monitor: Callable[[int, float], bool] | None = None) -> Refined[_Model]:
    """
    Refine a drift model and a filter's gain for the best prediction of the next measurement.

    dx/dt = f(x) + B u, and at each measurement y of the first n_y states x becomes x + K (y - C
    x), C = [1 0] (the innovations form, Ljung 1999, section 4.3). The predictor is stable where
    the plant is not, and the other states need not be measured: their coordinates are arbitrary
    unless the model defines them.

    :param gain: (n_x, n_y) K to begin with, in deviations.
    :param segments: with n_y columns of measurements.
    :param starts: (M, n_x) predictions of the first samples, in deviations.
    :param deviation: (n_y,) standard deviations of the innovations by which outputs are weighed,
        in deviations.
    :param settling: first samples of a segment whose innovations do not count.
    :param smooth: whether the starts are refined in place of the gain. With both a predictor would
        be found that is not stable and fits its starts to the noise.
    :param tolerance: relative decrease of the cost that ends it.
    :param penalty: (p,) weights of the squares of the model's parameters in the cost (ridge).
    :param iterations: limit on steps tried.
    """
    problem = _Problem(model, segments, gain, starts, deviation, settling, smooth, penalty)
    theta: Array = minimise(
        problem.add_residuals, problem.start(), max_iterations=iterations,
        tolerance=tolerance, patience=3, monitor=monitor).theta.numpy()
    refined, K, starts = problem.split(theta)
    cost = normal_equations(problem.add_residuals, torch.from_numpy(theta), derivatives=False).cost
    return Refined(refined, K, starts, cost, problem, theta)


@dataclass(frozen=True)
class _Problem(Generic[_Model]):
    """The parameters are those of the model, then the gain, or the starts where smoothed."""

    model: _Model
    segments: Segments
    gain: Array
    starts: Array
    deviation: Array
    settling: int = 0
    smooth: bool = True
    penalty: Array | None = None

    def start(self) -> Tensor:
        """Return the parameters to begin with."""
        last = self.starts if self.smooth else self.gain
        return torch.from_numpy(np.concatenate((self.model.theta, last.ravel())))

    def split(self, theta: Array) -> tuple[_Model, Array, Array]:
        """Return the model, the gain (n_x, n_y) and the scaled starts (M, n_x)."""
        p = len(self.model.theta)
        model = self.model.at(theta[:p])
        if self.smooth:
            return model, self.gain, theta[p:].reshape(self.starts.shape)
        return model, theta[p:].reshape(self.gain.shape), self.starts

    @cached_property
    def count(self) -> int:
        """Samples whose errors count."""
        return int(np.sum(self._counted))

    @cached_property
    def _inputs(self) -> Array:
        return self.model.drift.box.inputs.to_deviation(self.segments.u)

    @cached_property
    def _target(self) -> Array:
        states = self.model.drift.box.states
        return states.only(states.names[:self.segments.x.shape[2]]).to_deviation(self.segments.x)

    @cached_property
    def _counted(self) -> NDArray[np.bool_]:
        """(K + 1, M, 1) where an error counts."""
        measured = self.segments.measured
        counted: NDArray[np.bool_] = measured & (np.cumsum(measured, axis=0) > self.settling)
        return counted[..., None]

    def add_residuals(self, theta: Tensor, equations: NormalEquations) -> None:
        """Add the scaled prediction errors at given parameters."""
        model, K, x = self.split(theta.numpy())
        data, target = self.segments, self._target
        M, n_x = x.shape
        n_y = target.shape[2]
        # starts of a simulation are refined without a gain
        corrected = not self.smooth or bool(np.any(K))
        p = len(self.model.theta) + (0 if self.smooth else K.size)
        weight = 1.0 / self.deviation
        y, sums = x[..., None], None
        if equations.derivatives:
            starts = n_x if self.smooth else 0
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
                cost += 0.5 * float(np.sum(weighed ** 2)) / self.count
                if not np.isfinite(cost):
                    equations.add_sums(np.inf)
                    return
                if sums is not None:
                    sums.add(np.where(counted[..., None], weight[:, None] * seen[..., 1:], 0.0),
                             weighed)
                if corrected:
                    measured = data.measured[k][:, None]
                    correction = K @ np.concatenate((error[..., None], seen[..., 1:]), axis=-1)
                    if sums is not None and not self.smooth:
                        for i in range(n_x):
                            first = 1 + p - K.size + i * n_y
                            correction[:, i, first:first + n_y] += error
                    y = y - np.where(measured[..., None], correction, 0.0)
                if k < len(data.steps):
                    y = runge_kutta_step(partial(_rates, model, self._inputs[k]), y,
                                         data.steps[k][:, None, None])
        found = () if sums is None else sums.result()
        equations.add_sums(cost, *(torch.from_numpy(a / self.count) for a in found))
        if self.penalty is not None:
            weights = np.zeros(len(theta))
            weights[:len(self.penalty)] = self.penalty
            slope = weights * theta.numpy()
            equations.add_sums(0.5 * float(slope @ theta.numpy()), *(
                map(torch.from_numpy, (slope, np.diag(weights))) if found else ()))


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


def _rates(model: Refinable, v: Array, y: Array) -> Array:
    """Evaluate the rates of states and of their sensitivities: (M, n_x, 1 + ...)."""
    rate, dS = model.rates(y[..., 0], v, y[..., 1:])
    return np.concatenate((rate[..., None], dS), axis=-1)
