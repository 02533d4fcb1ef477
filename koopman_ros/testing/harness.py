# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A ROS node inside a test, in a domain of its own, with the processes that it talks to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import contextlib
from pathlib import Path
import signal
import time
from types import TracebackType
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool, Trigger

from koopman_ros.ros.remote_node import repeated
from koopman_ros.ros.topics import DIAGNOSTICS, LOOP_QOS, node_name
from koopman_ros.testing.process import given_domain, isolated_domain, NodeProcess

_TURN = 0.05  # s; how long the node listens before a condition is looked at again
_ASK_AGAIN = 0.5  # s
T = TypeVar('T')


class HarnessError(RuntimeError):
    """An expected condition was not met, or a process ended with an unexpected code."""


class Harness:
    """
    Start processes in a ROS domain of their own, and communicate with them from a node here.

    ::

        with Harness(tmp_path) as ros:
            ros.start('controller', {'model': 'reactor_nz4'})
            ros.start('mine', command=('ros2', 'run', 'my_package', 'my_node'))
            commands = ros.listen(Temperature, 'coolant_setpoint')
            ros.wait_until(lambda: len(commands) > 10, 'ten commands')

    Leaving the context ends all processes, by force in the end, and raises HarnessError when one
    of them ends with another code than 0. They end, too, when this process is killed.

    :param folder: for the output of the processes, a file each; must exist.
    :param environment: variables for the processes, on top of the present ones.
    :param name: of the node in here.
    :param timeout: in s, after which a wait fails.
    :param lasting: whether no process may end by itself, not even with code 0.
    :param domain: ROS domain to work in, with this process's settings of discovery; by default one
        that no other run uses.
    :param each_turn: called again and again while something is waited for; may raise.

    :ivar node: the node of the test, for all that has no method here.
    :ivar environment: variables of the processes, ``ROS_DOMAIN_ID`` among them.
    :ivar processes: all that were started.
    :ivar statuses: of diagnostics, as they came.
    """

    def __init__(self, folder: Path, environment: Mapping[str, str] | None = None, *,
                 name: str = 'bench', timeout: float = 120.0, lasting: bool = False,
                 domain: str = '', each_turn: Callable[[], object] = lambda: None) -> None:
        self.folder = folder
        self.processes: list[NodeProcess] = []
        self.statuses: list[DiagnosticStatus] = []
        self._timeout = timeout
        self._lasting = lasting
        self._each_turn = each_turn
        with contextlib.ExitStack() as stack:
            chosen = given_domain(domain) if domain else isolated_domain()
            self.environment = {**stack.enter_context(chosen), **(environment or {})}
            context = Context()
            rclpy.init(context=context, domain_id=int(self.environment['ROS_DOMAIN_ID']))
            stack.callback(rclpy.shutdown, context=context)
            self.node = Node(name, context=context)
            stack.callback(self.node.destroy_node)
            self._executor = SingleThreadedExecutor(context=context)
            stack.callback(self._executor.shutdown)
            self._executor.add_node(self.node)
            self._made = stack.pop_all()
        self.node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 100)

    def __enter__(self) -> Harness:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        ended = self.close()
        if kind is None and any(ended.values()):
            raise self._error(', '.join(f'{name} ended with code {code}'
                                        for name, code in ended.items() if code))

    def close(self) -> dict[str, int]:
        """End all processes, then the node; return the codes, by log, of those ended by this."""
        try:
            # all at once, as some take their time
            left = [process for process in self.processes if not process.told_to_end]
            for process in left:
                process.send(signal.SIGINT)
            codes = {process: process.wait() for process in self.processes}
            return {process.log.stem: codes[process] for process in left}
        finally:
            self._made.close()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.statuses.extend(message.status)

    # Processes.

    def start(self, name: str, parameters: Mapping[str, object] | None = None,
              arguments: tuple[str, ...] = (), command: tuple[str, ...] | None = None,
              called: str = '') -> NodeProcess:
        """Start a process as :class:`NodeProcess`, its log `called` as the node by default."""
        log = self.folder / f'{called or name}_{len(self.processes)}.log'
        process = NodeProcess(name, parameters or {}, log, self.environment, arguments, command)
        self.processes.append(process)
        return process

    def printed(self) -> str:
        """Return the output of all processes."""
        return '\n'.join(f'{process.log.name}: {process.output()}' for process in self.processes)

    def wait_for_end(self, process: NodeProcess) -> int:
        """Wait until a process ends by itself; return its exit code."""
        return process.wait(self._timeout)

    # Waiting.

    def spin_once(self, seconds: float = _TURN) -> None:
        """Let the node handle one message, or wait for so long."""
        self._executor.spin_once(timeout_sec=seconds)
        self._each_turn()

    def wait_until(self, condition: Callable[[], T], what: str | Callable[[], str] = '',
                   timeout: float | None = None) -> T:
        """
        Let the node work until a condition holds, and return its value.

        :param what: the awaited condition, or the present state, for the error.
        :raises HarnessError: after the timeout, or when a process ends unexpectedly.
        """
        patience = self._timeout if timeout is None else timeout
        deadline = time.monotonic() + patience
        while not (found := condition()):
            self._check_processes()
            if time.monotonic() > deadline:
                about = what if isinstance(what, str) else what()
                raise self._error(f'not within {patience:g} s: {about or condition}')
            self.spin_once()
        return found

    def _check_processes(self) -> None:
        for process in self.processes:
            if process.running or process.told_to_end:
                continue
            if (code := process.process.poll()) or self._lasting:
                raise self._error(f'{process.name} ended early, with code {code}: '
                                  f'{process.output()[-1000:].rstrip()}')

    def _error(self, sentence: str) -> HarnessError:
        error = HarnessError(f'{sentence}; see {self.folder}')
        error.add_note(self.printed())
        return error

    def wait_for_status(self, name: str, condition: Callable[[DiagnosticStatus], bool]
                        ) -> DiagnosticStatus:
        """
        Wait until the last status of a task meets a condition.

        A status has its own topic, and is received before or after other messages of the node. The
        condition has to hold for no status from before, e.g. by a count that it carries; all
        assertions on one status belong into one condition.
        """
        def met() -> DiagnosticStatus | None:
            last = self.last_status(name)
            return last if last is not None and condition(last) else None

        status = self.wait_until(met, lambda: f'last status: {self.last_status(name)}')
        assert status is not None
        return status

    def last_status(self, name: str) -> DiagnosticStatus | None:
        """Return the last status of a task, e.g. ``controller: control``."""
        return next((s for s in reversed(self.statuses) if s.name == name), None)

    # Topics.

    def listen(self, kind: Any, topic: str, qos: QoSProfile = LOOP_QOS, *,
               raw: bool = False) -> list[Any]:
        """Return a list to which every message of a topic will be added."""
        received: list[Any] = []
        self.node.create_subscription(kind, topic, received.append, qos, raw=raw)
        return received

    def speak(self, kind: Any, topic: str, qos: QoSProfile = LOOP_QOS, *,
              to: str, subscribers: int = 1) -> Publisher:
        """
        Return a publisher after a node and a number of subscriptions have connected.

        The number includes the node's own. A message that is sent before the publisher has
        discovered a subscription does not reach it.
        """
        publisher = self.node.create_publisher(kind, topic, qos)
        receiver = f'/{to.lstrip("/")}'

        def connected() -> bool:
            return (receiver in map(node_name, self.node.get_subscriptions_info_by_topic(
                publisher.topic_name)) and publisher.get_subscription_count() >= subscribers)

        self.wait_until(connected, f'no subscription of {receiver} to {publisher.topic_name}')
        self.meet(to)
        return publisher

    def meet(self, node: str) -> None:
        """Wait until a node knows the topics and services that the bench has made so far."""
        # it learns of them in the order in which they were made: this call's come last
        client = self.node.create_client(GetParameters, f'{node}/get_parameters')
        self.wait_until(client.service_is_ready)
        self.wait_until(repeated(lambda: client.call_async(
            GetParameters.Request(names=['use_sim_time'])), _ASK_AGAIN))
        self.node.destroy_client(client)

    # Services.

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service and return its response."""
        client = self.node.create_client(kind, service)
        self.wait_until(client.service_is_ready)
        self.meet(service.rpartition('/')[0])
        future = client.call_async(request)
        self.wait_until(future.done)
        self.node.destroy_client(client)
        return future.result()

    def trigger(self, service: str) -> Trigger.Response:
        """Call a service that takes nothing."""
        return self.call(Trigger, service, Trigger.Request())

    def set_bool(self, service: str, value: bool) -> SetBool.Response:
        """Call a service that takes a yes or no."""
        return self.call(SetBool, service, SetBool.Request(data=value))

    def set_parameters(self, node: str, **values: Any) -> list[SetParametersResult]:
        """Set parameters one by one."""
        return self.call(SetParameters, f'{node}/set_parameters', SetParameters.Request(
            parameters=_parameters(values))).results

    def rejected_parameters(self, node: str, **values: Any) -> list[str]:
        """Set parameters one by one; return why, of each that is rejected."""
        reasons = []
        for name, value in values.items():
            # on a busy machine reading a model takes longer than a loop may wait for it
            while 'still being read' in (reason := ''.join(
                    result.reason for result in self.set_parameters(node, **{name: value})
                    if not result.successful)):
                pass
            reasons += [reason] if reason else []
        return reasons

    def set_parameters_atomically(self, node: str, **values: Any) -> SetParametersResult:
        """Set parameters all or none."""
        return self.call(
            SetParametersAtomically, f'{node}/set_parameters_atomically',
            SetParametersAtomically.Request(parameters=_parameters(values))).result

    def get_parameters(self, node: str, *names: str) -> list[Any]:
        """Read parameters."""
        response = self.call(GetParameters, f'{node}/get_parameters',
                             GetParameters.Request(names=list(names)))
        return [parameter_value_to_python(value) for value in response.values]


def _parameters(values: Mapping[str, Any]) -> list[Any]:
    return [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
