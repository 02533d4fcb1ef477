# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models of a drift, and segments of episodes on which they are rolled out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import short_repr
from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.datasets import Array, Episode, PlantDescription, sample_interval
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.core.solvers import decaying
from koopman_ros.core.steady_state import steady_state
from koopman_ros.learning.identification.simulation import fitted, simulated
from koopman_ros.model import Box, InputTerms, PolynomialObservables
from koopman_ros.model.observables import Monomials

# dx/dt (M, n_x) of states (M, n_x) and inputs (M, n_u), all in units
Rate = Callable[[Array, Array], Array]

# A state; features that depend on it, their derivatives, and factors.
_Derivative = tuple[int, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]

# Of a drift: those of degree 6 for two states, of 4 for three, of 3 for four. Output error takes
# minutes for more, and an hour does not determine them: then few of them are chosen.
MOST_COEFFICIENTS = 150


def chooses_terms(degree: int, coefficients: int) -> bool:
    """Return whether an estimate with this number of coefficients keeps only some terms."""
    return degree > 1 and coefficients > MOST_COEFFICIENTS


# A steady state is searched for within the range of noisy measurements, in scaled deviations.
_SLIGHTLY_OUTSIDE = 1.1


def box_of(plant: PlantDescription, episodes: Sequence[Episode]) -> Box:
    """Return the episodes' range, its middle the origin; ValueError when a signal never moves."""
    return Box.of(plant, np.concatenate([episode.interpolated() for episode in episodes]),
                  np.concatenate([episode.u for episode in episodes]), nominal=False)


@dataclass(frozen=True)
class Drift(ABC):
    """A model of dx/dt = f(x) + B(x) u, in deviations within a box and in units."""

    box: Box  #: the deviations' origin and scale

    @property
    @abstractmethod
    def form(self) -> str:
        """The kind of model, in words."""

    @property
    @abstractmethod
    def varying_input_matrix(self) -> bool:
        """Whether B depends on the state."""

    @abstractmethod
    def scaled_rate(self, xi: Array, v: Array) -> Array:
        """Evaluate the rate in deviations: (..., n_x) and (..., n_u) -> (..., n_x)."""

    @abstractmethod
    def scaled_slope(self, xi: Array, v: Array | None = None) -> Array:
        """
        Evaluate the Jacobian of the scaled rate: (..., n_x) -> (..., n_x, n_x).

        :param v: (..., n_u) inputs in deviations; those of the box's middle by default.
        """

    @abstractmethod
    def scaled_input_matrix(self, xi: Array) -> Array:
        """Evaluate B(x) in deviations: (..., n_x) -> (..., n_x, n_u), one for all if constant."""

    def scaled_input_slope(self, xi: Array, v: Array) -> Array:
        """Evaluate the Jacobian of the scaled rate by inputs (..., n_u): that is B(x)."""
        return self.scaled_input_matrix(xi)

    @property
    def characteristics(self) -> Mapping[str, Characteristic]:
        """The static characteristics of its inputs, by name."""
        return self.box.inputs.characteristics

    def rate(self, x: Array, u: Array) -> Array:
        """Evaluate dx/dt in units: (..., n_x) and (..., n_u) -> (..., n_x)."""
        return self.box.states.scale * self.scaled_rate(
            self.box.states.to_deviation(x), self.box.inputs.to_deviation(u))

    def slope(self, x: Array) -> Array:
        """Evaluate df/dx (n_x, n_x) at a state (n_x,), in 1/time unit for equal units."""
        scale = self.box.states.scale
        return scale[:, None] * self.scaled_slope(self.box.states.to_deviation(x)) / scale

    @property
    def growth_rate(self) -> float:
        """
        Real part of the fastest growing mode in the middle of the box, in 1/time unit.

        0 for an integrator, on whichever side of 0 rounding leaves its eigenvalue.
        """
        modes = np.linalg.eigvals(self.slope(self.box.states.center))
        moving = decaying(modes) | decaying(-modes)
        return float(np.max(np.where(moving, modes.real, 0.0)))

    @property
    def input_matrix(self) -> Array:
        """B (n_x, n_u) in state units per input and time unit, in the middle of the box."""
        return self.input_matrix_at(self.box.states.center)

    def input_matrix_at(self, x: Array) -> Array:
        """Evaluate B(x) in units: (..., n_x) -> (..., n_x, n_u), one for all if constant."""
        B = self.scaled_input_matrix(self.box.states.to_deviation(x))
        return self.box.states.scale[:, None] * B / self.box.inputs.scale


@dataclass(frozen=True)
class DriftModel(Drift):
    """dx/dt = f(x) + B(x) u with f and B polynomials, in deviations within a box."""

    degree: int  #: highest total degree of the monomials
    coefficients: Array  #: (1 + m, n_x) of 1 and of the m monomials, in scale units a time unit
    #: (n_x, n_u (1 + n_phi)) likewise, of the inputs and, where B depends on the state, of their
    #: products with monomials, see :meth:`InputTerms.regressors`
    B: Array

    __repr__ = short_repr

    def features(self, xi: Array) -> Array:
        """Evaluate 1 and the monomials: (..., n_x) -> (..., 1 + m)."""
        return _features(len(self.box.states), self.degree).at(xi)

    @cached_property
    def _slope_coefficients(self) -> Array:
        """(1 + m, n_x n_x) of the features, for the slope."""
        n_x = len(self.box.states)
        found = np.zeros((len(self.coefficients), n_x, n_x))
        for by, rows, lowered, factors in _derivatives(n_x, self.degree):
            found[lowered, :, by] = factors[:, None] * self.coefficients[rows]
        return found.reshape(len(found), -1)

    @cached_property
    def _split(self) -> tuple[Array, InputTerms | None]:
        return InputTerms.split(self.B, len(self.box.inputs))

    @property
    def form(self) -> str:
        """Its degree, and that of B(x)."""
        return f'drift of degree {self.degree}' + (
            f', B of degree {self.input_degree}' if self.input_degree else '')

    @property
    def varying_input_matrix(self) -> bool:
        """Whether B depends on the state."""
        return self.input_degree > 0

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """(1 + m, n_x) which coefficients an estimate may change: of many only those it chose."""
        return (self.coefficients != 0.0) | (
            not chooses_terms(self.degree, self.coefficients.size))

    @property
    def linear(self) -> bool:
        """Whether it is linear in states and inputs."""
        return self.degree == 1 and not self.varying_input_matrix

    @property
    def input_degree(self) -> int:
        """Degree of the polynomial B(x)."""
        terms = self._split[1]
        return 0 if terms is None else terms.degree

    def scaled_input_matrix(self, xi: Array) -> Array:
        """Evaluate B(x) in deviations: (..., n_x) -> (..., n_x, n_u), one for all if constant."""
        B, terms = self._split
        return B if terms is None else B + terms.matrix(xi)

    def scaled_rate(self, xi: Array, v: Array) -> Array:
        """Evaluate the rate in deviations: (..., n_x) and (..., n_u) -> (..., n_x)."""
        return self.rate_of(self.features(xi), self.regressors(xi, v))

    def rate_of(self, features: Array, regressors: Array) -> Array:
        """Return the scaled rate (..., n_x) where its features and regressors are these."""
        return features @ self.coefficients + regressors @ self.B.T

    def regressors(self, xi: Array, v: Array) -> Array:
        """Return the regressors of `B`: (..., n_x), (..., n_u) -> (..., columns of B)."""
        return InputTerms.regressors(xi, v, self.input_degree)

    def scaled_slope(self, xi: Array, v: Array | None = None) -> Array:
        """Evaluate the Jacobian of the scaled rate; see :class:`Drift`."""
        return self.slope_of(self.features(xi), xi, v)

    def slope_of(self, features: Array, xi: Array, v: Array | None) -> Array:
        """Return the scaled slope (..., n_x, n_x) where the features are these."""
        # derivatives of monomials are monomials: the same features with other coefficients
        slope = (features @ self._slope_coefficients).reshape(*xi.shape, xi.shape[-1])
        terms = self._split[1]
        return slope if terms is None or v is None else slope + terms.jacobian(xi, v)


@lru_cache(maxsize=64)
def _features(n_x: int, degree: int) -> Monomials:
    """Return 1 and the monomials up to a degree."""
    E = PolynomialObservables.total_degree(n_x, degree).exponents
    E = np.vstack([np.zeros((1, n_x), dtype=np.int64), E])
    return Monomials(np.ones(len(E)), E)


@lru_cache(maxsize=64)
def _derivatives(n_x: int, degree: int) -> tuple[_Derivative, ...]:
    """Return for each state: features that depend on it, their derivatives, factors."""
    E = _features(n_x, degree).exponents
    place = {tuple(row): k for k, row in enumerate(E.tolist())}
    found = []
    for by in range(n_x):
        rows = np.flatnonzero(E[:, by])
        lowered = E[rows] - np.eye(n_x, dtype=np.int64)[by]
        found.append((by, rows, np.array([place[tuple(row)] for row in lowered.tolist()]),
                      E[rows, by]))
    return tuple(found)


@dataclass(frozen=True)
class Segments:
    """M segments on grids of K steps, each with one input; short ones are padded."""

    steps: Array  #: (K, M) lengths of the steps, 0 in the padding, in time units
    u: Array  #: (K, M, n_u) inputs held over them, or their means where they were linear
    #: (K + 1, M, n_x) measured states, lines between measurements, 0 between samples
    x: Array
    measured: NDArray[np.bool_]  #: (K + 1, M, n_x) whether a state was measured
    #: (M, n_x) constant disturbances of the rates, in state units per time unit; (M, 1) for none
    disturbance: Array

    __repr__ = short_repr

    @classmethod
    def of(cls, episodes: Sequence[Episode], longest_step: float) -> Segments:
        """Put episodes on grids of their own: samples, input changes and steps between."""
        grids = [_grid(episode, longest_step) for episode in episodes]
        K, M = max(len(grid) for grid in grids) - 1, len(episodes)
        n_x, n_u = episodes[0].x.shape[1], episodes[0].u.shape[1]
        steps, u = np.zeros((K, M)), np.zeros((K, M, n_u))
        x, measured = np.zeros((K + 1, M, n_x)), np.zeros((K + 1, M, n_x), dtype=bool)
        for j, (episode, grid) in enumerate(zip(episodes, grids, strict=True)):
            k = len(grid) - 1
            steps[:k, j] = np.diff(grid)
            u[:k, j] = 0.5 * np.add(*episode.inputs_between(grid))
            u[k:, j] = episode.u[-1]
            rows = np.searchsorted(grid, episode.time)
            x[rows, j], measured[rows, j] = episode.interpolated(), ~np.isnan(episode.x)
        width = max(1, *(len(episode.disturbance) for episode in episodes))
        disturbance = np.zeros((M, width))
        for own, episode in zip(disturbance, episodes, strict=True):
            own[:len(episode.disturbance)] = episode.disturbance
        return cls(steps, u, x, measured, disturbance)

    @property
    def sampled(self) -> NDArray[np.bool_]:
        """(K + 1, M) whether there is a sample of the episode."""
        return np.asarray(self.measured.any(axis=2))

    def repeated(self, count: int) -> Segments:
        """Return all of them a number of times, one round after the other."""
        def tiled(one: Any) -> Any:
            return np.tile(one, (1, count, *[1] * (one.ndim - 2)))

        return Segments(tiled(self.steps), tiled(self.u), tiled(self.x), tiled(self.measured),
                        np.tile(self.disturbance, (count, 1)))

    def path(self, rate: Rate, x0: Array) -> Array:
        """Return the states (K + 1, M, n_x) from starts (M, n_x), not finite after divergence."""
        u, h, added = (one.reshape(self.steps.size, -1) for one in (
            self.u, self.steps, np.broadcast_to(self.disturbance, (len(self.u), *x0.shape))))

        def step(rows: Any, x: Array) -> Array:
            return runge_kutta_step(lambda x: rate(x, u[rows]) + added[rows], x, h[rows])

        size = np.max(np.abs(x0), axis=0)
        return simulated(step, x0, len(self.steps), np.where(size > 0.0, size, 1.0))

    def errors(self, rate: Rate, x0: Array) -> Array:
        """Return the prediction less the measurement (K + 1, M, n_x), 0 where there is none."""
        return np.where(self.measured, self.path(rate, x0) - self.x, 0.0)


def longest_step(episodes: Sequence[Episode]) -> float:
    """Return a step over which a Runge-Kutta method follows motion that the episodes resolve."""
    # a motion is resolved where it takes several samples
    return 2.0 * sample_interval(episodes)


def fitted_starts(rate: Rate, segments: Segments, scale: Array) -> tuple[Array, Array]:
    """
    Predict every segment by a model, from the start that suits it best, and compare.

    The start is fitted, for a measurement of it would bring its noise into the prediction.

    :param scale: (n_x,) size of the states, in which their errors are weighed.
    :return: the starts (M, n_x), and the mean squared errors from there (M, n_x), in state units
        squared, infinite on divergence.
    """
    def errors(starts: Array) -> Array:
        """Evaluate the errors (S, K + 1, M, n_x), as states of different units weigh alike."""
        found = segments.repeated(len(starts)).errors(
            rate, (scale * starts).reshape(-1, len(scale))) / scale
        return np.moveaxis(found.reshape(len(found), *starts.shape), 1, 0)

    starts, squares = fitted(errors, (segments.x[0] / scale)[None])
    count = np.maximum(np.sum(segments.measured, axis=0), 1)
    return scale * starts, scale ** 2 * squares / count


def steady_point(drift: Drift, x: Array, u: Array, measured: int | None = None
                 ) -> tuple[Array, Array]:
    """
    Find a steady state of the drift and its input near given ones.

    With as many inputs as states the state is unchanged; otherwise both move as little as they
    can, in units of their range. ValueError when there is none nearby.

    :param x: (n_x,) in state units.
    :param u: (n_u,) in input units.
    :param measured: number of the first states, which must be within the range; all by default.
        The range of an unmeasured state is not a limit.
    """
    box, n_x = drift.box, len(x)
    y = np.concatenate((box.states.to_deviation(x), box.inputs.to_deviation(u)))
    limit = np.where(np.arange(len(y)) < (n_x if measured is None else measured),
                     _SLIGHTLY_OUTSIDE, np.inf)
    held = np.full(len(y), np.linalg.matrix_rank(drift.scaled_input_matrix(y[:n_x])) == n_x)
    held[n_x:] = False
    found = steady_state(
        lambda y: drift.scaled_rate(y[:n_x], y[n_x:]),
        lambda y: np.hstack([drift.scaled_slope(y[:n_x], y[n_x:]),
                             drift.scaled_input_matrix(y[:n_x])]),
        y, np.where(held, y, -limit), np.where(held, y, limit), anchor=y)
    if found is None:
        raise ValueError('no steady state was found within the range of the episodes: record '
                         'around a steady state of the plant')
    return box.states.to_physical(found[:n_x]), box.inputs.to_physical(found[n_x:])


def prediction_error(rate: Rate, segments: Segments, scale: Array) -> Array:
    """Return the root mean square error (n_x,) of :func:`fitted_starts`, in state units."""
    squares = fitted_starts(rate, segments, scale)[1]
    weights = np.sum(segments.measured, axis=0)
    return np.sqrt(np.average(squares, axis=0, weights=weights))


def autocorrelation(drift: Drift, segments: Segments) -> Array:
    """Return the autocorrelation (n_x,) of a drift's errors from one measurement to the next."""
    starts = fitted_starts(drift.rate, segments, drift.box.states.scale)[0]
    errors = segments.errors(drift.rate, starts)
    products, squares = np.zeros((2, errors.shape[2]))
    for j in range(errors.shape[1]):
        own = errors[segments.sampled[:, j], j]
        products += np.sum(own[1:] * own[:-1], axis=0)
        squares += 0.5 * np.sum(own[1:] ** 2 + own[:-1] ** 2, axis=0)
    return products / np.where(squares > 0.0, squares, 1.0)


def _grid(episode: Episode, longest: float) -> Array:
    inside = (episode.input_time > episode.time[0]) & (episode.input_time < episode.time[-1])
    knots = np.union1d(episode.time, episode.input_time[inside])
    pieces = [np.linspace(a, b, math.ceil((b - a) / longest * (1.0 - 1e-9)) + 1)[:-1]
              if b - a > longest else np.array([a])
              for a, b in itertools.pairwise(knots)]
    return np.concatenate([*pieces, knots[-1:]])
