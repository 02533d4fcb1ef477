# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recording of topics by raw subscriptions into a bag."""

from collections.abc import Mapping
import heapq
import time
from typing import Any, NamedTuple

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.utilities import get_rmw_implementation_identifier
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosgraph_msgs.msg import Clock

from koopman_ros.core.units import NANOSECONDS
from koopman_ros.records import BagWriter, message_definition
from koopman_ros.ros import topics
from koopman_ros.ros.missed_messages import MissedMessages
from koopman_ros.ros.rclpy_internals import take_message
from koopman_ros.ros.time_conversion import stamp_nanoseconds

# An unlimited duration [ns]: RMW_DURATION_INFINITE.
_INFINITE_NS = 2**63 - 1
# Five seconds at 1 kHz wait here while the disk is slow; Fast DDS keeps no more than this.
QUEUE_DEPTH = 5000
_LINGER = 0.1  # s
_CLOCK_PATIENCE = 1.0  # s from the start until the first /clock should be there
_LONGEST_WAY_NS = 1_000_000_000  # from sending to receipt, on a machine that is busy
# Middleware that gives the time of the take as that of receipt.
_STAMPED_AT_TAKE = ('rmw_cyclonedds_cpp',)


class _Taken(NamedTuple):
    topic: str
    data: bytes
    received_ns: int
    sent_ns: int


class _OutsideTheExecutor(CallbackGroup):
    # the executor rebuilds its wait set for each message, which costs many times as much as
    # costs to record one

    def can_execute(self, entity: object) -> bool:
        return False


class Recorder:
    """
    Write every message of some topics to a bag, byte for byte, from now until :meth:`close`.

    `known` has type and quality of service of topics without a publisher so far.

    Messages are logged at their receipt by the node's clock. Where `use_sim_time` is set, that is
    the last /clock received before, and recording begins with the first one, as that of
    `ros2 bag record --use-sim-time`. Where it is not set and /clock is published, /clock is
    recorded too as soon as a message without a stamp is expected: its receipt is not plant time.

    Messages wait in the middleware until :meth:`take`. Any method raises OSError where the bag
    cannot be written, and LookupError where the definition of a type is not installed.
    """

    def __init__(self, node: Node, writer: BagWriter, names: tuple[str, ...],
                 known: Mapping[str, tuple[Any, QoSProfile]]) -> None:
        self._node, self._writer = node, writer
        self._names = {node.resolve_topic_name(name): name for name in names}
        self._known = known
        self._types: dict[str, Any] = {
            topic: known[name][0] if name in known else None
            for topic, name in self._names.items()}
        self._group = _OutsideTheExecutor()
        self._subscriptions: dict[str, Subscription] = {}
        self._empty_ns: dict[str, int] = {}  # when nothing waited in each
        self.counts: dict[str, int] = dict.fromkeys(self._types, 0)
        self._missed = MissedMessages(node)
        self._at_take = get_rmw_implementation_identifier() in _STAMPED_AT_TAKE
        self._start_time = time.monotonic()
        self.simulated = bool(node.get_parameter('use_sim_time').value)
        # 0 before the first /clock
        self._now_ns = node.get_clock().now().nanoseconds if self.simulated else 0
        self._clock = self._subscribed(
            topics.CLOCK, Clock, topics.profile(QUEUE_DEPTH, reliable=False)
        ) if self.simulated else None
        self.complaint = ''  #: about the time of receipt, for the operator; empty for none
        self.look_for_publishers()

    @property
    def missed(self) -> dict[str, int]:
        """The number of messages that were sent and not received, of topics that missed any."""
        return self._missed.counts

    def look_for_publishers(self) -> None:
        """Subscribe to newly discovered topics, with their publishers' quality of service."""
        self._look_for_the_clock()
        for topic in list(self._types):
            self._missed.look_for_publishers(topic)
            publishers = self._node.get_publishers_info_by_topic(topic)
            if self._types[topic] is None and publishers:
                try:
                    self._types[topic] = topics.message_class(publishers[0].topic_type)
                except LookupError as error:
                    self._node.get_logger().error(f'{topic} is not recorded: {error}')
                    del self._types[topic]
                    continue
            if (message_type := self._types[topic]) is None:
                continue
            _, usual = self._known.get(self._names[topic], (None, topics.LOOP_QOS))
            wanted = topics.matching_profile(usual, publishers, QUEUE_DEPTH)
            existing = self._subscriptions.get(topic)
            if existing is not None:
                present = existing.qos_profile
                # without publishers it waits for those that were there
                if not publishers or (present.reliability, present.durability) == (
                        wanted.reliability, wanted.durability):
                    continue
                self._end([topic])
            before = usual if existing is None else existing.qos_profile
            if wanted.reliability is not before.reliability:
                self._node.get_logger().info(topics.followed(topic, wanted, publishers))
            self._subscriptions[topic] = self._subscribed(topic, message_type, wanted)
            self._missed.watch(self._subscriptions[topic])

    def _subscribed(self, topic: str, message_type: Any, qos: QoSProfile) -> Subscription:
        self._empty_ns[topic] = time.time_ns()
        return self._node.create_subscription(
            message_type, topic, lambda _: None, qos, callback_group=self._group, raw=True)

    def _look_for_the_clock(self) -> None:
        """Warn if times of receipt are not the plant's time."""
        unstamped = [topic for topic, name in self._names.items() if name in self._known
                     and name not in topics.TYPES and not hasattr(self._known[name][0], 'header')]
        if self.simulated:
            waited = time.monotonic() - self._start_time
            text = '' if self._now_ns or waited < _CLOCK_PATIENCE else (
                'nothing is recorded before the first /clock message, because use_sim_time is '
                'set: publish /clock, or set use_sim_time to false')
        elif unstamped and self._node.count_publishers(topics.CLOCK):
            text = (f'{unstamped[0]} has no stamps and is logged in wall time, although /clock is '
                    'published: start the trainer with use_sim_time set to true')
            # by which a reader sees how fast the plant ran
            self._types.setdefault(topics.CLOCK, Clock)
            self._names.setdefault(topics.CLOCK, topics.CLOCK)
            self.counts.setdefault(topics.CLOCK, 0)
        else:
            return
        if text and text != self.complaint:
            self._node.get_logger().warning(text)
        self.complaint = text

    def take(self) -> None:
        """Record the received messages."""
        self._record_in_order(self._subscriptions)
        self._missed.look_for_events()

    def flush(self) -> None:
        """Pass the recorded messages to the operating system."""
        self._writer.flush()

    def close(self) -> None:
        """Complete the bag with all that was sent; the subscriptions end with it."""
        # messages that others have received may still be on their way
        time.sleep(_LINGER)
        try:
            self._end(list(self._subscriptions))
        finally:
            if self._clock is not None:
                self._node.destroy_subscription(self._clock)
            self._writer.close()

    def _end(self, ended: list[str]) -> None:
        subscriptions = {topic: self._subscriptions.pop(topic) for topic in ended}
        try:
            self._record_in_order(subscriptions)
        finally:
            for subscription in subscriptions.values():
                self._missed.end(subscription)
                self._node.destroy_subscription(subscription)

    def _waiting(self, topic: str, subscription: Subscription) -> list[_Taken]:
        waiting: list[_Taken] = []
        # no more than can wait, lest a fast publisher keeps us here
        while len(waiting) < QUEUE_DEPTH:
            now_ns = time.time_ns()
            taken = take_message(subscription, raw=True)
            if taken is None:
                self._empty_ns[topic] = now_ns
                break
            data, info = taken
            if subscription is not self._clock:
                self._missed.on_message(topic, info)
            received_ns = receipt_ns(info, now_ns, self._empty_ns[topic], self._at_take)
            waiting.append(_Taken(
                topic, data, received_ns, info['source_timestamp'] or received_ns))
        return waiting

    def _record_in_order(self, subscriptions: Mapping[str, Subscription]) -> None:
        """Record in the order of receipt; the order within a topic is always kept."""
        waiting = [self._waiting(topic, each) for topic, each in subscriptions.items()]
        if self._clock is not None:
            # last, so that no /clock received before a message is missing; first of one instant
            waiting.insert(0, [taken._replace(topic='') for taken in self._waiting(
                topics.CLOCK, self._clock)])
        for taken in heapq.merge(*waiting, key=lambda taken: taken.received_ns):
            if not taken.topic:
                self._on_clock(taken.data)
                continue
            if self.simulated:
                if not self._now_ns:
                    continue
                taken = taken._replace(received_ns=self._now_ns, sent_ns=self._now_ns)
            if not self.counts[taken.topic]:
                # with the QoS that its publishers offer now
                self._writer.add_topic(
                    taken.topic, message_definition(topics.type_name(self._types[taken.topic])),
                    [_offered(info.qos_profile) for info in
                     self._node.get_publishers_info_by_topic(taken.topic)])
            # rosbag2, too, logs the time of receipt
            self._writer.write(taken.topic, taken.data, taken.received_ns, taken.sent_ns)
            self.counts[taken.topic] += 1

    def _on_clock(self, data: bytes) -> None:
        """Set the node's time from a message on /clock; ignore an invalid time."""
        now = deserialize_message(data, Clock).clock
        if now.sec >= 0 and now.nanosec < NANOSECONDS:
            self._now_ns = stamp_nanoseconds(now)


def receipt_ns(info: Mapping[str, int], take_ns: int, empty_ns: int, at_take: bool) -> int:
    """
    Return when a message was received, for its place in the recording.

    rmw_fastrtps gives the time of receipt; rmw_cyclonedds when it was taken, which puts all that
    waited on one topic before the next. The sender's time is used then, or the nearest possible
    time of receipt. Both never mix in one recording: a message that arrives while the topic is
    read would come before another that was sent and received earlier.

    :param info: received and source timestamp in ns, 0 where unknown.
    :param take_ns: just before it was taken.
    :param empty_ns: when nothing waited on its topic for the last time.
    :param at_take: whether the middleware gives the time of the take as that of receipt.
    """
    received_ns, source_ns = info['received_timestamp'], info['source_timestamp']
    if received_ns and not at_take:
        return received_ns
    latest_ns = received_ns or take_ns
    if not source_ns:
        return latest_ns
    return source_ns if empty_ns - _LONGEST_WAY_NS <= source_ns <= latest_ns else min(
        max(source_ns, empty_ns), latest_ns)


def _offered(profile: QoSProfile) -> Qos:
    # both number the policies as rmw does
    return Qos(
        QosHistory(int(profile.history)), profile.depth,
        QosReliability(int(profile.reliability)), QosDurability(int(profile.durability)),
        _time(profile.deadline), _time(profile.lifespan),
        QosLiveliness(int(profile.liveliness)), _time(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=False)


def _time(duration: Any) -> QosTime:
    ns = duration.nanoseconds
    return QosTime(*divmod(ns if 0 <= ns <= _INFINITE_NS else _INFINITE_NS, NANOSECONDS))
