# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
From records of a plant to an accepted model; in torch, never in a node.

``python -m koopman_ros learn`` learns from files; nodes start :mod:`.training_process`.
"""

from koopman_ros.learning.acceptance import AcceptanceResult, evaluate_model, Thresholds
from koopman_ros.learning.drift_sampling import compare_classes, drift_samples, learn_lift
from koopman_ros.learning.free_run import FreeRun, simulate
from koopman_ros.learning.from_record import learn
from koopman_ros.learning.lift.algorithm_1 import Algorithm1
from koopman_ros.learning.lift.edmd import Edmd, Linearisation
from koopman_ros.learning.lift.incremental import IncrementalTraining
from koopman_ros.learning.lift.metrics import (
    evaluate,
    Fit,
    fit,
    LiftMetrics,
    rollout_rmse,
)
from koopman_ros.learning.lift.multistart import MultistartProgress
from koopman_ros.learning.lift.neural_drift import NeuralDrift
from koopman_ros.learning.lift.training import train, Trained, TrainingFailed
from koopman_ros.learning.model_selection import ClassComparison, compare, Judge, ModelCandidate
from koopman_ros.learning.pipeline import retrain
from koopman_ros.learning.report import write_report
from koopman_ros.learning.task import TrainingTask
from koopman_ros.learning.training_result import TrainingResult
from koopman_ros.learning.unfinished import Interrupted

__all__ = [
    'AcceptanceResult',
    'Algorithm1',
    'ClassComparison',
    'Edmd',
    'Fit',
    'FreeRun',
    'IncrementalTraining',
    'Interrupted',
    'Judge',
    'LiftMetrics',
    'Linearisation',
    'ModelCandidate',
    'MultistartProgress',
    'NeuralDrift',
    'Thresholds',
    'Trained',
    'TrainingFailed',
    'TrainingResult',
    'TrainingTask',
    'compare',
    'compare_classes',
    'drift_samples',
    'evaluate',
    'evaluate_model',
    'fit',
    'learn',
    'learn_lift',
    'retrain',
    'rollout_rmse',
    'simulate',
    'train',
    'write_report',
]
