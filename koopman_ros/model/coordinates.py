# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Names, units, scaling and training range of a model's signals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
import math

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.core.arrays import Array, frozen, real, short_repr
from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.datasets import PlantDescription
from koopman_ros.core.units import quantity_text


@dataclass(frozen=True)
class Coordinates:
    """
    Names, units, scaling and training box of the states or of the inputs.

    A physical value v maps to the deviation (v - center) / scale that the lift sees; an input with
    a static characteristic g to (g(v) - g(center)) / scale.

    :raises ValueError: on inconsistent sizes, a scale that is not positive, or an empty box.
    """

    names: tuple[str, ...]  #: one name a coordinate, e.g. ``('temperature',)``
    units: tuple[str, ...]  #: one unit a coordinate, e.g. ``('K',)``
    center: Array  #: (n,) nominal point, in units
    scale: Array  #: (n,) positive, in units
    lower: Array  #: (n,) lower corner of the training box, in units
    upper: Array  #: (n,) upper corner of the training box, in units
    #: static characteristics by name, none of a signal that acts linearly
    characteristics: Mapping[str, Characteristic] = field(default_factory=dict, kw_only=True)

    __repr__ = short_repr

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
        object.__setattr__(self, 'characteristics', {
            name: self.characteristics[name] for name in self.names
            if name in self.characteristics})

    @classmethod
    def spanning(cls, names: tuple[str, ...], units: tuple[str, ...], lower: Array, upper: Array,
                 center: Array | None = None) -> Coordinates:
        """
        Scale by half the width of a range, from its middle or from a given center.

        :raises ValueError: when a range is empty, naming the coordinate, or the sizes do not fit.
        """
        lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
        if not len(names) == len(lower) == len(upper):
            raise ValueError(f'got values of {len(lower)} signals for {len(names)} names: '
                             f'{", ".join(names)}')
        for name, unit, low, high in zip(names, units, lower, upper, strict=True):
            if not low < high:
                raise ValueError(f'{name} is constant at {low} {unit}: excite the plant')
        if center is None:
            center = 0.5 * (lower + upper)
        return cls(names, units, center, 0.5 * (upper - lower), lower, upper)

    def __len__(self) -> int:
        return len(self.names)

    def array(self, what: str, values: ArrayLike) -> Array:
        """Return values (..., n) of these coordinates as an array; ValueError for another size."""
        array = values if isinstance(values, np.ndarray) and values.dtype == np.float64 else (
            real(values, what))
        if array.shape[-1:] != (len(self.names),):
            raise ValueError(f'incompatible {what}: expected one number for each of '
                             f'{", ".join(self.names)} in the last axis, got {array.shape}')
        return array

    def only(self, names: Sequence[str]) -> Coordinates:
        """Return these coordinates alone; raise ValueError for an unknown one."""
        if tuple(names) == self.names:
            return self
        if unknown := [name for name in names if name not in self.names]:
            raise ValueError(f'unknown names {", ".join(unknown)}: choose from '
                             f'{", ".join(self.names)}')
        chosen = [self.names.index(name) for name in names]
        return Coordinates(tuple(names), tuple(self.units[i] for i in chosen), *(
            value[chosen] for value in (self.center, self.scale, self.lower, self.upper)),
            characteristics=self.characteristics)

    def followed_by(self, others: Coordinates) -> Coordinates:
        """Return these coordinates, and after them others."""
        return Coordinates(self.names + others.names, self.units + others.units, *(
            np.concatenate([getattr(self, name), getattr(others, name)])
            for name in ('center', 'scale', 'lower', 'upper')),
            characteristics={**self.characteristics, **others.characteristics})

    def text(self, values: Array, number_format: str = '.6g') -> str:
        """Write values (n,) with names and units, e.g. 'temperature 46.5 degC, level 2 m'."""
        return ', '.join(f'{name} {quantity_text(value, unit, number_format)}'
                         for name, unit, value in zip(
                             self.names, self.units, values.tolist(), strict=True))

    def to_deviation(self, value: Array) -> Array:
        """Map physical values (..., n) to scaled deviations (..., n)."""
        if self.characteristics:
            return (self._mapped(value, Characteristic.effect) - self._central) / self.scale
        return (value - self.center) / self.scale

    def to_physical(self, deviation: Array) -> Array:
        """Map scaled deviations (..., n) to physical values (..., n)."""
        if self.characteristics:
            return self._mapped(self._central + deviation * self.scale, Characteristic.value)
        return self.center + deviation * self.scale

    def slope(self, value: Array) -> Array:
        """Return the slope (..., n) of the characteristics at physical values (..., n)."""
        found = np.ones_like(value)
        for name, one in self.characteristics.items():
            j = self.names.index(name)
            found[..., j] = one.slope(value[..., j])
        return found

    def _mapped(self, value: Array, by: Callable[[Characteristic, Array], Array]) -> Array:
        mapped = np.array(value)
        for name, one in self.characteristics.items():
            j = self.names.index(name)
            mapped[..., j] = by(one, value[..., j])
        return mapped

    @cached_property
    def _central(self) -> Array:
        """The effects (n,) of the center."""
        return self._mapped(self.center, Characteristic.effect)

    def violation(self, value: Array) -> float:
        """
        Return the distance of a physical value (n,) from the training box.

        :return: largest excess over a side of the box in half its width; 0 inside, infinity for a
            value that is not finite.
        """
        largest = 0.0
        for one, low, high in zip(value.tolist(), *self._sides, strict=True):
            # NaN is not inside
            if not low <= one <= high:
                excess = 2.0 * max(low - one, one - high) / (high - low)
                largest = math.inf if math.isnan(excess) else max(largest, excess)
        return largest

    @cached_property
    def _sides(self) -> tuple[list[float], list[float]]:
        return self.lower.tolist(), self.upper.tolist()

    @cached_property
    def half_widths(self) -> Array:
        """Half the width (n,) of the training box, in scaled deviations."""
        return frozen(0.5 * (self.upper - self.lower) / self.scale, 'half-ranges', (len(self),))

    @cached_property
    def corners(self) -> Array:
        """Lower and upper corner (2, n) of the training box, in scaled deviations."""
        return frozen(self.to_deviation(np.array((self.lower, self.upper))), 'corners',
                      (2, len(self)))


#: coordinates of no signal
NO_SIGNALS = Coordinates((), (), *([np.zeros(0)] * 4))


@dataclass(frozen=True)
class Box:
    """The range of states and inputs that a model is learned over, and its scaled coordinates."""

    states: Coordinates  #: the states' names, units, scaling and range
    inputs: Coordinates  #: coordinates of the inputs
    time_unit: str  #: ``'s'`` or ``'min'``

    __repr__ = short_repr

    @staticmethod
    def of(plant: PlantDescription, x: Array, u: Array, *, nominal: bool = True) -> Box:
        """
        Return the range of some values.

        :param x: (N, n_x) states, NaN for a missing one, and u (N, n_u) inputs, in their units.
        :param nominal: whether deviations are from the nominal point or from the middle.
        :raises ValueError: when a state or an input never moves, or the sizes do not fit.
        """
        for what, given in (('x', x), ('u', u)):
            if np.ndim(given) != 2:
                raise ValueError(f'incompatible {what}: expected one row per sample, got an array '
                                 f'{np.shape(given)}')
        states, inputs = (
            Coordinates.spanning(names, units, np.fmin.reduce(values), np.fmax.reduce(values),
                                 center if nominal else None)
            for names, units, center, values in (
                (plant.state_names, plant.state_units, plant.nominal_state, x),
                (plant.input_names, plant.input_units, plant.nominal_input, u)))
        inputs = replace(inputs, characteristics=plant.characteristics)
        return Box(states, inputs, plant.time_unit)

    def input_matrix(self, B: Array) -> Array:
        """Scale B (..., n_x, n_u) from units to deviations; raise ValueError for another shape."""
        n_x, n_u = len(self.states), len(self.inputs)
        if np.shape(B)[-2:] != (n_x, n_u):
            raise ValueError(f'incompatible B: expected {(n_x, n_u)}, got {np.shape(B)}')
        return np.asarray(B) * self.inputs.scale / self.states.scale[:, None]
