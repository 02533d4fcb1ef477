# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Records: numbered lines of JSON, one for each event that changed a controller; see docs/records.md.

Numbers are in the model's units, times in nanoseconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import json
from typing import Any

from koopman_ros import __version__
from koopman_ros.control import Mode, State
from koopman_ros.replay.events import (
    Event,
    Initialisation,
    ManualCommand,
    Measurement,
    ModeChange,
    Outcome,
    SetpointRequest,
    Silence,
)
from koopman_ros.replay.values import decoded, encoded, float_array, numbers

VERSION = 1

# Names of the events that carry the controller's whole state.
START, SNAPSHOT = 'start', 'snapshot'
# Names of those by which it is exchanged for one with other parameters or another model.
PARAMETERS, MODEL = 'parameters', 'model'


class RecordError(ValueError):
    """A text is no record that can be read; the message says why."""


@dataclass(frozen=True)
class Record:
    """
    One record.

    :param run: of the controller, another one each time it is started.
    :param number: counts within a run, from 0 without a gap.
    :param event: name of the event.
    :param fields: what else is written.
    """

    run: str
    number: int
    event: str
    fields: Mapping[str, Any]

    def text(self) -> str:
        """Return the record as a line of JSON."""
        return json.dumps({'version': VERSION, 'run': self.run, 'number': self.number,
                           'event': self.event, **self.fields},
                          separators=(',', ':'), allow_nan=False)

    @property
    def stamp_ns(self) -> int:
        """Stamp of what was answered or asked for; 0 where there is none."""
        return int(self.fields.get('stamp_ns', 0))


def parse(text: str) -> Record:
    """
    Read a record.

    :raises RecordError: for another text, or another version of the schema.
    """
    try:
        fields = json.loads(text)
        version = fields.pop('version')
        if version != VERSION:
            raise RecordError(
                f'its records are of version {version!r}, this package reads {VERSION}: take the '
                'package that recorded it')
        record = Record(str(fields.pop('run')), int(fields.pop('number')),
                        str(fields.pop('event')), fields)
        int(record.stamp_ns)
    except RecordError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise RecordError(f'{text[:60]!r} is no record of a controller') from error
    return record


def fields_of(event: Event, outcome: Outcome) -> tuple[str, dict[str, Any]]:
    """Return the name of an event, and what is written of it and of what it led to."""
    match event:
        case Measurement():
            assert outcome.report is not None
            return 'measurement', {
                'stamp_ns': event.stamp_ns, 'measured': numbers(event.measured),
                'applied': None if event.applied is None else numbers(event.applied),
                'result': outcome.report.measurement.arrival.value, **_commanded(outcome)}
        case Silence():
            return 'silence', {'stamp_ns': event.stamp_ns, **_commanded(outcome)}
        case SetpointRequest():
            return 'setpoint', {'stamp_ns': event.stamp_ns, 'value': numbers(event.value),
                                'accepted': outcome.refused is None}
        case ManualCommand():
            return 'manual_command', {'value': numbers(event.value),
                                      'accepted': outcome.refused is None}
        case ModeChange():
            return 'mode', {'mode': event.mode.name.lower()}
        case Initialisation():
            return 'initialisation', {'applied': numbers(event.applied)}


def event_of(record: Record) -> Event:
    """
    Return the event of a record.

    :raises KeyError, TypeError, ValueError: for a record that is none of an event.
    """
    fields = record.fields
    match record.event:
        case 'measurement':
            applied = fields['applied']
            return Measurement(record.stamp_ns, float_array(fields['measured']),
                               None if applied is None else float_array(applied))
        case 'silence':
            return Silence(record.stamp_ns)
        case 'setpoint':
            return SetpointRequest(record.stamp_ns, float_array(fields['value']))
        case 'manual_command':
            return ManualCommand(float_array(fields['value']))
        case 'mode':
            return ModeChange(Mode[fields['mode'].upper()])
        case 'initialisation':
            return Initialisation(float_array(fields['applied']))
    raise ValueError(f'the event {record.event!r} is not known')


def snapshot(state: State, parameters: Mapping[str, Any], model: Mapping[str, str]
             ) -> dict[str, Any]:
    """
    Return the fields of a record from which a replay can begin.

    :param state: of the controller.
    :param parameters: all of them, by name.
    :param model: its name and the SHA-256 digest of its file.
    """
    return {'package': __version__, 'model': dict(model), 'parameters': dict(parameters),
            'state': encoded(state)}


def state_of(record: Record) -> State:
    """
    Return the state in a snapshot.

    :raises KeyError, TypeError, ValueError: where it does not fit this package.
    """
    state = decoded(record.fields['state'])
    if not isinstance(state, State):
        raise TypeError(f'a {type(state).__name__} is no state of a controller')
    return state


def _commanded(outcome: Outcome) -> dict[str, Any]:
    report = outcome.report
    assert report is not None
    return {'command': None if outcome.command is None else numbers(outcome.command),
            'setpoint': None if report.target is None else numbers(report.target.setpoint),
            'mode': report.mode.name.lower(), 'level': report.level}
