# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The trainer node: records the loop to a bag."""

from __future__ import annotations

import datetime
import sys

from koopman_ros.bags import BagWriter
from koopman_ros.nodes.diagnostics import DiagnosticsPublisher, Level, Status
from koopman_ros.nodes.parameters import ConfigurationError
from koopman_ros.nodes.process import LoopNode, run
from koopman_ros.nodes.recorder import Recorder
from koopman_ros.nodes.trainer_parameters import TABLE, TrainerParameters
from rclpy.clock import Clock, ClockType
from std_srvs.srv import SetBool

_LOOK_PERIOD = 0.2  # s, for new publishers
_FLUSH_PERIOD = 0.5  # s; what a killed process may lose


class TrainerNode(LoopNode):
    """Record topics from raw subscriptions; see the README for topics and services."""

    def __init__(self) -> None:
        super().__init__('trainer', automatically_declare_parameters_from_overrides=True)
        self._settings = TABLE.declare(self)
        self._recorder: Recorder | None = None
        self._problem = ''
        self._diagnostics = DiagnosticsPublisher(self, 'recording', 'trainer', self._status)
        self.create_service(SetBool, '~/record', self._on_record)
        wall_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_LOOK_PERIOD, self._on_look, clock=wall_clock)
        self.create_timer(_FLUSH_PERIOD, self._on_flush, clock=wall_clock)
        TABLE.follow(self, self._settings, self._on_parameters)
        if self._settings.record_at_start:
            try:
                self._start()
            except (OSError, ValueError) as error:
                raise ConfigurationError(f'cannot record: {error}') from error

    def complete(self) -> None:
        """Complete the bag with all that has arrived."""
        if self._recorder is not None:
            self._close(self._recorder)

    def _start(self) -> str:
        # to the millisecond: recordings may follow each other quickly
        output = self._settings.output or datetime.datetime.now().strftime(
            'koopman_ros_%Y_%m_%d-%H_%M_%S_%f')[:-3]
        writer = BagWriter(output, compression=self._settings.compression)
        self._problem = ''
        self._recorder = Recorder(self, writer, self._settings.topics, self._on_failure)
        said = f'recording to {output}'
        self.get_logger().info(said)
        return said

    def _stop(self) -> str:
        assert self._recorder is not None
        recorder, self._recorder = self._recorder, None
        self._close(recorder)
        said = f'recorded {sum(recorder.counts.values())} messages to {recorder.path}'
        self.get_logger().info(said)
        return said

    def _on_failure(self, error: Exception) -> None:
        """Give a recording up; what was flushed before stays readable."""
        assert self._recorder is not None
        recorder, self._recorder = self._recorder, None
        self._problem = (f'recording to {recorder.path} stopped: {error}; free some space and '
                         'call ~/record again')
        self.get_logger().error(self._problem)
        self._close(recorder)
        self._diagnostics.publish_if_changed()

    def _close(self, recorder: Recorder) -> None:
        try:
            recorder.close()
        except OSError as error:
            said = f'{recorder.path} is not complete: {error}'
            self.get_logger().error(said)
            # what went wrong first tells more
            self._problem = self._problem or said

    def _on_record(self, request: SetBool.Request, response: SetBool.Response
                   ) -> SetBool.Response:
        recording = self._recorder is not None
        response.success = request.data != recording
        if not response.success:
            response.message = 'already recording' if recording else 'not recording'
            return response
        try:
            response.message = self._start() if request.data else self._stop()
        except (OSError, ValueError) as error:
            response.success, response.message = False, str(error)
            self._problem = f'cannot record: {error}'
            self.get_logger().error(self._problem)
        self._diagnostics.publish_if_changed()
        return response

    def _on_look(self) -> None:
        if self._recorder is not None:
            self._recorder.look_for_publishers()

    def _on_flush(self) -> None:
        if self._recorder is not None:
            self._recorder.flush()

    def _on_parameters(self, parameters: TrainerParameters) -> None:
        # a running recording keeps what it was started with
        self._settings = parameters

    def _status(self) -> Status:
        if self._recorder is None:
            return Status(Level.ERROR, self._problem) if self._problem else Status(
                Level.OK, 'not recording')
        counts = self._recorder.counts
        return Status(Level.OK, f'recording to {self._recorder.path}', {
            'messages': sum(counts.values()),
            **{f'messages on {topic}': count for topic, count in counts.items()}})


def main(args: list[str] | None = None) -> int:
    """Run the trainer node."""
    return run('trainer', TrainerNode, args)


if __name__ == '__main__':
    sys.exit(main())
