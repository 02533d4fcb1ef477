# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Identification experiments as the trainer does them: on its service, with words for each end."""

from __future__ import annotations

from collections.abc import Callable
import time

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_srvs.srv import SetBool

from koopman_ros.arrays import Array
from koopman_ros.experiment import advance, begin, end, Following, level, Phase, Progress
from koopman_ros.parameters.trainer import TrainerParameters
from koopman_ros.reasons import Code, Reason, reason
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_message, stamp_nanoseconds, temperature_message
from koopman_ros.ros.node import DiagnosticsPublisher, Level, OPERATOR, Owned, Status
from koopman_ros.units import in_celsius, NANOSECONDS, to_celsius, to_kelvin

_TICK = 0.1  # s
_ASTRAY = 10  # commands of a controller, and
_ASTRAY_TIME = 1.0  # s, after which it is said not to follow
_FAREWELL = 0.2  # s in which a last measurement is answered


class CoolantExperiment:
    """
    Drive the coolant with random steps on the service ``~/experiment``; reports by diagnostics.

    When the steps are over, the coolant returns to the safe temperature along the rate limit and
    is held there until the service is called with false once more, or another publisher comes.
    """

    def __init__(self, node: Node, settings: TrainerParameters) -> None:
        self.settings = settings  # of the next experiment
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
        self._let_go(self._outcome)
        topic = self._node.resolve_topic_name(self.settings.experiment_topic)
        if others := other_publishers(self._node, topic):
            return f'{others} publishes on {topic}: end it, or choose another experiment_topic'
        answers = self._node.resolve_topic_name(topics.COOLANT_SETPOINT)
        if topic != answers and not self._node.count_publishers(answers):
            return (f'nobody publishes on {answers}: start the controller and switch it to '
                    'manual mode')
        self._run = ExperimentRun(self._node, self.settings, self._on_end)
        self._diagnostics.publish_if_changed()
        return ''

    def _stop(self) -> tuple[bool, str]:
        """End the steps, or let go of the coolant when they are over."""
        if self._run is None:
            return False, 'no experiment is running'
        safe = in_celsius(float(self._run.plan.home[0]))
        if self._run.running:
            self._run.stop(Phase.ENDED)
            return True, (f'ended: the coolant returns to {safe} and is held there; call again '
                          'to let go of it')
        self._let_go(self._verdict(self._run))
        return True, 'the trainer does not command the coolant any more'

    def _on_end(self, why: Reason | None) -> None:
        """Say that the steps are over, or stop commanding at once for a reason."""
        run = self._run
        assert run is not None
        if why is None:
            self._say(self._verdict(run).message)
            return
        # an experiment that was over is over as it was
        run.stop(Phase.ABORTED, why)
        self._let_go(self._verdict(run))
        self._say(f'the trainer does not command the coolant any more: {OPERATOR(why)}')

    def _let_go(self, outcome: Status) -> None:
        self._outcome = outcome
        if self._run is not None:
            self._run.destroy()
        self._run = None

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
        if run is None:
            return self._outcome
        verdict = self._verdict(run)
        if run.progress is None:
            return verdict
        held = '' if run.running else (
            f'; the coolant returns to {in_celsius(float(run.plan.home[0]))} and is held there')
        left = max(0.0, run.plan.duration - run.progress.elapsed) if run.running else 0.0
        return Status(verdict.level, verdict.message + held, {
            'topic': run.topic,
            'level [degC]': to_celsius(float(level(run.plan, run.progress)[0])),
            'coolant [degC]': to_celsius(float(run.progress.command[0])),
            'left [s]': left,
            'seed': run.plan.seed,
        })


class ExperimentRun:
    """
    Command the coolant from the first measurement on until :meth:`destroy`.

    :param on_end: called when the steps are over, with the reason when it must command no more.
    """

    def __init__(self, node: Node, settings: TrainerParameters,
                 on_end: Callable[[Reason | None], None]) -> None:
        self.plan = settings.experiment()
        self.topic = node.resolve_topic_name(settings.experiment_topic)
        self.progress: Progress | None = None
        # why it cannot start, or None with the first measurement
        self.started = Future()
        self._node = node
        self._patience, self._on_end = settings.experiment_timeout, on_end
        self._frame_id, self._stamp_ns, self._heard_at = '', 0, time.monotonic()
        self._following = Following(float(self.plan.upper[0] - self.plan.lower[0]))
        owned = Owned(node)
        self.destroy = owned.destroy  #: commands no more
        # a sensor driver may publish best effort
        offers = node.get_publishers_info_by_topic(node.resolve_topic_name(topics.TEMPERATURE))
        reliable = all(info.qos_profile.reliability is not ReliabilityPolicy.BEST_EFFORT
                       for info in offers)
        self._temperatures = owned.keep(node.create_subscription(
            Temperature, topics.TEMPERATURE, self._on_temperature,
            topics.profile(topics.LOOP_QOS.depth, reliable=reliable)))
        self._coolants = owned.keep(node.create_subscription(
            Temperature, topics.COOLANT_SETPOINT, self._on_coolant, topics.LOOP_QOS)) if (
                settings.experiment_topic == topics.MANUAL_COOLANT_SETPOINT) else None
        self._publisher = owned.keep(
            node.create_publisher(Temperature, self.topic, topics.LOOP_QOS))
        owned.timer(_TICK, self._on_tick)

    @property
    def running(self) -> bool:
        """Whether it waits for its first measurement, or steps."""
        return self.progress is None or self.progress.phase is Phase.RUNNING

    def stop(self, phase: Phase, why: Reason | None = None) -> None:
        """End the steps; the coolant then returns to the safe temperature."""
        if self.progress is not None:
            self.progress = end(self.progress, phase, why)

    def farewell(self) -> None:
        """Leave the coolant at the safe temperature before the process ends."""
        if self.progress is None:
            return
        self._command(self.plan.home, self._stamp_ns)
        # a plant in lock-step takes only the answer to its next measurement
        deadline = time.monotonic() + _FAREWELL
        with (handle := self._temperatures.handle):
            while time.monotonic() < deadline:
                if taken := handle.take_message(Temperature, False):
                    self._command(self.plan.home, stamp_nanoseconds(taken[0].header.stamp))
                else:
                    time.sleep(0.001)
        self._publisher.wait_for_all_acked(Duration(seconds=_FAREWELL))

    def _on_temperature(self, message: Temperature) -> None:
        measured = np.array([to_kelvin(message.temperature)])
        stamp_ns = stamp_nanoseconds(message.header.stamp)
        if self.progress is None:
            if self.started.done():
                return
            self.started.set_result(refusal := self.plan.refusal(measured))
            if refusal is not None:
                return
            self.progress = begin(self.plan, stamp_ns)
        if stamp_ns != self._stamp_ns:
            self._stamp_ns, self._heard_at = stamp_ns, time.monotonic()
        self._frame_id = message.header.frame_id
        was_running = self.running
        self.progress = advance(self.plan, self.progress, measured, stamp_ns)
        self._command(self.progress.command, stamp_ns)
        if was_running and not self.running:
            self._on_end(None)

    def _command(self, kelvin: Array, stamp_ns: int) -> None:
        self._publisher.publish(
            temperature_message(float(kelvin[0]), stamp_message(stamp_ns), self._frame_id))

    def _on_coolant(self, message: Temperature) -> None:
        """Watch a controller that should be in manual mode."""
        if self.progress is None:
            return
        heard, now = to_kelvin(message.temperature), time.monotonic()
        asked = float(self.progress.command[0])
        self._following = self._following.after(heard, asked, now)
        if self._following.astray >= _ASTRAY and now - self._following.since >= _ASTRAY_TIME:
            self._on_end(reason(Code.NOT_FOLLOWED, signal='coolant_temperature', value=heard,
                                requested=asked))

    def _on_tick(self) -> None:
        """Look for other commanders, and for measurements that stay away."""
        why = None
        if others := other_publishers(self._node, self.topic, own=1):
            why = reason(Code.OTHER_PUBLISHER, nodes=others, topic=self.topic)
        elif self._coolants is not None and not self._node.count_publishers(
                self._coolants.topic_name):
            why = reason(Code.CONTROLLER_GONE)
        elif time.monotonic() - self._heard_at > self._patience:
            why = reason(Code.SILENCE, timeout=self._patience)
        if self.progress is None:
            if why is not None and not self.started.done():
                self.started.set_result(why)
        elif why is not None and why.code is Code.SILENCE:
            was_running = self.running
            # the way back goes by the wall clock
            self.progress = advance(
                self.plan, end(self.progress, Phase.ABORTED, why), None,
                self.progress.time_ns + round(_TICK * NANOSECONDS))
            self._command(self.progress.command, self.progress.time_ns)
            if was_running:
                self._on_end(None)
        elif why is not None:
            self._on_end(why)


def other_publishers(node: Node, topic: str, own: int = 0) -> str:
    """Name the nodes that publish on a topic, but for so many publishers of a node's own."""
    # a publisher may be known before its node is
    names = ['another node' if 'UNKNOWN' in info.node_name else topics.node_name(info)
             for info in node.get_publishers_info_by_topic(topic)]
    me = node.get_fully_qualified_name()
    # another node may have the same name
    others = {name for name in names if name != me}
    return ' and '.join(sorted(others | ({me} if names.count(me) > own else set())))
