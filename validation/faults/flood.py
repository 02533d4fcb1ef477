# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A neighbour that floods the domain: ``python -m validation.faults.flood SECONDS COUNT``."""

import sys
import time

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import Temperature


def main() -> int:
    """Come and go with so many participants at once, and print how many there were."""
    end, count, come = time.monotonic() + float(sys.argv[1]), int(sys.argv[2]), 0
    while time.monotonic() < end:
        present = []
        for number in range(count):
            context = Context()
            rclpy.init(context=context)
            node = Node(f'flood_{number}', context=context)
            node.create_publisher(Temperature, f'flood_{number}', 10)
            present.append((context, node))
        come += count
        for context, node in present:
            node.destroy_node()
            rclpy.shutdown(context=context)
    print(come)
    return 0


if __name__ == '__main__':
    sys.exit(main())
