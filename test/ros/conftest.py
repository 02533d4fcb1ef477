# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What ROS needs, in a domain of its own."""

from support.nodes import left_as_found, ros, run_node, shared_ros, type_support

__all__ = ['left_as_found', 'ros', 'run_node', 'shared_ros', 'type_support']
