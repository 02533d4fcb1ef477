# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Records: numbered lines of JSON, one for each event that changed a controller.

They are described in docs/reference/event_log.md.

Numbers are in the model's units, times in nanoseconds. JSON has numbers, texts, lists and objects.
Other values are an object with the key ``@``, which names their kind: ``float`` for one that is
not finite, ``array``, or the class of a dataclass, a named tuple or an enum as ``module:name``.
Lists become tuples.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
import json
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros import __version__
from koopman_ros.control import events, Mode, State
from koopman_ros.core.plugins import loaded_class
from koopman_ros.core.status import Reason, StatusCode

VERSION = 1

# Events by the names that they have in records.
EVENTS: dict[str, type[events.Event]] = {
    'measurement': events.Measurement, 'silence': events.Silence,
    'setpoint': events.SetpointRequest, 'manual_command': events.ManualCommand,
    'mode': events.ModeChange, 'initialisation': events.Initialisation,
    'analysis': events.AnalysisValue, 'clear_safe_state': events.ClearSafeState}
_NAMES = {kind: name for name, kind in EVENTS.items()}
_FIELDS = {kind: tuple(item.name for item in fields(kind)) for kind in _NAMES}
_ENCODER = json.JSONEncoder(separators=(',', ':'), allow_nan=False)
# Names of records that carry the controller's whole state.
START, SNAPSHOT = 'start', 'snapshot'
# Names of those by which it is exchanged for one with other parameters or another model.
PARAMETERS, MODEL = 'parameters', 'model'
_TAG = '@'


class RecordError(ValueError):
    """A text is not a readable record; the message says why."""


@dataclass(frozen=True)
class EventRecord:
    """One record."""

    run: str  #: of the controller, another one each time it is started
    number: int  #: counts within a run, from 0 without a gap
    event: str  #: name of the event
    fields: Mapping[str, Any]  #: further fields

    def text(self) -> str:
        """Return the record as a line of JSON."""
        return _ENCODER.encode({'version': VERSION, 'run': self.run, 'number': self.number,
                                'event': self.event, **self.fields})

    @property
    def stamp_ns(self) -> int:
        """Stamp of the measurement or request; 0 where there is none."""
        return int(self.fields.get('stamp_ns', 0))


def parse(text: str) -> EventRecord:
    """Read a record; raise RecordError for another text, or another version of the schema."""
    try:
        fields = json.loads(text)
        version = fields.pop('version')
        if version != VERSION:
            raise RecordError(
                f'its records have version {version!r}, this package reads {VERSION}: use the '
                'package that recorded it')
        record = EventRecord(str(fields.pop('run')), int(fields.pop('number')),
                             str(fields.pop('event')), fields)
        int(record.stamp_ns)
    except RecordError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise RecordError(f'{text[:60]!r} is not a record of a controller') from error
    return record


def fields_of(event: events.Event, outcome: events.EventOutcome) -> tuple[str, dict[str, Any]]:
    """Return the name of an event, and its fields and outcome as they are written."""
    name, report = _NAMES[type(event)], outcome.report
    written = {of: _written(getattr(event, of)) for of in _FIELDS[type(event)]}
    if report is not None:
        if isinstance(event, events.Measurement):
            written['result'] = report.measurement.arrival.value
        written |= {
            'command': _written(outcome.command),
            'setpoint': None if report.target is None else numbers(report.target.setpoint),
            'mode': _written(report.mode), 'level': report.level, 'reason': _codes(report.reason)}
    elif isinstance(event, (
            events.SetpointRequest, events.ManualCommand, events.AnalysisValue,
            events.ClearSafeState)):
        written |= {'accepted': outcome.rejected is None, 'reason': _codes(outcome.rejected)}
    return name, written


def event_of(record: EventRecord) -> events.Event:
    """Return the event of a record; raise KeyError, TypeError or ValueError where it has none."""
    if record.event not in EVENTS:
        raise ValueError(f'unknown event {record.event!r}')
    kind = EVENTS[record.event]
    return kind(**{name: _read(name, record.fields[name]) for name in _FIELDS[kind]
                   if name in record.fields})


def snapshot(state: State, parameters: Mapping[str, Any], model: Mapping[str, str]
             ) -> dict[str, Any]:
    """Return the fields of a snapshot; a model is its `name` and the SHA-256 of its file."""
    return {'package': __version__, 'model': dict(model), 'parameters': dict(parameters),
            'state': encoded(state)}


def state_of(record: EventRecord) -> State:
    """Return the state in a snapshot; raise KeyError, TypeError or ValueError for another."""
    state = decoded(record.fields['state'])
    if not isinstance(state, State):
        raise TypeError(f'a {type(state).__name__} is not a state of a controller')
    return state


def _written(value: Any) -> Any:
    """Return an array, an enum, a number or None as it is written in the fields of an event."""
    if isinstance(value, StatusCode):
        return value.value
    if isinstance(value, Enum):
        return value.name.lower()
    if isinstance(value, float):
        return value if math.isfinite(value) else repr(value)
    return numbers(value) if isinstance(value, np.ndarray) else value


def _read(name: str, value: Any) -> Any:
    """Return a field of an event from its written form."""
    if name == 'value' and isinstance(value, str):
        return float(value)
    if name == 'mode':
        return Mode[value.upper()]
    if name == 'cause':
        return None if value is None else StatusCode(value)
    if name in ('signals', 'quality'):
        return None if value is None else tuple(map(str if name == 'signals' else int, value))
    return value if value is None or isinstance(value, (int, float, str)) else float_array(value)


def _codes(reason: Reason | None) -> list[str]:
    """Return the code of a reason, and those of the reasons behind it."""
    return [] if reason is None else [reason.code.value, *_codes(reason.cause)]


def encoded(value: Any) -> Any:
    """Return a value in a form that :func:`json.dumps` writes without loss, or raise TypeError."""
    if isinstance(value, Enum):
        return {_TAG: _name(type(value)), 'name': value.name}
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {_TAG: 'float', 'value': repr(value)}
    if isinstance(value, np.ndarray):
        return {_TAG: 'array', 'dtype': value.dtype.str, 'shape': list(value.shape),
                'values': numbers(value.ravel())}
    if isinstance(value, Mapping):
        return {str(key): encoded(item) for key, item in value.items()}
    if names := _names_of(type(value)):
        return {_TAG: _name(type(value)), **{
            name: encoded(getattr(value, name)) for name in names}}
    if isinstance(value, (tuple, list)):
        return [encoded(item) for item in value]
    raise TypeError(f'a {type(value).__name__} cannot be written to a record')


def decoded(value: Any) -> Any:
    """
    Return the value that :func:`encoded` was given.

    A class has to be loaded, and hold data or be an enum: no text of a bag imports anything.

    :raises ValueError: for a class that is not known here.
    :raises TypeError: for one that has other fields here.
    """
    if isinstance(value, list):
        return tuple(decoded(item) for item in value)
    if not isinstance(value, dict):
        return value
    rest = {key: item for key, item in value.items() if key != _TAG}
    match value.get(_TAG):
        case None:
            return {key: decoded(item) for key, item in rest.items()}
        case 'float':
            return float(rest['value'])
        case 'array':
            array = np.array([float(item) if isinstance(item, str) else item
                              for item in rest['values']],
                             dtype=np.dtype(rest['dtype'])).reshape(rest['shape'])
            array.setflags(write=False)
            return array
        case name:
            kind = loaded_class(str(name))
            if not (_names_of(kind) or issubclass(kind, Enum)):
                raise ValueError(f'the class {name!r} holds no data')
            if issubclass(kind, Enum):
                return kind[rest['name']]
            return kind(**{key: decoded(item) for key, item in rest.items()})


def numbers(values: NDArray[Any]) -> list[Any]:
    """Return the numbers, (n,), of an array, as texts those that JSON has no number for."""
    return [item if not isinstance(item, float) or math.isfinite(item) else repr(item)
            for item in values.tolist()]


def float_array(values: Any) -> NDArray[np.float64]:
    """Return the argument of :func:`numbers`; raise TypeError or ValueError for no numbers."""
    if not isinstance(values, list):
        raise TypeError(f'{values!r} is not a list of numbers')
    array = np.array([float(item) for item in values], dtype=np.float64)
    array.setflags(write=False)
    return array


def _names_of(kind: type) -> tuple[str, ...]:
    """Return the names of the fields of a named tuple or a dataclass; none of another class."""
    names: tuple[str, ...] = getattr(kind, '_fields', ())
    return tuple(item.name for item in fields(kind)) if is_dataclass(kind) else names


def _name(kind: type) -> str:
    return f'{kind.__module__}:{kind.__qualname__}'
