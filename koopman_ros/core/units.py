# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Units: conversion between them, and how values of a signal are written for people."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
import math
import operator
import re
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Numbers = TypeVar('Numbers', float, NDArray[np.float64])

NANOSECONDS = 1_000_000_000  # in a second
SECONDS_PER_MINUTE = 60.0
LAST_STAMP_SECONDS = 2 ** 31 - 1  # of a stamp of ROS, whose seconds are an int32
ZERO_CELSIUS = 273.15  # K
SECONDS_PER_TIME_UNIT = {'min': 60.0, 's': 1.0}
# A stamp that is earlier than the last by no more than this is out of order; one that is earlier
# still means that time itself was set back.
LATE_NANOSECONDS = NANOSECONDS


@dataclass(frozen=True)
class Conversion:
    """From one unit to another: value * factor + offset."""

    factor: float = 1.0  #: of values and of differences
    offset: float = 0.0  #: of values alone

    def __call__(self, value: Numbers) -> Numbers:
        """Convert a value, or an array of them."""
        if self.factor == 1.0 and self.offset == 0.0:
            # -0.0 is kept
            return value
        return value * self.factor + self.offset


# Units that each node needs at its start, without the registry.
_AT_HAND = {('K', 'degC'): Conversion(offset=-ZERO_CELSIUS),
            ('degC', 'K'): Conversion(offset=ZERO_CELSIUS)}
# Likewise: units that there are.
_USUAL = {'K', 'degC', 'Pa', 'm', 'm/s', 'rad', 'rad/s', 'N', 'N m', 'V', 'W', 'mol/L', '1'}
# Names of units with powers, multiplied and divided. The registry skips characters that it does
# not know, reads comments, and evaluates powers of numbers without a bound.
_POWER = r'(?:(?:\^|\*\*)-?\d{1,2}(?:\.\d{1,2})?|[²³])?'
_FACTOR = rf'\(*(?:1|[^\W\d]\w*|[°%][^\W\d]*){_POWER}(?:\){_POWER})*'
_UNIT = re.compile(rf'(?:{_FACTOR}(?: ?[*/] ?| ))*{_FACTOR}')
_LONGEST = 60  # characters of a unit

_PRINTED = re.compile(r'\bdeg(?=[CF]?\b)|\bpercent\b')
_SHARES = {'percent': 1e-2, 'ppm': 1e-6}  # units of dimension one, by name


@cache
def conversion(unit: str, wanted: str) -> Conversion:
    """
    Return how values in one unit, e.g. ``'K'``, are converted to another, e.g. ``'degC'``.

    :raises ValueError: for an unknown unit, or one of another dimension.
    """
    if unit == wanted:
        return Conversion()
    if (unit, wanted) in _AT_HAND:
        return _AT_HAND[unit, wanted]
    try:
        for each in (unit, wanted):
            _check_form(each)
        # not before: it takes 0.4 s
        registry = _registry()
        into = registry.parse_units(wanted)
        offset = float(registry.Quantity(0.0, unit).to(into).magnitude)
        factor = float(registry.Quantity(1.0, unit).to(into).magnitude) - offset
        if offset != 0.0:
            # exact, where the difference of two values is not
            source = registry.Quantity(1.0, unit) - registry.Quantity(0.0, unit)
            target = registry.Quantity(1.0, wanted) - registry.Quantity(0.0, wanted)
            factor = float((source / target).to('dimensionless').magnitude)
    # its parser fails in many ways, also by assertions
    except Exception as error:
        why = ' '.join(str(error).split()) or 'one of them is not a unit'
        raise ValueError(f'{unit!r} cannot be converted to {wanted!r}: {why}') from error
    return Conversion(factor, offset)


@cache
def check_unit(unit: str) -> None:
    """Raise ValueError for an unknown unit."""
    if unit in _USUAL:
        return
    if unit == 'pH':
        # the registry takes it for picohenries
        raise ValueError("'pH' is dimensionless: use the unit 1, and name the signal pH")
    try:
        _check_form(unit)
        _registry().Quantity(1.0, unit)
    # as above
    except Exception as error:
        shown = unit if len(unit) <= _LONGEST else f'{unit[:_LONGEST]}...'
        raise ValueError(f'there is no unit {shown!r}: use e.g. K, m/s, L/min or N m, or 1 for '
                         'dimensionless') from error


def checked_signals(kind: str, names: Sequence[str], units: Sequence[str]
                ) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """
    Return names and units of states or inputs.

    :raises ValueError: for a string in place of a sequence, an unknown unit, or other numbers.
    """
    for what, given in (('names', names), ('units', units)):
        if isinstance(given, str):
            raise ValueError(f'{kind}_{what} is the string {given!r}: pass a sequence, '
                             f'({given!r},) for one {kind}')
    for unit in units:
        check_unit(unit)
    if len(units) != len(names) or len(set(names)) != len(names):
        raise ValueError(f'incompatible {kind}_names and {kind}_units: expected different '
                         f'names and as many units, got {list(names)} and {list(units)}')
    return tuple(names), tuple(units)


def _check_form(unit: str) -> None:
    if unit and (len(unit) > _LONGEST or not _UNIT.fullmatch(unit)):
        raise ValueError(f'{unit[:_LONGEST]!r} is not a valid unit expression')


def check_time_unit(unit: str) -> None:
    """Raise ValueError for an unknown time unit."""
    if unit not in SECONDS_PER_TIME_UNIT:
        raise ValueError(f"time_unit must be 's' or 'min', got {unit!r}: convert times and rates "
                         'to one of them')


def display_unit(unit: str) -> str:
    """Return the unit in which people read values: degrees Celsius in place of kelvins."""
    return 'degC' if unit == 'K' else unit


def unit_label(unit: str) -> str:
    """Return the unit in which people read values, as it is printed."""
    return printed(display_unit(unit))


def printed(text: str) -> str:
    """Return a unit, or the units in a text of a node or a file, as people write them."""
    return _PRINTED.sub(lambda found: '°' if found[0] == 'deg' else '%', text)


def shown(values: Numbers, unit: str) -> Numbers:
    """Return values as people read them."""
    return conversion(unit, display_unit(unit))(values)


def quantity_text(value: float, unit: str, number_format: str = '.6g') -> str:
    """Write a value as people read it, with its unit, e.g. '46.5 degC'."""
    return f'{shown(value, unit):{number_format}} {display_unit(unit)}'


def difference_text(value: float, unit: str, number_format: str = '.4g') -> str:
    """Write a difference of values with its unit, e.g. '0.05 K'; one of dimension one has none."""
    return f'{value:{number_format}}' + ('' if unit == '1' else f' {unit}')


def values_by_name(units: Mapping[str, str], values: Sequence[float], label: str = '{}'
                   ) -> dict[str, float]:
    """
    Return values as people read them, by name and unit, e.g. ``'temperature [degC]'``.

    :param units: unit of each signal, by name.
    :param values: (n,) in these units.
    :param label: text in which ``{}`` stands for the name.
    """
    return {f'{label.format(name)} [{display_unit(unit)}]': shown(value, unit)
            for (name, unit), value in zip(units.items(), values, strict=True)}


@cache
def _registry() -> Any:
    import pint

    # without its cache: a file that is cut short would end each program that reads it
    registry: Any = pint.UnitRegistry(preprocessors=[lambda text: text.replace('%', ' percent ')])
    # pint defines these since its release 0.21; Ubuntu 24.04 and Debian 12 have 0.19
    for name, share in _SHARES.items():
        if name not in registry:
            registry.define(f'{name} = {share!r}')
    return registry


@dataclass(frozen=True)
class Display:
    """How the values of a signal are written."""

    unit: str  #: of the values that are given
    shown: str = ''  #: unit in which they are written; the same by default
    format: str = '.6g'  #: of numbers

    @cached_property
    def conversion(self) -> Conversion:
        """From the unit given to the one shown."""
        return conversion(self.unit, self.shown or self.unit)

    def text(self, value: float) -> str:
        """Write a value with its unit."""
        return f'{self.conversion(value):{self.format}} {self.shown or self.unit}'.rstrip()


@dataclass(frozen=True)
class Displays:
    """How all signals are written."""

    units: Mapping[str, str]  #: of the signals, by name
    #: how values are written, by signal or by unit; as they are by default
    shown: Mapping[str, Display] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Display:
        unit = self.units.get(name, '')
        return self.shown.get(name) or self.shown.get(unit) or Display(unit)


def to_kelvin(celsius: float) -> float:
    """Convert a temperature from degrees Celsius."""
    return celsius + ZERO_CELSIUS


def to_celsius(kelvin: float) -> float:
    """Convert a temperature to degrees Celsius."""
    return kelvin - ZERO_CELSIUS


def nanoseconds(time: int) -> int:
    """Return a time in ns; TypeError unless it is an integer, as a time in seconds is not."""
    try:
        return operator.index(time)
    except TypeError:
        raise TypeError(f'a time must be an integer of nanoseconds, got {time!r}: pass '
                        'round(seconds * 1e9)') from None


def seconds_text(nanoseconds: int) -> str:
    """Write integer nanoseconds in seconds, with all digits, e.g. '1700000000.25'."""
    seconds, rest = divmod(abs(nanoseconds), NANOSECONDS)
    sign = '-' if nanoseconds < 0 else ''
    return f'{sign}{seconds}.{rest:09d}'.rstrip('0').rstrip('.')


def in_steps(value: float, resolution: float) -> float:
    """Return the nearest multiple of a sensor's resolution; 0 shows every value."""
    return value if resolution == 0.0 else value - math.remainder(value, resolution)
