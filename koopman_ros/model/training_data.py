# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""States that a model was learned from, and closed loops that its law was tested in."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array, frozen, short_repr

MAX_TRAINING_STATES = 256
MAX_TRIED_LOOPS = 1024


@dataclass(frozen=True)
class TrainingStates:
    """
    At most 256 of the states that a lift was learned from, spread over all of them.

    A box around the data of several states has corners without data.

    :raises ValueError: naming the mismatch.
    """

    states: Array  #: (M, n_x) in scaled deviations, M from 1 to 256
    #: largest distance of any training state from the nearest of these, in half-ranges of the
    #: training box
    fill_distance: float

    __repr__ = short_repr

    def __post_init__(self) -> None:
        shape = np.shape(self.states)
        if len(shape) != 2 or not 1 <= shape[0] <= MAX_TRAINING_STATES:
            raise ValueError(f'incompatible training_states: expected (M, n_x) with M from 1 to '
                             f'{MAX_TRAINING_STATES}, got {shape}')
        object.__setattr__(self, 'states', frozen(self.states, 'training_states', shape))
        if not (math.isfinite(self.fill_distance) and self.fill_distance >= 0.0):
            raise ValueError('fill_distance must be finite and at least 0, got '
                             f'{self.fill_distance}')

    @property
    def n_x(self) -> int:
        """Number of states."""
        return self.states.shape[1]

    @staticmethod
    def of(states: Array, half_widths: Array) -> TrainingStates:
        """
        Choose by farthest points: each next one is the farthest from those chosen so far.

        :param states: (N, n_x) all of the training data, in scaled deviations, as the half-ranges
            (n_x,) of the training box.
        """
        middle = 0.5 * (states.min(axis=0) + states.max(axis=0))
        chosen = [int(np.argmin(_distances(states, middle, half_widths)))]
        nearest = _distances(states, states[chosen[0]], half_widths)
        while len(chosen) < MAX_TRAINING_STATES and np.max(nearest) > 0.0:
            chosen.append(int(np.argmax(nearest)))
            nearest = np.minimum(nearest, _distances(states, states[chosen[-1]], half_widths))
        return TrainingStates(states[chosen], float(np.max(nearest)))

    def distance(self, x: Array, half_widths: Array) -> Array:
        """
        Return the distance of states from the nearest one beyond the fill distance.

        :param x: (..., n_x) in scaled deviations.
        :return: (...) in half-ranges, so 0 at every training state; NaN where x holds one.
        """
        nearest = _distances(x[..., None, :], self.states, half_widths).min(axis=-1)
        found: Array = np.maximum(nearest - self.fill_distance, 0.0)
        return found


@dataclass(frozen=True)
class VerifiedLoops:
    """
    The closed loops that a model's law was tested in, and which of them failed.

    :raises ValueError: naming the mismatch.
    """

    starts: Array  #: (N, n_x) initial states in scaled deviations, N from 1 to 1024
    setpoints: Array  #: (N, n_x) set-points of the loops
    #: (N,) whether the law did not arrive, or had no gain, where a linear law arrived
    lost: NDArray[np.bool_]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        shape = np.shape(self.starts)
        if len(shape) != 2 or not 1 <= shape[0] <= MAX_TRIED_LOOPS:
            raise ValueError(f'incompatible verified_loops: expected (N, n_x) with N from 1 to '
                             f'{MAX_TRIED_LOOPS}, got {shape}')
        object.__setattr__(self, 'starts', frozen(self.starts, 'starts', shape))
        object.__setattr__(self, 'setpoints', frozen(self.setpoints, 'setpoints', shape))
        lost = np.array(self.lost, dtype=np.bool_)
        if lost.shape != shape[:1]:
            raise ValueError(f'incompatible lost: expected {shape[:1]}, got {lost.shape}')
        lost.setflags(write=False)
        object.__setattr__(self, 'lost', lost)

    @property
    def n_x(self) -> int:
        """Number of states."""
        return self.starts.shape[1]

    def failed_near(self, x: Array, x_ref: Array, half_widths: Array) -> bool:
        """
        Whether the loop nearest to a state and a set-point, (n_x,) each and scaled, failed.

        Of two loops at the same distance, in half-ranges, the one that arrived counts.
        """
        distances = np.maximum(_distances(self.starts, x, half_widths),
                               _distances(self.setpoints, x_ref, half_widths))
        nearest = np.min(distances, where=self.lost, initial=math.inf)
        return bool(nearest < np.min(distances, where=~self.lost, initial=math.inf))


def _distances(states: Array, x: Array, half_widths: Array) -> Array:
    """Return the distances (...) between states (..., n_x): the largest coordinate's."""
    distances: Array = np.abs((states - x) / half_widths).max(axis=-1)
    return distances
