# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Records of what changed a controller, and a loop over them that gives its commands; no ROS."""
