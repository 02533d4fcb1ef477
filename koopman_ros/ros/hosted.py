# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a node has of a process that it shares with others: timers, and errors of its own."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
import contextlib
from dataclasses import dataclass, field
import functools
import heapq
import inspect
import itertools
import math
import time
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer

_POLL = 0.02  # s between two looks at what an asynchronous callback waits for


class HostedTimer:
    """
    A timer of a :class:`Schedule`, with what the nodes here use of rclpy's.

    :ivar due: by the steady clock, in s.
    """

    def __init__(self, schedule: Schedule, seconds: float, callback: Callable[[], Any]) -> None:
        self._schedule, self._seconds, self._callback = schedule, seconds, callback
        self._turn = 0  # number of the entry in the schedule that counts
        self.reset()

    def reset(self) -> None:
        """Begin a period now."""
        self.due = time.monotonic() + self._seconds
        self._turn = self._schedule.enter(self)

    def cancel(self) -> None:
        """Be due no more, until :meth:`reset`."""
        self._turn = 0

    destroy = cancel

    def holds(self, turn: int) -> bool:
        """Tell whether an entry of the schedule is still the one that counts."""
        return turn == self._turn

    def call(self, now: float) -> None:
        """Call back, and be due again at the next whole period that is ahead."""
        missed = math.floor((now - self.due) / self._seconds) if self._seconds else 0
        self.due += (missed + 1) * self._seconds
        self._turn = self._schedule.enter(self)
        self._callback()


class Schedule:
    """
    Timers of many nodes by the steady clock, in the thread that turns it.

    rclpy's executors look at each timer at each event, or keep a thread for each clock.
    """

    def __init__(self) -> None:
        self._entries: list[tuple[float, int, HostedTimer]] = []
        self._turns = itertools.count(1)

    def timer(self, seconds: float, callback: Callable[[], Any]) -> HostedTimer:
        """Return a timer that is due every so many seconds."""
        return HostedTimer(self, seconds, callback)

    def enter(self, timer: HostedTimer) -> int:
        """Note when a timer is due; return the number of the entry."""
        turn = next(self._turns)
        heapq.heappush(self._entries, (timer.due, turn, timer))
        return turn

    def turn(self) -> float:
        """Call the timer that has been due for the longest; return the seconds to the next."""
        now = time.monotonic()
        if self._entries and self._entries[0][0] <= now:
            _, turn, timer = heapq.heappop(self._entries)
            if timer.holds(turn):
                timer.call(now)
                now = time.monotonic()
        return max(0.0, self._entries[0][0] - now) if self._entries else math.inf


@dataclass(frozen=True)
class Hosting:
    """What a node has of a process of many."""

    schedule: Schedule
    loops: int  #: that share the process
    failed: Callable[[BaseException], None]  #: called with what a callback of the node raised
    made: list[HostableNode] = field(default_factory=list)  #: the node, also a half-made one

    def guarded(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return a callback whose errors end the node and not the process."""
        @functools.wraps(callback)
        def call(*arguments: Any) -> Any:
            try:
                return callback(*arguments)
            except KeyboardInterrupt:
                raise
            except BaseException as error:
                # SystemExit, too: it would end the other nodes of the process
                self.failed(error)
                return None

        return call

    def answering(self, send: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
        """Return what sends a response, also one that an asynchronous callback will return."""
        def answer(response: Any, header: Any) -> None:
            if inspect.iscoroutine(response):
                # rclpy's EventsExecutor awaits no callback before 7.1.11
                self._await(response, lambda found: answer(found, header))
            elif response is not None:
                send(response, header)

        return answer

    def _await(self, work: Coroutine[Any, Any, Any], done: Callable[[Any], None]) -> None:
        def step() -> None:
            try:
                work.send(None)
            except StopIteration as end:
                timer.cancel()
                done(end.value)
            except BaseException:
                timer.cancel()
                raise

        timer = self.schedule.timer(_POLL, self.guarded(step))


class HostableNode(Node):
    """
    A node that has the process for itself, or is hosted by one of many.

    :ivar hosting: None where it is alone.
    :ivar hosted_timers: of the process, in place of rclpy's.
    """

    def __init__(self, name: str, hosting: Hosting | None, **options: Any) -> None:
        self.hosting = hosting
        self.hosted_timers: list[HostedTimer] = []
        super().__init__(name, **options)
        if hosting is not None:
            hosting.made.append(self)

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[..., Any],
                       **options: Any) -> Service:
        """Serve as any node does; an answer that comes after the service's end is dropped."""
        made = super().create_service(srv_type, srv_name, self.guarded(callback), **options)
        send = made.send_response

        def answer(response: Any, header: Any) -> None:
            # rclpy ends spin where a service went while its answer was awaited
            with contextlib.suppress(InvalidHandle):
                send(response, header)

        last: Any = answer if self.hosting is None else self.hosting.answering(answer)
        made.send_response = last  # type: ignore[method-assign]
        return made

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription as any node does; messages that wait are dropped."""
        # rclpy's EventsExecutor takes them all the same
        subscription.callback = lambda _: None
        return bool(super().destroy_subscription(subscription))

    def destroy_service(self, service: Service) -> bool:
        """Destroy a service as any node does; requests that wait are dropped."""
        service.callback = lambda _, response: response
        return bool(super().destroy_service(service))

    def guarded(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return a callback whose errors end no other node of the process."""
        return callback if self.hosting is None else self.hosting.guarded(callback)

    def hosted_timer(self, seconds: float, callback: Callable[[], Any]) -> HostedTimer:
        """Create a timer of the process that the node shares."""
        assert self.hosting is not None
        self.hosted_timers.append(self.hosting.schedule.timer(seconds, self.guarded(callback)))
        return self.hosted_timers[-1]

    def destroy_timer(self, timer: Timer | HostedTimer) -> bool:
        """Destroy a timer as any node does, also one of the process."""
        if isinstance(timer, HostedTimer):
            timer.destroy()
            self.hosted_timers.remove(timer)
            return True
        return bool(super().destroy_timer(timer))
