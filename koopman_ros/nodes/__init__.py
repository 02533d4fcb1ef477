# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The nodes, a file each: plant, controller, trainer, player and replay."""
