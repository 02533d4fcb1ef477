# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Plain nodes of rclpy on the controller's topics: an echo, and a textbook PID controller.

Run one as ``python -m benchmarks.answering echo`` or ``... pid``.
"""

import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Temperature

from koopman_ros.ros import topics


def echo() -> Node:
    """Return a node that answers each temperature with the same message."""
    node = rclpy.create_node('echo')
    answers = node.create_publisher(Temperature, 'coolant_setpoint', topics.LOOP_QOS)
    node.create_subscription(Temperature, 'temperature', answers.publish, topics.LOOP_QOS)
    return node


class PidNode(Node):
    """Command the coolant by the textbook: bounds, anti-windup, derivative of the measurement."""

    def __init__(self) -> None:
        super().__init__('pid')
        self._gain, self._integral_time, self._derivative_time = 1.0, 120.0, 5.0  # K/K, s, s
        self._lower, self._upper, self._setpoint = 10.0, 40.0, 51.0  # degC
        self._integral, self._before = 25.0, (0.0, float('nan'))
        self._commands = self.create_publisher(Temperature, 'coolant_setpoint', topics.LOOP_QOS)
        self.create_subscription(
            Temperature, 'temperature', self._on_temperature, topics.LOOP_QOS)

    def _on_temperature(self, message: Temperature) -> None:
        seconds = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        before, measured = self._before
        self._before = seconds, message.temperature
        step = seconds - before
        error = self._setpoint - message.temperature
        slope = (message.temperature - measured) / step if 0.0 < step < 60.0 else 0.0
        free = self._gain * (error - self._derivative_time * slope) + self._integral
        command = min(max(free, self._lower), self._upper)
        if free == command and 0.0 < step < 60.0:
            self._integral += self._gain * error * step / self._integral_time
        self._commands.publish(Temperature(header=message.header, temperature=command))


def main(name: str) -> int:
    """Spin a node with rclpy's default executor until a signal ends the process."""
    rclpy.init()
    node = {'echo': echo, 'pid': PidNode}[name]()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1]))
