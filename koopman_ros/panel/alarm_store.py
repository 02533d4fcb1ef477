# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""File in which alarms and their journal outlast the panel."""

from dataclasses import asdict
from enum import Enum
import json
import math
import os
from pathlib import Path
import re
from typing import Any

from koopman_ros.core.paths import write_atomically
from koopman_ros.panel.alarms import (
    Alarm,
    AlarmLogEntry,
    Alarms,
    AlarmState,
    MAX_TEXT,
    MAX_WHO,
    Priority,
)
from koopman_ros.panel.files import read_bounded, sanitize_text

VERSION = 1
_MAX_BYTES = 32 * 2 ** 20
_INTERVAL = 5.0  # s between two writes
_BEGIN = re.compile(rb'\{\s*"version":\s*\d+,\s*"alarms":\s*\[')  # of a file of alarms
_EVENTS = ('raised', 'returned', 'acknowledged', 'shelved', 'unshelved')


class AlarmStore:
    """
    Loads alarms from a file, and saves their changes.

    A file that no panel wrote is not replaced.

    :param path: of the file, which may be missing or empty.
    :param now: wall time.
    :ivar complaint: why the content of a file was not loaded, or empty; the file was moved aside.
    :raises ValueError: for a file without alarms.
    :raises OSError: for a file that cannot be read, or a folder that cannot be written.
    """

    def __init__(self, alarms: Alarms, path: Path, now: float) -> None:
        # a link stays one
        self._alarms, self._path = alarms, Path(os.path.realpath(path))
        self._saved, self._due = alarms.noted, now
        self.complaint = ''
        if self._path.exists():
            content, _ = read_bounded(self._path, _MAX_BYTES)
            if content.strip():
                self._load(content, now)
        self._save()

    def _load(self, content: bytes, now: float) -> None:
        if not _BEGIN.match(content):
            raise ValueError(f'{self._path} is not an alarm file and is not replaced')
        try:
            self._alarms.restore(*_parsed(content.decode()), now)
        except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError,
                RecursionError) as error:
            aside = self._path.with_name(f'{self._path.name}.damaged')
            os.replace(self._path, aside)
            self.complaint = (f'the alarms of {self._path} are not loaded, because the file is '
                              f'damaged ({error}): it is kept as {aside}')

    def save(self, now: float) -> None:
        """Save changes, every few seconds; to be called more often."""
        # a clock that was set back does not delay it
        if self._alarms.noted != self._saved and not self._due - _INTERVAL <= now < self._due:
            self._due = now + _INTERVAL
            self._save()

    def close(self) -> None:
        """Save the last changes."""
        if self._alarms.noted != self._saved:
            self._save()

    def _save(self) -> None:
        self._saved = self._alarms.noted
        content = {'version': VERSION, 'alarms': [asdict(one) for one in self._alarms.all],
                   'journal': [asdict(one) for one in self._alarms.journal(-math.inf)[::-1]]}
        self._path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(content, indent=2, allow_nan=False, default=_name) + '\n'
        write_atomically(self._path, text.encode(), 0o600)


def _name(value: Any) -> str:
    if isinstance(value, Enum):
        return value.name
    raise TypeError(f'{value!r} is not saved')


def _parsed(text: str) -> tuple[list[Alarm], list[AlarmLogEntry]]:
    found = json.loads(text)
    if found.get('version') != VERSION:
        raise ValueError(f'its version is {found.get("version")!r}, must be {VERSION}')
    return ([_alarm(**one) for one in found['alarms']],
            sorted((_entry(**one) for one in found['journal']), key=lambda entry: entry.time))


def _alarm(key: str, text: str, priority: str, state: str, since: float,
           shelved_until: float | None, acknowledged_by: str) -> Alarm:
    return Alarm(sanitize_text(key, MAX_TEXT), sanitize_text(text, MAX_TEXT), Priority[priority],
                 AlarmState[state], _finite(since),
                 None if shelved_until is None else _finite(shelved_until),
                 sanitize_text(acknowledged_by, MAX_WHO))


def _entry(time: float, key: str, priority: str, text: str, what: str, who: str) -> AlarmLogEntry:
    if what not in _EVENTS:
        raise ValueError(f'{what!r} must be one of {", ".join(_EVENTS)}')
    return AlarmLogEntry(_finite(time), sanitize_text(key, MAX_TEXT), Priority[priority],
                         sanitize_text(text, MAX_TEXT), what, sanitize_text(who, MAX_WHO))


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f'times must be finite, got {value}')
    return float(value)
