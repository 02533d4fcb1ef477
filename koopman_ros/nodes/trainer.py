# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The trainer node: records the loop, drives the plant through experiments, trains from bags."""

import sys

from koopman_ros.jobs.training import JobState
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.parameters.trainer import TABLE, TrainerParameters
from koopman_ros.ros import topics
from koopman_ros.ros.experiment import CoolantExperiment
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.process import run
from koopman_ros.ros.recording import Recording
from koopman_ros.ros.training import Training


class TrainerNode(LoopNode):
    """Compose what the trainer does; docs/interfaces.md has its topics and services."""

    def __init__(self) -> None:
        super().__init__('trainer')
        settings = self.declare_table(TABLE)
        if reason := topics.unusable(self, settings.topics):
            raise ConfigurationError(reason)
        self._recording = Recording(self, settings)
        self._experiment = CoolantExperiment(self, settings)
        self._training = Training(self, settings, self._recording.flushed, self._on_trained)
        self.follow_table(TABLE, settings, self._on_parameters,
                          lambda changed, _: topics.unusable(self, changed.topics))
        try:
            if settings.task == 'train':
                self._training.start()
            elif settings.record_at_start:
                self._recording.start()
        except (OSError, ValueError) as error:
            raise ConfigurationError(f'cannot {settings.task}: {error}') from error

    def complete(self) -> None:
        """Leave the coolant safe, complete the bag with all that arrived, then end a training."""
        self._experiment.complete()
        # first, because a training may take seconds to end
        self._recording.complete()
        self._training.complete()

    def _on_trained(self, end: JobState) -> None:
        if self._training.settings.task == 'train':
            self.exit_code = 0 if end.accepted else 2 if end.refused else 1

    def _on_parameters(self, parameters: TrainerParameters) -> None:
        # a running recording keeps what it was started with, but for the room on the disk
        self._recording.settings = parameters
        # a running experiment keeps all
        self._experiment.settings = parameters
        self._training.settings = parameters


def main(args: list[str] | None = None) -> int:
    """Run the trainer node."""
    return run('trainer', TrainerNode, args)


if __name__ == '__main__':
    sys.exit(main())
