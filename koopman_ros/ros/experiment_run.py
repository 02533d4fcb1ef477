# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""One identification experiment: answers each temperature with a coolant, while it commands."""

from __future__ import annotations

from collections.abc import Callable
import time

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import Temperature

from koopman_ros.experiment import advance, begin, end, Following, Phase, Progress
from koopman_ros.parameters.trainer import TrainerParameters
from koopman_ros.reasons import Code, Reason, reason
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_message, stamp_nanoseconds, temperature_message
from koopman_ros.ros.owned import Owned
from koopman_ros.units import NANOSECONDS, to_kelvin

_TICK = 0.1  # s
_ASTRAY = 10  # commands of a controller, and
_ASTRAY_TIME = 1.0  # s, after which it is said not to follow
_FAREWELL = 0.2  # s in which a last measurement is answered


class ExperimentRun:
    """
    Command the coolant from the first measurement on until :meth:`destroy`.

    Publisher, subscriptions and timer exist as long as the run: nobody takes an idle trainer for
    a commander, and a plant in lock-step that waits for one starts.

    :param node: whose executor does the work.
    :param settings: what it starts with.
    :param on_change: called when the steps are over.
    :param on_loss: called with the reason when it must not command any more.
    """

    def __init__(self, node: Node, settings: TrainerParameters, on_change: Callable[[], None],
                 on_loss: Callable[[Reason], None]) -> None:
        self.plan = settings.experiment()
        self.topic = node.resolve_topic_name(settings.experiment_topic)
        self.progress: Progress | None = None
        # why it cannot start, or None with the first measurement
        self.started = Future()
        self._node = node
        self._patience = settings.experiment_timeout
        self._on_change = on_change
        self._on_loss = on_loss
        self._frame_id = ''
        self._stamp_ns = 0
        self._heard_at = time.monotonic()
        self._following = Following()
        self._owned = owned = Owned(node)
        self._temperatures = owned.keep(node.create_subscription(
            Temperature, topics.TEMPERATURE, self._on_temperature, _sensor_qos(node)))
        self._coolants = owned.keep(node.create_subscription(
            Temperature, topics.COOLANT_SETPOINT, self._on_coolant, topics.LOOP_QOS)) if (
                settings.experiment_topic == topics.MANUAL_COOLANT_SETPOINT) else None
        self._publisher = owned.keep(
            node.create_publisher(Temperature, self.topic, topics.LOOP_QOS))
        # measurements that stay away come with no message, and the time of the plant stands still
        owned.keep(node.create_timer(
            _TICK, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME)))

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
        self._command(self.plan.safe_input, self._stamp_ns)
        # a plant in lock-step takes only the answer to its next measurement
        deadline = time.monotonic() + _FAREWELL
        with (handle := self._temperatures.handle):
            while time.monotonic() < deadline:
                if taken := handle.take_message(Temperature, False):
                    self._command(self.plan.safe_input, stamp_nanoseconds(taken[0].header.stamp))
                else:
                    time.sleep(0.001)
        self._publisher.wait_for_all_acked(Duration(seconds=_FAREWELL))

    def destroy(self) -> None:
        """Command no more."""
        self._owned.destroy()

    def _on_temperature(self, message: Temperature) -> None:
        measured = to_kelvin(message.temperature)
        stamp_ns = stamp_nanoseconds(message.header.stamp)
        if self.progress is None:
            if self.started.done():
                return
            refusal = self.plan.refusal(measured)
            self.started.set_result(refusal)
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
            self._on_change()

    def _command(self, kelvin: float, stamp_ns: int) -> None:
        self._publisher.publish(
            temperature_message(kelvin, stamp_message(stamp_ns), self._frame_id))

    def _on_coolant(self, message: Temperature) -> None:
        """Watch a controller that should be in manual mode."""
        if self.progress is None:
            return
        heard, now = to_kelvin(message.temperature), time.monotonic()
        self._following = self._following.after(heard, self.progress.command, now)
        if self._following.astray >= _ASTRAY and now - self._following.since >= _ASTRAY_TIME:
            self._on_loss(reason(Code.NOT_FOLLOWED, signal='coolant_temperature', value=heard,
                                 requested=self.progress.command))

    def _on_tick(self) -> None:
        """Look for other commanders, and for measurements that stay away."""
        if others := other_publishers(self._node, self.topic, own=1):
            self._on_loss(reason(Code.OTHER_PUBLISHER, nodes=others, topic=self.topic))
        elif self._coolants is not None and not self._node.count_publishers(
                self._coolants.topic_name):
            self._on_loss(reason(Code.CONTROLLER_GONE))
        elif time.monotonic() - self._heard_at > self._patience:
            self._on_silence(reason(Code.SILENCE, timeout=self._patience))

    def _on_silence(self, why: Reason) -> None:
        if self.progress is None:
            if not self.started.done():
                self.started.set_result(why)
            return
        was_running = self.running
        self.stop(Phase.ABORTED, why)
        # the way back goes by the wall clock
        self.progress = advance(self.plan, self.progress, None,
                                self.progress.time_ns + round(_TICK * NANOSECONDS))
        self._command(self.progress.command, self.progress.time_ns)
        if was_running:
            self._on_change()


def other_publishers(node: Node, topic: str, own: int = 0) -> str:
    """
    Name the nodes that publish on a topic, or return an empty string.

    :param node: which is not named.
    :param topic: resolved name.
    :param own: how many publishers the node has there.
    """
    # a publisher may be known before its node is
    names = ['another node' if 'UNKNOWN' in info.node_name else
             f'{info.node_namespace.rstrip("/")}/{info.node_name}'
             for info in node.get_publishers_info_by_topic(topic)]
    me = node.get_fully_qualified_name()
    # another node may have the same name
    others = {name for name in names if name != me}
    return ' and '.join(sorted(others | ({me} if names.count(me) > own else set())))


def _sensor_qos(node: Node) -> QoSProfile:
    """Hear a sensor driver that publishes best effort."""
    offers = node.get_publishers_info_by_topic(node.resolve_topic_name(topics.TEMPERATURE))
    best_effort = any(
        info.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT for info in offers)
    return QoSProfile(depth=topics.LOOP_QOS.depth, reliability=ReliabilityPolicy.BEST_EFFORT if (
        best_effort) else ReliabilityPolicy.RELIABLE)
