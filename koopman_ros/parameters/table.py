# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameter tables: one frozen dataclass a node gives declarations, checks, snapshot and YAML.

Rows of signals are named after the signal, ``temperature.weight``, and those of plug-ins after the
plug-in, ``pi.temperature.gain``. See :mod:`koopman_ros.core.declaration`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, Field, fields, replace
from functools import partial, reduce
import json
import math
from operator import attrgetter, itemgetter
import re
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.declaration import (
    Column,
    group,
    parameter,
    per_signal,
    signal_value,
    UNBOUNDED,
)
from koopman_ros.core.plugins import contained
from koopman_ros.core.units import conversion, display_unit, ZERO_CELSIUS

__all__ = ['UNBOUNDED', 'ConfigurationError', 'ParameterTable', 'Specification', 'as_yaml',
           'group', 'in_own_units', 'lowest', 'parameter', 'per_signal', 'signal_value']

T = TypeVar('T')
_Path = tuple[Callable[[Any], Any], ...]
_Make = Callable[[Mapping[str, Any]], Any]  # of values by name

_TYPE_WORDS = {
    bool: ('a boolean', 'true'),
    int: ('an integer', '1'),
    float: ('a double', '1.0'),
    str: ('a string', 'text'),
    tuple: ('a list of strings', '[a, b]'),
}
_NUMBERS = ('a list of doubles', '[1.0, 2.0]')


class ConfigurationError(ValueError):
    """A node cannot start with its parameters; the message is one line for the user."""


@dataclass(frozen=True)
class Specification:
    """One row of a parameter table."""

    name: str  #: name of the ROS parameter
    default: Any  #: default, whose type is the parameter's type (a tuple is a string array)
    unit: str  #: unit, empty for none
    description: str  #: one sentence without the unit
    minimum: float = -math.inf  #: smallest value
    maximum: float = math.inf  #: largest value
    open_minimum: bool = False  #: whether the minimum itself is excluded
    smallest: float = 0.0  #: above a minimum of 0 that stands for something of its own
    choices: tuple[str, ...] = ()  #: allowed strings, empty for any
    read_only: bool = False  #: whether it is fixed at start
    #: whether a value may name code as module:name, which is fixed at start
    code: bool = False

    @property
    def range_text(self) -> str:
        """The allowed values in words, empty when all are allowed."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if math.isinf(self.minimum) and math.isinf(self.maximum):
            return ''
        unit = f' {self.unit}' if self.unit else ''
        if math.isinf(self.maximum):
            return f'{"above" if self.open_minimum else "at least"} {self.minimum:.10g}{unit}'
        if self.smallest:
            return f'{self.minimum:.10g}, or in [{self.smallest:.10g}, {self.maximum:.10g}]{unit}'
        bracket = '(' if self.open_minimum else '['
        return f'{bracket}{self.minimum:.10g}, {self.maximum:.10g}]{unit}'

    @property
    def notes(self) -> list[str]:
        """The allowed values, and whether a node takes another one while it runs."""
        return [*filter(None, [self.range_text]), *['fixed at start'] * self.read_only,
                *['a module:name is fixed at start'] * self.code]

    def check(self, value: Any) -> str:
        """Return the reason why a value of the right type is rejected, or an empty string."""
        unit = f' {self.unit}' if self.unit else ''
        if self.choices and value not in self.choices:
            return f'{self.name} = {value!r} must be {self.range_text}'
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            above = value > self.minimum if self.open_minimum else (
                value >= self.smallest or value == self.minimum if self.smallest
                else value >= self.minimum)
            # written so that NaN, which compares false with everything, is rejected, too
            if not (above and value <= self.maximum and math.isfinite(value)):
                return f'{self.name} = {value}{unit} must be {self._in_range_words()}'
        return ''

    def _in_range_words(self) -> str:
        text = self.range_text or 'finite'
        return f'in {text}' if text[0] in '[(' else text

    def type_error(self, value: Any) -> str:
        """Return the sentence for a value of another type."""
        numbers = isinstance(self.default, tuple) and isinstance(self.default[0], float)
        word, example = _NUMBERS if numbers else _TYPE_WORDS[type(self.default)]
        if value == [] and isinstance(self.default, tuple):
            word = word.replace('list of', 'list of at least one').removesuffix('s')
        return f'{self.name} = {value!r} must be {word}, e.g. {example}'


class ParameterTable(Generic[T]):
    """
    The parameters of a node, from the dataclass that is also their typed, frozen snapshot.

    :param signals: names and units of the signals, by field made with :func:`per_signal`, or by
        the signals of a column.
    :param groups: rows by field made with :func:`group`.
    :param plugins: parameter dataclasses by the name of the plug-in.
    :param defaults: values, by name, in place of those of the dataclass; foreign ones are ignored.
    :param ordered: names of which the first must be below the second, the same for each signal.
    :param cross_check: returns the defect of a whole snapshot, or an empty string.
    :param build: builds the node's objects from a snapshot; a ValueError or an ArithmeticError of
        it rejects the snapshot.
    """

    def __init__(self, kind: type[T], cross_check: Callable[[T], str] = lambda _: '',
                 build: Callable[[T], object] = lambda _: None,
                 ordered: tuple[tuple[str, str], ...] = (), *,
                 signals: Mapping[str, Mapping[str, str]] = MappingProxyType({}),
                 groups: Mapping[str, Sequence[Specification]] = MappingProxyType({}),
                 plugins: Mapping[str, type[Any]] = MappingProxyType({}),
                 defaults: Mapping[str, Any] = MappingProxyType({})) -> None:
        self.ordered, self.cross_check, self.build = ordered, cross_check, build
        self.signals, self._groups, self._plugins = signals, groups, plugins
        self._defaults = defaults
        declared, self._make = self._layout(kind)
        self._paths: dict[str, _Path] = {row.name: path for row, path in declared}
        # a file begins with the parameters of no signal or plug-in
        self.rows: dict[str, Specification] = {row.name: row for row, _ in sorted(
            declared, key=lambda one: (one[0].name.count('.'), self._first(one[0].name)))}

    def _first(self, name: str) -> int:
        """Return the place of a row's signal or plug-in."""
        prefixes = [*(one for names in self.signals.values() for one in names), *self._plugins]
        prefix = name.partition('.')[0]
        return prefixes.index(prefix) if prefix in prefixes else len(prefixes)

    def _layout(self, kind: type[Any], prefix: str = '', path: _Path = (), unit: str = ''
                ) -> tuple[list[tuple[Specification, _Path]], _Make]:
        """Return the rows, each with the path to its value, and the maker of an object of them."""
        rows: list[tuple[Specification, _Path]] = []
        makers: dict[str, _Make] = {}
        for item in fields(kind):
            metadata, name = item.metadata, item.name
            place: _Path = (*path, attrgetter(name))
            if 'nested' in metadata:
                own, makers[name] = self._layout(metadata['nested'], prefix, place)
            elif 'plugins' in metadata or 'per_signal' in metadata:
                inner = [(key, found, '') for key, found in self._plugins.items()] if (
                    'plugins' in metadata) else [(signal, metadata['per_signal'], its_unit)
                                                 for signal, its_unit in self._of(item).items()]
                parts = {key: self._layout(found, f'{prefix}{key}.', (*place, itemgetter(key)), of)
                         for key, found, of in inner}
                own = [row for several, _ in parts.values() for row in several]
                makers[name] = partial(_made, _frozen, {
                    key: make for key, (_, make) in parts.items()})
            elif 'group' in metadata:
                own = [(replace(row, name=f'{name}.{row.name}'), (*place, itemgetter(row.name)))
                       for row in self._groups[name]]
                makers[name] = partial(_made, _frozen, {
                    row.name: itemgetter(f'{name}.{row.name}') for row in self._groups[name]})
            elif 'column' in metadata:
                column = {f'{prefix}{signal}.{metadata["column"].name or name}': its_unit
                          for signal, its_unit in self._of(item).items()}
                own = [(_row(one, item, of, self._defaults), (
                    *place, itemgetter(i), float, partial(_as_shown, item, unit=of)))
                    for i, (one, of) in enumerate(column.items())]
                makers[name] = partial(_array, item, column)
            else:
                own = [(_row(prefix + name, item, unit, self._defaults), place)]
                makers[name] = itemgetter(prefix + name)
            rows += own
        return rows, partial(_made, kind, makers)

    def _of(self, item: Field[Any]) -> Mapping[str, str]:
        """Return names and units of the signals of a field."""
        column = item.metadata.get('column')
        name = column.signals if column is not None else item.metadata['signals'] or item.name
        return self.signals.get(name, {})

    def snapshot(self, values: Mapping[str, Any]) -> T:
        """
        Return the snapshot of values by name; those that are not given are the defaults.

        :raises ConfigurationError: for a value out of its range, or limits in the wrong order.
        """
        every = {name: values.get(name, row.default) for name, row in self.rows.items()}
        for name, row in self.rows.items():
            if reason := row.check(every[name]):
                raise ConfigurationError(reason)
        self._check_order(every)
        made: T = self._make(every)
        # two may be equal in the units of the calculation
        self._check_order(self.values(made))
        return made

    def _check_order(self, values: Mapping[str, Any]) -> None:
        for low, high in self._ordered_rows():
            if not values[low] < values[high]:
                raise ConfigurationError(
                    f'{self._given(low, values)} must be below {self._given(high, values)}: '
                    'change the other one first')

    def values(self, snapshot: T) -> dict[str, Any]:
        """Return the values of a snapshot by name."""
        return {name: reduce(lambda part, step: step(part), self._paths[name], snapshot)
                for name in self.rows}

    def amended(self, snapshot: T, **values: Any) -> T:
        """Return a snapshot with other values of some names."""
        return self.snapshot({**self.values(snapshot), **values})

    def check(self, snapshot: T, before: T | None = None) -> str:
        """
        Return the first thing wrong with a snapshot as a whole, or an empty string.

        :param before: the one in force, which is known to be right; None for the defaults.
        """
        return self.cross_check(snapshot) or self._unusable(
            snapshot, self.snapshot({}) if before is None else before)

    def _ordered_rows(self) -> list[tuple[str, str]]:
        pairs = [(name, name.removesuffix(low) + high) for low, high in self.ordered
                 for name in self.rows if name == low or name.endswith(f'.{low}')]
        return [(low, high) for low, high in pairs if high in self.rows]

    def _unusable(self, snapshot: T, before: T) -> str:
        """Return why nothing can be built from values that fit each for itself, or ''."""
        values, old = self.values(snapshot), self.values(before)
        if not (error := self._build_error(values)):
            return ''
        changed = [row for name, row in self.rows.items() if values[name] != old[name]]
        guilty = [row for row in changed if not self._build_error(
            {**values, row.name: old[row.name]})] or changed
        given = ' and '.join(self._given(row.name, values) for row in guilty)
        ranges = dict.fromkeys(f' in {row.range_text}' for row in guilty if row.range_text)
        return f'{given} is not usable: {error}; choose another value{" or".join(ranges)}'

    def _given(self, name: str, values: Mapping[str, Any]) -> str:
        return f'{name} = {values[name]} {self.rows[name].unit}'.rstrip()

    def _build_error(self, values: Mapping[str, Any]) -> str:
        try:
            self.build(self._make(values))
        except (ValueError, ArithmeticError) as error:
            return ' '.join(str(error).split()) or type(error).__name__
        except Exception as error:  # of a user's class, anywhere in the object that is built
            return contained(error)
        return ''

    def yaml(self) -> str:
        """Write the table as a commented ROS parameter file, for nodes of any name."""
        lines = ['/**:', '  ros__parameters:']
        for name, row in self.rows.items():
            lines += ['', f'    # {row.description}' + (f' [{row.unit}]' if row.unit else '')]
            lines += [f'    #   {"; ".join(row.notes)}'] if row.notes else []
            lines.append(f'    {name}: {as_yaml(row.default)}')
        return '\n'.join(lines) + '\n'


def in_own_units(tuned: Mapping[str, Any], attribute: str, units: Mapping[str, str]) -> Array:
    """Return values declared by :func:`signal_value` for signals (n,), in their own units."""
    return np.array([conversion(display_unit(unit), unit)(getattr(tuned[name], attribute))
                     for name, unit in units.items()])


def _row(name: str, item: Field[Any], unit: str, defaults: Mapping[str, Any]) -> Specification:
    details = dict(item.metadata)
    column: Column | None = details.pop('column', None)
    own = details.pop('unit').replace('({unit})', unit if unit.isalpha() else f'({unit})')
    own = own.replace('{unit}', unit).replace('{shown}', display_unit(unit))
    declared = item.default if column is None else column.default
    default = defaults.get(name, declared)
    if isinstance(declared, (float, tuple)):
        # a file may say 1 for 1.0, and has lists
        default = type(declared)(default)
    row = Specification(name, default, own, **details)
    return replace(row, default=max(default, lowest(own)), minimum=max(
        row.minimum, lowest(own))) if own == 'degC' and math.isfinite(row.minimum) else row


def _made(kind: Callable[..., Any], makers: Mapping[str, _Make], given: Mapping[str, Any]) -> Any:
    return kind(**{name: make(given) for name, make in makers.items()})


def _frozen(**parts: Any) -> Mapping[str, Any]:
    return MappingProxyType(parts)


def _array(item: Field[Any], column: Mapping[str, str], given: Mapping[str, Any]) -> Array:
    return np.array([_in_code(item, given[name], unit) for name, unit in column.items()])


def _in_code(item: Field[Any], shown: float, unit: str) -> float:
    """Return a number of a column in the unit of the model, infinity for no bound."""
    none, is_value = item.metadata['column'].none, item.metadata['unit'] == '{shown}'
    if none is not None and shown == _shown_none(none[0], is_value, unit):
        return float(none[1])
    return conversion(display_unit(unit), unit)(shown) if is_value else shown


def _as_shown(item: Field[Any], number: float, unit: str) -> float:
    """Return a number of a column as people read it, the shortest that stands for it."""
    none, is_value = item.metadata['column'].none, item.metadata['unit'] == '{shown}'
    if none is not None and number == none[1]:
        return _shown_none(none[0], is_value, unit)
    if not is_value or unit == display_unit(unit):
        return number
    shown, back = (conversion(unit, display_unit(unit))(number),
                   conversion(display_unit(unit), unit))
    return next((short for short in (round(shown, digits) for digits in range(16))
                 if back(short) == number), shown)


def _shown_none(none: float, is_value: bool, unit: str) -> float:
    return max(none, lowest(display_unit(unit))) if is_value and none < 0.0 else none


def lowest(unit: str) -> float:
    """Return the lowest possible value in a unit; as a limit it means none."""
    # there is nothing below absolute zero
    return -ZERO_CELSIUS if unit == 'degC' else -UNBOUNDED


def as_yaml(value: Any) -> str:
    """Write a value so that rcl reads back the same type."""
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, float):
        text = repr(value)
        # YAML 1.1 wants a point and a sign in the exponent, else it reads a string
        if 'e' in text:
            mantissa, exponent = text.split('e')
            mantissa = mantissa if '.' in mantissa else mantissa + '.0'
            text = f'{mantissa}e{int(exponent):+03d}'
        return text
    if isinstance(value, tuple):
        return '[' + ', '.join(as_yaml(item) if isinstance(item, float) else (
            item if _PLAIN.fullmatch(item) else _quoted(item)) for item in value) + ']'
    return repr(value) if isinstance(value, int) else _quoted(str(value))


# Texts that YAML reads as texts without quotes: not numbers, and without its own characters.
_PLAIN = re.compile(r'[A-Za-z][\w./:;()+*^-]*(?: [\w./:;()+*^-]+)*')


def _quoted(text: str) -> str:
    return f"'{text}'" if text.isprintable() and "'" not in text else json.dumps(text)
