# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recording by the trainer: starts and stops, names, disk space, errors."""

from collections.abc import Callable, Mapping
import contextlib
import datetime
from functools import partial
import os
from pathlib import Path
import shutil

from std_srvs.srv import SetBool

from koopman_ros.parameters.signal_topics import SignalTopics
from koopman_ros.parameters.trainer import TrainerParameters
from koopman_ros.records import BagWriter
from koopman_ros.ros import topics
from koopman_ros.ros.diagnostics import Severity, TaskReport
from koopman_ros.ros.hosted import wall_timer
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.recorder import Recorder

_TAKE_PERIOD = 0.05  # s, for new messages
_LOOK_PERIOD = 0.2  # s, for new publishers
_FLUSH_PERIOD = 0.5  # s; the longest time that a killed process loses
_MEGABYTE = 1_000_000


class Recording:
    """Record the loop to one bag after another, on ``~/record``; reports by diagnostics."""

    def __init__(self, node: ManagedNode, settings: TrainerParameters,
                 wiring: SignalTopics) -> None:
        self.settings = settings  # of the next recording
        self._node, self._known = node, topics.expected_topics(wiring)
        self._recorder: Recorder | None = None
        self._problem = self._path = ''
        self._diagnostics = node.diagnostics.add('recording', self._status)
        node.create_service(SetBool, '~/record', self._on_record)
        self._timers = [
            wall_timer(node, period, partial(self._attempt, work), autostart=False)
            for period, work in ((_TAKE_PERIOD, Recorder.take), (_FLUSH_PERIOD, self._flush),
                                 (_LOOK_PERIOD, Recorder.look_for_publishers))]

    def start(self) -> str:
        """Start a bag and return a sentence that names it; OSError without room, e.g."""
        # to the millisecond: recordings may follow each other quickly
        requested = Path(self.settings.output or datetime.datetime.now().strftime(
            'koopman_ros_%Y_%m_%d-%H_%M_%S_%f')[:-3])
        output = free_name(requested)
        if reason := self._too_little_room(output):
            raise OSError(f'{reason}: free some space, or choose another disk')
        writer = BagWriter(
            output, compression=self.settings.compression,
            max_file_bytes=round(self.settings.max_bag_size * _MEGABYTE),
            max_file_duration_s=self.settings.max_bag_duration)
        self._problem = ''
        self._recorder = Recorder(self._node, writer, self.settings.topics, self._known)
        self._path = str(output)
        for timer in self._timers:
            timer.reset()
        text = f'recording to {output}'
        if output == requested:
            self._node.get_logger().info(text)
        else:
            text += f', because {requested} already exists'
            self._node.get_logger().warning(text)
        return text

    def stop(self) -> str:
        """Complete the bag and return a sentence that counts it; OSError when that fails."""
        recorder = self._end()
        if self._problem:
            raise OSError(self._problem)
        text = f'recorded {sum(recorder.counts.values())} messages to {self._path}'
        if missed := _missed_text(recorder.missed):
            text += f'; {missed}'
            self._node.get_logger().warning(text)
        else:
            self._node.get_logger().info(text)
        return text

    def flushed(self) -> str:
        """Return the path of the present or the last bag with all of it on disk, or ''."""
        self._attempt(Recorder.flush)
        return self._path

    def complete(self) -> None:
        """Complete an open bag with all received messages, and report its content."""
        if self._recorder is not None:
            with contextlib.suppress(OSError):
                self.stop()

    def _end(self) -> Recorder:
        assert self._recorder is not None
        recorder, self._recorder = self._recorder, None
        for timer in self._timers:
            timer.cancel()
        try:
            recorder.close()
        except (OSError, LookupError) as error:
            text = f'{self._path} is not complete: {error}'
            self._node.get_logger().error(text)
            # the first error tells more
            self._problem = self._problem or text
        return recorder

    def _attempt(self, work: Callable[[Recorder], None]) -> None:
        """Run a part of the recording; an error ends it, flushed messages stay readable."""
        if self._recorder is None:
            return
        try:
            work(self._recorder)
        except (OSError, LookupError) as error:
            remedy = 'free some space and ' if isinstance(error, OSError) else ''
            self._problem = (f'recording to {self._path} stopped: {error}; {remedy}call '
                             '~/record again')
            self._node.get_logger().error(self._problem)
            self._end()
            self._diagnostics.publish_if_changed()

    def _flush(self, recorder: Recorder) -> None:
        recorder.flush()
        if reason := self._too_little_room(Path(self._path)):
            raise OSError(reason)

    def _on_record(self, request: SetBool.Request, response: SetBool.Response
                   ) -> SetBool.Response:
        if reason := self._node.rejection:
            response.success, response.message = False, reason
            return response
        recording = self._recorder is not None
        response.success = request.data != recording
        if not response.success:
            response.message = 'already recording' if recording else 'not recording'
            return response
        try:
            response.message = self.start() if request.data else self.stop()
        except (OSError, ValueError) as error:
            response.success, response.message = False, str(error)
            self._problem = f'cannot record: {error}' if request.data else str(error)
            self._node.get_logger().error(self._problem)
        self._diagnostics.publish_if_changed()
        return response

    def _too_little_room(self, output: Path) -> str:
        limit = self.settings.min_free_disk
        if not limit:
            return ''
        folder = next(parent for parent in output.absolute().parents if parent.is_dir())
        free = shutil.disk_usage(folder).free / _MEGABYTE
        return '' if free >= limit else (
            f'{free:.0f} MB are free on the disk of {folder}, less than min_free_disk = '
            f'{limit:.10g} MB')

    def _status(self) -> TaskReport:
        if self._recorder is None:
            return TaskReport(Severity.ERROR, self._problem) if self._problem else TaskReport(
                Severity.OK, 'not recording')
        counts = self._recorder.counts
        missed = self._recorder.missed
        complaints = [*filter(None, (self._recorder.complaint, _missed_text(missed)))]
        return TaskReport(Severity.WARN if complaints else Severity.OK,
                          '; '.join([f'recording to {self._path}', *complaints]), {
            'bag': os.path.abspath(self._path),
            'messages': sum(counts.values()),
            'missed messages': sum(missed.values()),
            **{f'messages on {topic}': count for topic, count in counts.items()}})


def _missed_text(missed: Mapping[str, int]) -> str:
    return '' if not missed else (
        f'missed {", ".join(f"{count} messages on {topic}" for topic, count in missed.items())}: '
        'lower the load of this machine, or increase the queue depth of the publisher')


def free_name(requested: Path) -> Path:
    """Return the path, or the first of run_2, run_3, ... (run_2.mcap, ...) that does not exist."""
    path, number = requested, 1
    while os.path.lexists(path):
        number += 1
        path = requested.with_name(f'{requested.stem}_{number}.mcap' if requested.suffix == '.mcap'
                                   else f'{requested.name}_{number}')
    return path
