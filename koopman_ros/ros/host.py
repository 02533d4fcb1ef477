# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Many loops in one process: a node each, one executor; a failed node ends no other."""

from collections.abc import Callable, MutableMapping, Sequence
from functools import partial
import os
from pathlib import Path
import signal
import sys
import time
import traceback

from rclpy.exceptions import InvalidNamespaceException
from rclpy.validate_namespace import validate_namespace

from koopman_ros.core.paths import config_directory, LEAN_PROFILE
from koopman_ros.core.plugins import contained
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.process_entry import handle_signals
from koopman_ros.ros.diagnostics import Diagnostics, Severity, TaskReport
from koopman_ros.ros.hosted import HostContext, HostedNode, wall_timer
from koopman_ros.ros.managed import ManagedNode, one_line, START_ERRORS
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.process import (
    init,
    LONGEST_WAIT,
    PROFILES,
    start_warnings,
    take_down,
    TAKE_DOWN_PATIENCE,
)
from koopman_ros.ros.rclpy_internals import events_executor
from koopman_ros.ros.watchdog import end_in_time

_PERIOD = 0.1  # s between two looks at nodes that have ended
_GOODBYE = 0.1  # s that taking down a node may take
_LATE = 0.5  # s; a timer so late shows that the process is overloaded
_SHOWN = 10  # loops that failed, in diagnostics; the log has them all

# Collected nodes are destroyed one by one, each with a message to all others; at the end of the
# process all are gone at once.
_LEFT: list[object] = []


def loop_namespace(name: str, where: str) -> str:
    """
    Return the full namespace of a loop.

    :param where: the name is given, for the message.
    :raises ConfigurationError: for an invalid name.
    """
    namespace = f'/{name.lstrip("/")}'
    try:
        validate_namespace(namespace)
    except InvalidNamespaceException as error:
        raise ConfigurationError(f'{where}: {name[:100]!r} is not a namespace '
                                 f'({one_line(error)}): use e.g. line_1/reactor_3') from None
    return namespace


def read_loops(path: Path) -> tuple[str, ...]:
    """
    Read the namespaces of loops, one a line; blank lines and comments after # do not count.

    :raises ConfigurationError: naming the line and its defect.
    :raises OSError: when the file cannot be read.
    """
    lines: dict[str, int] = {}
    for number, line in enumerate(path.read_text(errors='replace').splitlines(), 1):
        if not (word := line.partition('#')[0].strip()):
            continue
        namespace = loop_namespace(word, f'{path}, line {number}')
        if namespace in lines:
            raise ConfigurationError(f'{path}, line {number}: {namespace} is also in line '
                                     f'{lines[namespace]}: each loop needs its own')
        lines[namespace] = number
    if not lines:
        raise ConfigurationError(f'{path} lists no loops: write one namespace per line')
    return tuple(lines)


class Host:
    """
    The nodes of many loops, and one that reports their state.

    :param create: makes the node of one loop, given its namespace and the hosting.
    """

    def __init__(self, name: str, create: Callable[..., LoopNode], loops: Sequence[str],
                 args: list[str] | None) -> None:
        self._create, self._loops = create, loops
        self._waiting = list(reversed(loops))
        self._nodes: dict[str, LoopNode] = {}  # that run, by namespace
        self._failed: dict[str, str] = {}  # why, by namespace
        self._set_aside: list[LoopNode] = []  # whose watchdogs stand in for them
        self._leaving: list[str] = []
        self._node = HostedNode(f'{name}_host', None)
        if self._node.get_namespace() != '/':
            raise ConfigurationError(
                f'-r __ns:={self._node.get_namespace()} would apply to all loops: write the '
                'namespaces into the file of loops')
        self.executor = events_executor()
        self.executor.add_node(self._node)
        self._diagnostics = Diagnostics(self._node).add('loops', self._status)
        self._delay, self._looked = 0.0, time.monotonic()
        wall_timer(self._node, _PERIOD, self._look)
        for note in start_warnings(name, f'{loops[0]}/{name}', args):
            self._node.get_logger().warning(note)

    def run(self, arrived: Sequence[int]) -> int:
        """
        Start the loops one after the other, and run them until a signal arrives or none is left.

        :return: 0 after a signal, or when all were shut down; 1 when none is left and one failed.
        """
        while not arrived:
            if self._waiting:
                self._begin(self._waiting.pop())
                self._catch_up(arrived)
            elif self._nodes:
                self._turn()
            else:
                return int(bool(self._failed))
        return 0

    def complete(self) -> None:
        """Let no node command while the middleware is taken down."""
        _LEFT.append(self)
        for node in (*self._nodes.values(), *self._set_aside):
            node.complete()

    def _turn(self) -> None:
        """Call one callback that is due, or wait for the next; no exception ends a loop."""
        try:
            self.executor.spin_once(timeout_sec=LONGEST_WAIT)
        except Exception:
            # the exception of a node's callback has ended that node; others are rclpy's own
            self._node.get_logger().error(traceback.format_exc(), throttle_duration_sec=1.0)
        while self._leaving:
            self._part(self._leaving.pop())

    def _catch_up(self, arrived: Sequence[int]) -> None:
        """Call every callback that is due before another loop is started."""
        done: list[bool] = []
        self.executor.create_task(lambda: done.append(True))
        while not done and not arrived:
            self._turn()

    def _begin(self, namespace: str) -> None:
        hosting = HostContext(len(self._loops), partial(self._fail, namespace))
        try:
            node = self._create(namespace=namespace, hosting=hosting)
            if isinstance(node, ManagedNode) and node.get_parameter('autostart').value:
                node.start()
        except BaseException as error:
            contained(error)
            self._note(namespace, error, 'cannot start: ')
            for made in hosting.made:
                _destroy(made)
            return
        self._nodes[namespace] = node
        self.executor.add_node(node)

    def _fail(self, namespace: str, error: BaseException) -> None:
        """Record the exception of a callback; its node gets no further callbacks."""
        if namespace not in self._failed:
            self._note(namespace, error, 'stopped: ')
            self._leaving.append(namespace)

    def _note(self, namespace: str, error: BaseException, what: str) -> None:
        self._failed[namespace] = f'{what}{one_line(error)}'
        expected = isinstance(error, START_ERRORS) and namespace not in self._nodes
        self._node.get_logger().error(f'{namespace}: {what}' + (
            one_line(error) if expected else ''.join(traceback.format_exception(error))))
        self._diagnostics.publish_if_changed()

    def _part(self, namespace: str) -> None:
        """Remove a node that has failed or was shut down."""
        # it may have failed while it was shut down
        if (node := self._nodes.pop(namespace, None)) is None:
            return
        self.executor.remove_node(node)
        if namespace in self._failed:
            # its watchdog takes it for busy: it holds the command, then goes to the safe one
            self._set_aside.append(node)
        else:
            _destroy(node)

    def _look(self) -> None:
        now = time.monotonic()
        self._delay, self._looked = max(self._delay, now - self._looked - _PERIOD), now
        self._leaving += [namespace for namespace, node in self._nodes.items()
                          if node.exit_code is not None and namespace not in self._leaving]

    def _status(self) -> TaskReport:
        running, failed = len(self._nodes), list(self._failed.items())
        level, message = Severity.OK, f'{running} of {len(self._loops)} loops are running'
        if failed:
            level, message = Severity.ERROR, f'{message}, {len(failed)} failed: ' + '; '.join(
                f'{namespace}: {why}' for namespace, why in failed[:_SHOWN]) + (
                '; and more, see the log' if len(failed) > _SHOWN else '')
        delay, self._delay = self._delay, 0.0
        if level is Severity.OK and delay > _LATE and not self._waiting:
            level, message = Severity.WARN, (
                f'{message}, {delay:.2g} s late: one process cannot keep up; distribute the loops '
                'over several processes, or increase the sample period')
        return TaskReport(level, message, {
            'loops': len(self._loops), 'running': running, 'failed': len(failed),
            'to be started': len(self._waiting),
            'longest delay of a timer [ms]': 1e3 * delay})


def _destroy(node: HostedNode) -> None:
    if isinstance(node, LoopNode):
        node.complete()
    node.destroy_node()


def run_loops(name: str, create: Callable[..., LoopNode], args: list[str] | None, file: str,
              arrived: Sequence[int]) -> int:
    """
    Run a node for each loop of a file until a signal; see :func:`koopman_ros.ros.process.run`.

    :param arrived: signals, as they come.
    :return: exit code, 1 when no loop could start, or all have failed since then.
    """
    leave = end_in_time(name)
    host = None
    loops: tuple[str, ...] = ()
    try:
        try:
            loops = read_loops(Path(file))
            _be_lean(os.environ)
            init(args)
            host = Host(name, create, loops, args)
        except START_ERRORS as error:
            print(f'{name}: cannot start: {one_line(error)}', file=sys.stderr)
            return 1
        return host.run(arrived)
    finally:
        leave()
        try:
            if host is not None:
                host.complete()
        finally:
            # the middleware says good-bye for each node
            take_down(name, None, None if host is None else host.executor,
                      TAKE_DOWN_PATIENCE + _GOODBYE * len(loops))
            handle_signals(signal.SIG_IGN)


def _be_lean(environment: MutableMapping[str, str]) -> None:
    """Select the Fast DDS profile with little reserved memory, unless another is set."""
    if not any(environment.get(name) for name in PROFILES):
        environment.update(dict.fromkeys(PROFILES, str(config_directory() / LEAN_PROFILE)))
