# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Riccati equations, solved and checked; in numpy and scipy, imports nothing of ours."""

from koopman_ros.solvers.riccati import RiccatiSolution, RiccatiStatus, solve_riccati

__all__ = [
    'RiccatiSolution',
    'RiccatiStatus',
    'solve_riccati',
]
