# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""How far the loop can be pushed: margins, attraction, disturbances, noise, narrow data."""
