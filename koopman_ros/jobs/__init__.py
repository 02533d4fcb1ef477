# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Where long work runs: here, in processes of its own, on a cluster; without ROS."""
