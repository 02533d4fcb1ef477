# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A ROS node inside the test, in a domain of its own, with the processes that it talks to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
import signal
import subprocess
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
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_srvs.srv import SetBool, Trigger

from koopman_ros.demo.processes import NodeProcess, STOP_TIMEOUT
from koopman_ros.nodes import topics
from koopman_ros.nodes.messages import NANOSECONDS, stamp_message, stamp_nanoseconds

TIMEOUT = 120.0  # s; a test that waits this long has failed, on a busy machine, too
T = TypeVar('T')


class Workbench:
    """
    Starts nodes as processes and talks to them; leaving the context ends them all.

    :param environment: variables of the reserved domain.
    :param folder: for what the processes print.
    """

    def __init__(self, environment: Mapping[str, str], folder: Path) -> None:
        self.environment = environment
        self.folder = folder
        self.processes: list[NodeProcess] = []
        self._context = Context()
        rclpy.init(context=self._context, domain_id=int(environment['ROS_DOMAIN_ID']))
        self.node = Node('bench', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.statuses: list[DiagnosticStatus] = []
        self.node.create_subscription(
            DiagnosticArray, topics.DIAGNOSTICS,
            lambda message: self.statuses.extend(message.status), 100)

    def __enter__(self) -> Workbench:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        left = [process for process in self.processes if process.running]
        for process in left:
            process.process.send_signal(signal.SIGINT)
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)
        codes = {process.log.name: _code(process) for process in left}
        if kind is None:
            assert not any(codes.values()), (codes, self.printed())

    # Processes.

    def start(self, name: str, parameters: Mapping[str, object] | None = None,
              arguments: tuple[str, ...] = (), command: tuple[str, ...] | None = None
              ) -> NodeProcess:
        """Start a node as a process."""
        log = self.folder / f'{name}_{len(self.processes)}.log'
        process = NodeProcess(name, parameters or {}, log, self.environment, arguments, command)
        self.processes.append(process)
        return process

    def printed(self) -> str:
        """Return what all processes printed."""
        return '\n'.join(f'{process.log.name}: {process.output()}' for process in self.processes)

    # Waiting.

    def wait_until(self, condition: Callable[[], T], about: Callable[[], str] = str) -> T:
        """
        Spin until a condition holds, and return what it returned.

        :param about: says what there was instead.
        """
        deadline = time.monotonic() + TIMEOUT
        while not (found := condition()):
            assert time.monotonic() < deadline, (
                f'not within {TIMEOUT} s\n{about()}\n{self.printed()}')
            assert not any(p.process.poll() for p in self.processes), self.printed()
            self._executor.spin_once(timeout_sec=0.05)
        return found

    def wait_for_end(self, process: NodeProcess) -> int:
        """Wait until a process ends by itself; return its exit code."""
        return process.process.wait(TIMEOUT)

    def wait_for_status(self, name: str, condition: Callable[[DiagnosticStatus], bool]
                        ) -> DiagnosticStatus:
        """
        Wait until the last status of a task meets a condition.

        It may have been collected before the event that it is to show: a status comes on a topic
        of its own, later or sooner than what else a node answers with, and again each second.
        The condition has to hold for no status from before, e.g. by a count that it carries; what
        a test asserts of one status belongs into one condition.
        """
        last: DiagnosticStatus | None = None

        def met() -> bool:
            nonlocal last
            last = next((s for s in reversed(self.statuses) if s.name == name), None)
            return last is not None and condition(last)

        self.wait_until(met, lambda: f'last status: {last}')
        assert last is not None
        return last

    # Topics.

    def listen(self, kind: Any, topic: str, qos: QoSProfile = topics.LOOP_QOS, *,
               raw: bool = False) -> list[Any]:
        """Return a list to which every message of a topic will be added."""
        heard: list[Any] = []
        self.node.create_subscription(kind, topic, heard.append, qos, raw=raw)
        return heard

    def speak(self, kind: Any, topic: str, qos: QoSProfile = topics.LOOP_QOS, *,
              to: str, subscribers: int = 1) -> Publisher:
        """
        Return a publisher that a node hears from the first message on.

        :param to: name of the node.
        :param subscribers: how many there are, with those of the bench.
        """
        publisher = self.node.create_publisher(kind, topic, qos)
        self.wait_until(lambda: publisher.get_subscription_count() >= subscribers)
        self.meet(to)
        return publisher

    def meet(self, node: str) -> None:
        """
        Wait until a node knows the topics and services that the bench has made so far.

        It learns of the bench's readers, and of its writers, in the order in which they were
        made: those of the service call in here come last.
        """
        client = self.node.create_client(GetParameters, f'{node}/get_parameters')
        self.wait_until(client.service_is_ready)
        asked: list[Future] = []
        due = 0.0

        def answered() -> bool:
            nonlocal due
            # the response is lost when the node does not know the reader yet: ask again
            if (now := time.monotonic()) >= due:
                asked.append(client.call_async(GetParameters.Request(names=['use_sim_time'])))
                due = now + 0.5
            return any(future.done() for future in asked)

        self.wait_until(answered)
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


def _code(process: NodeProcess) -> int:
    """Return the exit code of a process that was told to end, or else end it."""
    try:
        return process.process.wait(STOP_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.process.kill()
        return process.process.wait()


def _parameters(values: Mapping[str, Any]) -> list[Any]:
    return [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]


def temperature(celsius: float, seconds: float = 0.0) -> Temperature:
    """Build a temperature with a stamp."""
    message = Temperature(temperature=celsius)
    message.header.stamp = stamp_message(round(seconds * NANOSECONDS))
    return message


def seconds(message: Any) -> float:
    """Return the stamp of a message."""
    return stamp_nanoseconds(message.header.stamp) / NANOSECONDS


def value(status: DiagnosticStatus, key: str) -> str:
    """Return a figure of a status."""
    return next(item.value for item in status.values if item.key == key)
