# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Evaluation of controllers and models: simulated loops, comparisons, optimal cost; no ROS."""

from koopman_ros.evaluation.closed_loop_test import check_law, LawCheck
from koopman_ros.evaluation.model_comparison import compare, ModelComparison, Recent, Windows
from koopman_ros.evaluation.simulate import (
    at,
    Change,
    ClosedLoop,
    exchange,
    Loop,
    perfect,
    Plant,
    restart,
    run_closed_loop,
    Sensor,
    simulate,
    Simulation,
    Timed,
)

__all__ = [
    'Change',
    'ClosedLoop',
    'LawCheck',
    'Loop',
    'ModelComparison',
    'Plant',
    'Recent',
    'Sensor',
    'Simulation',
    'Timed',
    'Windows',
    'at',
    'check_law',
    'compare',
    'exchange',
    'perfect',
    'restart',
    'run_closed_loop',
    'simulate',
]
