# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The operator beside a loop: set-points, parameters and services."""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_srvs.srv import SetBool, Trigger

from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from validation.faults.line import Line

_STEADY = 0.3  # s of wall time that a set-point must stay the one tracked
_START_TIMEOUT = 30.0  # s for the processes to find each other


class Operator:
    """
    Turn set-points, change parameters and call services of the loop's nodes.

    :param harness: whose node speaks.
    :param line: whose course takes down what was asked for, and when.
    :param wait: waits until a condition holds and returns what it returned, or complains.

    :ivar setpoint: the publisher of set-points, for what is not to be taken down.
    """

    def __init__(self, harness: Harness, line: Line, wait: Callable[..., Any]) -> None:
        self._harness = harness
        self._node = harness.node
        self._line = line
        self._wait = wait
        self._clients: dict[str, Client] = {}
        self.setpoint = self.speak(topics.SETPOINT)

    def speak(self, topic: str, kind: Any = Temperature) -> Publisher:
        """Return a publisher."""
        return self._node.create_publisher(kind, topic, topics.LOOP_QOS)

    def meet_controller(self) -> None:
        """Wait until the controller is there and knows the rig."""
        self._harness.meet('controller')
        self._wait(self.setpoint.get_subscription_count, 'nobody hears the set-point',
                  _START_TIMEOUT)

    def ask(self, celsius: float) -> None:
        """Ask for a set-point."""
        self._line.course.setpoints.append((self._line.now, celsius))
        self.setpoint.publish(Temperature(temperature=celsius))

    def insist(self, celsius: float) -> None:
        """Ask for a set-point until the controller, which may be new, says that it tracks it."""
        heard: list[float] = []

        def hear(message: Any) -> None:
            heard.append(message.temperature)

        listening = self._node.create_subscription(
            Temperature, topics.ACTIVE_SETPOINT, hear, topics.LATCHED_QOS)
        self.meet_controller()
        due = steady_since = 0.0

        def tracked() -> bool:
            nonlocal due, steady_since
            if (now := time.monotonic()) >= due:
                self.setpoint.publish(Temperature(temperature=celsius))
                due = now + 0.2
            if not heard or abs(heard[-1] - celsius) > 1e-6:
                steady_since = now
            return now - steady_since > _STEADY

        self._wait(tracked, 'the controller does not track what it was asked for')
        self._node.destroy_subscription(listening)
        self._line.course.setpoints.append((self._line.now, celsius))

    def client(self, kind: Any, service: str) -> Client:
        """Return the client of a service."""
        if service not in self._clients:
            self._clients[service] = self._node.create_client(kind, service)
        return self._clients[service]

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service and return its answer."""
        client = self.client(kind, service)
        self._wait(client.service_is_ready, f'there is no service {service}')
        asked: list[Future] = []
        due = 0.0

        def answered() -> Any:
            nonlocal due
            if (now := time.monotonic()) >= due:
                asked.append(client.call_async(request))
                due = now + 2.0
            return next((future for future in asked if future.done()), None)

        return self._wait(answered, f'{service} does not answer').result()

    def trigger(self, service: str) -> Any:
        """Call a service that takes nothing."""
        return self.call(Trigger, service, Trigger.Request())

    def set_bool(self, service: str, value: bool) -> Any:
        """Call a service that takes a yes or no."""
        return self.call(SetBool, service, SetBool.Request(data=value))

    def set_parameters(self, node: str, **values: Any) -> list[str]:
        """Set parameters one by one; return why each was refused, empty where it was not."""
        request = SetParameters.Request(parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()])
        results = self.call(SetParameters, f'{node}/set_parameters', request).results
        return ['' if result.successful else result.reason for result in results]
