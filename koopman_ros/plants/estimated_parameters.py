# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Constants of a plant that are looked for in a record, and where."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from koopman_ros.plants.constants import constants_of

# A range of positive numbers whose ends differ by such a factor is gone through in powers.
_WIDE = 10.0
_ON_EDGE = 1.0 - 1e-9  # of a range from -1 to 1: no search begins where nothing moves


@dataclass(frozen=True)
class EstimatedParameter:
    """A constant that is looked for within a range."""

    name: str  #: of the field of the plant's class
    unit: str  #: of SI, in which the plant node has it; degC for a temperature
    default: float  #: that of the class, in `unit`
    lower: float  #: lowest value, likewise
    upper: float  #: highest value, likewise

    @property
    def in_powers(self) -> bool:
        """Whether its logarithm is looked for."""
        return self.unit != 'degC' and self.lower > 0.0 and self.upper >= _WIDE * self.lower

    def value(self, share: float) -> float:
        """Return the value at a share of the range, from -1 at its lower end to 1."""
        middle, half = self._span()
        found = middle + half * share
        # the ends themselves, whatever rounding makes of them
        return min(max(float(np.exp(found)) if self.in_powers else found, self.lower), self.upper)

    def share(self, value: float) -> float:
        """Return where in the range a value is, from -1 at the lower end to 1."""
        middle, half = self._span()
        return float((np.log(value) if self.in_powers else value) - middle) / half

    def slope(self, share: float) -> float:
        """Return how much the value changes with the share."""
        half = self._span()[1]
        return half * self.value(share) if self.in_powers else half

    @property
    def start(self) -> float:
        """The share to begin with: the class's own value, the middle where that is outside."""
        outside = not self.lower < self.default < self.upper
        return 0.0 if outside else float(np.clip(self.share(self.default), -_ON_EDGE, _ON_EDGE))

    def _span(self) -> tuple[float, float]:
        low, high = (np.log([self.lower, self.upper]) if self.in_powers
                     else (self.lower, self.upper))
        return float(0.5 * (low + high)), float(0.5 * (high - low))


def estimated_parameters_of(plant: Any,
                            ranges: Mapping[str,
                                            tuple[float,
                                                  float] | None]) -> tuple[EstimatedParameter,
                                                                           ...]:
    """
    Return the constants of a plant's class that are looked for.

    :param ranges: lowest and highest value by name, in SI, None for the range that the class
        gives; nothing at all for the constants of which the class says that they are estimated.
    :raises ValueError: for a constant that there is not, and a range outside that of the class.
    """
    known = {constant.name: constant for constant in constants_of(plant)}
    own = {name: constant.estimated for name, constant in known.items() if constant.estimated}
    if not (ranges or own):
        raise ValueError(f'{plant.__name__} does not say which of its constants are to be '
                         f'estimated: name some of {", ".join(known) or "none"}, with ranges')
    found = []
    for name, given in (ranges or dict.fromkeys(own)).items():
        if name not in known:
            raise ValueError(f'{name} is no constant of {plant.__name__}: it has '
                             f'{", ".join(known) or "none"}')
        one = known[name]
        low, high = given or own.get(name) or (one.lower, one.upper)
        if not one.lower <= low < high <= one.upper:
            raise ValueError(
                f'the range of {name} is [{low:.10g}, {high:.10g}] {one.unit}, must rise and lie '
                f'in [{one.lower:.10g}, {one.upper:.10g}] {one.unit}')
        found.append(EstimatedParameter(name, one.unit, one.default, low, high))
    return tuple(found)
