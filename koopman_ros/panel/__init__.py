# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The operator's web panel: view model, alarms, trends, access and pages, without ROS."""
