# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The file in which alarms and their journal outlast the panel."""

from dataclasses import asdict
import json
import math
import os
from pathlib import Path
from typing import Any

from koopman_ros.panel.alarms import (
    Alarm,
    Alarms,
    AlarmState,
    Entry,
    MAX_ALARMS,
    MAX_KEY,
    MAX_TEXT,
    MAX_WHO,
    Priority,
)
from koopman_ros.panel.learning import read_bounded
from koopman_ros.panel.texts import plain
from koopman_ros.reports import write_figures

VERSION = 1
_MOST_BYTES = 32 * 2 ** 20
_INTERVAL = 5.0  # s between two times that the file is written
_WORDS = ('raised', 'returned', 'acknowledged', 'shelved', 'unshelved')


class AlarmMemory:
    """
    Keeps alarms in a file: what was there is recalled, and what changes is written.

    :param path: of the file, which may be missing.
    :param now: s of Unix time.
    :ivar complaint: why what the file held is not recalled, or an empty string; it was moved aside
        then.
    :raises OSError: where the file cannot be read, or its folder not be written.
    """

    def __init__(self, alarms: Alarms, path: Path, now: float) -> None:
        self._alarms, self._path = alarms, path
        self._written, self._due = alarms.noted, now
        self.complaint = ''
        if path.exists():
            try:
                alarms.recall(*_parsed(read_bounded(path, _MOST_BYTES).decode()), now)
            except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError,
                    RecursionError) as error:
                aside = path.with_name(path.name + '.damaged')
                os.replace(path, aside)
                self.complaint = (f'the alarms of {path} are not recalled, as it is not what a '
                                  f'panel writes ({error}): it is kept as {aside}')
        self._write()

    def keep(self, now: float) -> None:
        """Write what has changed, every few seconds; a few calls a second will do."""
        if now >= self._due and self._alarms.noted != self._written:
            self._due = now + _INTERVAL
            self._write()

    def close(self) -> None:
        """Write what has changed last."""
        if self._alarms.noted != self._written:
            self._write()

    def _write(self) -> None:
        self._written = self._alarms.noted
        write_figures(self._path, {'version': VERSION, **{
            name: [asdict(one, dict_factory=_plainly) for one in found] for name, found in (
                ('alarms', self._alarms.all),
                ('journal', self._alarms.journal(-math.inf)[::-1]))}})


def _plainly(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    return {name: value.name if isinstance(value, (Priority, AlarmState)) else value
            for name, value in pairs}


def _parsed(text: str) -> tuple[list[Alarm], list[Entry]]:
    found = json.loads(text)
    if found.get('version') != VERSION:
        raise ValueError(f'its version is {found.get("version")!r}, must be {VERSION}')
    return ([_alarm(one) for one in found['alarms'][:MAX_ALARMS]],
            sorted(map(_entry, found['journal']), key=lambda entry: entry.time))


def _alarm(found: dict[str, Any]) -> Alarm:
    until = found['shelved_until']
    return Alarm(plain(found['key'], MAX_KEY), plain(found['text'], MAX_TEXT),
                 Priority[found['priority']], AlarmState[found['state']], _time(found['since']),
                 None if until is None else _time(until),
                 plain(found['acknowledged_by'], MAX_WHO))


def _entry(found: dict[str, Any]) -> Entry:
    if found['what'] not in _WORDS:
        raise ValueError(f'{found["what"]!r} must be one of {", ".join(_WORDS)}')
    return Entry(_time(found['time']), plain(found['key'], MAX_KEY), Priority[found['priority']],
                 plain(found['text'], MAX_TEXT), found['what'], plain(found['who'], MAX_WHO))


def _time(value: Any) -> float:
    if not math.isfinite(value):
        raise ValueError(f'times must be finite, got {value}')
    return float(value)
