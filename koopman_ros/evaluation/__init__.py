# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Evaluation of controllers and models: simulated loops, comparisons, optimal cost; no ROS."""

from koopman_ros.evaluation.closed_loop_test import ClosedLoopTest, evaluate_closed_loops
from koopman_ros.evaluation.loop import (
    at,
    Change,
    ClosedLoop,
    exchange,
    Loop,
    LoopRun,
    perfect,
    Plant,
    restart,
    run_closed_loop,
    run_loop,
    ScheduledChange,
    Sensor,
)
from koopman_ros.evaluation.model_comparison import (
    compare,
    MeasurementBuffer,
    ModelComparison,
    PredictionWindows,
)

__all__ = ['Change', 'ClosedLoop', 'ClosedLoopTest', 'Loop', 'LoopRun', 'MeasurementBuffer',
           'ModelComparison', 'Plant', 'PredictionWindows', 'ScheduledChange', 'Sensor', 'at',
           'compare', 'evaluate_closed_loops', 'exchange', 'perfect', 'restart',
           'run_closed_loop', 'run_loop']
