# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Count of the messages that were sent on recorded topics and not received."""

from collections import Counter
from collections.abc import Mapping

from rclpy.node import Node
from rclpy.subscription import Subscription

from koopman_ros.ros.rclpy_internals import LostMessages


class MissedMessages:
    """
    Count the missed messages of each topic, if the middleware reports them.

    The larger of two counts is taken. One is the subscription's event of lost messages, which does
    not include messages that arrive while its queue is full. The other is the number of gaps in
    the sequence numbers of a publisher, which rmw_fastrtps gives. Gaps are counted while the topic
    has one publisher, because a message does not say which publisher sent it.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._events: dict[str, LostMessages] = {}
        self._lost: Counter[str] = Counter()  # by the events
        self._skipped: Counter[str] = Counter()  # by the numbers
        self._last_number: dict[str, int] = {}
        self._publisher: dict[str, bytes] = {}  # the only one of a topic; empty: several or none

    @property
    def counts(self) -> dict[str, int]:
        """The number of missed messages of each topic that missed any."""
        return dict(self._lost | self._skipped)

    def watch(self, subscription: Subscription) -> None:
        """Count the events of a subscription, until :meth:`end`."""
        self._events[subscription.topic_name] = LostMessages(subscription)

    def end(self, subscription: Subscription) -> None:
        """Read the last events of a subscription, before it is destroyed."""
        self.look_for_events()
        if event := self._events.pop(subscription.topic_name, None):
            event.end()

    def look_for_events(self) -> None:
        """Count the messages that were lost since the last call."""
        for topic, event in self._events.items():
            self._lost[topic] += event.take()

    def on_message(self, topic: str, info: Mapping[str, int | None]) -> None:
        """Count the messages between the last one and this one by their sequence numbers."""
        number = info.get('publication_sequence_number')
        if number is None:
            return
        last = self._last_number.get(topic)
        self._last_number[topic] = number
        if last is None:
            self._publisher[topic] = self._only_publisher(topic)
        elif number > last + 1 and (before := self._publisher[topic]):
            self._publisher[topic] = self._only_publisher(topic)
            if self._publisher[topic] == before:
                self._skipped[topic] += number - last - 1

    def look_for_publishers(self, topic: str) -> None:
        """Count from the next message on where the publisher of a topic is another."""
        if topic in self._publisher and (found := self._only_publisher(topic)) != (
                self._publisher[topic]):
            self._publisher[topic] = found
            self._last_number.pop(topic, None)

    def _only_publisher(self, topic: str) -> bytes:
        found = self._node.get_publishers_info_by_topic(topic)
        return bytes(found[0].endpoint_gid) if len(found) == 1 else b''
