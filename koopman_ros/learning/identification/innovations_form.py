# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A drift with the gain of its filter, which predicts the next measurement: innovations form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.learning.identification.drift import Drift, DriftModel, Segments
from koopman_ros.learning.identification.simulation import fitted, simulated
from koopman_ros.learning.identification.weak_form import regress
from koopman_ros.model import Coordinates

SETTLING = 40  # samples after which a filter has found the state
_APART = 0.5  # how far hidden states are tried at the start of an episode


_Drift = TypeVar('_Drift', bound=Drift, covariant=True)


@dataclass(frozen=True)
class Predictor(Generic[_Drift]):
    """A drift whose first states are measured, with the gain of its filter."""

    drift: _Drift
    gain: Array  #: (n_x, n_y) in deviations

    def run(self, episodes: Sequence[Episode], step: float) -> FilterRun:
        """Filter episodes of measurements (N, n_y), from the starts that suit the first ones."""
        data = Segments.of(episodes, step)
        found = self.along(data, self.starts(data))
        if not np.all(np.isfinite(found.estimates)):
            raise ValueError('the estimate of the unmeasured states diverges')
        return found

    def along(self, segments: Segments, starts: Array) -> FilterRun:
        """Filter segments from starts (M, n_x), in deviations."""
        before, after = self.states(segments, starts)
        # episode by episode, each in the order of its times
        return FilterRun(*(np.swapaxes(one, 0, 1)[segments.sampled.T] for one in (
            before, after, self._errors(segments, before))))

    def states(self, data: Segments, x: Array, guess: Array | None = None
               ) -> tuple[Array, Array]:
        """
        Return the states (K + 1, M, n_x) before and after corrections, from starts (M, n_x).

        :param guess: similar states before corrections.
        """
        drift, n_y = self.drift, self.gain.shape[1]
        v, h, y = (one.reshape(len(one) * len(x), -1) for one in (
            drift.box.inputs.to_deviation(data.u), data.steps, self.target(data)))
        measured = data.measured.reshape(y.shape)

        def corrected(rows: Any, x: Array) -> Array:
            # without a gain a predictor never corrects its state: its prediction is a simulation
            return x - np.where(measured[rows], x[:, :n_y] - y[rows], 0.0) @ self.gain.T if (
                np.any(self.gain)) else x

        def step(rows: Any, x: Array) -> Array:
            return runge_kutta_step(partial(drift.scaled_rate, v=v[rows]), corrected(rows, x),
                                    h[rows])

        before = simulated(step, x, len(data.u), np.ones(x.shape[1]), guess)
        with np.errstate(all='ignore'):
            after = corrected(slice(None), before.reshape(-1, x.shape[1])).reshape(before.shape)
        return before, after if np.any(self.gain) else before

    def _errors(self, data: Segments, before: Array) -> Array:
        """Return the innovations (K + 1, M, n_y), 0 where nothing was measured."""
        return np.where(data.measured, self.target(data) - before[..., :self.gain.shape[1]], 0.0)

    def target(self, data: Segments) -> Array:
        """Return the measurements (K + 1, M, n_y) in deviations."""
        states = self.drift.box.states
        return states.only(states.names[:self.gain.shape[1]]).to_deviation(data.x)

    def starts(self, data: Segments, guess: Array | None = None) -> Array:
        """
        Return initial states (M, n_x) that predict the first measurements, in deviations.

        :param guess: (M, n_x) states to begin with, among others.
        """
        taken = np.cumsum(data.sampled, axis=0).max(axis=1)
        rows = min(int(np.sum(taken <= SETTLING)), len(data.steps))
        first = replace(data, steps=data.steps[:rows], u=data.u[:rows], x=data.x[:rows + 1],
                        measured=data.measured[:rows + 1])
        n_x, n_y = self.gain.shape
        home = np.zeros((first.x.shape[1], n_x))
        home[:, :n_y] = self.target(first)[0]
        hidden = _APART * np.eye(n_x)[n_y:]

        def errors(starts: Array) -> Array:
            """Evaluate the errors, (S, k, M, n_y), from starts (S, M, n_x), side by side."""
            tiled = first.repeated(len(starts))
            found = self._errors(tiled, self.states(tiled, starts.reshape(-1, n_x))[0])
            return np.moveaxis(found.reshape(len(found), *starts.shape[:2], n_y), 1, 0)

        shifts = np.concatenate((np.zeros((1, n_x)), hidden, -hidden))
        tried = home + shifts[:, None]
        return fitted(errors, tried if guess is None else np.concatenate((guess[None], tried)))[0]


@dataclass(frozen=True)
class FilterRun:
    """The result of a filter on all samples, in deviations."""

    foreseen: Array  #: (N, n_x) states before the samples
    estimates: Array  #: (N, n_x) states after them
    innovations: Array  #: (N, n_y)


def raised(predictor: Predictor[DriftModel]) -> Predictor[DriftModel]:
    """Return the same with monomials of the next degree, which have no weight yet."""
    drift = predictor.drift
    higher = DriftModel(drift.box, drift.degree + 1, np.empty(0), drift.B)
    n_x = len(drift.B)
    coefficients = np.zeros((len(higher.features(np.zeros(n_x))), n_x))
    # those of a degree come before those of the next
    coefficients[:len(drift.coefficients)] = drift.coefficients
    return replace(predictor, drift=replace(higher, coefficients=coefficients))


def spanned(predictor: Predictor[Any], xi: Array) -> Predictor[Any]:
    """
    Return a predictor whose drift can be moved, with hidden states from -1 to 1.

    :param xi: (N, n_x) states as they were estimated, in deviations.
    :raises ValueError: for a hidden state that is constant.
    """
    old, n_y = predictor.drift.box.states, predictor.gain.shape[1]
    low, high = (old.to_physical(end(xi, axis=0)) for end in (np.min, np.max))
    if not np.all(high[n_y:] > low[n_y:]):
        raise ValueError('an unmeasured state is constant: record longer, with steps of the input')
    low[:n_y], high[:n_y] = old.lower[:n_y], old.upper[:n_y]
    new = Coordinates.spanning(old.names, old.units, low, high)
    ratio = new.scale / old.scale
    return Predictor(predictor.drift.moved(new), predictor.gain / ratio[:, None] * ratio[:n_y])


def standardised(predictor: Predictor[DriftModel], xi: Array) -> Predictor[DriftModel]:
    """
    Replace hidden states by their part that measurements do not explain, from -1 to 1.

    :param xi: (N, n_x) states as they were estimated, in deviations.
    """
    drift, n_y = predictor.drift, predictor.gain.shape[1]
    left = np.column_stack([np.ones(len(xi)), xi[:, :n_y]])
    weights = np.linalg.lstsq(left, xi[:, n_y:], rcond=None)[0]
    rest = xi[:, n_y:] - left @ weights
    if rest.shape[1] > 1:
        # uncorrelated among each other, too
        rest_axes = np.linalg.svd(rest, full_matrices=False)[2]
    else:
        rest_axes = np.eye(rest.shape[1])
    turned = rest @ rest_axes.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    if not np.all(high > low):
        raise ValueError('an unmeasured state is constant')
    S = np.eye(len(xi.T))
    S[n_y:, n_y:] = 2.0 * rest_axes / (high - low)[:, None]
    S[n_y:, :n_y] = -S[n_y:, n_y:] @ weights[1:].T
    shift = -S[n_y:, n_y:] @ weights[0] - (high + low) / (high - low)
    offset = np.concatenate((np.zeros(n_y), shift))
    # polynomials of a degree remain such: as many points as determine them, and some more
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (4 * len(drift.coefficients), len(S)))
    before = np.linalg.solve(S, (points - offset).T).T
    none = np.zeros((len(points), len(drift.box.inputs)))
    rates = drift.features(before) @ drift.coefficients @ S.T
    B = S @ drift.B
    return Predictor(regress(drift.box, drift.degree, drift.features(points), none, rates, B),
                     S @ predictor.gain)
