# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
How a lift is learned from samples, in torch; imports lifting and control.

Nothing else imports torch, and no node imports this package where it controls or simulates.
"""

from koopman_ros.learning.algorithm1 import Algorithm1
from koopman_ros.learning.baselines import Edmd, Linearisation
from koopman_ros.learning.growth import Growth
from koopman_ros.learning.samples import Plant, Samples, Scaling, split_by_episode
from koopman_ros.learning.training import (
    NoUsefulLift,
    Progress,
    RECIPES,
    train,
    Trained,
)
from koopman_ros.learning.validation import (
    compare_closed_loops,
    Fit,
    fit,
    judge,
    Report,
    roll_out,
    rollout_rmse,
)

__all__ = [
    'RECIPES',
    'Algorithm1',
    'Edmd',
    'Fit',
    'Growth',
    'Linearisation',
    'NoUsefulLift',
    'Plant',
    'Progress',
    'Report',
    'Samples',
    'Scaling',
    'Trained',
    'compare_closed_loops',
    'fit',
    'judge',
    'roll_out',
    'rollout_rmse',
    'split_by_episode',
    'train',
]
