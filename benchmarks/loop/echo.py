# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.


"""A bare node that answers each temperature with the same message, on the controller's topics."""

from __future__ import annotations

import sys

from koopman_ros.nodes import topics
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Temperature


def main(args: list[str] | None = None) -> int:
    """Answer until the process is told to end."""
    rclpy.init(args=args)
    node = Node('echo')
    answers = node.create_publisher(Temperature, topics.COOLANT_SETPOINT, topics.LOOP_QOS)
    node.create_subscription(
        Temperature, topics.TEMPERATURE, answers.publish, topics.LOOP_QOS)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
