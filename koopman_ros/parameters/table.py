# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameter tables: one frozen dataclass a node gives declarations, checks, snapshot and YAML.

A field made by :func:`per_signal` holds one further dataclass for each of some signals, whose
rows are named after the signal: ``temperature.weight``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, Field, field, fields, replace
import json
import math
import re
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.plugs import contained
from koopman_ros.units import conversion, display_unit, ZERO_CELSIUS

T = TypeVar('T')

_TYPE_WORDS = {
    bool: ('a boolean', 'true'),
    int: ('an integer', '1'),
    float: ('a double', '1.0'),
    str: ('a string', 'text'),
    tuple: ('a list of strings', '[a, b]'),
}
_NUMBERS = ('a list of doubles', '[1.0, 2.0]')


#: what stands for no bound, in any unit
UNBOUNDED = 1e9


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

    def check(self, value: Any) -> str:
        """Return what is wrong with a value of the right type, or an empty string."""
        unit = f' {self.unit}' if self.unit else ''
        if self.choices and value not in self.choices:
            return f'{self.name} = {value!r} must be {self.range_text}'
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            above = value > self.minimum if self.open_minimum else (
                value >= self.smallest or value == self.minimum if self.smallest
                else value >= self.minimum)
            # written so that NaN, which compares false with everything, is refused, too
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


def parameter(default: Any, description: str, unit: str = '', minimum: float = -math.inf,
              maximum: float = math.inf, **details: Any) -> Any:
    """Declare a field of a parameter dataclass; the arguments are those of a specification."""
    return field(default=default, metadata={
        'unit': unit, 'description': description, 'minimum': minimum, 'maximum': maximum,
        **details})


def signal_value(default: float, description: str, **details: Any) -> Any:
    """Declare a value of a signal, in the unit in which people read it, that may be any."""
    return parameter(default, description, '{shown}', -UNBOUNDED, UNBOUNDED, **details)


def per_signal(kind: type[Any]) -> Any:
    """
    Declare a field with one `kind`, a parameter dataclass, for each of some signals.

    ``{unit}`` in its units stands for that of a difference of the signal, ``{shown}`` for that of
    its values, as people read them.
    """
    return field(default_factory=dict, metadata={'per_signal': kind})


def group() -> Any:
    """Declare a field with numbers by name, whose rows ``field.name`` the table is given."""
    return field(default_factory=dict, metadata={'group': True})


class ParameterTable(Generic[T]):
    """
    The parameters of a node, from the dataclass that is also their typed, frozen snapshot.

    :param signals: names and units of the signals, by field made with :func:`per_signal`.
    :param groups: rows by field made with :func:`group`.
    :param defaults: values, by name, in place of those of the dataclass; foreign ones are ignored.
    :param ordered: names of which the first must be below the second, the same for each signal.
    :param cross_check: returns what is wrong with a whole snapshot, or an empty string.
    :param build: builds from a snapshot what the node will use, of which a ValueError or an
        ArithmeticError is the reason to refuse the snapshot.
    """

    def __init__(self, kind: type[T], cross_check: Callable[[T], str] = lambda _: '',
                 build: Callable[[T], object] = lambda _: None,
                 ordered: tuple[tuple[str, str], ...] = (), *,
                 signals: Mapping[str, Mapping[str, str]] = MappingProxyType({}),
                 groups: Mapping[str, Sequence[Specification]] = MappingProxyType({}),
                 defaults: Mapping[str, Any] = MappingProxyType({})) -> None:
        self.kind = kind
        self.ordered = ordered
        self.cross_check = cross_check
        self.build = build
        self.signals = signals
        self.rows: dict[str, Specification] = {}
        self._groups = {name: tuple(row.name for row in rows) for name, rows in groups.items()}
        for item in fields(kind):  # type: ignore[arg-type]
            inner = item.metadata.get('per_signal')
            if 'group' in item.metadata:
                self.rows |= {f'{item.name}.{row.name}': replace(
                    row, name=f'{item.name}.{row.name}') for row in groups[item.name]}
                continue
            for name, row, unit in [(item.name, item, '')] if inner is None else [
                    (f'{signal}.{row.name}', row, unit)
                    for signal, unit in signals.get(item.name, {}).items()
                    for row in fields(inner)]:
                self.rows[name] = _row(name, row, unit, defaults)

    def snapshot(self, values: Mapping[str, Any]) -> T:
        """Return the snapshot of values by name; those that are not given are the defaults."""
        given = {name: values.get(name, row.default) for name, row in self.rows.items()}
        parts: dict[str, Any] = {}
        for item in fields(self.kind):  # type: ignore[arg-type]
            inner = item.metadata.get('per_signal')
            if item.name in self._groups:
                parts[item.name] = MappingProxyType({
                    name: given[f'{item.name}.{name}'] for name in self._groups[item.name]})
                continue
            parts[item.name] = given[item.name] if inner is None else MappingProxyType({
                signal: inner(**{row.name: given[f'{signal}.{row.name}']
                                 for row in fields(inner)})
                for signal in self.signals.get(item.name, {})})
        return self.kind(**parts)

    def values(self, snapshot: T) -> dict[str, Any]:
        """Return the values of a snapshot by name."""
        flat: dict[str, Any] = {}
        for item in fields(self.kind):  # type: ignore[arg-type]
            value = getattr(snapshot, item.name)
            if item.name in self._groups:
                flat |= {f'{item.name}.{name}': number for name, number in value.items()}
            elif 'per_signal' in item.metadata:
                flat |= {f'{signal}.{row.name}': getattr(part, row.name)
                         for signal, part in value.items() for row in fields(part)}
            else:
                flat[item.name] = value
        return flat

    def amended(self, snapshot: T, **values: Any) -> T:
        """Return a snapshot with other values of some names."""
        return self.snapshot({**self.values(snapshot), **values})

    def check(self, snapshot: T, before: T | None = None) -> str:
        """
        Return the first thing wrong with a snapshot, or an empty string.

        :param before: the one in force, which is known to be right; None for the defaults.
        """
        values = self.values(snapshot)
        for name, row in self.rows.items():
            if reason := row.check(values[name]):
                return reason
        for low, high in self._ordered_rows():
            if not values[low] < values[high]:
                return (f'{self._given(low, values)} must be below '
                        f'{self._given(high, values)}: change the other one first')
        return self.cross_check(snapshot) or self._unusable(
            snapshot, self.snapshot({}) if before is None else before)

    def _ordered_rows(self) -> list[tuple[str, str]]:
        prefixes = ['', *(f'{name}.' for names in self.signals.values() for name in names)]
        return [(prefix + low, prefix + high) for low, high in self.ordered
                for prefix in prefixes if prefix + low in self.rows]

    def _unusable(self, snapshot: T, before: T) -> str:
        """Return why nothing can be built from values that fit each for itself, or ''."""
        if not (error := self._build_error(snapshot)):
            return ''
        values, old = self.values(snapshot), self.values(before)
        changed = [row for name, row in self.rows.items() if values[name] != old[name]]
        guilty = [row for row in changed if not self._build_error(
            self.amended(snapshot, **{row.name: old[row.name]}))] or changed
        given = ' and '.join(self._given(row.name, values) for row in guilty)
        ranges = dict.fromkeys(f' in {row.range_text}' for row in guilty if row.range_text)
        return f'{given} cannot be used: {error}; choose another value{" or".join(ranges)}'

    def _given(self, name: str, values: Mapping[str, Any]) -> str:
        return f'{name} = {values[name]} {self.rows[name].unit}'.rstrip()

    def _build_error(self, snapshot: T) -> str:
        try:
            self.build(snapshot)
        except (ValueError, ArithmeticError) as error:
            return ' '.join(str(error).split()) or type(error).__name__
        except Exception as error:  # of a class of one's own, somewhere in what is built
            return contained(error)
        return ''

    def yaml(self) -> str:
        """Write the table as a commented ROS parameter file, for nodes of any name."""
        lines = ['/**:', '  ros__parameters:']
        for name, row in self.rows.items():
            notes = [row.range_text] if row.range_text else []
            notes += ['fixed at start'] if row.read_only else []
            notes += ['a module:name is fixed at start'] if row.code else []
            lines += ['', f'    # {row.description}' + (f' [{row.unit}]' if row.unit else '')]
            lines += [f'    #   {"; ".join(notes)}'] if notes else []
            lines.append(f'    {name}: {as_yaml(row.default)}')
        return '\n'.join(lines) + '\n'


def in_own_units(tuned: Mapping[str, Any], attribute: str, units: Mapping[str, str]) -> Array:
    """Return what :func:`signal_value` declared for signals (n,), in their own units."""
    return np.array([conversion(display_unit(unit), unit)(getattr(tuned[name], attribute))
                     for name, unit in units.items()])


def _row(name: str, item: Field[Any], unit: str, defaults: Mapping[str, Any]) -> Specification:
    own = item.metadata['unit'].replace('({unit})', unit if unit.isalpha() else f'({unit})')
    own = own.replace('{unit}', unit).replace('{shown}', display_unit(unit))
    default = defaults.get(name, item.default)
    if isinstance(item.default, (float, tuple)):
        # a file may say 1 for 1.0, and has lists
        default = type(item.default)(default)
    row = Specification(name, default, **{**item.metadata, 'unit': own})
    return replace(row, default=max(default, lowest(own)), minimum=max(
        row.minimum, lowest(own))) if own == 'degC' and math.isfinite(row.minimum) else row


def lowest(unit: str) -> float:
    """Return what a value in a unit cannot be below; as a limit it stands for none."""
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
