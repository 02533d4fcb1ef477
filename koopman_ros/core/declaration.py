# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Declaration of parameters as fields of a frozen dataclass.

One field gives name, type, default, unit, range and description: nodes declare it, check it and
write it into YAML (:mod:`koopman_ros.parameters.table`), Python code sets it as a keyword, and
the docstring of its class shows it.

A custom control law declares its own parameters in the same way::

    @dataclass(frozen=True)
    class Gains(Settings):
        gain: Array = column('controlled', 1.0, 'Proportional gain.')
        limit: float = parameter(10.0, 'Largest change per sample.', 's', 0.0, 100.0)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, Field, field, fields, is_dataclass, replace
import inspect
import math
from numbers import Real
import textwrap
from typing import Any, TypeVar

import numpy as np

from koopman_ros.core.arrays import Array, real

__all__ = ['UNBOUNDED', 'Column', 'NoParameters', 'Settings', 'column', 'for_signals', 'group',
           'nested', 'of_other_states', 'parameter', 'per_signal', 'plugin_parameters',
           'signal_value', 'value_column']

T = TypeVar('T')

#: Stands for no bound, in any unit.
UNBOUNDED = 1e9
# Numbers in YAML that stand for no bound, and the infinity that is meant.
ANY, NO_LOWER, NO_UPPER = (0.0, math.inf), (-UNBOUNDED, -math.inf), (UNBOUNDED, math.inf)


class Settings:
    """
    Base class of a frozen dataclass of declared fields, which are checked where they are written.

    Its docstring gets a list of them. In Python and YAML one number stands for no bound.

    :raises TypeError: for a value of another type, naming the field.
    :raises ValueError: for a number that is none or out of its range, naming field and value.
    """

    def __init_subclass__(cls) -> None:
        rows = [row for name, item in vars(cls).items() if isinstance(item, Field)
                for row in _described(name, item)]
        cls.__doc__ = '\n\n'.join([inspect.cleandoc(cls.__doc__ or ''), '\n'.join(rows)])

    def __post_init__(self) -> None:
        lengths: dict[str, tuple[str, int]] = {}  # of fields and arrays, by signals
        for item in fields(self):  # type: ignore[arg-type]
            value, of = getattr(self, item.name), item.metadata.get('column')
            if of is None:
                _check_kind(item, value)
                continue
            numbers = real(value, item.name)
            if numbers.ndim:
                if numbers.ndim > 1:
                    raise ValueError(f'{item.name} must be a number or one per '
                                     f'{_ONE_OF[of.signals]}, got {numbers.tolist()}')
                other, length = lengths.setdefault(of.signals, (item.name, len(numbers)))
                if length != len(numbers):
                    raise ValueError(f'{other} and {item.name} must be as long as each other, '
                                     f'got {length} and {len(numbers)}: give one number per '
                                     f'{_ONE_OF[of.signals]}')
            if of.none is not None and np.any(numbers == of.none[0]):
                numbers = np.where(numbers == of.none[0], of.none[1], numbers)
            object.__setattr__(self, item.name, numbers if numbers.ndim else float(numbers))
            _check_range(item.name, numbers, item.metadata)


@dataclass(frozen=True)
class NoParameters:
    """The parameters of a plug-in that has none of its own."""


@dataclass(frozen=True)
class Column:
    """The metadata of a field declared by :func:`column`."""

    signals: str  #: of which signals
    name: str  #: in YAML; empty for that of the field
    default: float  #: of each, as in YAML
    none: tuple[float, float] | None  #: number in YAML for no bound, and the infinity it means


def parameter(default: Any, description: str, unit: str = '', minimum: float = -math.inf,
              maximum: float = math.inf, **details: Any) -> Any:
    """
    Declare a number, a text, a boolean or a tuple of texts.

    :param description: one sentence.
    :param details: further attributes of a
        :class:`~koopman_ros.parameters.table.Specification`.
    """
    return field(default=default, metadata={
        'unit': unit, 'description': description, 'minimum': minimum, 'maximum': maximum,
        **details})


def signal_value(default: float, description: str, **details: Any) -> Any:
    """Declare a value of a signal, in the unit in which people read it, that may be any."""
    return parameter(default, description, '{shown}', -UNBOUNDED, UNBOUNDED, **details)


_ONE_OF = {'states': 'state', 'measured': 'measured signal', 'controlled': 'controlled signal',
           'inputs': 'input', 'disturbances': 'disturbance'}


def column(signals: str, default: float, description: str, unit: str = '{unit}',
           minimum: float = 0.0, maximum: float = UNBOUNDED, *, name: str = '',
           none: tuple[float, float] | None = None, **details: Any) -> Any:
    """
    Declare an array with one number for each of some signals, as ``<signal>.<name>`` in YAML.

    :param signals: ``'states'`` (n_x,), ``'measured'`` (n_y,), ``'controlled'`` (n_c,),
        ``'inputs'`` (n_u,) or ``'disturbances'`` (n_d,).
    :param default: of each, as in YAML.
    :param unit: ``{unit}`` stands for that of a difference of the signal; ``{shown}`` says that
        the number is a value of the signal, which is converted to the unit of the model.
    :param name: in YAML, where that is not the name of the field.
    :param none: number in YAML that stands for no bound, and the infinity that is meant.
    """
    in_code = none[1] if none is not None and none[0] == default else default
    return field(default=in_code, metadata={
        'unit': unit, 'description': description, 'minimum': minimum, 'maximum': maximum,
        'column': Column(signals, name, default, none), **details})


def value_column(signals: str, default: float, description: str, **details: Any) -> Any:
    """Declare an array of values of some signals, each in the unit in which people read it."""
    return column(signals, default, description, '{shown}', -UNBOUNDED, UNBOUNDED, **details)


def per_signal(kind: type[Any], signals: str = '') -> Any:
    """
    Declare a field with one `kind`, a parameter dataclass, for each of some signals.

    ``{unit}`` in its units stands for that of a difference of the signal, ``{shown}`` for that of
    its values, as people read them.

    :param signals: as of :func:`column`; the name of the field by default.
    """
    return field(default_factory=dict, metadata={'per_signal': kind, 'signals': signals})


def group() -> Any:
    """Declare a field with numbers by name, whose rows ``field.name`` the table is given."""
    return field(default_factory=dict, metadata={'group': True})


def nested(kind: type[Any]) -> Any:
    """Declare a field with another parameter dataclass, whose rows are added to the others."""
    return field(default_factory=kind, metadata={'nested': kind})


def plugin_parameters() -> Any:
    """Declare a field with parameter dataclasses by plug-in, with the rows ``plug-in.name``."""
    return field(default_factory=dict, metadata={'plugins': True})


def for_signals(parameters: T, signals: Mapping[str, Sequence[str]]) -> T:
    """
    Return parameters in which each column holds one number for each of its signals.

    A single number, as a default, holds for all of them.

    :param signals: names by the first argument of :func:`column`.
    :raises ValueError: for a column of another size, with NaN, or out of its range.
    """
    changes: dict[str, Any] = {}
    for item in fields(parameters):  # type: ignore[arg-type]
        value, of = getattr(parameters, item.name), item.metadata.get('column')
        if 'nested' in item.metadata and is_dataclass(value):
            changes[item.name] = for_signals(value, signals)
        elif of is not None:
            changes[item.name] = _one_each(item.name, value, signals[of.signals], item.metadata)
        elif isinstance(value, float):
            _check_range(item.name, np.array(value), item.metadata)
    return replace(parameters, **changes)  # type: ignore[type-var]


def of_other_states(parameters: T, before: Sequence[str], now: Sequence[str]) -> T:
    """
    Return parameters for the states of another model; one that it did not have has the default.

    :param before: names of the states that they are for.
    :param now: names of the states that they are to be for.
    """
    changes: dict[str, Any] = {}
    for item in fields(parameters):  # type: ignore[arg-type]
        of = item.metadata.get('column')
        if of is not None and of.signals == 'states':
            known = dict(zip(before, getattr(parameters, item.name).tolist(), strict=True))
            changes[item.name] = np.array([known.get(name, item.default) for name in now])
        elif 'plugins' in item.metadata:
            changes[item.name] = {name: of_other_states(own, before, now) for name, own in getattr(
                parameters, item.name).items()}
    return replace(parameters, **changes)  # type: ignore[type-var]


def _described(name: str, item: Field[Any]) -> list[str]:
    """Return the lines of a docstring about a field."""
    about, of = item.metadata, item.metadata.get('column')
    if 'description' not in about:
        if (kind := about.get('nested')) is None:
            return [f'``{name}``: by name', '    Own parameters of laws and estimators.']
        return [f'``{name}``: see ``{kind.__name__}``',
                f'    {inspect.cleandoc(kind.__doc__).splitlines()[0]}']
    unit = about['unit'].replace('{shown}', 'its unit').replace('({unit})', '(its unit)').replace(
        '{unit}', 'its unit')
    default = item.default if of is None else of.default
    bounds = _range_words(about['minimum'], about['maximum'], about.get('open_minimum', False))
    signal = '' if of is None else _ONE_OF[of.signals]
    facts = [signal and f'one per {signal}', unit and f'in {unit}', bounds, 'default ' + (
        'no limit' if default in (UNBOUNDED, -UNBOUNDED) else
        f'{default:.10g}' if isinstance(default, float) else repr(default)),
        f'in YAML ``<{signal}>.{of.name}``' if of is not None and of.name else '']
    return [f'``{name}``: {", ".join(filter(None, facts))}',
            *textwrap.wrap(about['description'], 92, initial_indent='    ',
                           subsequent_indent='    ')]


def _check_kind(item: Field[Any], value: Any) -> None:
    """Check a value that is not one of each of some signals."""
    kind = item.metadata.get('nested', type(item.default))
    if 'nested' in item.metadata or isinstance(item.default, (bool, str)):
        if not isinstance(value, kind):
            raise TypeError(f'{item.name} must be of the class {kind.__name__}, got {value!r}')
    elif isinstance(item.default, tuple):
        if isinstance(value, str) or not all(isinstance(one, str) for one in value):
            raise TypeError(f'{item.name} must be a list of names, got {value!r}')
    elif isinstance(item.default, float):
        if not isinstance(value, Real):
            raise TypeError(f'{item.name} must be a number, got {value!r}')
        _check_range(item.name, np.array(value, dtype=np.float64), item.metadata)
    elif not all(map(is_dataclass, value.values())):
        raise TypeError(f'{item.name} must be parameters of plug-ins by name, got {value!r}')


def _range_words(minimum: float, maximum: float, opened: bool) -> str:
    low, high = (abs(one) < UNBOUNDED for one in (minimum, maximum))
    above = f'{"above" if opened else "at least"} {minimum:.10g}' * low
    below = f'at most {maximum:.10g}' * high
    return f'{minimum:.10g} to {maximum:.10g}' if low and high and not opened else (
        ' and '.join(filter(None, (above, below))))


def _one_each(name: str, value: Any, signals: Sequence[str], metadata: Mapping[str, Any]
              ) -> Array:
    array = real(value, name)
    if array.ndim == 0:
        array = np.full(len(signals), array)
    if array.shape != (len(signals),):
        raise ValueError(f'incompatible {name}: expected one number for each of '
                         f'{", ".join(signals)}, got {array.tolist()}')
    _check_range(name, array, metadata)
    array = array.copy()
    array.setflags(write=False)
    return array


def _check_range(name: str, value: Array, metadata: Mapping[str, Any]) -> None:
    low, high, of = metadata['minimum'], metadata['maximum'], metadata.get('column')
    opened = metadata.get('open_minimum', False)
    # of a value of a signal the range is in the unit that people read
    fits = ~np.isnan(value) if metadata['unit'] == '{shown}' else (
        (value > low if opened else value >= low) & (value <= high))
    if of is not None and of.none is not None:
        fits |= value == of.none[1]
    if not np.all(fits):
        raise ValueError(f'{name} = {value.tolist()} must be '
                         f'{_range_words(low, high, opened) or "a number"}')
