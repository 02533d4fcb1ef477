# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Physical constants of a plant: fields of a dataclass with unit, range and how SI has them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import numpy as np

from koopman_ros.core.units import to_celsius, to_kelvin

# A range of positive numbers whose ends differ by such a factor is gone through in powers.
_WIDE = 10.0
_ON_EDGE = 1.0 - 1e-9  # of a range from -1 to 1: no search begins where nothing moves


def constant(default: float, unit: str, lower: float, upper: float, description: str, *,
             si: str | None = None, factor: float = 1.0,
             estimated: tuple[float, float] | None = None) -> Any:
    """
    Declare a physical constant of a plant.

    :param default: in the plant's unit, as `lower` and `upper`, the ends of its range.
    :param si: the unit in which a parameter shows it; the plant's by default. A temperature in K
        with ``'degC'`` is shown in degrees Celsius, as in REP 103.
    :param factor: the value in the plant's unit is that in `si` times this factor.
    :param estimated: the range, in the plant's unit, in which it is looked for where the plant's
        equations are fitted to a record; None for one that is taken as known then.
    """
    return field(default=default, metadata={
        'unit': unit, 'lower': lower, 'upper': upper, 'description': description,
        'si': unit if si is None else si, 'factor': factor, 'estimated': estimated})


@dataclass(frozen=True)
class Constants:
    """
    The base of a plant's class, whose constants are checked.

    :raises ValueError: for a constant that is not a number or outside its range.
    """

    def __post_init__(self) -> None:
        for row in _rows(self):
            value, unit = getattr(self, row.name), row.metadata['unit']
            lower, upper = row.metadata['lower'], row.metadata['upper']
            # Written so that NaN, which compares false with everything, is rejected too.
            if not lower <= value <= upper:
                raise ValueError(f'{row.name} is {value:.10g} {unit}, must lie in '
                                 f'[{lower:.10g}, {upper:.10g}] {unit}')


@dataclass(frozen=True)
class Constant:
    """A constant as a parameter shows it."""

    name: str  #: of the field
    default: float  #: in `unit`, as `lower` and `upper`
    unit: str  #: of SI; degC for a temperature
    lower: float  #: lowest value
    upper: float  #: highest value
    description: str  #: in words
    #: the range in which it is estimated from a record, None where it is taken as known
    estimated: tuple[float, float] | None = None

    @property
    def in_powers(self) -> bool:
        """Whether its logarithm is estimated."""
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


def constants_of(plant: Any) -> tuple[Constant, ...]:
    """Return the constants of a plant's class in SI; none where it declares none."""
    return tuple(Constant(
        row.name, _to_si(row, row.default), row.metadata['si'],
        _to_si(row, row.metadata['lower']), _to_si(row, row.metadata['upper']),
        row.metadata['description'],
        None if (ends := row.metadata['estimated']) is None else (
            _to_si(row, ends[0]), _to_si(row, ends[1]))) for row in _rows(plant))


def estimated_parameters_of(plant: Any, ranges: Mapping[str, tuple[float, float] | None]
                            ) -> tuple[Constant, ...]:
    """
    Return the constants of a plant's class to be estimated, each with the range of its search.

    :param ranges: lowest and highest value by name, in SI, None for the range that the class
        gives; empty for the constants that the class marks as estimated.
    :raises ValueError: for an unknown constant, or a range outside that of the class.
    """
    known = {constant.name: constant for constant in constants_of(plant)}
    own = {name: constant.estimated for name, constant in known.items() if constant.estimated}
    if not (ranges or own):
        raise ValueError(f'{plant.__name__} marks no constants as estimated: name some of '
                         f'{", ".join(known) or "none"}, with ranges')
    found = []
    for name, given in (ranges or dict.fromkeys(own)).items():
        if name not in known:
            raise ValueError(f'{name} is not a constant of {plant.__name__}: choose from '
                             f'{", ".join(known) or "none"}')
        one = known[name]
        low, high = given or own.get(name) or (one.lower, one.upper)
        if not one.lower <= low < high <= one.upper:
            raise ValueError(
                f'the range of {name} is [{low:.10g}, {high:.10g}] {one.unit}, must increase and '
                f'lie in [{one.lower:.10g}, {one.upper:.10g}] {one.unit}')
        found.append(replace(one, lower=low, upper=high))
    return tuple(found)


def in_plant_units(plant: Any, values: Mapping[str, float]) -> dict[str, float]:
    """
    Return constants given in SI in the units of the plant's class.

    An unchanged default or end of a range is returned exactly.

    :raises ValueError: for a name that is not a constant of the plant.
    """
    rows = {row.name: row for row in _rows(plant)}
    if unknown := values.keys() - rows.keys():
        raise ValueError(f'{min(unknown)} is not a constant of {plant.__name__}: choose from '
                         f'{", ".join(rows) or "none"}')
    return {name: _from_si(rows[name], value) for name, value in values.items()}


def _rows(plant: Any) -> list[Any]:
    return [row for row in fields(plant) if 'si' in row.metadata] if is_dataclass(plant) else []


def _to_si(row: Any, value: float) -> float:
    shown = (to_celsius(value) if row.metadata['si'] == 'degC'
             else value / row.metadata['factor'])
    # 76.85, and not 76.85000000000002
    return float(f'{shown:.15g}')


def _from_si(row: Any, value: float) -> float:
    for exact in (row.default, row.metadata['lower'], row.metadata['upper']):
        if value == _to_si(row, exact):
            return float(exact)
    return to_kelvin(value) if row.metadata['si'] == 'degC' else value * row.metadata['factor']
