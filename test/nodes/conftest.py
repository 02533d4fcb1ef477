# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Real processes over real DDS: each test in a ROS domain of its own, on loopback."""

from support.installation import colcon
from support.nodes import left_as_found, ros, run_node, shared_ros, type_support

__all__ = ['colcon', 'left_as_found', 'ros', 'run_node', 'shared_ros', 'type_support']
