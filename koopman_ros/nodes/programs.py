# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Programs of the package: a signal ends them without a traceback while they still load.

A node that is ended by a signal has done its work: 0. A replay has not: 130.
"""

from __future__ import annotations

from functools import partial

from koopman_ros.startup import run_program

plant = partial(run_program, 'koopman_ros.nodes.plant', 0)
controller = partial(run_program, 'koopman_ros.nodes.controller', 0)
trainer = partial(run_program, 'koopman_ros.nodes.trainer', 0)
player = partial(run_program, 'koopman_ros.nodes.player', 0)
replay = partial(run_program, 'koopman_ros.nodes.replay', 130)
