# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The player: the inputs of a controller from a bag, as recorded, or set-points from a CSV."""

import copy
import sys
import time
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosbags.interfaces import Qos, QosDurability, QosReliability
from rosgraph_msgs.msg import Clock as ClockMessage

from koopman_ros import records
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.parameters.player import player_table
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.parameters.trainer_table import preset_wiring
from koopman_ros.ros import topics
from koopman_ros.ros.hosted import wall_timer
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.process import run
from koopman_ros.ros.setpoint_table import SetpointTable
from koopman_ros.ros.time_conversion import stamp_message, stamp_nanoseconds

_POLL_PERIOD_NS = 10_000_000  # for conditions that no message announces
_PROGRESS_PERIOD = 3.0  # s
_LAST_PATIENCE = Duration(seconds=5.0)  # for the last messages to be received
_BURST = 100  # messages without an answer that are sent in one go, before signals are heard again


class PlayerNode(LoopNode):
    """
    Publish recorded messages byte for byte, in the order and at the pace of the recording.

    As fast as possible means in lock-step: a measurement is followed by the next message when its
    command has arrived, and any other message when all subscribers have received it, which takes
    some middlewares 0.1 s, so that messages of one stamp go together.
    """

    def __init__(self) -> None:
        super().__init__('player')
        self._settings = settings = self.declare_table(player_table(self.given()))
        if reason := topics.unusable(self, list(filter(None, (
                *settings.topics, *settings.measurement, settings.answer)))):
            raise ConfigurationError(reason)
        # by topic of the bag
        names = {'/' + name.lstrip('/'): name for name in settings.topics}
        table = SetpointTable.read(
            settings, preset_wiring(settings.system)) if settings.bag.endswith('.csv') else None
        content = records.summary(settings.bag) if table is None else table.content
        begin_ns = (content.start_ns or 0) + round(settings.start_offset * NANOSECONDS)
        messages = records.in_log_order(records.read_messages(
            settings.bag, names, recover=settings.recover)) if table is None else (
                table.messages(self.get_clock(), settings.setpoint_lead))
        self._messages = (message for message in messages if message.log_time_ns >= begin_ns)
        played = {topic: name for topic, name in names.items() if content.counts.get(topic)}
        if not played:
            known = ', '.join(sorted(t for t, count in content.counts.items() if count))
            raise ConfigurationError(f'bag {settings.bag!r} has no message on {", ".join(names)}: '
                                     f'choose from {known or "none"}')
        self._total = sum(content.counts[topic] for topic in played)
        # a measurement is whole when all of its parts are out
        self._measured = {'/' + name.lstrip('/') for name in settings.measurement} & set(played)
        self._parts: tuple[int, set[str]] = (0, set())  # stamp and topics of those that are
        self._lockstep = settings.rate == 0.0
        # set-points are due in the time of the plant
        self._simulated = table is not None and bool(self.get_parameter('use_sim_time').value)

        # the subscription first: a controller that hears the measurement has then seen it, too
        self._clock_publisher = self.create_publisher(
            ClockMessage, topics.CLOCK, topics.CLOCK_QOS, qos_overriding_options=(
                topics.overridable())) if settings.clock else None
        try:
            answer_type = content.types.get(
                '/' + settings.answer.lstrip('/'), settings.answer_type)
            self._answers = self.create_subscription(
                topics.message_class(answer_type), settings.answer, self._on_answer,
                copy.copy(topics.LOOP_QOS), qos_overriding_options=topics.overridable(),
            ) if self._lockstep and self._measured else None
            self._outlets: dict[str, Publisher] = {
                topic: self.create_publisher(
                    topics.message_class(content.types[topic]), name,
                    recorded_offer(content.offered_qos.get(topic, ())),
                    qos_overriding_options=topics.overridable())
                for topic, name in played.items()}
        except LookupError as error:
            raise ConfigurationError(str(error)) from error

        self._next: records.BagMessage | None = None
        self._open: int | None = None  # stamp of the measurement that has no answer yet
        self._began, self._sent = False, 0
        self._received: set[str] = set()  # topics of which subscribers have received a message
        self._due = self._wall_start = self._last_report = self._last_sent = time.monotonic()
        self._timer: Any = wall_timer(self, _POLL_PERIOD_NS / NANOSECONDS, self._on_timer)

    def _on_timer(self) -> None:
        try:
            if not self._began:
                self._begin()
            elif self._open is not None:
                if time.monotonic() - self._last_sent > self._settings.answer_timeout:
                    self._give_up(
                        f'no command for the measurement at {self._open / NANOSECONDS:.3f} s '
                        f'within {self._settings.answer_timeout:g} s: check that the controller '
                        'is running; a rate above 0 plays without waiting for commands')
            elif self._lockstep:
                self._play_in_lockstep()
            else:
                self._play_in_time()
        except records.BagReadError as error:
            self._give_up(str(error))
        except MemoryError:
            self._give_up('five seconds of messages do not fit into memory: play fewer topics')

    def _begin(self) -> None:
        """Start once all subscribers are there."""
        wanted = self._settings.wait_for_subscribers
        missing = [publisher.topic_name for publisher in self._outlets.values()
                   if publisher.get_subscription_count() < wanted]
        if self._answers is not None and wanted and not self._answers.get_publisher_count():
            missing.append(self._answers.topic_name)
        if self._simulated and not self._now():
            missing.append(topics.CLOCK)
        if not missing:
            self._began = True
            # before the time counts: the first message of a type takes a tenth of a second
            self._next = next(self._messages, None)
            self._due, self._wall_start = self._now(), time.monotonic()
            self._last_report = self._wall_start
            self.get_logger().info(f'playing {self._settings.bag}')
        elif time.monotonic() - self._wall_start > self._settings.wait_timeout:
            self._give_up(
                f'{", ".join(missing)} found no subscriber or publisher within '
                f'{self._settings.wait_timeout:g} s: start the controller first, or set '
                'wait_for_subscribers to 0')

    def _now(self) -> float:
        """Return the time in s at which messages are due."""
        return (self.get_clock().now().nanoseconds / NANOSECONDS if self._simulated
                else time.monotonic())

    def _play_in_time(self) -> None:
        """Publish the messages that are due, and wait for the next."""
        while self._next is not None and self._due <= self._now():
            message = self._next
            self._publish(message)
            self._next = next(self._messages, None)
            if self._next is not None:
                # where the recorder's clock was set back, the next message follows at once
                seconds = (self._next.log_time_ns - message.log_time_ns) / NANOSECONDS
                self._due += max(0.0, seconds) / self._settings.rate
        if self._next is None:
            self._finish()
            return
        left_ns = round((self._due - self._now()) * NANOSECONDS)
        # a simulation may be faster than the wall's clock, which the timer follows
        self._timer.timer_period_ns = _POLL_PERIOD_NS if self._simulated else min(
            max(left_ns, 1), 100 * _POLL_PERIOD_NS)
        self._timer.reset()
        self._say_progress()

    def _play_in_lockstep(self) -> None:
        """Publish up to the next measurement; its command continues the play-back."""
        for _ in range(_BURST):
            if self._next is None:
                self._finish()
                return
            message, self._next = self._next, next(self._messages, None)
            self._publish(message)
            if message.topic in self._measured and self._completes(message):
                self._open = _stamp_ns(message)
                self._last_sent = time.monotonic()
                break
            following = self._next
            # the first one of a topic tells that the subscribers have found it; later ones go
            # with the next message where it was published at the same instant on another topic
            if message.topic in self._received and following and (
                    following.topic != message.topic
                    and _stamp_ns(message) == _stamp_ns(following) is not None):
                continue
            patience = Duration(seconds=self._settings.answer_timeout)
            if not self._outlets[message.topic].wait_for_all_acked(patience):
                self._give_up(f'no node received a message on {message.topic} within '
                              f'{self._settings.answer_timeout:g} s: check that the controller is '
                              'running')
                return
            self._received.add(message.topic)
        self._say_progress()

    def _completes(self, message: records.BagMessage) -> bool:
        """Return whether a message completes a measurement."""
        stamp_ns = _stamp_ns(message) or 0
        if stamp_ns != self._parts[0]:
            self._parts = (stamp_ns, set())
        self._parts[1].add(message.topic)
        return self._parts[1] == self._measured

    def _on_answer(self, message: Any) -> None:
        header = getattr(message, 'header', None)
        if header is None or stamp_nanoseconds(header.stamp) == (self._open or 0):
            self._open = None
            self._on_timer()

    def _publish(self, message: records.BagMessage) -> None:
        if self._clock_publisher is not None and message.topic in self._measured:
            self._clock_publisher.publish(ClockMessage(clock=stamp_message(
                _stamp_ns(message) or message.log_time_ns)))
        self._outlets[message.topic].publish(message.data)
        self._sent += 1

    def _say_progress(self) -> None:
        if time.monotonic() - self._last_report >= _PROGRESS_PERIOD:
            self._last_report = time.monotonic()
            self.get_logger().info(f'{self._sent} of {self._total} messages')

    def _finish(self) -> None:
        received = all(publisher.wait_for_all_acked(_LAST_PATIENCE)
                       for publisher in self._outlets.values())
        seconds = time.monotonic() - self._wall_start
        self.get_logger().info(f'played {self._sent} messages in {seconds:.3f} s')
        self.exit_code = 0
        if not received:
            self._give_up('not all of the last messages were received: check that the subscribers '
                          'are running')

    def _give_up(self, reason: str) -> None:
        self._timer.cancel()
        print(f'player: {reason}', file=sys.stderr, flush=True)
        self.exit_code = 1


def _stamp_ns(message: records.BagMessage) -> int | None:
    """Return the stamp of a message; None if it has none or is unset."""
    try:
        return stamp_nanoseconds(message.message.header.stamp) or None
    except (AttributeError, TypeError):
        return None


def recorded_offer(offered: tuple[Qos, ...]) -> QoSProfile:
    """Return the quality of service that all recorded publishers offered."""
    best_effort = {o.reliability for o in offered} == {QosReliability.BEST_EFFORT}
    latched = {o.durability for o in offered} == {QosDurability.TRANSIENT_LOCAL}
    return topics.profile(
        max(1, *(o.depth for o in offered)) if latched else topics.LOOP_QOS.depth,
        reliable=not best_effort, latched=latched)


def main(args: list[str] | None = None) -> int:
    """Run the player."""
    return run('player', PlayerNode, args)


if __name__ == '__main__':
    sys.exit(main())
