# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Service and status of the trainer's identification experiments."""

from __future__ import annotations

import math

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_srvs.srv import SetBool

from koopman_ros.control.experiment import ExperimentPhase, level
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.parameters.signal_topics import SignalTopics, words_of
from koopman_ros.parameters.trainer import MANUAL, SETPOINT, TrainerParameters
from koopman_ros.ros import topics
from koopman_ros.ros.diagnostics import Severity, TaskReport
from koopman_ros.ros.experiment_run import ExperimentRun, other_publishers, stepped
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.signals import SignalSample, SignalSubscriber


class PlantExperiment:
    """
    Drive the plant with random steps on the service ``~/experiment``; reports by diagnostics.

    The steps begin at the present inputs. Afterwards the inputs return to their safe values along
    the rate limit, or the set-points to their former values, and are held there until the service
    is called with false again, or another publisher appears.

    :param commanded: last command of each input by name, of any node; kept up to date.
    """

    def __init__(self, node: ManagedNode, settings: TrainerParameters, wiring: SignalTopics,
                 commanded: dict[str, float] | None = None) -> None:
        self.settings = settings  # of the next experiment
        self._node, self._wiring = node, wiring
        self._words = words_of(wiring.signals)
        self._run: ExperimentRun | None = None
        self._outcome = TaskReport(Severity.OK, 'no experiment')
        self._diagnostics = node.diagnostics.add('experiment', self._status)
        self._commanded = {} if commanded is None else commanded
        # best effort fits every publisher
        qos = topics.profile(1, reliable=False)
        SignalSubscriber(node, lambda topic, callback, kind: node.create_subscription(
            kind, topic, callback, qos), wiring.commands, wiring.signals.inputs, self._on_command)
        # a group of its own: the service waits for the first measurement
        node.create_service(SetBool, '~/experiment', self._on_service,
                            callback_group=MutuallyExclusiveCallbackGroup())

    def complete(self) -> None:
        """Return the inputs as far as the rate limit allows in 2 s, then stop commanding."""
        run = self._run
        if run is not None:
            run.stop(ExperimentPhase.ENDED)
            run.return_before_exit()
            self._release(self._verdict(run))

    def _on_command(self, received: SignalSample) -> None:
        self._commanded |= {name: value for name, value in received.values.items()
                            if math.isfinite(value)}

    async def _on_service(self, request: SetBool.Request, response: SetBool.Response
                          ) -> SetBool.Response:
        if reason := self._node.rejection:
            response.message = reason
        elif not request.data:
            response.success, response.message = self._stop()
        elif self._run is not None and self._run.running:
            response.message = 'an experiment is running: call with data: false to end it'
        else:
            reason = self._start()
            if self._run is not None:
                reason = self._words(await self._run.started)
            response.success = not reason
            response.message = f'rejected: {reason}' if reason else (
                f'started on {self._run.topics if self._run else ""}')
            if reason:
                self._release(TaskReport(Severity.WARN, response.message))
        self._report(response.message)
        return response

    def _start(self) -> str:
        """Start a run; return the reason if it cannot start."""
        self._release(self._outcome)
        resolve = self._node.resolve_topic_name
        for place in stepped(self.settings, self._wiring).values():
            topic = resolve(place.topic)
            if others := other_publishers(self._node, topic):
                return (f'{others} publishes on {topic}: stop it, or choose another '
                        'experiment_signal')
        if self.settings.experiment_signal in (MANUAL, SETPOINT):
            answers = resolve(next(iter(self._wiring.commands.values())).topic)
            if not self._node.count_publishers(answers):
                mode = 'manual' if self.settings.experiment_signal == MANUAL else 'automatic'
                return (f'{answers} is not published: start the controller and switch it to '
                        f'{mode} mode')
        try:
            self._run = ExperimentRun(
                self._node, self.settings, self._wiring, self._commanded, self._on_end)
        except ValueError as error:
            return str(error)
        self._diagnostics.publish_if_changed()
        return ''

    def _stop(self) -> tuple[bool, str]:
        """End the steps, or stop commanding if the steps have ended."""
        if self._run is None:
            return False, 'no experiment is running'
        if self._run.running:
            self._run.stop(ExperimentPhase.ENDED)
            return True, (f'ended: {self._run.return_text}; end it once more to release the '
                          'inputs')
        self._release(self._verdict(self._run))
        return True, 'the trainer has released the inputs'

    def _on_end(self, why: Reason | None) -> None:
        """Report the end of the steps, or stop commanding at once for a reason."""
        run = self._run
        assert run is not None
        if why is None:
            self._report(self._verdict(run).message)
            return
        # an experiment that was over is over as it was
        run.stop(ExperimentPhase.ABORTED, why)
        self._release(self._verdict(run))
        self._report(f'the trainer has released the inputs: {self._words(why)}')

    def _release(self, outcome: TaskReport) -> None:
        run, self._run = self._run, None
        self._outcome = outcome
        if run is not None:
            run.destroy()
            if not run.started.done():
                run.started.set_result(reason(StatusCode.ENDED_EARLY))

    def _report(self, sentence: str) -> None:
        # two lines, because rclpy allows one severity a line
        if self._status().level is Severity.OK:
            self._node.get_logger().info(f'experiment: {sentence}')
        else:
            self._node.get_logger().warning(f'experiment: {sentence}')
        self._diagnostics.publish_if_changed()

    def _verdict(self, run: ExperimentRun) -> TaskReport:
        if run.progress is None:
            return TaskReport(Severity.OK, 'waiting for the first measurement')
        if run.progress.phase is ExperimentPhase.ABORTED:
            return TaskReport(Severity.ERROR, f'aborted: {self._words(run.progress.reason)}')
        return TaskReport(Severity.OK, run.progress.phase.value)

    def _status(self) -> TaskReport:
        run = self._run
        if run is None:
            return self._outcome
        verdict = self._verdict(run)
        if run.progress is None:
            return verdict
        held = '' if run.running else f'; {run.return_text}'
        left = max(0.0, run.plan.duration - run.progress.elapsed) if run.running else 0.0
        return TaskReport(verdict.level, verdict.message + held, {
            'topic': run.topics,
            **run.figures('level', level(run.plan, run.progress)),
            **run.figures('command', run.progress.command),
            'left [s]': left,
            'seed': run.plan.seed,
        })
