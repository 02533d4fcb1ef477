# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Life of a node's process: start, one-line reason on a bad start, clean end on a signal."""

from __future__ import annotations

from collections.abc import Callable
import os
import signal
import sys
from typing import Any

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

from koopman_ros.last_resort import end_by_force
from koopman_ros.ros import command_line
from koopman_ros.ros.exposure import open_to_the_network
from koopman_ros.ros.parameters import ParameterNode
from koopman_ros.ros.watchdog import end_in_time
from koopman_ros.startup import ignore_signals, SIGNALS
from koopman_ros.units import NANOSECONDS

# A parameter or a model that does not fit is a ValueError; rclpy raises RCLError for an unreadable
# parameter file, a RuntimeError whose class is private to the extension.
_START_ERRORS = (OSError, ParameterException, RuntimeError, ValueError)

_LONGEST_WAIT = 0.1  # s from a signal to the end
_TAKE_DOWN_PATIENCE = 5.0  # s; taking down a participant needs some ten milliseconds


class LoopNode(ParameterNode):
    """
    A node with work of its own to complete before the middleware is taken down.

    :ivar exit_code: ends the process when a node whose work is done sets it.
    """

    exit_code: int | None = None
    _clocks_refused = 0

    def create_subscription(self, msg_type: Any, topic: str, callback: Callable[[Any], None],
                            *args: Any, **options: Any) -> Subscription:
        """Subscribe as any node does; a time that cannot be does not reach its clock."""
        # rclpy subscribes through here for `use_sim_time`, and a negative time ends it in spin
        heard = self._possible(callback) if msg_type is Clock else callback
        return super().create_subscription(msg_type, topic, heard, *args, **options)

    def _possible(self, callback: Callable[[Clock], None]) -> Callable[[Clock], None]:
        def hear(message: Clock) -> None:
            time = message.clock
            if time.sec >= 0 and time.nanosec < NANOSECONDS:
                callback(message)
                return
            self._clocks_refused += 1
            self.get_logger().warning(
                f'/clock told sec {time.sec}, nanosec {time.nanosec}, which is no time: ignored '
                f'({self._clocks_refused} so far); check who publishes /clock',
                throttle_duration_sec=10.0)

        return hear

    def complete(self) -> None:
        """Complete that work; by default there is none. What is published here goes out last."""


def run(name: str, create: Callable[[], LoopNode], args: list[str] | None = None) -> int:
    """
    Run a node until SIGINT, SIGTERM or SIGHUP, which end it between two callbacks.

    One that is still in a callback after five seconds is ended by force.

    :param name: word that starts an error line.
    :param create: builds the node.
    :param args: command line, or None for the process's own.
    :return: exit code, 0 after a signal and for `--help`, 1 when the node could not start, 2 for
        an unknown argument, or the node's own.
    """
    # a list, because a second signal may come while the first is handled, where a lock would hang
    arrived: list[int] = []
    for number in SIGNALS:
        signal.signal(number, lambda number, _: arrived.append(number))
    if (said := command_line.answer(name, args)) is not None:
        return said
    leave = end_in_time(name)
    node = None
    try:
        try:
            _init(args)
            node = create()
        except _START_ERRORS as error:
            print(f'{name}: cannot start: {_one_line(error)}', file=sys.stderr)
            return 1
        if note := open_to_the_network(os.environ):
            node.get_logger().warning(note)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not arrived and node.exit_code is None:
            # Python handles a signal when the wait returns, so the wait is bounded
            executor.spin_once(timeout_sec=_LONGEST_WAIT)
    finally:
        leave()
        try:
            if node is not None:
                node.complete()
        finally:
            _take_down(name, node)
            ignore_signals()
    return node.exit_code or 0


def run_task(name: str, prepare: Callable[[], Callable[[], int]],
             args: list[str] | None = None) -> int:
    """
    Run what needs ROS for its parameters and names alone; an interrupt ends it.

    :param name: word that starts an error line.
    :param prepare: reads them with a node of its own, and returns the task, which runs without
        the middleware and returns the exit code.
    :param args: command line, or None for the process's own.
    :return: exit code; 1 when it could not start or complete, 2 for an unknown argument.
    """
    if (said := command_line.answer(name, args)) is not None:
        return said
    try:
        try:
            _init(args)
            task = prepare()
        finally:
            rclpy.try_shutdown()
        return task()
    except _START_ERRORS as error:
        print(f'{name}: {_one_line(error)}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def _take_down(name: str, node: LoopNode | None) -> None:
    """
    Take the middleware down, or leave it to the operating system when it hangs in that.

    Fast DDS can: two of its threads wait for each other, and whoever takes an entity down waits
    for them, in rclpy with the interpreter's lock held. See docs/middleware.md.
    """
    disarm = end_by_force(_TAKE_DOWN_PATIENCE, 0, (
        f'{name}: the middleware does not shut down: left to the operating system'))
    if node is not None:
        node.destroy_node()
    rclpy.try_shutdown()
    # whoever called may go on
    disarm()


def _init(args: list[str] | None) -> None:
    # rcl logs what it also raises, which would say it twice
    set_logger_level('rcl', LoggingSeverity.FATAL)
    # rclpy's own handlers end the context in the middle of a callback: what the callback then
    # publishes or asks fails, and an interrupt inside the extension comes out as another error
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    set_logger_level('rcl', LoggingSeverity.UNSET)


def _one_line(error: Exception) -> str:
    """Return an error's text on one line; rcl repeats itself over several."""
    text = str(error).split(', at ./')[0].split(', at /')[0]
    return ' '.join(text.split()) or type(error).__name__
