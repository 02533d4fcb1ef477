# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The panel's look at learning: the report of a training, and a replay beside a new model."""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import os
from pathlib import Path
import shutil
import stat
import tempfile
import threading
import time

from rclpy.node import Node
import yaml

from koopman_ros.execution.job import ReplayJob
from koopman_ros.panel.learning import (
    Comparison,
    Learning,
    read_comparison,
    read_report,
    report_base,
    report_state,
)
from koopman_ros.panel.requests import Answer
from koopman_ros.parameters.wire import CONTROLLER_EVENTS, Wiring

LAST = 3600.0  # s of the end of a bag that are compared
_PERIOD = 1.0  # s between two looks at the files of a report
_PREFIX = 'koopman_ros_panel_'  # of folders for a while, followed by the process that has them


def remove_leftovers() -> None:
    """Remove the folders of panels of this user that were ended by force."""
    for folder in Path(tempfile.gettempdir()).glob(f'{_PREFIX}*_*'):
        process = folder.name.removeprefix(_PREFIX).partition('_')[0]
        with contextlib.suppress(OSError, ValueError):
            about = folder.lstat()
            if stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid() and (
                    not Path(f'/proc/{int(process)}').exists()):
                shutil.rmtree(folder, ignore_errors=True)


class LearningWatch:
    """
    Keeps :class:`Learning` up to date.

    Files are read in a thread of its own, for a disk may be slow or gone; all methods are called
    from the main thread.
    """

    def __init__(self, node: Node, system: str, wiring: Wiring) -> None:
        remove_leftovers()
        self.learning = Learning()
        self._node, self._system, self._wiring = node, system, wiring
        self._place: tuple[str, Mapping[str, str]] = ('', {})
        self._bag = ''
        self._job: ReplayJob | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._cancelled = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name='reports', daemon=True)
        self._thread.start()

    def training(self, values: Mapping[str, str], output: str) -> None:
        """Take the figures of the trainer's status, and where it writes models."""
        told = values if 'accepted' in values else {}
        self._place = (told.get('model_file') or output, told)

    def recording(self, bag: str) -> None:
        """Take the bag that is being recorded."""
        self._bag = bag or self._bag

    def compare(self, model: str) -> Answer:
        """
        Begin to replay the bag that is being recorded, or was last, with the new model.

        :param model: the acting one, as the controller names it.
        """
        new = self._new_model()
        if self._job is not None:
            return Answer(False, 'a comparison is running')
        if not new:
            return Answer(False, 'there is no new model: train one')
        if not self._bag:
            return Answer(False, 'nothing was recorded since the panel was started: record first')
        self._clear()
        self._folder = tempfile.TemporaryDirectory(prefix=f'{_PREFIX}{os.getpid()}_')
        folder = Path(self._folder.name)
        given = {
            'system': self._system, 'bags': [self._bag], 'new_model': new, 'recover': True,
            'output': str(folder), 'last': LAST,
            # where models are that acted before
            'model': os.path.dirname(model) or os.path.dirname(new) or '.'}
        file = folder / 'replay.yaml'
        file.write_text(yaml.safe_dump({'/**': {'ros__parameters': given}}))
        places = dict.fromkeys((CONTROLLER_EVENTS, *(
            place.topic for place in self._wiring.commands.values())))
        remaps = [part for topic in places for part in (
            '-r', f'{topic}:={self._node.resolve_topic_name(topic)}')]
        try:
            self._job = ReplayJob(
                ['--ros-args', '--params-file', str(file), '-r',
                 f'__ns:={self._node.get_namespace()}', *remaps])
        except OSError as error:
            return Answer(False, f'the replay cannot be started: {error}')
        self._cancelled = False
        self.learning.comparison = Comparison(new, time.time(), running=True)
        return Answer(True, f'comparing {new} on {self._bag}')

    def cancel(self) -> Answer:
        """End a comparison."""
        if self._job is None:
            return Answer(False, 'nothing is being compared')
        self._cancelled = True
        self._job.cancel()
        return Answer(True, 'the comparison is being cancelled')

    def advance(self) -> None:
        """Take note of what has ended."""
        job, now = self._job, self.learning.comparison
        if job is None or job.running:
            return
        assert self._folder is not None
        self._job = None
        if self._cancelled:
            self.learning.comparison = Comparison(now.model, now.since, problem='cancelled')
        else:
            self.learning.comparison = read_comparison(
                Path(self._folder.name), now.model, now.since, job.said)
        self._clear()

    def complete(self) -> None:
        """End what is under way."""
        self._ended.set()
        if self._job is not None:
            self._job.close()
            self._job = None
        self._clear()
        self._thread.join(_PERIOD)

    def _clear(self) -> None:
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _new_model(self) -> str:
        _, told = self._place
        report = self.learning.report
        return told.get('model_file', '') if told else report.model_file if report else ''

    def _watch(self) -> None:
        last: object = None
        while not self._ended.wait(_PERIOD):
            name, told = self._place
            base = report_base(name)
            if base is None:
                continue
            found = (base, dict(told), report_state(base))
            if found == last:
                continue
            last = found
            # a trainer that has not trained yet has no report
            if told or any(any(one) for one in found[2]):
                self.learning.report = read_report(base, told)
