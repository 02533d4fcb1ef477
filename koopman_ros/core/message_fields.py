# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Where signals are on the wire: topic, message type, field of the message and unit there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
import math
import re
from typing import Any

import numpy as np

from koopman_ros.core.units import conversion, display_unit


@dataclass(frozen=True)
class FieldDefaults:
    """The default field and unit of a message type."""

    field: str  #: where in the message; '{name}' stands for the name of the signal
    unit: str = ''  #: of the number there; empty for that of the signal
    lowest: float = -math.inf  #: possible value, in this unit; lower ones are no measurements
    highest: float = math.inf  #: possible value, in this unit


# One row a message type; any other type can be named with the field. Units are those of REP 103.
KNOWN_TYPES = {
    'sensor_msgs/msg/Temperature': FieldDefaults('temperature', 'degC', -273.15, 1e4),
    'sensor_msgs/msg/FluidPressure': FieldDefaults('fluid_pressure', 'Pa', -1e12, 1e12),
    'sensor_msgs/msg/RelativeHumidity': FieldDefaults('relative_humidity', '1', 0.0, 1.0),
    'sensor_msgs/msg/Illuminance': FieldDefaults('illuminance', 'lx', 0.0),
    'sensor_msgs/msg/Range': FieldDefaults('range', 'm'),
    'sensor_msgs/msg/JointState': FieldDefaults('position[{name}]'),
    'std_msgs/msg/Float64': FieldDefaults('data'),
    'std_msgs/msg/UInt8': FieldDefaults('data'),
    'diagnostic_msgs/msg/DiagnosticStatus': FieldDefaults('level'),
    'std_msgs/msg/Float64MultiArray': FieldDefaults('data[0]'),
}
_ANY = FieldDefaults('')
JOINT_STATE = 'sensor_msgs/msg/JointState'
# The type, and for named values the array, by the unit of a signal.
_TYPES = {'K': ('sensor_msgs/msg/Temperature', ''), 'Pa': ('sensor_msgs/msg/FluidPressure', ''),
          **dict.fromkeys(('rad/s', 'm/s'), (JOINT_STATE, 'velocity[{name}]')),
          **dict.fromkeys(('N m', 'N'), (JOINT_STATE, 'effort[{name}]'))}
_QUANTITIES = {'K': 'temperature', 'Pa': 'pressure'}

# Valid names of topics and parameters.
SIGNAL_NAME = re.compile(r'[A-Za-z]\w*', re.ASCII)
# where the names of the elements of a message's arrays are
_NAMES = ('name', 'joint_names')
_STEP = re.compile(r'([A-Za-z_]\w*)(?:\[((?:[^\[\]]|\[[^\[\]]*\])+)\])?(\.|$)')


def full_type_name(name: str) -> str:
    """Return package/msg/Name for package/Name, as some writers shorten it; others as they are."""
    package, _, rest = name.partition('/')
    return f'{package}/msg/{rest}' if package and rest and '/' not in rest else name


@dataclass(frozen=True)
class MessageField:
    """
    Where a number is on the wire.

    :raises ValueError: for a field that is not a path of names and indices.
    """

    topic: str  #: name of the topic
    type: str  #: of its messages, as package/msg/Name; package/Name is written out
    field: str  #: path in the message, e.g. ``twist.linear.x``, ``data[2]``, ``position[shaft]``
    unit: str  #: of the number there

    def __post_init__(self) -> None:
        object.__setattr__(self, 'type', full_type_name(self.type))
        _steps(self.field)

    @cached_property
    def range(self) -> tuple[float, float]:
        """Lowest and highest number that can be there; ValueError for a unit that is none here."""
        usual = KNOWN_TYPES.get(self.type, _ANY)
        if self.field != usual.field:
            return -math.inf, math.inf
        convert = conversion(usual.unit or self.unit, self.unit)
        return convert(usual.lowest), convert(usual.highest)

    def get(self, message: Any) -> float:
        """Return the number in a message; LookupError where it has none there."""
        value = message
        for name, key in _steps(self.field):
            try:
                holder, value = value, getattr(value, name)
                if key:
                    value = value[_index(holder, key)]
            except (AttributeError, IndexError, ValueError, TypeError) as error:
                raise LookupError(f'{self.field} is not in a message of {self.topic} '
                                  f'({self.type})') from error
        if isinstance(value, bytes) and len(value) == 1:
            # a byte, as rclpy has it
            return float(value[0])
        try:
            return float(value)
        except (TypeError, ValueError) as error:
            raise LookupError(f'{self.field} of a message of {self.topic} ({self.type}) is not a '
                              'number') from error

    def expect(self, message: Any) -> None:
        """Raise LookupError where no message of its kind, here an empty one, has the number."""
        for name, key in _steps(self.field):
            if not hasattr(message, name):
                raise LookupError(f'{self.type} has no {self.field}: name another field')
            if key:
                return
            message = getattr(message, name)
        if not isinstance(message, (int, float)) and not (
                isinstance(message, bytes) and len(message) == 1):
            raise LookupError(f'{self.field} of {self.type} is not a number: name another field')

    def expect_decimals(self, message: Any) -> None:
        """Raise LookupError where a message of its kind, here an empty one, holds integers."""
        path = _steps(self.field)
        for name, key in path:
            message = getattr(message, name)
            if key:
                break
        kind = getattr(message, 'typecode', '') or getattr(message, 'dtype', np.dtype('d')).char
        if isinstance(message, (int, bytes)) or kind not in 'df' or (
                isinstance(message, list) and key and (name, key) == path[-1]):
            raise LookupError(f'{self.field} of {self.type} holds integers, which would round the '
                              'value: name a field of type float64 or float32')

    def put(self, message: Any, value: float) -> None:
        """Write a number into a message, whose arrays grow where they are too short."""
        *path, (name, key) = _steps(self.field)
        for step, index in path:
            holder, message = message, getattr(message, step)
            message = message[_index(holder, index)] if index else message
        if not key:
            setattr(message, name, value)
            return
        values, at = list(getattr(message, name)), _index_of(message, key)
        values += [math.nan] * (at + 1 - len(values))
        values[at] = value
        setattr(message, name, values)


@cache
def _steps(field: str) -> tuple[tuple[str, str], ...]:
    steps, end = [], 0
    while match := _STEP.match(field, end):
        steps.append((match[1], match[2] or ''))
        end = match.end()
        if not match[3]:
            break
    if not steps or end != len(field) or field.endswith('.'):
        raise ValueError(f'field = {field!r} is not the path of a message field: use e.g. '
                         'temperature, twist.linear.x, data[2] or position[shaft]')
    return tuple(steps)


def _names(message: Any) -> list[str] | None:
    return next((list(getattr(message, name)) for name in _NAMES if hasattr(message, name)), None)


def _index(message: Any, key: str) -> int:
    """Return where an element is, by its number or name; ValueError for one that is not there."""
    if key.isdecimal():
        return int(key)
    names = _names(message)
    if names is None:
        raise ValueError(f'{key!r} is not a number, and the message has no names')
    return names.index(key)


def _index_of(message: Any, key: str) -> int:
    """Return the same; a name that is not there is added."""
    names = _names(message)
    if key.isdecimal() or names is None or key in names:
        return _index(message, key)
    setattr(message, next(name for name in _NAMES if hasattr(message, name)), [*names, key])
    return len(names)


def place(topic: str, name: str, unit: str,
          given: Mapping[str, str] | None = None) -> MessageField:
    """
    Return where a signal is, from the given ones of ``topic``, ``type``, ``field`` and ``unit``.

    The rest follows: the type from the unit of the signal, field and unit from the type.

    :param topic: by default.
    :param unit: of the signal itself.
    :raises ValueError: for a type without a usual field where none is given.
    """
    chosen = {key: value for key, value in (given or {}).items() if value}
    kind, array = _TYPES.get(unit, (JOINT_STATE, ''))
    kind = full_type_name(chosen.get('type', kind))
    carrier = KNOWN_TYPES.get(kind, _ANY)
    field = chosen.get('field') or (array if kind == JOINT_STATE and array else carrier.field)
    if not field:
        raise ValueError(f'the field of a {kind} that holds the value is unknown: name it, e.g. '
                         'twist.linear.x or data[2]')
    return MessageField(chosen.get('topic', topic), kind, field.replace('{name}', name),
                        chosen.get('unit') or carrier.unit or display_unit(unit))


def base_name(name: str, unit: str) -> str:
    """Return the name of an input without its quantity: ``coolant`` of ``coolant_temperature``."""
    return name.removesuffix(f'_{_QUANTITIES.get(unit, "")}') or name
