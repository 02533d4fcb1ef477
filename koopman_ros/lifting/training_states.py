# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Representative states of the training data, for the distance from them."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.arrays import Array, frozen

MAX_STATES = 256


@dataclass(frozen=True)
class TrainingStates:
    """
    Some of the states that a lift was learned from, spread over all of them.

    A box around the data of several states holds corners where no data are.

    :raises ValueError: naming what does not fit.
    """

    states: Array  #: (M, n_x) in scaled deviations, M from 1 to 256
    #: largest distance of any training state from the nearest of these, in half widths of the
    #: training box
    fill_distance: float

    def __post_init__(self) -> None:
        shape = np.shape(self.states)
        if len(shape) != 2 or not 1 <= shape[0] <= MAX_STATES:
            raise ValueError(f'incompatible training_states: expected (M, n_x) with M from 1 to '
                             f'{MAX_STATES}, got {shape}')
        object.__setattr__(self, 'states', frozen(self.states, 'training_states', shape))
        if not (math.isfinite(self.fill_distance) and self.fill_distance >= 0.0):
            raise ValueError('fill_distance must be finite and at least 0, got '
                             f'{self.fill_distance}')

    @staticmethod
    def of(states: Array, half_widths: Array) -> TrainingStates:
        """
        Choose by farthest points: each next one is the farthest from those chosen so far.

        :param states: (N, n_x) all of the training data, in scaled deviations.
        :param half_widths: (n_x,) of the training box, in scaled deviations.
        """
        middle = 0.5 * (states.min(axis=0) + states.max(axis=0))
        chosen = [int(np.argmin(_distances(states, middle, half_widths)))]
        nearest = _distances(states, states[chosen[0]], half_widths)
        while len(chosen) < MAX_STATES and np.max(nearest) > 0.0:
            chosen.append(int(np.argmax(nearest)))
            nearest = np.minimum(nearest, _distances(states, states[chosen[-1]], half_widths))
        return TrainingStates(states[chosen], float(np.max(nearest)))

    def distance(self, x: Array, half_widths: Array) -> float:
        """
        Return how far a state (n_x,) is from the nearest one beyond the fill distance.

        :param x: in scaled deviations.
        :param half_widths: (n_x,) of the training box, in scaled deviations.
        :return: in half widths, so 0 at every training state; infinity where x is not finite.
        """
        if not np.all(np.isfinite(x)):
            return math.inf
        nearest = float(np.min(_distances(self.states, x, half_widths)))
        return max(0.0, nearest - self.fill_distance)


def _distances(states: Array, x: Array, half_widths: Array) -> Array:
    """Return the distances (N,) of states (N, n_x) from one (n_x,): the largest coordinate's."""
    distances: Array = np.max(np.abs((states - x) / half_widths), axis=1)
    return distances
