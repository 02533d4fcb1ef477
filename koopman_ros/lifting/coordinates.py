# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Names, units, scaling and range of the signals that a model was learned over, and its data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koopman_ros.arrays import Array, brief, frozen
from koopman_ros.plant_data import Plant

MAX_TRAINING_STATES = 256
MAX_TRIED_LOOPS = 1024


@dataclass(frozen=True)
class Coordinates:
    """
    Names, units, scaling and training box of the states or of the inputs.

    A physical value v maps to the deviation (v - center) / scale that the lift sees.

    :raises ValueError: on inconsistent sizes, a scale that is not positive or an empty box.
    """

    names: tuple[str, ...]  #: one name a coordinate, e.g. ``('temperature',)``
    units: tuple[str, ...]  #: one unit a coordinate, e.g. ``('K',)``
    center: Array  #: (n,) nominal point, in units
    scale: Array  #: (n,) positive, in units
    lower: Array  #: (n,) lower corner of the training box, in units
    upper: Array  #: (n,) upper corner of the training box, in units

    __repr__ = brief

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(self.units) != n:
            raise ValueError(f'incompatible units: expected {n}, got {len(self.units)}')
        for name in ('center', 'scale', 'lower', 'upper'):
            object.__setattr__(self, name, frozen(getattr(self, name), name, (n,)))
        if np.any(self.scale <= 0.0):
            raise ValueError(f'scale must be positive, got {self.scale.tolist()}')
        if np.any(self.lower >= self.upper):
            raise ValueError(
                f'the box is empty: lower {self.lower.tolist()}, upper {self.upper.tolist()}')

    @classmethod
    def spanning(cls, names: tuple[str, ...], units: tuple[str, ...], lower: Array, upper: Array,
                 center: Array | None = None) -> Coordinates:
        """
        Scale by half the width of a range, from its middle or from a given center.

        :raises ValueError: when a range is empty, naming the coordinate, or the sizes do not fit.
        """
        lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
        if not len(names) == len(lower) == len(upper):
            raise ValueError(f'there are values of {len(lower)} signals for {len(names)} names: '
                             f'{", ".join(names)}')
        for name, unit, low, high in zip(names, units, lower, upper, strict=True):
            if not low < high:
                raise ValueError(f'{name} never moves from {low} {unit}: excite the plant')
        if center is None:
            center = 0.5 * (lower + upper)
        return cls(names, units, center, 0.5 * (upper - lower), lower, upper)

    def __len__(self) -> int:
        return len(self.names)

    def array(self, what: str, values: ArrayLike) -> Array:
        """Return values (..., n) of these coordinates as an array; ValueError for another size."""
        array = np.asarray(values, dtype=np.float64)
        if array.shape[-1:] != (len(self.names),):
            raise ValueError(f'incompatible {what}: expected one number for each of '
                             f'{", ".join(self.names)} in the last axis, got {array.shape}')
        return array

    def only(self, names: Sequence[str]) -> Coordinates:
        """Return these coordinates alone; raise ValueError for one that there is not."""
        if tuple(names) == self.names:
            return self
        if unknown := [name for name in names if name not in self.names]:
            raise ValueError(f'there is no {", ".join(unknown)}: choose some of '
                             f'{", ".join(self.names)}')
        chosen = [self.names.index(name) for name in names]
        return Coordinates(tuple(names), tuple(self.units[i] for i in chosen), *(
            value[chosen] for value in (self.center, self.scale, self.lower, self.upper)))

    def to_deviation(self, value: Array) -> Array:
        """Map physical values (..., n) to scaled deviations (..., n)."""
        return (value - self.center) / self.scale

    def to_physical(self, deviation: Array) -> Array:
        """Map scaled deviations (..., n) to physical values (..., n)."""
        return self.center + deviation * self.scale

    def violation(self, value: Array) -> float:
        """
        Measure how far a physical value (n,) lies outside the training box.

        :return: largest excess over a side of the box, as a fraction of half its width; 0 inside,
            infinity for a value that is not finite.
        """
        worst = 0.0
        # in plain numbers, as the few of a measurement take numpy ten times as long
        for v, (lower, upper, half) in zip(value.tolist(), self._sides, strict=True):
            if not math.isfinite(v):
                return math.inf
            if not lower <= v <= upper:
                worst = max(worst, max(lower - v, v - upper) / half)
        return worst

    @cached_property
    def _sides(self) -> list[tuple[float, float, float]]:
        return list(zip(self.lower.tolist(), self.upper.tolist(),
                        (0.5 * (self.upper - self.lower)).tolist(), strict=True))

    @cached_property
    def half_widths(self) -> Array:
        """Half the width (n,) of the training box, in scaled deviations."""
        return frozen(0.5 * (self.upper - self.lower) / self.scale, 'half widths', (len(self),))

    @cached_property
    def corners(self) -> Array:
        """Lower and upper corner (2, n) of the training box, in scaled deviations."""
        return frozen(self.to_deviation(np.array((self.lower, self.upper))), 'corners',
                      (2, len(self)))


@dataclass(frozen=True)
class Box:
    """The range of states and inputs that a model is learned over, and its scaled coordinates."""

    states: Coordinates  #: the states' names, units, scaling and range
    inputs: Coordinates  #: the inputs' likewise
    time_unit: str  #: ``'s'`` or ``'min'``

    __repr__ = brief

    @staticmethod
    def of(plant: Plant, x: Array, u: Array, *, nominal: bool = True) -> Box:
        """
        Return the range of some values.

        :param x: (N, n_x) states, and u (N, n_u) inputs, in their units.
        :param nominal: whether deviations are from the nominal point or from the middle.
        :raises ValueError: when a state or an input never moves, or the sizes do not fit.
        """
        for what, given in (('x', x), ('u', u)):
            if np.ndim(given) != 2:
                raise ValueError(f'incompatible {what}: expected one row a sample, got an array '
                                 f'{np.shape(given)}')
        states, inputs = (
            Coordinates.spanning(names, units, np.min(values, axis=0), np.max(values, axis=0),
                                 center if nominal else None)
            for names, units, center, values in (
                (plant.state_names, plant.state_units, plant.nominal_state, x),
                (plant.input_names, plant.input_units, plant.nominal_input, u)))
        return Box(states, inputs, plant.time_unit)

    def input_matrix(self, B: Array) -> Array:
        """Scale B (..., n_x, n_u) from units to deviations; raise ValueError for another shape."""
        n_x, n_u = len(self.states), len(self.inputs)
        if np.shape(B)[-2:] != (n_x, n_u):
            raise ValueError(f'incompatible B: expected {(n_x, n_u)}, got {np.shape(B)}')
        return np.asarray(B) * self.inputs.scale / self.states.scale[:, None]


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

    __repr__ = brief

    def __post_init__(self) -> None:
        shape = np.shape(self.states)
        if len(shape) != 2 or not 1 <= shape[0] <= MAX_TRAINING_STATES:
            raise ValueError(f'incompatible training_states: expected (M, n_x) with M from 1 to '
                             f'{MAX_TRAINING_STATES}, got {shape}')
        object.__setattr__(self, 'states', frozen(self.states, 'training_states', shape))
        if not (math.isfinite(self.fill_distance) and self.fill_distance >= 0.0):
            raise ValueError('fill_distance must be finite and at least 0, got '
                             f'{self.fill_distance}')

    @staticmethod
    def of(states: Array, half_widths: Array) -> TrainingStates:
        """
        Choose by farthest points: each next one is the farthest from those chosen so far.

        :param states: (N, n_x) all of the training data, in scaled deviations, as the half widths
            (n_x,) of the training box.
        """
        middle = 0.5 * (states.min(axis=0) + states.max(axis=0))
        chosen = [int(np.argmin(_distances(states, middle, half_widths)))]
        nearest = _distances(states, states[chosen[0]], half_widths)
        while len(chosen) < MAX_TRAINING_STATES and np.max(nearest) > 0.0:
            chosen.append(int(np.argmax(nearest)))
            nearest = np.minimum(nearest, _distances(states, states[chosen[-1]], half_widths))
        return TrainingStates(states[chosen], float(np.max(nearest)))

    def distance(self, x: Array, half_widths: Array) -> float:
        """
        Return how far a state (n_x,), scaled, is from the nearest one beyond the fill distance.

        :return: in half widths, so 0 at every training state; infinity where x is not finite.
        """
        if not all(map(math.isfinite, x.tolist())):
            return math.inf
        # the largest of each column: numpy takes half as long as for rows of a few numbers
        apart = np.abs(self._columns - x[:, None]) / half_widths[:, None]
        return max(0.0, float(apart.max(axis=0).min()) - self.fill_distance)

    @cached_property
    def _columns(self) -> Array:
        return np.ascontiguousarray(self.states.T)

    def distances(self, x: Array, half_widths: Array) -> Array:
        """Return the distances, (N,), as :meth:`distance`, of finite states (N, n_x)."""
        apart = np.zeros((len(x), len(self.states)))
        for column, values, half in zip(self._columns, x.T, half_widths.tolist(), strict=True):
            np.maximum(apart, np.abs(column - values[:, None]) / half, out=apart)
        found: Array = np.maximum(apart.min(axis=1) - self.fill_distance, 0.0)
        return found


@dataclass(frozen=True)
class TriedLoops:
    """
    The closed loops in which a model's law was tried, and in which of them it was lost.

    :raises ValueError: naming what does not fit.
    """

    starts: Array  #: (N, n_x) where they began, in scaled deviations; N from 1 to 1024
    setpoints: Array  #: (N, n_x) where they were to go, likewise
    lost: NDArray[np.bool_]  #: (N,) where it did not arrive, or had no gain, but a linear law did

    __repr__ = brief

    def __post_init__(self) -> None:
        shape = np.shape(self.starts)
        if len(shape) != 2 or not 1 <= shape[0] <= MAX_TRIED_LOOPS:
            raise ValueError(f'incompatible tried_loops: expected (N, n_x) with N from 1 to '
                             f'{MAX_TRIED_LOOPS}, got {shape}')
        object.__setattr__(self, 'starts', frozen(self.starts, 'starts', shape))
        object.__setattr__(self, 'setpoints', frozen(self.setpoints, 'setpoints', shape))
        lost = np.array(self.lost, dtype=np.bool_)
        if lost.shape != shape[:1]:
            raise ValueError(f'incompatible lost: expected {shape[:1]}, got {lost.shape}')
        lost.setflags(write=False)
        object.__setattr__(self, 'lost', lost)

    def lost_at(self, x: Array, x_ref: Array, half_widths: Array) -> bool:
        """
        Tell whether the loop that is nearest to a state and a set-point, (n_x,) each, was lost.

        All are scaled; distances are in half widths of the training box, as those of
        :class:`TrainingStates`. Between two equally near loops the law has the doubt's benefit.
        """
        distances = np.maximum(_distances(self.starts, x, half_widths),
                               _distances(self.setpoints, x_ref, half_widths))
        nearest = np.min(distances, where=self.lost, initial=math.inf)
        return bool(nearest < np.min(distances, where=~self.lost, initial=math.inf))


def _distances(states: Array, x: Array, half_widths: Array) -> Array:
    """Return the distances (N,) of states (N, n_x) from one (n_x,): the largest coordinate's."""
    distances: Array = np.max(np.abs((states - x) / half_widths), axis=1)
    return distances
