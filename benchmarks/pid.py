# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A plain PID controller as a node of rclpy, on the controller's topics."""

import sys

from rclpy.node import Node
from sensor_msgs.msg import Temperature

from benchmarks.echo import answer
from koopman_ros.ros import topics


class PidNode(Node):
    """Command the coolant by the textbook: bounds, no wind-up, derivative of the measurement."""

    def __init__(self) -> None:
        super().__init__('pid')
        self.gain = self.declare_parameter('gain', 1.0).value
        self.reset_time = self.declare_parameter('reset_time', 120.0).value  # s
        self.derivative_time = self.declare_parameter('derivative_time', 5.0).value  # s
        self.lower = self.declare_parameter('min', 10.0).value  # degC
        self.upper = self.declare_parameter('max', 40.0).value  # degC
        self.setpoint = self.declare_parameter('setpoint', 51.0).value  # degC
        self._integral, self._before = 25.0, (0.0, float('nan'))
        self._commands = self.create_publisher(
            Temperature, 'coolant_setpoint', topics.LOOP_QOS)
        self.create_subscription(
            Temperature, 'temperature', self._on_temperature, topics.LOOP_QOS)
        self.create_subscription(
            Temperature, 'temperature_setpoint', self._on_setpoint, topics.LOOP_QOS)

    def _on_setpoint(self, message: Temperature) -> None:
        self.setpoint = message.temperature

    def _on_temperature(self, message: Temperature) -> None:
        seconds = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        before, measured = self._before
        self._before = seconds, message.temperature
        step = seconds - before
        error = self.setpoint - message.temperature
        slope = (message.temperature - measured) / step if 0.0 < step < 60.0 else 0.0
        free = self.gain * (error - self.derivative_time * slope) + self._integral
        command = min(max(free, self.lower), self.upper)
        if free == command and 0.0 < step < 60.0:
            self._integral += self.gain * error * step / self.reset_time
        answer = Temperature(temperature=command)
        answer.header = message.header
        self._commands.publish(answer)


if __name__ == '__main__':
    sys.exit(answer(PidNode))
