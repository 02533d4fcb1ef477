# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The trainer node: records the loop, drives the plant through experiments, trains from bags."""

import sys
from typing import Any

from koopman_ros.execution.training import JobState
from koopman_ros.parameters.signal_topics import SIGNALS, SignalTopics
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.parameters.trainer import TrainerParameters
from koopman_ros.parameters.trainer_table import trainer_signals, trainer_table
from koopman_ros.ros import topics
from koopman_ros.ros.experiment import PlantExperiment
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.process import run
from koopman_ros.ros.recording import Recording
from koopman_ros.ros.signals import by_topic
from koopman_ros.ros.training import current_model, Training


class TrainerNode(ManagedNode):
    """Combine recording, experiments and training; see docs/reference/interfaces.md."""

    def __init__(self, **options: Any) -> None:
        super().__init__('trainer', **options)
        given = self.given()
        present = current_model(given)
        table = trainer_table(present, given)
        self._table, self._present = table, present
        self._recording: Recording | None = None
        self._experiment: PlantExperiment | None = None
        self._training: Training | None = None
        # last command of each input, which stays in force while the node is not configured
        self._commanded: dict[str, float] = {}
        self.declare_table(table)

    def configure(self) -> None:
        """Create recording, experiments and training; none of them starts yet."""
        table, present = self._table, self._present
        self._settings = settings = self.current(table)
        if reason := topics.unusable(self, settings.topics):
            raise ConfigurationError(reason)
        signals = trainer_signals(present, {
            name: getattr(settings, name) for name in SIGNALS})
        self.diagnostics.hardware_id = settings.system if present is None else (
            present.provenance.plant or settings.system)
        wiring = SignalTopics.of(signals, settings)
        for kind in wiring.kinds:
            # a field that its message type lacks is rejected now, not when a bag holds nothing
            list(by_topic(getattr(wiring, kind)))
        self._recording = Recording(self, settings, wiring)
        self._experiment = PlantExperiment(self, settings, wiring, self._commanded)
        self._training = Training(
            self, settings, wiring, self._recording.flushed, self._on_trained)
        self.follow_table(table, settings, self._on_parameters,
                          lambda changed, _: topics.unusable(self, changed.topics))

    def activate(self) -> None:
        """Start the task of the parameters."""
        settings = self._settings
        assert self._training and self._recording
        try:
            if settings.task == 'train':
                self._training.start()
            elif settings.record_at_start:
                self._recording.start()
        except (OSError, ValueError) as error:
            raise ConfigurationError(f'cannot {settings.task}: {error}') from error

    def deactivate(self) -> None:
        """End recording, experiment and training, as at the end of the process."""
        self.complete()

    def complete(self) -> None:
        """Leave the inputs safe, complete the bag with all that arrived, then end a training."""
        if self._experiment is None or self._recording is None or self._training is None:
            return
        self._experiment.complete()
        # first, because a training may take seconds to end
        self._recording.complete()
        self._training.complete()

    def _on_trained(self, end: JobState) -> None:
        if self._settings.task == 'train' and self.active:
            self.exit_code = 0 if end.accepted else 2 if end.rejected else 1

    def _on_parameters(self, parameters: TrainerParameters) -> None:
        self._settings = parameters
        assert self._recording and self._experiment and self._training
        # a running recording keeps its parameters, except the free disk space
        self._recording.settings = parameters
        # a running experiment keeps all
        self._experiment.settings = parameters
        self._training.settings = parameters


def main(args: list[str] | None = None) -> int:
    """Run the trainer node."""
    return run('trainer', TrainerNode, args)


if __name__ == '__main__':
    sys.exit(main())
