# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""File in which trends, events and actions outlast the panel."""

from dataclasses import asdict
import io
import json
import math
import os
from pathlib import Path
from typing import Any
import zipfile

import numpy as np

from koopman_ros.core.paths import write_atomically
from koopman_ros.panel.files import read_bounded
from koopman_ros.panel.requests import AuditEntry
from koopman_ros.panel.view_model import LoopViewModel

_BUCKETS = 2_000  # of each pen, with up to four values each
_MAX_BYTES = 128 * 2 ** 20
_INTERVAL = 60.0  # s between two writes
_TEXTS = 'koopman_ros panel'  # name of the array with events and actions


class HistoryFile:
    """
    Loads the history of a loop from a file, and saves it every minute.

    The file is bounded: of a long history it holds the extremes of each pen.

    :param path: of the file, which may be missing.
    :ivar complaint: always empty, because a damaged file is an error.
    :param now: wall time.
    :raises ValueError: for a file that no panel wrote, which is not replaced.
    :raises OSError: for a file that cannot be read, or a folder that cannot be written.
    """

    complaint = ''

    def __init__(self, view: LoopViewModel, path: Path, now: float) -> None:
        self._view, self._path, self._due = view, Path(os.path.realpath(path)), now + _INTERVAL
        if self._path.exists():
            try:
                self._load(read_bounded(self._path, _MAX_BYTES)[0])
            except (KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
                raise ValueError(f'it holds no history of a panel: {error}') from error
        self.close()

    def _load(self, content: bytes) -> None:
        with np.load(io.BytesIO(content), allow_pickle=False) as found:
            texts = json.loads(str(found[_TEXTS]))
            trends = self._view.trends
            for name in found.files:
                if name != _TEXTS:
                    for time, value in found[name].T.tolist():
                        trends.add(name, time, value)
        trends.interrupt()
        for mark in texts['marks']:
            trends.mark(float(mark['time']), str(mark['kind']), str(mark['text']))
        for entry in texts['audit']:
            self._view.take_action(AuditEntry(**entry))

    def save(self, now: float) -> None:
        """Save the history every minute; to be called more often."""
        # a clock that was set back does not delay it
        if not self._due - _INTERVAL <= now < self._due:
            self._due = now + _INTERVAL
            self.close()

    def close(self) -> None:
        """Save the history."""
        trends = self._view.trends
        pens = trends.window(trends.pens, -math.inf, math.inf, _BUCKETS)
        text = json.dumps({'marks': [asdict(one) for one in trends.marks(-math.inf, math.inf)],
                           'audit': [asdict(one) for one in self._view.audit]})
        content = io.BytesIO()
        arrays: dict[str, Any] = {
            _TEXTS: np.array(text),
            **{name: np.array(of) for name, of in pens.items() if len(of[0])}}
        np.savez(content, **arrays)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self._path, content.getvalue(), 0o600)
