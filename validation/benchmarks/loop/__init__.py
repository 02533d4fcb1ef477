# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""How quick the closed loop is: the control step, its way across processes, its start."""
