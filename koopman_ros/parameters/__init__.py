# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters of each node as a table: defaults, units, ranges, checks; without ROS."""
