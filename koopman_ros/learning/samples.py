# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What training starts from: samples of a plant's motion, and what is known of the plant."""

from __future__ import annotations

from dataclasses import dataclass
import hashlib

import numpy as np
from numpy.typing import NDArray

from koopman_ros.lifting import Coordinates

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Samples:
    """
    States, their derivatives and the inputs that acted, from one or more episodes.

    :param x: (N, n_x) states, in state units.
    :param dxdt: (N, n_x) derivatives, in state units per time unit.
    :param u: (N, n_u) inputs, in input units.
    :param episode: (N,) number of the episode that each sample belongs to.
    :param time: (N,) times of the samples, in time units, rising within an episode, where the
        input of a sample was held until the next one; None when samples do not follow each other
        (then no roll-out can be judged).
    :raises ValueError: on unequal lengths, values that are not finite, or times that do not rise.
    """

    x: Array
    dxdt: Array
    u: Array
    episode: np.ndarray
    time: Array | None = None

    def __post_init__(self) -> None:
        for name in ('x', 'dxdt', 'u'):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if array.ndim != 2 or len(array) != len(self.episode):
                raise ValueError(f'incompatible {name}: expected ({len(self.episode)}, n), '
                                 f'got {array.shape}')
            if not np.all(np.isfinite(array)):
                raise ValueError(f'{name} holds {np.count_nonzero(~np.isfinite(array))} values '
                                 'that are not finite: drop those samples')
            object.__setattr__(self, name, array)
        if self.x.shape != self.dxdt.shape:
            raise ValueError(f'incompatible dxdt: expected {self.x.shape}, '
                             f'got {self.dxdt.shape}')
        if self.time is not None:
            time = np.ascontiguousarray(self.time, dtype=np.float64)
            if time.shape != (len(self.episode),):
                raise ValueError(f'incompatible time: expected ({len(self.episode)},), '
                                 f'got {time.shape}')
            # an episode's samples need not lie side by side
            order = np.argsort(self.episode, kind='stable')
            within = np.diff(np.asarray(self.episode)[order]) == 0
            if not (np.all(np.isfinite(time)) and np.all(np.diff(time[order])[within] > 0.0)):
                raise ValueError('time must rise from sample to sample within an episode: '
                                 'sort the samples and drop repeated ones')
            object.__setattr__(self, 'time', time)

    def __len__(self) -> int:
        return len(self.episode)

    def take(self, episodes: np.ndarray) -> Samples:
        """Return the samples of some episodes."""
        keep = np.isin(self.episode, episodes)
        return Samples(self.x[keep], self.dxdt[keep], self.u[keep], self.episode[keep],
                       None if self.time is None else self.time[keep])

    def digest(self) -> str:
        """Return the SHA-256 of the samples, in hexadecimal."""
        sha = hashlib.sha256()
        for array in (self.x, self.dxdt, self.u, np.asarray(self.episode, dtype=np.int64)):
            sha.update(np.ascontiguousarray(array).astype('<f8').tobytes())
        return sha.hexdigest()


@dataclass(frozen=True)
class Plant:
    """
    What is known of the plant beside its data.

    :param name: name of the plant.
    :param state_names: one name a state.
    :param state_units: one unit a state.
    :param input_names: one name an input.
    :param input_units: one unit an input.
    :param time_unit: ``'s'`` or ``'min'``.
    :param nominal_state: (n_x,) fixed point under the nominal input.
    :param nominal_input: (n_u,) nominal input.
    :param B: (n_x, n_u) input matrix, in units, or None to learn it with the lift.
    """

    name: str
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    time_unit: str
    nominal_state: Array
    nominal_input: Array
    B: Array | None


def split_by_episode(samples: Samples, seed: int) -> tuple[Samples, Samples, Samples]:
    """
    Split samples into training (three fifths), validation and test by whole episodes.

    :raises ValueError: with fewer than three episodes.
    """
    episodes = np.unique(samples.episode)
    if len(episodes) < 3:
        raise ValueError(f'training needs at least 3 episodes to hold some out, got '
                         f'{len(episodes)}: record more, or cut the record into episodes')
    order = np.random.default_rng(seed).permutation(episodes)
    held = max(1, len(episodes) // 5)
    return (samples.take(order[2 * held:]), samples.take(order[:held]),
            samples.take(order[held:2 * held]))


@dataclass(frozen=True)
class Scaling:
    """
    The coordinates in which a plant is learned.

    :param states: the states' names, units, scaling and training box.
    :param inputs: the inputs' likewise.
    :param time_unit: the plant's.
    """

    states: Coordinates
    inputs: Coordinates
    time_unit: str

    @staticmethod
    def of(plant: Plant, samples: Samples) -> Scaling:
        """
        Scale by half the range of the samples, from the nominal point; the range is the box.

        :raises ValueError: when a state or an input never moves, or the sizes do not fit.
        """
        boxes = []
        for kind, names, units, center, values in (
                ('states', plant.state_names, plant.state_units, plant.nominal_state, samples.x),
                ('inputs', plant.input_names, plant.input_units, plant.nominal_input, samples.u)):
            if values.shape[1] != len(names):
                raise ValueError(f'the samples have {values.shape[1]} {kind}, the plant '
                                 f'{len(names)}: {", ".join(names)}')
            lower, upper = values.min(axis=0), values.max(axis=0)
            for name, unit, low, high in zip(names, units, lower, upper, strict=True):
                if not low < high:
                    raise ValueError(f'{name} never moves from {low} {unit}: excite the plant')
            boxes.append(Coordinates(names, units, center, 0.5 * (upper - lower), lower, upper))
        return Scaling(boxes[0], boxes[1], plant.time_unit)

    def input_matrix(self, B: Array) -> Array:
        """Scale B (n_x, n_u) from units to deviations."""
        n_x, n_u = len(self.states), len(self.inputs)
        if np.shape(B) != (n_x, n_u):
            raise ValueError(f'incompatible B: expected {(n_x, n_u)}, got {np.shape(B)}')
        return np.asarray(B) * self.inputs.scale / self.states.scale[:, None]

    def deviations(self, samples: Samples) -> tuple[Array, Array, Array]:
        """Scale samples to deviations: x (N, n_x), dx/dt (N, n_x), u (N, n_u)."""
        return (self.states.to_deviation(samples.x), samples.dxdt / self.states.scale,
                self.inputs.to_deviation(samples.u))
