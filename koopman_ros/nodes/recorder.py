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

"""Recording of topics as they come: raw subscriptions into a bag."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
import importlib
import time
from typing import Any

from koopman_ros.bags import BagWriter, INFINITE_NS, message_definition, QosProfile
from koopman_ros.nodes import topics
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

# Ten seconds at 100 Hz wait here while the disk is slow.
_QUEUE_DEPTH = 1000


class Recorder:
    """
    Write every message of some topics to a bag, byte for byte, from now until :meth:`close`.

    :param node: whose executor delivers the messages.
    :param writer: the open bag; closed by :meth:`close`.
    :param names: topics, relative or absolute; types are looked up for those outside the loop.
    :param on_failure: called, instead of an error in a callback, when nothing more can be written.
    """

    def __init__(self, node: Node, writer: BagWriter, names: tuple[str, ...],
                 on_failure: Callable[[Exception], None]) -> None:
        self._on_failure = on_failure
        self._node = node
        self._writer = writer
        self._names = {node.resolve_topic_name(name): name for name in names}
        self._types = {topic: topics.TYPES.get(name) for topic, name in self._names.items()}
        self._subscriptions: dict[str, Subscription] = {}
        self.counts: dict[str, int] = dict.fromkeys(self._types, 0)
        self.look_for_publishers()

    @property
    def path(self) -> str:
        """The file or folder that is written."""
        return str(self._writer.path)

    def look_for_publishers(self) -> None:
        """Subscribe to what has become known, matching what its publishers offer."""
        for topic in list(self._types):
            publishers = self._node.get_publishers_info_by_topic(topic)
            if self._types[topic] is None and publishers:
                try:
                    self._types[topic] = _message_type(publishers[0].topic_type)
                except (ImportError, AttributeError, ValueError):
                    self._node.get_logger().error(
                        f'{topic} is not recorded: its type {publishers[0].topic_type} is not '
                        'installed here')
                    del self._types[topic]
                    continue
            message_type = self._types[topic]
            if message_type is None:
                continue
            wanted = _matching_qos(self._names[topic], publishers)
            existing = self._subscriptions.get(topic)
            if existing is not None:
                present = existing.qos_profile
                # without publishers it waits for those that were there
                if not publishers or (present.reliability, present.durability) == (
                        wanted.reliability, wanted.durability):
                    continue
                self._end([topic])
            self._subscriptions[topic] = self._node.create_subscription(
                message_type, topic, partial(self._record, topic), wanted, raw=True)

    def flush(self) -> None:
        """Hand what is recorded to the operating system."""
        try:
            self._writer.flush()
        except OSError as error:
            self._on_failure(error)

    def close(self) -> None:
        """Complete the bag with all that has arrived; the subscriptions end with it."""
        self._end(list(self._subscriptions))
        self._writer.close()

    def _end(self, ended: list[str]) -> None:
        """End subscriptions after recording what waits in them for the executor."""
        waiting = []
        for topic in ended:
            subscription = self._subscriptions.pop(topic)
            with subscription.handle:
                while taken := subscription.handle.take_message(self._types[topic], True):
                    waiting.append((topic, *taken))
            self._node.destroy_subscription(subscription)
        for topic, data, info in sorted(waiting, key=lambda entry: entry[2]['received_timestamp']):
            self._record(topic, data, info)

    def _record(self, topic: str, data: bytes, info: Mapping[str, int]) -> None:
        if self._writer.closed:
            return
        # the middleware stamps both ends; rosbag2 logs the time of receipt
        received = info['received_timestamp'] or time.time_ns()
        try:
            if not self.counts[topic]:
                self._announce(topic)
            self._writer.write(topic, data, received, info['source_timestamp'] or received)
        except (OSError, LookupError) as error:
            self._on_failure(error)
            return
        self.counts[topic] += 1

    def _announce(self, topic: str) -> None:
        """Add a topic to the bag with what its publishers offer now."""
        publishers = self._node.get_publishers_info_by_topic(topic)
        message_type = self._types[topic]
        assert message_type is not None
        name = f'{message_type.__module__.split(".")[0]}/msg/{message_type.__name__}'
        self._writer.add_topic(topic, message_definition(name),
                               [_offered(info.qos_profile) for info in publishers])


def _matching_qos(topic: str, publishers: list[TopicEndpointInfo]) -> QoSProfile:
    """Ask for reliability and history only where every publisher offers them."""
    offers = [info.qos_profile for info in publishers] or [topics.qos(topic)]
    reliable = all(o.reliability is not ReliabilityPolicy.BEST_EFFORT for o in offers)
    latched = all(o.durability is DurabilityPolicy.TRANSIENT_LOCAL for o in offers)
    return QoSProfile(
        depth=_QUEUE_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE))


def _message_type(name: str) -> Any:
    """Return the class of a message type given as ``package/msg/Name``."""
    package, kind, message = name.split('/')
    return getattr(importlib.import_module(f'{package}.{kind}'), message)


def _offered(profile: QoSProfile) -> QosProfile:
    return QosProfile(
        history=profile.history.short_key, depth=profile.depth,
        reliability=profile.reliability.short_key, durability=profile.durability.short_key,
        deadline_ns=_nanoseconds(profile.deadline.nanoseconds),
        lifespan_ns=_nanoseconds(profile.lifespan.nanoseconds),
        liveliness=profile.liveliness.short_key,
        liveliness_lease_duration_ns=_nanoseconds(
            profile.liveliness_lease_duration.nanoseconds))


def _nanoseconds(value: int) -> int:
    return value if 0 <= value <= INFINITE_NS else INFINITE_NS
