# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Riccati equations, Runge-Kutta steps and nonlinear least squares; imports nothing of ours.

In numpy and scipy, but for :mod:`koopman_ros.solvers.levenberg_marquardt`, which needs torch and
is imported by that name.
"""

from koopman_ros.solvers.riccati import RiccatiSolution, RiccatiStatus, solve_riccati
from koopman_ros.solvers.runge_kutta import runge_kutta_step

__all__ = [
    'RiccatiSolution',
    'RiccatiStatus',
    'runge_kutta_step',
    'solve_riccati',
]
