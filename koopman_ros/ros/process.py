# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Process of a node: start, reason in one line for a bad start, clean end after a signal."""

from collections.abc import Callable, Mapping
import os
from pathlib import Path
import re
import signal
import sys

import rclpy
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from koopman_ros import __version__
from koopman_ros.core.paths import LOOPBACK_PROFILE
from koopman_ros.process_entry import force_exit_after, handle_signals
from koopman_ros.ros.managed import ManagedNode, one_line, START_ERRORS
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.parameter_files import ignored_sections
from koopman_ros.ros.watchdog import end_in_time

PROFILES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
_LOOPS = '--loops'
# (arguments, file of loops, signals as they come) to the exit code
LoopRunner = Callable[[list[str] | None, str, list[int]], int]
LONGEST_WAIT = 0.1  # s from a signal to the end
TAKE_DOWN_PATIENCE = 5.0  # s; taking down a participant needs some ten milliseconds


def run(name: str, create: Callable[[], LoopNode], args: list[str] | None = None,
        loops: LoopRunner | None = None, executor: Callable[[], Executor] = SingleThreadedExecutor
        ) -> int:
    """
    Run a node until SIGINT, SIGTERM or SIGHUP, which end it between two callbacks, or by force.

    :param loops: runs the file of ``--loops``; None for a node without that argument.
    :return: exit code, 0 after a signal and for `--help`, 1 when the node could not start, 2 for
        an unknown argument, or the node's own.
    """
    # a list, because a second signal may come while the first is handled, where a lock would hang
    arrived: list[int] = []
    handle_signals(lambda number, _: arrived.append(number))
    if (code := answer(name, args, loops is not None)) is not None:
        return code
    if loops is not None and (file := _loops_file(args)) is not None:
        return loops(args, file, arrived)
    leave = end_in_time(name)
    node = spinning = None
    try:
        try:
            init(args)
            node = create()
            spinning = executor()
            spinning.add_node(node)
            if isinstance(node, ManagedNode) and node.get_parameter('autostart').value:
                node.start()
        except START_ERRORS as error:
            print(f'{name}: cannot start: {one_line(error)}', file=sys.stderr)
            return 1
        for note in start_warnings(name, node.get_fully_qualified_name(), args):
            node.get_logger().warning(note)
        while not arrived and node.exit_code is None:
            # Python handles a signal when the wait returns, so the wait is bounded
            spinning.spin_once(timeout_sec=LONGEST_WAIT)
    finally:
        leave()
        try:
            if node is not None:
                node.complete()
        finally:
            take_down(name, node, spinning)
            handle_signals(signal.SIG_IGN)
    return node.exit_code or 0


def run_task(name: str, prepare: Callable[[], Callable[[], int]],
             args: list[str] | None = None) -> int:
    """
    Run a task that needs ROS for its parameters and names only; an interrupt ends it.

    :param prepare: reads them, and returns a task without ROS that returns the exit code, which
        is 1 when it could not start or complete, 2 for an unknown argument.
    """
    if (code := answer(name, args)) is not None:
        return code
    try:
        try:
            init(args)
            task = prepare()
        finally:
            rclpy.try_shutdown()
        return task()
    except START_ERRORS as error:
        print(f'{name}: {one_line(error)}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def take_down(name: str, node: LoopNode | None, executor: Executor | None,
              patience: float = TAKE_DOWN_PATIENCE) -> None:
    """Take a node down, and the middleware, by force after `patience` s."""
    # Fast DDS can hang in that, in rclpy with the interpreter's lock held: see
    # docs/explanation/fast_dds_deadlock.md
    disarm = force_exit_after(patience, 0, (
        f'{name}: the middleware did not shut down: the process is ended'))
    if executor is not None:
        # its threads would call into the interpreter while that ends
        executor.shutdown()
    if node is not None:
        node.await_delivery(node.publishers)
        node.destroy_node()
    rclpy.try_shutdown()
    # the caller may continue
    disarm()


def init(args: list[str] | None) -> None:
    """Begin with ROS; signals stay with us."""
    # rcl logs the errors that it also raises: report them once
    set_logger_level('rcl', LoggingSeverity.FATAL)
    # rclpy's own handlers end the context in the middle of a callback: what the callback then
    # publishes or asks fails, and an interrupt inside the extension comes out as another error
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    set_logger_level('rcl', LoggingSeverity.UNSET)


def _loops_file(args: list[str] | None) -> str | None:
    """Return the file of loops if it is the only argument that is not ROS's, or None."""
    try:
        rest = remove_ros_args(args)[1:]
    except RuntimeError:
        return None
    return rest[1] if rest[:1] == [_LOOPS] and len(rest) == 2 else None


def _given(args: list[str] | None) -> dict[str, str]:
    """Return the system and the model among the arguments."""
    found = (re.fullmatch(r'(?:.*:)?(system|model):=(.*)', arg) for arg in (
        sys.argv if args is None else args))
    return {match[1]: match[2].strip('\'"') for match in found if match}


def answer(name: str, args: list[str] | None, hosts: bool = False) -> int | None:
    """Print help or version, or reject an argument; return an exit code, or None to start."""
    if '--version' in (sys.argv if args is None else args):
        print(__version__, flush=True)
        return 0
    if {'--help', '-h'} & {*(sys.argv if args is None else args)}:
        # the tables of all nodes
        from koopman_ros.ros.node_descriptions import help_text

        try:
            print(help_text(name, _given(args)), flush=True)
        except ValueError as error:
            print(f'{name}: {one_line(error)}', file=sys.stderr)
            return 1
        except BrokenPipeError:
            # `--help | head` stops half-way; the interpreter flushes once more when it ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    try:
        rest = remove_ros_args(args)[1:]
    except RuntimeError:
        # rclpy.init gives the reason
        return None
    if not rest or (hosts and _loops_file(args) is not None):
        return None
    print(f'{name}: unknown argument {rest[0][:100]!r}: pass parameters as --ros-args -p '
          'name:=value; see --help', file=sys.stderr)
    return 2


def start_warnings(program: str, full_name: str, args: list[str] | None) -> list[str]:
    """Return warnings about the command line and the environment of a node."""
    return [*ignored_sections(sys.argv if args is None else args, program, full_name),
            *filter(None, [open_to_the_network(os.environ)])]


def open_to_the_network(environment: Mapping[str, str]) -> str:
    """Return a warning for a node that others on the network can command, or ''."""
    closed = (
        environment.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper() in ('LOCALHOST', 'OFF')
        or environment.get('ROS_LOCALHOST_ONLY') == '1'
        or any(Path(environment.get(name, '')).name == LOOPBACK_PROFILE for name in PROFILES)
        # with keys, or not at all
        or (environment.get('ROS_SECURITY_ENABLE', '').lower() == 'true'
            and environment.get('ROS_SECURITY_STRATEGY', '') == 'Enforce'))
    return '' if closed else (
        'open to the network: any machine on the same network can command this node in ROS domain '
        f'{environment.get("ROS_DOMAIN_ID") or 0}; ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST '
        'restricts access to this machine')
