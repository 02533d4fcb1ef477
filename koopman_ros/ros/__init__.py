# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Where ROS begins: messages, topics, parameters, diagnostics, processes, parts of the nodes."""
