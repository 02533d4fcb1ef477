# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lifts learned from samples, their baselines and held-out figures; in torch, never in a node."""

from koopman_ros.learning.baselines import Algorithm1, Edmd, Linearisation
from koopman_ros.learning.comparison import compare, Comparison, Contender, Judge
from koopman_ros.learning.drift import NeuralDrift
from koopman_ros.learning.growth import Growth
from koopman_ros.learning.shards import read_samples, Shard, write_samples
from koopman_ros.learning.starts import Progress
from koopman_ros.learning.training import NoUsefulLift, train, Trained
from koopman_ros.learning.validation import (
    evaluate,
    Figures,
    Fit,
    fit,
    roll_out,
    rollout_rmse,
)

__all__ = [
    'Algorithm1', 'Comparison', 'Contender', 'Edmd', 'Figures', 'Fit', 'Growth', 'Judge',
    'Linearisation', 'NeuralDrift', 'NoUsefulLift', 'Progress', 'Shard', 'Trained', 'compare',
    'evaluate', 'fit', 'read_samples', 'roll_out', 'rollout_rmse', 'train', 'write_samples',
]
