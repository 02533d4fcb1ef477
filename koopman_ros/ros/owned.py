# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a part of a node has created on it, to be taken down with the part."""

from __future__ import annotations

from typing import TypeVar

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer

Entity = TypeVar('Entity', Publisher, Service, Subscription, Timer)


class Owned:
    """
    Publishers, subscriptions, services and timers of one part of a node.

    :param node: on which they were created.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._entities: list[Publisher | Service | Subscription | Timer] = []

    def keep(self, entity: Entity) -> Entity:
        """Note an entity, and return it."""
        self._entities.append(entity)
        return entity

    def destroy(self) -> None:
        """Take all of them down, the last one first."""
        while self._entities:
            entity = self._entities.pop()
            if isinstance(entity, Publisher):
                self._node.destroy_publisher(entity)
            elif isinstance(entity, Subscription):
                self._node.destroy_subscription(entity)
            elif isinstance(entity, Service):
                self._node.destroy_service(entity)
            else:
                self._node.destroy_timer(entity)
