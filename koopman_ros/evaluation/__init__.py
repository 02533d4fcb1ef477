# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Evaluation of controllers and models: simulated loops, comparisons, optimal cost; no ROS."""

from koopman_ros.evaluation.closed_loop_test import ClosedLoopTest, evaluate_closed_loops
from koopman_ros.evaluation.model_comparison import (
    compare,
    MeasurementBuffer,
    ModelComparison,
    PredictionWindows,
)
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
    ScheduledChange,
    Sensor,
    simulate,
    Simulation,
)

__all__ = ['Change', 'ClosedLoop', 'ClosedLoopTest', 'Loop', 'MeasurementBuffer',
           'ModelComparison', 'Plant', 'PredictionWindows', 'ScheduledChange', 'Sensor',
           'Simulation', 'at', 'compare', 'evaluate_closed_loops', 'exchange', 'perfect',
           'restart', 'run_closed_loop', 'simulate']
