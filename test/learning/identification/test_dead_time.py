# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Dead times are found from records, and an episode is moved by them."""

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode
from koopman_ros.learning.identification import find_dead_times
from support.sampling import sampled

PERIOD = 2.0


def steps(rng, count, columns):
    """Return inputs that step at random and hold each value for 5 to 60 samples."""
    u = np.empty((count, columns))
    for column in u.T:
        changes = np.cumsum(rng.integers(5, 60, count))
        held = np.searchsorted(changes, np.arange(count), 'right')
        column[:] = rng.uniform(-1.0, 1.0, count)[held]
    return u


def record(seed, dead_times, time_constants, gains=(1.0, -0.7), noise=0.03, count=500):
    """Return an episode of first-order lags in series behind inputs that act late."""
    rng = np.random.default_rng(seed)
    u = steps(rng, count, len(dead_times))
    force = sum(gain * np.concatenate([np.full(d, column[0]), column[:count - d]])
                for gain, column, d in zip(gains, u.T, dead_times, strict=False))
    n = len(time_constants)
    A = np.diag(-1.0 / np.array(time_constants))
    for i in range(1, n):
        A[i, i - 1] = 1.0 / time_constants[i]
    B = np.eye(n, 1) / time_constants[0]
    step, gain = sampled(A, B, PERIOD)
    x, y = np.zeros(n), np.empty((count, 1))
    for k in range(count):
        y[k], x = x[-1], step @ x + gain[:, 0] * force[k]
    time = PERIOD * np.arange(count)
    return Episode(time, y + noise * np.std(y) * rng.standard_normal(y.shape), time, u)


@pytest.mark.parametrize(('dead_times', 'time_constants'), [
    ((0,), (20.0,)),
    ((7,), (20.0,)),
    ((20,), (12.0, 30.0)),
    ((3, 14), (25.0,)),
    ((16, 0), (9.0, 22.0))])
def test_dead_times_are_found_within_a_sample(dead_times, time_constants):
    found = find_dead_times([record(1, dead_times, time_constants)])
    assert np.max(np.abs(np.subtract(found.samples, dead_times))) <= 1
    assert found.period == PERIOD
    np.testing.assert_array_equal(found.values, PERIOD * np.array(found.samples))


@pytest.mark.parametrize('seed', [6, 7])
def test_two_lags_are_not_taken_for_a_dead_time(seed):
    # with zeros it is a sample off either way
    assert find_dead_times([record(seed, (12,), (16.0, 36.0))]).samples == (12,)


def test_a_known_dead_time_is_not_looked_for():
    episode = record(1, (8, 5), (20.0,)).delayed(np.array([8 * PERIOD, 0.0]))
    assert episode is not None
    samples = find_dead_times([episode], (True, False)).samples
    assert samples[0] == 0
    assert abs(samples[1] - 5) <= 1


def test_a_nonlinear_plant_is_not_taken_for_a_late_one():
    rng = np.random.default_rng(3)
    u = steps(rng, 1000, 1) + 1.2
    x, levels = np.array([1.0, 1.0]), []
    for value in u[:, 0]:
        levels.append(x[1])
        for _ in range(10):
            flow = np.sqrt(np.maximum(x, 0.0))
            x = x + 0.02 * np.array([value - flow[0], 2.0 * flow[0] - flow[1]])
    time = np.arange(1000.0)
    y = np.array(levels)[:, None]
    assert find_dead_times([Episode(time, y, time, u)]).samples == (0,)


def test_a_record_of_a_few_samples_decides_nothing():
    time = np.arange(20.0)
    found = find_dead_times([Episode(time, np.zeros((20, 1)), time, np.zeros((20, 1)))])
    assert found.samples == (0,)


@pytest.mark.parametrize('linear', [(), (True, False)])
def test_inputs_act_later_by_their_dead_times(linear):
    episode = Episode(np.arange(10.0), np.arange(10.0)[:, None], np.array([0.0, 3.5, 6.0]),
                      np.array([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]]), linear)
    late = episode.delayed(np.array([1.5, 4.0]))
    assert late is not None
    np.testing.assert_array_equal(late.time, np.arange(4.0, 10.0))
    np.testing.assert_array_equal(late.x[:, 0], late.time)
    for at in (4.0, 5.0, 7.4, 7.5, 9.0):
        before = episode.inputs_at(np.array([at - 1.5, at - 4.0]))
        np.testing.assert_allclose(late.inputs_at(np.array([at]))[0],
                                   [before[0, 0], before[1, 1]], rtol=1e-12)
    assert episode.delayed(np.array([0.0, 8.5])) is None
    assert episode.delayed(np.zeros(2)) is episode
