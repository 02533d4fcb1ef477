# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What ROS needs, in a domain of its own."""

from support.nodes import ros, shared_ros, type_support

__all__ = ['ros', 'shared_ros', 'type_support']
