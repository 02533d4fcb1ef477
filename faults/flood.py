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

"""A neighbour that floods the domain: ``python -m faults.flood SECONDS COUNT``."""

from __future__ import annotations

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
