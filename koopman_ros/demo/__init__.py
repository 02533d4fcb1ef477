# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The main job in one command: a learned controller on a live reactor; imports everything."""
