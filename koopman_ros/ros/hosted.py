# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Nodes that may share a process: each has its own errors, and timers by the steady clock."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterable
import contextlib
from dataclasses import dataclass, field
import functools
import inspect
import time
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from koopman_ros.core.plugins import contained

_POLL = 0.02  # s between two steps of an asynchronous callback


@dataclass(frozen=True)
class HostContext:
    """The share of a node in a process of many."""

    loops: int  #: that share the process
    failed: Callable[[BaseException], None]  #: called with the exception of a callback
    made: list[HostedNode] = field(default_factory=list)  #: the node, also a half-made one


class HostedNode(Node):
    """
    A node that may share its process with others.

    :ivar hosting: None where the node is alone.
    :ivar steady_clock: runs while simulated time is paused.
    :ivar last_messages_time: s for the last messages to reach their subscribers.
    """

    def __init__(self, name: str, hosting: HostContext | None, **options: Any) -> None:
        self.hosting, self.last_messages_time = hosting, 0.5
        # rclpy's EventsExecutor has a thread for each clock, and warns of many timers of one
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        super().__init__(name, **options)
        if hosting is not None:
            hosting.made.append(self)

    def create_publisher(self, *args: Any, **options: Any) -> Publisher:
        """Create a publisher as any node does, but without events of the middleware."""
        # rclpy raises or crashes where an entity is destroyed while one of its events is waiting
        return super().create_publisher(
            *args, event_callbacks=PublisherEventCallbacks(use_default_callbacks=False), **options)

    def create_subscription(self, msg_type: Any, topic: str, callback: Callable[..., Any],
                            *args: Any, **options: Any) -> Subscription:
        """Subscribe as any node does, but without events of the middleware."""
        return super().create_subscription(
            msg_type, topic, self.guarded(callback), *args,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False), **options)

    def create_timer(self, timer_period_sec: float, callback: Callable[..., Any], *args: Any,
                     **options: Any) -> Timer:
        """Create a timer as any node does, with errors of its own."""
        return super().create_timer(timer_period_sec, self.guarded(callback), *args, **options)

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[..., Any],
                       **options: Any) -> Service:
        """Serve as any node does; a response after the end of the service is dropped."""
        made = super().create_service(srv_type, srv_name, self.guarded(callback), **options)
        send = made.send_response

        def answer(response: Any, header: Any) -> None:
            if inspect.iscoroutine(response):
                # rclpy's EventsExecutor awaits no callback before 7.1.11
                self._await(response, lambda found: answer(found, header))
            elif response is not None:
                # rclpy ends spin where a service is destroyed before its response
                with contextlib.suppress(InvalidHandle):
                    send(response, header)

        made.send_response = answer  # type: ignore[method-assign]
        return made

    def _await(self, work: Coroutine[Any, Any, Any], done: Callable[[Any], None]) -> None:
        def step() -> None:
            try:
                work.send(None)
            except StopIteration as end:
                self.destroy_timer(timer)
                done(end.value)
            except BaseException:
                self.destroy_timer(timer)
                raise

        timer = wall_timer(self, _POLL, step)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription as any node does; messages that wait are dropped."""
        # rclpy's EventsExecutor takes them all the same
        subscription.callback = lambda _: None
        return bool(super().destroy_subscription(subscription))

    def destroy_service(self, service: Service) -> bool:
        """Destroy a service as any node does; requests that wait are dropped."""
        service.callback = lambda _, response: response
        return bool(super().destroy_service(service))

    def destroy_timer(self, timer: Timer) -> bool:
        """Destroy a timer as any node does; a call that waits is dropped."""
        timer.callback = lambda: None
        return bool(super().destroy_timer(timer))

    def await_delivery(self, publishers: Iterable[Publisher]) -> None:
        """Wait until subscribers have all messages: those under way are lost with their sender."""
        deadline = time.monotonic() + self.last_messages_time
        for publisher in publishers:
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, deadline - time.monotonic())))

    def guarded(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return a callback whose exceptions end no other node of the process."""
        if (hosting := self.hosting) is None:
            return callback

        @functools.wraps(callback)
        def call(*arguments: Any) -> Any:
            try:
                return callback(*arguments)
            except BaseException as error:
                contained(error)
                hosting.failed(error)
                return None

        return call


def wall_timer(node: HostedNode, seconds: float, callback: Callable[[], Any], **options: Any
               ) -> Timer:
    """Create a timer by the steady clock, which runs while simulated time is paused."""
    return node.create_timer(seconds, callback, clock=node.steady_clock, **options)
