# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The file in which alarms and their journal outlast the panel."""

import contextlib
from dataclasses import asdict
import json
import math
import os
from pathlib import Path
import re
import tempfile
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

VERSION = 1
_MOST_BYTES = 32 * 2 ** 20
_INTERVAL = 5.0  # s between two times that the file is written
# How a file of alarms begins.
_BEGIN = re.compile(rb'\{\s*"version":\s*\d+,\s*"alarms":\s*\[')
_Identity = tuple[int, int, int, int]  # device, number, time of writing in ns, bytes
_WORDS = ('raised', 'returned', 'acknowledged', 'shelved', 'unshelved')


class AlarmMemory:
    """
    Keeps alarms in a file: what was there is recalled, and what changes is written.

    A file that is no file of alarms is never replaced, neither at the start nor later.

    :param path: of the file, which may be missing or empty.
    :param now: s of Unix time.
    :ivar complaint: why what the file held is not recalled, or an empty string; it was moved aside
        then.
    :raises ValueError: where there is something else than a file of alarms.
    :raises OSError: where the file cannot be read, or its folder not be written.
    """

    def __init__(self, alarms: Alarms, path: Path, now: float) -> None:
        # a link stays one
        self._alarms, self._path = alarms, Path(os.path.realpath(path))
        self._written, self._due = alarms.noted, now
        self._own: _Identity | None = None  # of the file as it was written or recalled
        self.complaint = ''
        if self._path.exists():
            content = read_bounded(self._path, _MOST_BYTES)
            if content.strip():
                self._recall(content, now)
            self._own = _identity(self._path)
        self._write()

    def _recall(self, content: bytes, now: float) -> None:
        if not _BEGIN.match(content):
            raise ValueError(f'{self._path} is no file of alarms, and is not replaced')
        try:
            self._alarms.recall(*_parsed(content.decode()), now)
        except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError,
                RecursionError) as error:
            aside = _free(self._path)
            # fails where there is one by now
            os.link(self._path, aside)
            self.complaint = (f'the alarms of {self._path} are not recalled, as it is not what a '
                              f'panel writes ({error}): it is kept as {aside}')

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
        text = json.dumps({'version': VERSION, **{
            name: [asdict(one, dict_factory=_plainly) for one in found] for name, found in (
                ('alarms', self._alarms.all),
                ('journal', self._alarms.journal(-math.inf)[::-1]))}}, indent=2, allow_nan=False)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(
            dir=self._path.parent, prefix=self._path.name, suffix='.part')
        try:
            with os.fdopen(descriptor, 'w', encoding='utf-8') as file:
                file.write(text + '\n')
                file.flush()
                os.fsync(descriptor)
                written = _identity(descriptor)
            if self._path.exists() and _identity(self._path) != self._own:
                raise FileExistsError(f'another program has written {self._path} since, and it is '
                                      'not replaced: give each panel its own alarm_file')
            os.replace(temporary, self._path)
            self._own = written
        except BaseException:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)
            raise


def _identity(of: Path | int) -> _Identity:
    found = os.stat(of)
    return found.st_dev, found.st_ino, found.st_mtime_ns, found.st_size


def _free(path: Path) -> Path:
    """Return a name beside a file that no other file has."""
    number, found = 1, path.with_name(f'{path.name}.damaged')
    while os.path.lexists(found):
        number, found = number + 1, path.with_name(f'{path.name}.damaged{number + 1}')
    return found


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
