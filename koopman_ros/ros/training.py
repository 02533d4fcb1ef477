# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training as the trainer offers it: on request, or as the one task of the process."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
import os
import sys
from typing import Any

from std_srvs.srv import Trigger

from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.paths import model_path
from koopman_ros.execution.training import (
    class_lines,
    constant_lines,
    JobState,
    scalars,
    TrainingJob,
    TrainingProgress,
)
from koopman_ros.model import LiftedModel, load
from koopman_ros.parameters.signal_topics import plant_defaults, SignalTopics, system_of
from koopman_ros.parameters.trainer import TrainerParameters
from koopman_ros.ros.diagnostics import Severity, TaskReport
from koopman_ros.ros.hosted import wall_timer
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.node import LoopNode

_POLL_PERIOD = 0.1  # s between two looks at a training


def current_model(given: Mapping[str, Any]) -> LiftedModel | None:
    """Return the lift in use by parameters that were given, None where there is none yet."""
    own = plant_defaults(system_of(given), 'trainer')
    name = str(given.get('model', own.get('model', '')))
    return load(model_path(name)) if name else None


def task_fields(node: LoopNode, settings: TrainerParameters, wiring: SignalTopics,
                bags: Iterable[str]) -> dict[str, Any]:
    """Return the fields of a `koopman_ros.learning.TrainingTask` of a trainer's parameters."""
    def found(place: MessageField) -> dict[str, str]:
        return {**asdict(place), 'topic': node.resolve_topic_name(place.topic)}

    def file(model: str) -> str:
        return os.path.abspath(model_path(model)) if model else ''

    states, inputs = wiring.signals.states, wiring.signals.inputs
    disturbances = wiring.signals.disturbances
    return {
        'bags': [os.path.abspath(bag) for bag in bags],
        'output': os.path.abspath(settings.model_output),
        'model': file(settings.model), 'plant': settings.system,
        'warm_start_model': file(settings.warm_start_model),
        'states': [{'name': name, 'unit': unit, 'place': found(wiring.measured[name])}
                   for name, unit in states.items()],
        'inputs': [{'name': name, 'unit': unit, 'command': found(wiring.commands[name]),
                    'measured': found(wiring.applied[name]),
                    'delay': delay} for (name, unit), delay in zip(
                        inputs.items(), settings.delay.tolist(), strict=True)] + [
            {'name': name, 'unit': unit, 'command': None,
             'measured': found(wiring.measured_disturbances[name])}
            for name, unit in disturbances.items()],
        'setpoints': settings.setpoint_ranges(wiring.signals),
        'tolerance': settings.synchronisation_tolerance,
        **settings.training(wiring.signals)}


class Training:
    """Retrain in a process of its own, on ``~/train``; ``~/cancel_training`` ends it."""

    def __init__(self, node: ManagedNode, settings: TrainerParameters, wiring: SignalTopics,
                 recorded: Callable[[], str],
                 on_end: Callable[[JobState], None] = lambda _: None) -> None:
        self.settings = settings  # of the next training
        self._node, self._wiring = node, wiring
        self._recorded, self._on_end = recorded, on_end
        self._job: TrainingJob | None = None
        self._state: JobState | None = None
        self._progress = TrainingProgress(node.get_logger().info)
        self._diagnostics = node.diagnostics.add('training', self._status)
        node.create_service(Trigger, '~/train', self._on_train)
        node.create_service(Trigger, '~/cancel_training', self._on_cancel)
        self._timer = wall_timer(node, _POLL_PERIOD, self._on_poll, autostart=False)

    def start(self) -> str:
        """Start a training, return a message; ValueError without a bag, OSError of the system."""
        settings = self.settings
        bags = [bag for bag in (settings.bags if any(settings.bags) else (self._recorded(),))
                if bag]
        if not bags:
            raise ValueError('no bag to train from: record one, or set bags')
        self._job = TrainingJob(task_fields(self._node, settings, self._wiring, bags))
        self._state = self._job.state
        self._progress = TrainingProgress(self._node.get_logger().info)
        self._timer.reset()
        announcement = f'training from {", ".join(bags)}'
        self._node.get_logger().info(announcement)
        return announcement

    def complete(self) -> None:
        """End a training that is under way, which keeps the best model so far."""
        if self._job is not None:
            self._job.close()
            # it may have ended well just before
            state = self._job.poll()
            self._job = None
            print(f'training: {state.text}', file=sys.stderr, flush=True)
            self._on_end(state)

    def _on_train(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._job is not None or self._node.rejection:
            response.message = self._node.rejection or 'already training'
            return response
        try:
            response.message, response.success = self.start(), True
        except (OSError, ValueError) as error:
            response.message = f'cannot train: {error}'
            self._node.get_logger().error(response.message)
        self._diagnostics.publish_if_changed()
        return response

    def _on_cancel(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._job is not None
        response.message = 'the training is being cancelled' if self._job else 'not training'
        if self._job is not None:
            self._job.cancel()
        return response

    def _on_poll(self) -> None:
        if self._job is None:
            return
        self._state = self._job.poll()
        self._progress.show(self._state)
        if not self._state.ended:
            return
        self._timer.cancel()
        self._job.close()
        self._job = None
        log = self._node.get_logger()
        # a line each, because rclpy allows one severity a line
        if self._state.accepted or self._state.cancelled:
            log.info(self._state.text)
        elif self._state.rejected:
            log.warning(self._state.text)
        else:
            log.error(self._state.text)
        summary = self._state.summary or {}
        for name, line in {**class_lines(summary), **constant_lines(summary)}.items():
            log.info(f'{name}: {line}')
        for warning in summary.get('warnings', ()):
            log.warning(warning)
        self._diagnostics.publish_if_changed()
        self._on_end(self._state)

    def _status(self) -> TaskReport:
        state = self._state
        if state is None:
            return TaskReport(Severity.OK, 'not training')
        values = {'done [%]': 100.0 * state.share, **scalars(state.summary or {})}
        if not state.ended:
            # the sentence stays while the figures move, or there would be a status a step
            return TaskReport(Severity.OK, state.text.split(',')[0],
                              {**values, 'step': state.text})
        return TaskReport(
            Severity.OK if state.accepted or state.cancelled else
            Severity.WARN if state.rejected else Severity.ERROR, state.text, values)
