# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A bare node that answers each temperature with the same message, on the controller's topics."""

from collections.abc import Callable
import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Temperature

from koopman_ros.ros import topics


def echo() -> Node:
    """Return the node."""
    node = rclpy.create_node('echo')
    answers = node.create_publisher(Temperature, 'coolant_setpoint', topics.LOOP_QOS)
    node.create_subscription(Temperature, 'temperature', answers.publish, topics.LOOP_QOS)
    return node


def answer(create: Callable[[], Node]) -> int:
    """Let a node answer, as plain as rclpy runs one, until the process is told to end."""
    rclpy.init()
    node = create()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(answer(echo))
