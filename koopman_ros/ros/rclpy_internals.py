# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
All uses of rclpy beyond its public API, of release 7.1.6 for Jazzy.

The rest of the package uses the public API alone. A test calls each function here with a node, so
that another release of rclpy without one of these names fails there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rclpy.context import Context
from rclpy.event_handler import QoSSubscriptionEventType, UnsupportedEventTypeError
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.service import Service
from rclpy.subscription import Subscription


def events_executor(context: Context | None = None) -> Executor:
    """
    Return an executor that is notified of each message, for nodes without clients.

    rclpy's other executors rebuild their wait set for each message, which takes longer than a
    control step. The first releases for Jazzy have no other.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def take_message(subscription: Subscription, raw: bool = False
                 ) -> tuple[Any, Mapping[str, int]] | None:
    """
    Take one waiting message with its times and numbers, without an executor.

    :param raw: return the serialized message.
    """
    with (handle := subscription.handle):
        taken: tuple[Any, Mapping[str, int]] | None = handle.take_message(
            subscription.msg_type, raw)
        return taken


def take_request(service: Service) -> Any | None:
    """Take one waiting request of a service, and return the header for its response, or None."""
    kind: Any = service.srv_type
    with (handle := service.handle):
        return handle.service_take_request(kind.Request)[1]


def end_lifecycle(node: LifecycleNodeMixin) -> None:
    """Destroy the state machine of a node, which keeps the node's name on the network."""
    node._state_machine.destroy_when_not_in_use()


class LostMessages:
    """
    The messages that a subscription lost, by the middleware's event, without an executor.

    :param subscription: to be destroyed after :meth:`end`.
    """

    def __init__(self, subscription: Subscription) -> None:
        try:
            self._event = rclpy_implementation.EventHandle(
                subscription.handle, QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST)
        except UnsupportedEventTypeError:
            self._event = None

    def take(self) -> int:
        """Return how many were lost since the last call; 0 if the middleware counts none."""
        if self._event is None:
            return 0
        with self._event:
            status = self._event.take_event()
        return 0 if status is None else int(status.total_count_change)

    def end(self) -> None:
        """Count no more."""
        if self._event is not None:
            self._event.destroy_when_not_in_use()
