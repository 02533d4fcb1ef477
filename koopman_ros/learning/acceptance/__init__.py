# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The acceptance of a model: its figures on held-out data, and a statement about the plant.

The statement is about plants that the record cannot distinguish from the estimated one.
"""

from koopman_ros.learning.acceptance.corrections import correction_posterior, OwnTerms
from koopman_ros.learning.acceptance.decision import (
    AcceptanceResult,
    evaluate_model,
    PlantAcceptance,
)
from koopman_ros.learning.acceptance.held_out import HeldOut
from koopman_ros.learning.acceptance.missing_structure import missing_structure
from koopman_ros.learning.acceptance.settings import Thresholds
from koopman_ros.learning.acceptance.warnings import uncovered_setpoints

__all__ = ['AcceptanceResult', 'HeldOut', 'OwnTerms', 'PlantAcceptance', 'Thresholds',
           'correction_posterior', 'evaluate_model', 'missing_structure', 'uncovered_setpoints']
