# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Learned linear representations of nonlinear dynamics in control of a plant, on ROS 2."""

__version__ = '0.1.0'
