# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""A recorded loop run through the control step again, compared, drawn and reported."""
