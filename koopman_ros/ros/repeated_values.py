# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Values that are published again until they are answered."""

from collections.abc import Callable
from dataclasses import dataclass
import time

from builtin_interfaces.msg import Time
import numpy as np

from koopman_ros.core.message_fields import MessageField
from koopman_ros.ros import topics
from koopman_ros.ros.hosted import HostedNode, wall_timer
from koopman_ros.ros.signals import SignalPublisher

_PERIOD = 0.05  # s between two looks
_REPEAT = 0.7  # s without an answer until a value is published again


@dataclass
class _Value:
    outlet: SignalPublisher
    value: float
    due: float
    answered: bool = False


class RepeatedValues:
    """Publishes values, each by a publisher that exists until the answer."""

    def __init__(self, node: HostedNode) -> None:
        self._node = node
        self._values: list[_Value] = []
        self._timer = wall_timer(node, _PERIOD, self._on_timer)
        self._timer.cancel()

    def send(self, name: str, place: MessageField, unit: str, value: float) -> Callable[[], None]:
        """
        Publish the value of a signal until the function that is returned is called.

        :param unit: of the value.
        """
        outlet = SignalPublisher({name: place}, {name: unit}, lambda topic, kind: (
            self._node.create_publisher(kind, topic, topics.LOOP_QOS)))
        own = _Value(outlet, value, time.monotonic())
        self._values.append(own)
        self._timer.reset()

        def answered() -> None:
            own.answered = True

        return answered

    def _on_timer(self) -> None:
        now = time.monotonic()
        for own in list(self._values):
            (publisher,) = own.outlet.publishers
            if own.answered:
                self._values.remove(own)
                self._node.destroy_publisher(publisher)
                continue
            matched = publisher.get_subscription_count()
            if now >= own.due and matched and matched >= self._node.count_subscribers(
                    publisher.topic_name):
                own.outlet.send(np.array([own.value]), Time(), self._node.get_name())
                own.due = now + _REPEAT
        if not self._values:
            self._timer.cancel()
