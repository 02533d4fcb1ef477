# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's motivating example dx/dt = x^2, learned on [0, 5] and judged inside and beyond."""

import numpy as np

from koopman_ros.core.datasets import DriftSamples
from koopman_ros.learning import fit, IncrementalTraining, train
from koopman_ros.plants import describe, scalar_example
from studies.campaign import Metrics, Models

RANGE = (0.0, 5.0)
PARTS = {'rw_in': RANGE, 'rw_5_6': (5.0, 6.0), 'rw_6_8': (6.0, 8.0)}
SAMPLES = 500
STARTS = 4


def points(lower: float, upper: float, count: int = 400) -> DriftSamples:
    """Return evenly spaced states with their derivatives; there is no input."""
    x = np.linspace(lower, upper, count)[:, None]
    return DriftSamples(x, x * x, np.zeros((count, 0)), np.zeros(count, dtype=int))


def run(seed: int) -> tuple[Metrics, Models]:
    """
    Learn a free lift of one coordinate from random states.

    :return: `rw_in` within the training range, `rw_5_6` and `rw_6_8` beyond it, and the
        `eigenvalue` found; any positive one belongs to an exact lift, exp(-eigenvalue / x).
    """
    x = np.random.default_rng(seed).uniform(*RANGE, (SAMPLES, 1))
    samples = DriftSamples(x, x * x, np.zeros((SAMPLES, 0)), np.arange(SAMPLES) % 10)
    recipe = IncrementalTraining(1, identity=False, hidden_first=10)
    model = train(describe(scalar_example()), samples, recipe, seed=seed, starts=STARTS).model
    metrics: Metrics = {'eigenvalue': float(model.A[0, 0])}
    for name, bounds in PARTS.items():
        part = points(*bounds)
        metrics[name] = fit(model, part.x, part.dxdt, part.u).rw
    return metrics, {'scalar': model}
