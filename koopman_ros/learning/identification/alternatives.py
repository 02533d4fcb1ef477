# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drifts with unmeasured states that explain a record equally well, in the same coordinates."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopman_ros.core.arrays import short_repr
from koopman_ros.core.datasets import Array
from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.drift import Drift
from koopman_ros.learning.identification.innovations_form import Predictor

# Share of the variance of unmeasured states that an affine map of others must explain.
_EXPLAINED = 0.99


@dataclass(frozen=True)
class TransformedDrift(Drift):
    """A drift in coordinates of which its own are an affine map."""

    drift: Drift  #: in its own coordinates
    map: Array  #: (n_x, n_x) of deviations in the box to those of the drift
    shift: Array  #: (n_x,) added to them

    __repr__ = short_repr

    @property
    def form(self) -> str:
        """The kind of model, in words."""
        return self.drift.form

    @property
    def varying_input_matrix(self) -> bool:
        """Whether B depends on the state."""
        return self.drift.varying_input_matrix

    @cached_property
    def _back(self) -> Array:
        return np.asarray(np.linalg.inv(self.map), dtype=np.float64)

    def _own(self, xi: Array) -> Array:
        return xi @ self.map.T + self.shift

    def scaled_rate(self, xi: Array, v: Array) -> Array:
        """Evaluate the rate in deviations; see :class:`Drift`."""
        rate: Array = self.drift.scaled_rate(self._own(xi), v) @ self._back.T
        return rate

    def scaled_slope(self, xi: Array, v: Array | None = None) -> Array:
        """Evaluate the Jacobian of the scaled rate; see :class:`Drift`."""
        slope: Array = self._back @ self.drift.scaled_slope(self._own(xi), v) @ self.map
        return slope

    def scaled_input_matrix(self, xi: Array) -> Array:
        """Evaluate B in deviations; see :class:`Drift`."""
        B: Array = self._back @ self.drift.scaled_input_matrix(self._own(xi))
        return B


def in_coordinates_of(predictor: Predictor[Drift], others: Iterable[Predictor[Drift]],
                      record: SplitRecord) -> tuple[TransformedDrift, ...]:
    """
    Return drifts in the coordinates of a predictor's states, as far as these determine theirs.

    Each filter estimates the states of the record; unmeasured states of the one are an affine map
    of all states of the other, by least squares.

    :param others: with as many states, the first ones measured.
    """
    xi, n_y = record.estimates(predictor), predictor.gain.shape[1]
    columns = np.column_stack([xi, np.ones(len(xi))])
    found = []
    for other in others:
        try:
            own = record.estimates(other)[:, n_y:]
        except ValueError:
            # its filter diverges
            continue
        weights = np.linalg.lstsq(columns, own, rcond=None)[0]
        left = np.var(own - columns @ weights, axis=0)
        T = np.eye(len(xi.T))
        T[n_y:] = weights[:-1].T
        if np.all(left <= (1.0 - _EXPLAINED) * np.var(own, axis=0)) and (
                np.linalg.matrix_rank(T) == len(T)):
            shift = np.concatenate((np.zeros(n_y), weights[-1]))
            found.append(TransformedDrift(predictor.drift.box, other.drift, T, shift))
    return tuple(found)
