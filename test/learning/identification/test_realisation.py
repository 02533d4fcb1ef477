# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Linear models of a record's outputs, against the exact solution of linear plants."""

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode
from koopman_ros.learning.identification.realisation import realised
from support.sampling import sampled

PERIOD, LEVEL = 0.5, 3.0
# three tanks in series, of which the last, or the second and the last are measured
A = np.array([[-0.9, 0.0, 0.0], [0.4, -0.5, 0.0], [0.0, 0.3, -0.25]])
B = np.array([[1.0], [0.0], [0.0]])


def episode(C, seed=0, samples=400):
    """Return exact outputs above a level, under steps that are held for some samples."""
    step, gain = sampled(A, B, PERIOD)
    u = np.repeat(np.random.default_rng(seed).uniform(-1.0, 1.0, samples // 8), 8)[:, None]
    x, path = np.zeros(3), []
    for value in u:
        path.append(C @ x + LEVEL)
        x = step @ x + gain @ value
    time = PERIOD * np.arange(samples)
    return Episode(time, np.array(path), time, u)


@pytest.mark.parametrize('outputs', [[2], [1, 2]])
def test_poles_gains_and_levels_are_those_of_the_plant(outputs):
    C = np.eye(3)[outputs]
    found = realised([episode(C), episode(C, 1)], PERIOD, 3)
    assert found is not None
    own, inputs, constant = found
    assert np.sort(np.linalg.eigvals(own)) == pytest.approx(
        np.sort(np.linalg.eigvals(A)), rel=1e-3)
    n_y = len(C)
    assert -np.linalg.solve(own, inputs)[:n_y] == pytest.approx(-C @ np.linalg.solve(A, B),
                                                                rel=1e-3)
    # at rest without input
    assert -np.linalg.solve(own, constant)[:n_y] == pytest.approx(LEVEL, rel=1e-3)


def test_an_unstable_record_has_no_realisation():
    time = PERIOD * np.arange(100.0)
    growing = np.exp(0.2 * time)[:, None]
    assert realised([Episode(time, growing, time, np.sin(time)[:, None])], PERIOD, 1) is None
