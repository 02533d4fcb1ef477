# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the loop survives: faults put into real processes on purpose, each judged by figures."""
