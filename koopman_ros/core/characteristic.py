# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The static characteristic of an input, e.g. of a valve: a rising, piecewise linear function."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.core.arrays import Array, frozen, short_repr

MOST_POINTS = 100
# Of slopes, over that from end to end: a flat part, as of a dead zone, has no inverse.
_LEAST_SLOPE = 1e-3


@dataclass(frozen=True)
class Characteristic:
    """
    The effect g(u) of an input u, in the unit of the input; beyond its ends it has slope 1.

    :raises ValueError: unless values and effects rise from point to point.
    """

    values: Array  #: (K,) inputs, rising
    effects: Array  #: (K,) their effects, rising, with the same ends

    __repr__ = short_repr

    def __post_init__(self) -> None:
        for name in ('values', 'effects'):
            rising = frozen(getattr(self, name), name, (len(self.values),))
            object.__setattr__(self, name, rising)
            if not (2 <= len(rising) <= MOST_POINTS and np.all(np.diff(rising) > 0.0)):
                raise ValueError(f'the {name} of a characteristic must be 2 to {MOST_POINTS} '
                                 f'rising numbers, got {rising.tolist()}')
        if not np.array_equal(self.values[[0, -1]], self.effects[[0, -1]]):
            raise ValueError('the effects of a characteristic must end at '
                             f'{self.values[[0, -1]].tolist()}, got {self.effects.tolist()}')

    @classmethod
    def of(cls, values: ArrayLike, effects: ArrayLike) -> Characteristic:
        """
        Return the one through points whose effects have any scale and may be equal.

        :raises ValueError: for values that do not rise, or effects that fall.
        """
        u, g = (np.asarray(one, dtype=np.float64) for one in (values, effects))
        if not (1 < len(u) == len(g) and np.all(np.diff(u) > 0.0) and np.all(np.diff(g) >= 0.0)
                and g[-1] > g[0]):
            raise ValueError('a characteristic needs pairs of value and effect, values that rise '
                             'and effects that do not fall, got the effects '
                             f'{g.tolist()} at {u.tolist()}')
        line, g = (u - u[0]) / (u[-1] - u[0]), (g - g[0]) / (g[-1] - g[0])
        g = u[0] + (u[-1] - u[0]) * ((1.0 - _LEAST_SLOPE) * g + _LEAST_SLOPE * line)
        g[-1] = u[-1]
        return cls(u, g)

    def __str__(self) -> str:
        chosen = np.linspace(self.values[0], self.values[-1], 5)
        return ', '.join(f'{u:.4g} acts as {g:.4g}'
                         for u, g in zip(chosen, self.effect(chosen), strict=True))

    def effect(self, value: Array) -> Array:
        """Return g(u) of inputs of any shape."""
        return _interpolated(value, self.values, self.effects)

    def value(self, effect: Array) -> Array:
        """Return the inputs with some effects; they jump across a dead zone."""
        return _interpolated(effect, self.effects, self.values)

    def slope(self, value: Array) -> Array:
        """Return g'(u); 1 beyond the ends."""
        slopes = np.diff(self.effects) / np.diff(self.values)
        return np.pad(slopes, 1, constant_values=1.0)[
            np.searchsorted(self.values, value, side='right')]


def _interpolated(at: Array, x: Array, y: Array) -> Array:
    inside = np.clip(at, x[0], x[-1])
    found: Array = np.interp(inside, x, y) + np.where(np.isinf(at), at, at - inside)
    return found
