# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Others that publish where only one node may."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from koopman_ros.nodes import topics
from koopman_ros.nodes.matching import node_name, type_name

_LOOK_PERIOD = 0.5  # s


class Rivals:
    """
    Watch topics for more than one publisher.

    :param node: that watches.
    :param what: by topic of the loop, what a publisher of it does, e.g. 'command the coolant'.
    :param on_change: called when there are some, others, or none any more.
    """

    def __init__(self, node: Node, what: Mapping[str, str], on_change: Callable[[], None]
                 ) -> None:
        self._node = node
        self._what = what
        self._on_change = on_change
        self.complaint = ''
        node.create_timer(_LOOK_PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _look(self) -> None:
        complaint = '; '.join(filter(None, map(self._complaint, self._what)))
        if complaint != self.complaint:
            self.complaint = complaint
            self._on_change()

    def _complaint(self, topic: str) -> str:
        """Return who publishes a topic if there are several, or an empty string."""
        # who publishes something else there is no rival
        publishers = [info for info in self._node.get_publishers_info_by_topic(topic)
                      if info.topic_type == type_name(topics.TYPES[topic])]
        names = sorted(map(node_name, publishers))
        # publishers, not names: a node may have been started twice under the same
        return '' if len(names) < 2 else (
            f'{len(names)} nodes {self._what[topic]}: {", ".join(names)}; end all but one')
