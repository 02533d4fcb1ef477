# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Identification experiments as the trainer does them: on its service, with words for each end."""

from __future__ import annotations

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_srvs.srv import SetBool

from koopman_ros.experiment import level, Phase
from koopman_ros.parameters.trainer import TrainerParameters
from koopman_ros.reasons import Reason
from koopman_ros.ros import topics
from koopman_ros.ros.diagnostics import DiagnosticsPublisher, Level, OPERATOR, Status
from koopman_ros.ros.experiment_run import ExperimentRun, other_publishers
from koopman_ros.ros.owned import Owned
from koopman_ros.units import in_celsius, to_celsius


class CoolantExperiment:
    """
    Drive the coolant with random steps on the service ``~/experiment``; reports by diagnostics.

    Every temperature is answered with a command of the same stamp. When the steps are over, for
    whatever reason, the coolant returns to the safe temperature along the rate limit and is held
    there until the service is called with false once more, or another node commands it. Two
    commanders are worse than none: beside another publisher no experiment starts, and when one
    comes the experiment stops at once and leaves the coolant to it.

    :param node: whose executor does the work.
    :param settings: what the next experiment starts with; the node replaces it when they change.
    """

    def __init__(self, node: Node, settings: TrainerParameters) -> None:
        self.settings = settings
        self._node = node
        self._run: ExperimentRun | None = None
        self._outcome = Status(Level.OK, 'no experiment')
        self._diagnostics = DiagnosticsPublisher(node, 'experiment', 'trainer', self._status)
        # a group of its own: the service waits for the first measurement
        self._owned = Owned(node)
        self._owned.keep(node.create_service(
            SetBool, '~/experiment', self._on_service,
            callback_group=MutuallyExclusiveCallbackGroup()))

    def complete(self) -> None:
        """Leave the coolant at the safe temperature; publishes the last command."""
        if self._run is not None:
            self._run.farewell()

    def destroy(self) -> None:
        """Take the service down, and a run with it: the coolant is left where it is."""
        self._let_go(self._outcome)
        self._owned.destroy()
        self._diagnostics.destroy()

    async def _on_service(self, request: SetBool.Request, response: SetBool.Response
                          ) -> SetBool.Response:
        if not request.data:
            response.success, response.message = self._stop()
        elif self._run is not None and self._run.running:
            response.message = 'an experiment is running: call with false to end it'
        else:
            reason = self._start()
            if self._run is not None:
                reason = OPERATOR(await self._run.started)
            response.success = not reason
            response.message = f'refused: {reason}' if reason else (
                f'running on {self._node.resolve_topic_name(self.settings.experiment_topic)}')
            if reason:
                self._let_go(Status(Level.WARN, response.message))
        self._say(response.message)
        return response

    def _start(self) -> str:
        """Take the coolant in hand, or return why not."""
        if self._run is not None:
            self._let_go(self._outcome)
        topic = self._node.resolve_topic_name(self.settings.experiment_topic)
        if others := other_publishers(self._node, topic):
            return f'{others} publishes on {topic}: end it, or choose another experiment_topic'
        answers = self._node.resolve_topic_name(topics.COOLANT_SETPOINT)
        if topic != answers and not self._node.count_publishers(answers):
            return (f'nobody publishes on {answers}: start the controller and switch it to '
                    'manual mode')
        self._run = ExperimentRun(self._node, self.settings, self._on_change, self._on_loss)
        self._diagnostics.publish_if_changed()
        return ''

    def _stop(self) -> tuple[bool, str]:
        """End the steps, or let go of the coolant when they are over."""
        if self._run is None:
            return False, 'no experiment is running'
        safe = in_celsius(self._run.plan.safe_input)
        if self._run.running:
            self._run.stop(Phase.ENDED)
            return True, (f'ended: the coolant returns to {safe} and is held there; call again '
                          'to let go of it')
        self._let_go(self._verdict(self._run))
        return True, 'the trainer does not command the coolant any more'

    def _on_change(self) -> None:
        assert self._run is not None
        self._say(self._verdict(self._run).message)

    def _on_loss(self, why: Reason) -> None:
        """Stop commanding at once; an experiment that was over is over as it was."""
        run = self._run
        assert run is not None
        if run.progress is None:
            if not run.started.done():
                run.started.set_result(why)
            return
        run.stop(Phase.ABORTED, why)
        self._let_go(self._verdict(run))
        self._say(f'the trainer does not command the coolant any more: {OPERATOR(why)}')

    def _let_go(self, outcome: Status) -> None:
        self._outcome = outcome
        run, self._run = self._run, None
        if run is not None:
            run.destroy()

    def _say(self, sentence: str) -> None:
        # two lines, because rclpy allows one severity a line
        if self._status().level is Level.OK:
            self._node.get_logger().info(f'experiment: {sentence}')
        else:
            self._node.get_logger().warning(f'experiment: {sentence}')
        self._diagnostics.publish_if_changed()

    def _verdict(self, run: ExperimentRun) -> Status:
        if run.progress is None:
            return Status(Level.OK, 'waiting for the first measurement')
        if run.progress.phase is Phase.ABORTED:
            return Status(Level.ERROR, f'aborted: {OPERATOR(run.progress.reason)}')
        return Status(Level.OK, run.progress.phase.value)

    def _status(self) -> Status:
        run = self._run
        if run is None or run.progress is None:
            return self._outcome if run is None else self._verdict(run)
        verdict = self._verdict(run)
        held = '' if run.running else (
            f'; the coolant returns to {in_celsius(run.plan.safe_input)} and is held there')
        left = max(0.0, run.plan.duration - run.progress.elapsed) if run.running else 0.0
        return Status(verdict.level, verdict.message + held, {
            'topic': run.topic,
            'level [degC]': to_celsius(level(run.plan, run.progress)),
            'coolant [degC]': to_celsius(run.progress.command),
            'left [s]': left,
            'seed': run.plan.seed,
        })
