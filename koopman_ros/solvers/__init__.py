# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Riccati equations and Runge-Kutta steps, in numpy and scipy; imports nothing of ours."""

from koopman_ros.solvers.riccati import RiccatiSolution, RiccatiStatus, solve_riccati
from koopman_ros.solvers.runge_kutta import runge_kutta_step

__all__ = [
    'RiccatiSolution',
    'RiccatiStatus',
    'runge_kutta_step',
    'solve_riccati',
]
