# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The panel node: shows one or many loops in a browser, and forwards operators' commands."""

from functools import partial
import sys
import threading
import traceback
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterEvent
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile

from koopman_ros.nodes.panel_loop import declare, PanelLoop
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.ros import topics
from koopman_ros.ros.diagnostics import Severity, TaskReport
from koopman_ros.ros.host import loop_namespace
from koopman_ros.ros.hosted import HostContext
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.process import LONGEST_WAIT, run


class PanelNode(LoopNode):
    """
    Serve the pages of one or many loops.

    The loop in the namespace of the panel uses its node. Each other one has a node and a thread of
    its own: the work of an executor for a message grows with all that its nodes wait for.

    :ivar loops: by namespace.
    """

    def __init__(self) -> None:
        super().__init__('panel')
        self.loops: dict[str, PanelLoop] = {}
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []
        try:
            self._start()
        except BaseException:
            # a node that did not start would go on listening in this process
            self._end_loops()
            self.destroy_node()
            raise

    def _start(self) -> None:
        own, declared = self.get_namespace(), declare(self)
        self._settings = settings = declared.settings
        names = [loop_namespace(name, 'loops') if name else own for name in settings.loops]
        hosting = HostContext(len(names), self._on_failure)
        for name in names:
            if name in self.loops:
                raise ConfigurationError(f'loops: {name} is given twice: name each loop once')
            if name == own:
                self.loops[name] = PanelLoop(self, declared)
                continue
            # remapping rules of a node precede those of the command line
            node = LoopNode('panel', hosting, cli_args=['--ros-args', '-r', f'__ns:={name}'])
            self.loops[name] = PanelLoop(node, declare(node))
        self._check_files()
        self._by_node = {full: loop for loop in self.loops.values() for full in loop.roles}
        matching = topics.EndpointMonitor(self, lambda: None)
        matching.subscribe(topics.DIAGNOSTICS, self._on_diagnostics, qos=QoSProfile(depth=1000))
        self.create_subscription(
            ParameterEvent, '/parameter_events', self._on_event, QoSProfile(depth=1000))
        self._server = self._serve()
        self.diagnostics.add('pages', self._status)
        for loop in self._others():
            self._threads.append(threading.Thread(target=self._spin, args=(loop.node,)))
            self._threads[-1].start()
        self.get_logger().info(f'the panel is at {self._server.address}')

    def _others(self) -> list[PanelLoop]:
        return [loop for loop in self.loops.values() if loop.node is not self]

    def _spin(self, node: LoopNode) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        try:
            while not self._over.is_set():
                executor.spin_once(LONGEST_WAIT)
        except Exception as error:
            self._on_failure(error)
        finally:
            executor.shutdown()

    def _on_failure(self, error: BaseException) -> None:
        """End the panel after an error in a loop, whose pages would show old values."""
        self.get_logger().error(''.join(traceback.format_exception(error)))
        self.exit_code = 1

    def _check_files(self) -> None:
        files = [file for loop in self.loops.values() for file in loop.files]
        if twice := next((file for file in files if files.count(file) > 1), None):
            raise ConfigurationError(
                f'alarm_file and history_file: {twice} is used twice: give each loop its own '
                'files in a section of its node, e.g. /line_1/reactor_3/panel')

    def _serve(self) -> Any:
        try:
            from koopman_ros.panel.server import PanelServer
        except ImportError as error:
            raise ConfigurationError(
                f"the panel needs {error.name}, which is not installed: pip install 'nicegui>=3' "
                'argon2-cffi itsdangerous limits') from error
        settings = self._settings
        server = PanelServer(
            self.loops, settings.host, settings.port, settings.users, settings.tls_certificate,
            settings.tls_key, [*filter(None, settings.trusted_proxy)], settings.command_timeout)
        server.start()
        return server

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            loop = self._by_node.get(status.name.partition(': ')[0])
            for one in [loop] if loop else self.loops.values():
                one.post(partial(one.take_status, status))
        self.diagnostics.hardware_id = ', '.join(dict.fromkeys(
            loop.plant for loop in self.loops.values()))

    def _on_event(self, event: ParameterEvent) -> None:
        for loop in self.loops.values():
            loop.on_event(event)

    def _status(self) -> TaskReport:
        return TaskReport(Severity.OK, f'{self._server.pages} pages are open', {
            'address': self._server.address, 'pages': self._server.pages,
            'loops': len(self.loops)})

    def complete(self) -> None:
        """Stop the pages, and save the alarms."""
        self._server.stop()
        self._end_loops()

    def _end_loops(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        for loop in self.loops.values():
            loop.complete()

    def destroy_node(self) -> None:
        """Destroy the node, and those of its loops."""
        for loop in self._others():
            loop.node.destroy_node()
        super().destroy_node()


def main(args: list[str] | None = None) -> int:
    """Run the panel node."""
    return run('panel', PanelNode, args)


if __name__ == '__main__':
    sys.exit(main())
