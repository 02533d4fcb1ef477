# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a part of a node has created on it, to be taken down with the part; timers by the wall."""

from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer

Entity = TypeVar('Entity', Publisher, Service, Subscription, Timer)

_DESTROY: dict[type, Callable[[Node, Any], object]] = {
    Publisher: Node.destroy_publisher, Subscription: Node.destroy_subscription,
    Service: Node.destroy_service, Timer: Node.destroy_timer}


def wall_timer(node: Node, seconds: float, callback: Callable[[], Any], **options: Any) -> Timer:
    """Create a timer by the steady clock, which runs while simulated time stands still."""
    return node.create_timer(
        seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME), **options)


class Owned:
    """Publishers, subscriptions, services and timers of one part of a node."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._entities: list[Any] = []

    def keep(self, entity: Entity) -> Entity:
        """Note an entity, and return it."""
        self._entities.append(entity)
        return entity

    def timer(self, seconds: float, callback: Callable[[], Any], **options: Any) -> Timer:
        """Create a :func:`wall_timer`."""
        return self.keep(wall_timer(self._node, seconds, callback, **options))

    def destroy(self) -> None:
        """Take all of them down, the last one first."""
        while self._entities:
            entity = self._entities.pop()
            _DESTROY[type(entity)](self._node, entity)
