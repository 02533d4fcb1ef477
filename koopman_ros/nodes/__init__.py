# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Where ROS begins: the three nodes, their parameters and messages; imports everything else."""
