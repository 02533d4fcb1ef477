# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Arrays, units, signals, status codes, plug-ins, paths: the base of every other package."""
