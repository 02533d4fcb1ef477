# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Follows the report of the training, and replays the recording with a new model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import os
from pathlib import Path
import tempfile
import threading
import time

import yaml

from koopman_ros.execution.job import ReplayJob
from koopman_ros.panel.requests import Answer
from koopman_ros.panel.training_report import (
    Learning,
    read_comparison,
    read_report,
    ReplayComparison,
    report_base,
    report_time,
)
from koopman_ros.parameters.signal_topics import EVENT_LOG, SignalTopics

LAST = 3600.0  # s of the end of a bag that are compared


class LearningWatch:
    """
    Keeps :class:`Learning` up to date.

    :param resolve: full name of a topic.
    """

    def __init__(self, system: str, wiring: SignalTopics, namespace: str,
                 resolve: Callable[[str], str]) -> None:
        self.learning = Learning()
        self._system, self._wiring = system, wiring
        self._namespace, self._resolve = namespace, resolve
        self._model_file = self._bag = ''
        self._job: ReplayJob | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._cancelled = False
        self._read: object = None  # the report that was read last
        self._reader: threading.Thread | None = None

    def training(self, values: Mapping[str, str], output: str) -> None:
        """Take the figures of the trainer's status, and the file of its next model."""
        trained = values if 'accepted' in values else {}
        self._model_file = trained.get('model_file', '')
        base = report_base(self._model_file or output)
        # a disk that does not answer must not stop the pages; the status is repeated
        if base is not None and (self._reader is None or not self._reader.is_alive()):
            self._reader = threading.Thread(
                target=self._follow, args=(base, trained), daemon=True)
            self._reader.start()

    def _follow(self, base: Path, trained: Mapping[str, str]) -> None:
        """Read a report if it has changed; called in a thread of its own."""
        found = base, trained, report_time(base)
        # a trainer that has not trained yet has no report
        if found != self._read and (trained or found[2]):
            self.learning.report = read_report(base, trained)
        self._read = found

    def recording(self, bag: str) -> None:
        """Take the bag of the recording, empty for none."""
        self._bag = bag or self._bag

    def compare(self, model: str) -> Answer:
        """
        Start a replay of the last recording with the new model.

        :param model: the active one, as the controller names it.
        """
        report = self.learning.report
        new = self._model_file or (report.model_file if report else '')
        if self._job is not None:
            return Answer(False, 'a comparison is running')
        if not new:
            return Answer(False, 'no new model: train one first')
        if not self._bag:
            return Answer(False, 'nothing was recorded since the panel started: record first')
        self._folder = tempfile.TemporaryDirectory(prefix='koopman_ros_panel_')
        folder = Path(self._folder.name)
        parameters = {
            'system': self._system, 'bags': [self._bag], 'new_model': new, 'recover': True,
            'output': str(folder), 'last': LAST,
            # the folder of earlier models
            'model': os.path.dirname(model) or os.path.dirname(new) or '.'}
        file = folder / 'replay.yaml'
        file.write_text(yaml.safe_dump({'/**': {'ros__parameters': parameters}}))
        topics = dict.fromkeys((EVENT_LOG, *(
            place.topic for place in self._wiring.commands.values())))
        remaps = [part for topic in topics for part in (
            '-r', f'{topic}:={self._resolve(topic)}')]
        try:
            self._job = ReplayJob(['--ros-args', '--params-file', str(file), '-r',
                                   f'__ns:={self._namespace}', *remaps])
        except OSError as error:
            self._folder.cleanup()
            return Answer(False, f'the replay cannot be started: {error}')
        self._cancelled = False
        self.learning.comparison = ReplayComparison(model=new, since=time.time(), running=True)
        return Answer(True, f'comparing {new} on {self._bag}')

    def cancel(self) -> Answer:
        """Cancel the comparison."""
        if self._job is None:
            return Answer(False, 'no comparison is running')
        self._cancelled = True
        self._job.cancel()
        return Answer(True, 'the comparison is being cancelled')

    def advance(self) -> None:
        """Take the result of a replay that has ended."""
        if self._job is None or self._job.running or self._folder is None:
            return
        now = self.learning.comparison
        self.learning.comparison = ReplayComparison(
            'cancelled', model=now.model, since=now.since) if self._cancelled else read_comparison(
                Path(self._folder.name), now.model, now.since, self._job.last_output)
        self._job = None
        self._folder.cleanup()

    def complete(self) -> None:
        """End the replay."""
        if self._job is not None and self._folder is not None:
            self._job.close()
            self._job = None
            self._folder.cleanup()
