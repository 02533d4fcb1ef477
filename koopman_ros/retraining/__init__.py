# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Retraining of the controller's lift from what was recorded, as a process of its own.

Imports bags, identification, learning, lifting, plants and control; needs the `train`
requirements. Nodes do not import it, they start ``python -m koopman_ros.retraining``.
"""

from koopman_ros.retraining.fleet import Outcome, retrain_fleet
from koopman_ros.retraining.gate import decide, Decision, Thresholds
from koopman_ros.retraining.known import Task
from koopman_ros.retraining.lift import compare_classes, drift_samples, learn_lift
from koopman_ros.retraining.report import write_report
from koopman_ros.retraining.task import retrain, Retrained

__all__ = ['Decision', 'Outcome', 'Retrained', 'Task', 'Thresholds', 'compare_classes', 'decide',
           'drift_samples', 'learn_lift', 'retrain', 'retrain_fleet', 'write_report']
