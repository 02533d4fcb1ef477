# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameter tables: one frozen dataclass a node gives declarations, checks, snapshot and YAML."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, MISSING, replace
import math
from typing import Any, Generic, TypeVar

T = TypeVar('T')

_TYPE_WORDS = {
    bool: ('a boolean', 'true'),
    int: ('an integer', '1'),
    float: ('a double', '1.0'),
    str: ('a string', 'text'),
    tuple: ('a list of strings', '[a, b]'),
}


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
    read_only: bool = False  #: whether it can be changed while the node runs

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
        word, example = _TYPE_WORDS[type(self.default)]
        if value == [] and isinstance(self.default, tuple):
            word = 'a list of at least one string'
        return f'{self.name} = {value!r} must be {word}, e.g. {example}'


def parameter(default: Any, description: str, unit: str = '', minimum: float = -math.inf,
              maximum: float = math.inf, **details: Any) -> Any:
    """Declare a field of a parameter dataclass; the arguments are those of a specification."""
    return field(default=default, metadata={
        'unit': unit, 'description': description, 'minimum': minimum, 'maximum': maximum,
        **details})


class ParameterTable(Generic[T]):
    """
    The parameters of a node, from the dataclass that is also their typed, frozen snapshot.

    :param ordered: names of which the first must be below the second.
    :param cross_check: returns what is wrong with a whole snapshot, or an empty string.
    :param build: builds from a snapshot what the node will use, of which a ValueError or an
        ArithmeticError is the reason to refuse the snapshot.
    """

    def __init__(self, kind: type[T], cross_check: Callable[[T], str] = lambda _: '',
                 build: Callable[[T], object] = lambda _: None,
                 ordered: tuple[tuple[str, str], ...] = ()) -> None:
        self.kind = kind
        self.ordered = ordered
        self.cross_check = cross_check
        self.build = build
        self.rows: dict[str, Specification] = {}
        for item in fields(kind):  # type: ignore[arg-type]
            assert item.default is not MISSING
            self.rows[item.name] = Specification(item.name, item.default, **item.metadata)

    def check(self, snapshot: T, before: T | None = None) -> str:
        """
        Return the first thing wrong with a snapshot, or an empty string.

        :param before: the one in force, which is known to be right; None for the defaults.
        """
        for name, row in self.rows.items():
            if reason := row.check(getattr(snapshot, name)):
                return reason
        for low, high in self.ordered:
            if not getattr(snapshot, low) < getattr(snapshot, high):
                return (f'{self._given(snapshot, low)} must be below '
                        f'{self._given(snapshot, high)}: change the other one first')
        return self.cross_check(snapshot) or self._unusable(
            snapshot, self.kind() if before is None else before)

    def _unusable(self, snapshot: T, before: T) -> str:
        """Return why nothing can be built from values that fit each for itself, or ''."""
        if not (error := self._build_error(snapshot)):
            return ''
        changed = [row for name, row in self.rows.items()
                   if getattr(snapshot, name) != getattr(before, name)]
        guilty = [row for row in changed if not self._build_error(replace(
            snapshot, **{row.name: getattr(before, row.name)}))] or changed  # type: ignore
        given = ' and '.join(self._given(snapshot, row.name) for row in guilty)
        ranges = dict.fromkeys(f' in {row.range_text}' for row in guilty if row.range_text)
        return f'{given} cannot be used: {error}; choose another value{" or".join(ranges)}'

    def _given(self, snapshot: T, name: str) -> str:
        return f'{name} = {getattr(snapshot, name)} {self.rows[name].unit}'.rstrip()

    def _build_error(self, snapshot: T) -> str:
        try:
            self.build(snapshot)
        except (ValueError, ArithmeticError) as error:
            return ' '.join(str(error).split()) or type(error).__name__
        return ''

    def yaml(self) -> str:
        """Write the table as a commented ROS parameter file, for nodes of any name."""
        lines = ['/**:', '  ros__parameters:']
        for name, row in self.rows.items():
            notes = [row.range_text] if row.range_text else []
            notes += ['fixed at start'] if row.read_only else []
            lines += ['', f'    # {row.description}' + (f' [{row.unit}]' if row.unit else '')]
            lines += [f'    #   {"; ".join(notes)}'] if notes else []
            lines.append(f'    {name}: {_as_yaml(row.default)}')
        return '\n'.join(lines) + '\n'


def _as_yaml(value: Any) -> str:
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
        return '[' + ', '.join(item or "''" for item in value) + ']'
    return repr(value) if isinstance(value, int) else f"'{value}'"
