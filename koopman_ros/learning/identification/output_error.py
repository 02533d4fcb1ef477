# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimates of a drift by the errors of its predictions, from the start on or of the next one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

from koopman_ros.core.datasets import Array
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.learning.identification.drift import Drift, DriftModel, Segments
from koopman_ros.learning.identification.innovations_form import Predictor
from koopman_ros.learning.identification.network_drift import NetworkDrift
from koopman_ros.learning.lift.levenberg_marquardt import (
    minimise,
    normal_equations,
    NormalEquations,
)

_MAX_ITERATIONS = 40
_BLOCK = 200_000  # numbers of derivatives that are evaluated at once


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
        return np.concatenate((self.drift.coefficients[self.drift.free],
                               self.drift.B.ravel()[:self._n_B]))

    def at(self, theta: Array) -> PolynomialCoefficients:
        """Return the same with other weights."""
        drift = self.drift
        free = drift.free
        n = np.count_nonzero(free)
        B = theta[n:].reshape(drift.B.shape) if self.learn_input_matrix else drift.B
        coefficients = np.zeros(free.shape)
        coefficients[free] = theta[:n]
        return replace(self, drift=replace(drift, B=B, coefficients=coefficients))

    def rates(self, xi: Array, v: Array, S: Array) -> tuple[Array, Array]:
        """Evaluate rates of states and sensitivities; see :class:`Refinable`."""
        drift = self.drift
        features, inputs = drift.features(xi), drift.regressors(xi, v)
        rate = drift.rate_of(features, inputs)
        if not S.shape[-1]:
            return rate, S
        dS = drift.slope_of(features, xi, v) @ S
        free = drift.free
        place, n_B = np.cumsum(free).reshape(free.shape) - 1, inputs.shape[1]
        n = np.count_nonzero(free)
        for i, own in enumerate(free.T):
            dS[:, i, place[own, i]] += features[:, own]
            if self.learn_input_matrix:
                first = n + i * n_B
                dS[:, i, first:first + n_B] += inputs
        return rate, dS

    @property
    def _n_B(self) -> int:
        return self.drift.B.size if self.learn_input_matrix else 0


_Model = TypeVar('_Model', bound=Refinable)


def output_error(model: DriftModel, segments: Segments, *, learn_input_matrix: bool,
                 monitor: Callable[[int, float], bool] | None = None) -> DriftModel:
    """
    Refine a drift model, B and the starts of all segments by :func:`fitted_by_simulation`.

    :param learn_input_matrix: whether B is refined, too.
    :param monitor: called with the step and the cost after each step; True ends it.
    """
    return fitted_by_simulation(
        PolynomialCoefficients(model, learn_input_matrix), segments, tolerance=1e-6,
        iterations=_MAX_ITERATIONS, monitor=monitor).model.drift


def fitted_by_simulation(model: _Model, segments: Segments, starts: Array | None = None, *,
                         tolerance: float = 1e-5, iterations: int = 200,
                         monitor: Callable[[int, float], bool] | None = None) -> Refined[_Model]:
    """
    Refine a model and the starts of all segments until its simulations err least.

    The maximum-likelihood estimate where the noise of the measurements is white and nothing else
    disturbs the plant (Ljung 1999, chapter 7). Levenberg-Marquardt with the exact derivatives of
    the Runge-Kutta steps; its normal equations are gathered step by step.

    :param starts: (M, n_x) to begin with, in deviations; as measured by default.
    :param tolerance: like `iterations` and `monitor` of :func:`innovations_form`.
    """
    states, n_y = model.drift.box.states, segments.x.shape[2]
    # without a gain a predictor never corrects its state: its prediction is a simulation
    return innovations_form(
        model, np.zeros((len(states), n_y)), segments,
        states.to_deviation(segments.x[0]) if starts is None else starts, np.ones(n_y),
        smooth=True, tolerance=tolerance, iterations=iterations, monitor=monitor,
        penalty=model.penalty if isinstance(model, NetworkDrift) else None)


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
    def count(self) -> float:
        """Samples whose innovations count, on average of the outputs."""
        return self._problem.count

    def information(self) -> Array:
        """
        Return J'J (q, q) of the weighed innovations.

        By the p parameters of the drift, then by K row by row, or by the starts.
        """
        found = normal_equations(self._problem.add_residuals, torch.from_numpy(self._theta))
        matrix: Array = found.matrix.numpy() * self._problem.count
        return matrix

    def left_out(self, samples: int) -> Array:
        """
        Return the errors (N, n_y) of samples in models that were not fitted to them.

        Segments of this length are left out one by one, with a model linearised in its parameters:
        e = (I - H)^-1 r with the hat matrix H of the segment (Cook and Weisberg 1982). Of a
        simulation, whose starts are refined. The errors have the weights of the cost; the pieces
        of the record follow each other.

        :param samples: of a segment.
        """
        problem, p, n_x = self._problem, len(self.model.theta), self.starts.shape[1]
        before, after, errors = problem.simulated(self._theta)
        J = np.concatenate([problem.weighed(S, rows) for rows, S in problem.sensitivities(
            self.model, self.gain, before, after, p + n_x)])
        C = np.linalg.pinv(self.information(), hermitian=True)[:p, :p]
        # a start is always fitted, within the range: nothing but the first samples tells it
        prior = np.mean(errors[problem.counted] ** 2) * np.eye(n_x)
        found = []
        for m in range(len(self.starts)):
            rows = np.flatnonzero(problem.counted[:, m].any(axis=1))
            for part in np.array_split(rows, max(1, len(rows) // samples)):
                S, start = np.split(J[part, m].reshape(-1, p + n_x), [p], axis=1)
                S = S - start @ np.linalg.solve(start.T @ start + prior, start.T @ S)
                rest = np.eye(len(S)) - S @ C @ S.T
                found.append(np.linalg.solve(rest, errors[part, m].ravel()).reshape(
                    -1, errors.shape[2]))
        return np.concatenate(found)


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
    :raises KeyboardInterrupt: at an interrupt from the keyboard.
    """
    problem = _Problem(model, segments, gain, starts, deviation, settling, smooth, penalty)
    found = minimise(problem.add_residuals, problem.start(), max_iterations=iterations,
                     tolerance=tolerance, patience=3, monitor=monitor)
    if found.from_keyboard:
        raise KeyboardInterrupt
    theta: Array = found.theta.numpy()
    return Refined(*problem.split(theta), found.cost, problem, theta)


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
    _last: list[Array] = field(default_factory=list)  # simulation, to begin the next one with

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
    def count(self) -> float:
        """Samples whose errors count, on average of the outputs."""
        return float(np.sum(self.counted)) / self._target.shape[2]

    @cached_property
    def _inputs(self) -> Array:
        return self.model.drift.box.inputs.to_deviation(self.segments.u)

    @cached_property
    def _target(self) -> Array:
        return Predictor(self.model.drift, self.gain).target(self.segments)

    @cached_property
    def counted(self) -> NDArray[np.bool_]:
        """(K + 1, M, n_y) where an error counts."""
        settled = np.cumsum(self.segments.sampled, axis=0) > self.settling
        return self.segments.measured & settled[..., None]

    def simulated(self, theta: Array) -> tuple[Array, Array, Array]:
        """Return the states before and after corrections, and weighed errors (K + 1, M, n_y)."""
        model, K, starts = self.split(theta)
        before, after = Predictor(model.drift, K).states(self.segments, starts, *self._last)
        if np.all(np.isfinite(before)):
            self._last[:] = [before]
        return before, after, self.weighed(before[..., :K.shape[1]] - self._target)

    def add_residuals(self, theta: Tensor, equations: NormalEquations) -> None:
        """Add the scaled prediction errors at given parameters."""
        model, K, _ = self.split(theta.numpy())
        with np.errstate(all='ignore'):
            before, after, errors = self.simulated(theta.numpy())
            cost = 0.5 * float(np.sum(errors ** 2)) / self.count
            if not np.isfinite(cost):
                equations.add_sums(np.inf)
                return
            found = self._sums(model, K, before, after, errors) if equations.derivatives else ()
        equations.add_sums(cost, *(torch.from_numpy(a / self.count) for a in found))
        if self.penalty is not None:
            weights = np.zeros(len(theta))
            weights[:len(self.penalty)] = self.penalty
            slope = weights * theta.numpy()
            equations.add_sums(0.5 * float(slope @ theta.numpy()), *(
                map(torch.from_numpy, (slope, np.diag(weights))) if found else ()))

    def weighed(self, values: Array, rows: slice = slice(None)) -> Array:
        """Return values (k, M, n_y, ...) of the outputs at some steps as the cost weighs them."""
        more = (1,) * (values.ndim - 3)
        counted, deviation = self.counted[rows], self.deviation
        return np.where(counted.reshape(*counted.shape, *more),
                        values / deviation.reshape(*deviation.shape, *more), 0.0)

    def _sums(self, model: _Model, K: Array, before: Array, after: Array, errors: Array
              ) -> tuple[Array, Array]:
        """Return J' r and J' J, whose rows of starts touch only their own segment."""
        M, n_x, p = *before.shape[1:], len(self.model.theta)
        q = p + (n_x if self.smooth else K.size)
        common = p if self.smooth else q
        gradient, matrix = np.zeros(common), np.zeros((common, common))
        own_gradient, own = np.zeros((M, q - common)), np.zeros((M, q - common, q))
        for rows, S in self.sensitivities(model, K, before, after, q):
            J, weighed = self.weighed(S, rows), errors[rows]
            # one product for all segments, of which the matrix is read and written once
            shared = J.reshape(-1, q)[:, :common]
            gradient += weighed.ravel() @ shared
            matrix += shared.T @ shared
            if self.smooth:
                by_segment = J.swapaxes(0, 1).reshape(M, -1, q)
                starts = by_segment[..., p:].swapaxes(1, 2)
                own += starts @ by_segment
                own_gradient += (starts @ weighed.swapaxes(0, 1).reshape(M, -1, 1))[..., 0]
        if not self.smooth:
            return gradient, matrix
        full = np.zeros((p + M * n_x,) * 2)
        full[:p, :p] = matrix
        for m in range(M):
            block = slice(p + m * n_x, p + (m + 1) * n_x)
            full[block, block], full[block, :p] = own[m, :, p:], own[m, :, :p]
            full[:p, block] = own[m, :, :p].T
        return np.concatenate((gradient, own_gradient.ravel())), full

    def sensitivities(self, model: _Model, K: Array, before: Array, after: Array, q: int
                       ) -> Iterator[tuple[slice, Array]]:
        """
        Yield blocks of derivatives (k, M, n_y, q) of the outputs by the parameters.

        Those of single steps do not depend on each other and are evaluated at once; only their
        chain is followed step by step.
        """
        data, p, n_y = self.segments, len(self.model.theta), self._target.shape[2]
        steps, M, n_x = before.shape
        S = np.zeros((M, n_x, q))
        if self.smooth:
            S[..., p:] = np.eye(n_x)
        block = max(1, _BLOCK // (M * n_x * (1 + p + n_x)))
        for first in range(0, steps, block):
            rows = slice(first, min(first + block, steps))
            inner = slice(first, min(rows.stop, steps - 1))
            slopes = _step_slopes(model, after[inner], self._inputs[inner], data.steps[inner])
            more, A = np.zeros((*slopes.shape[:-1], q)), slopes[..., p:]
            more[..., :p] = slopes[..., :p]
            measured = data.measured[inner, :, None]
            if not self.smooth:
                error = (before[..., :n_y] - self._target)[inner, :, None] * measured
                for i in range(n_x):
                    more[..., p + i * n_y:p + (i + 1) * n_y] -= A[..., i, None] * error
            A = A - np.pad(A @ K * measured, ((0, 0),) * 3 + ((0, n_x - n_y),))
            found = np.empty((1 + len(A), M, n_x, q))
            found[0] = S
            for k, own in enumerate(A):
                np.add(own @ found[k], more[k], out=found[k + 1])
            S = found[-1]
            yield rows, found[:rows.stop - first, :, :n_y]


def _step_slopes(model: Refinable, x: Array, v: Array, steps: Array) -> Array:
    """Return the derivatives (K, M, n_x, p + n_x) of steps by parameters and by states before."""
    n_x, p = x.shape[-1], len(model.theta)
    y = np.zeros((x[..., 0].size, n_x, 1 + p + n_x))
    y[..., 0], y[..., 1 + p:] = x.reshape(-1, n_x), np.eye(n_x)
    after = runge_kutta_step(partial(_rates, model, v.reshape(-1, v.shape[-1])), y,
                             steps.reshape(-1, 1, 1))
    return after[..., 1:].reshape(*x.shape, p + n_x)


def _rates(model: Refinable, v: Array, y: Array) -> Array:
    """Evaluate the rates of states and of their sensitivities: (M, n_x, 1 + ...)."""
    rate, dS = model.rates(y[..., 0], v, y[..., 1:])
    return np.concatenate((rate[..., None], dS), axis=-1)
