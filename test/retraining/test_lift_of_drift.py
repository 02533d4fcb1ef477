# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""From a drift to a lift: steady point, samples, training."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from koopman_ros.identification import DriftModel
from koopman_ros.plant_data import cut, Episode
from koopman_ros.retraining.lift import _spread, drift_samples, steady_point
from support.known_plants import box

BOX = box([-1.0], [3.0], [-2.0], [2.0])


def cubic(c0=0.5):
    """Return dx/dt = c0 - x + 0.3 x^2 - 0.2 x^3 + 1.5 u as a drift model."""
    middle, half = BOX.states.center, BOX.states.scale
    xi = np.linspace(-1.0, 1.0, 4)
    x = middle + half * xi
    f = c0 - x + 0.3 * x ** 2 - 0.2 * x ** 3
    rest = 1.5 * BOX.inputs.center
    coefficients = np.polynomial.polynomial.polyfit(xi, (f + rest) / half, 3)
    return DriftModel(BOX, 3, coefficients[:, None], BOX.input_matrix(np.array([[1.5]])))


def held(drift, x0, u, count=60, period=0.1):
    """Return a record of a drift's own path by another integrator."""
    times = period * np.arange(count)
    path = solve_ivp(lambda _, x: drift.rate(x, np.array([u])), (0.0, times[-1]), [x0],
                     t_eval=times, rtol=1e-10, atol=1e-12).y.T
    return Episode(times, path, np.zeros(1), np.array([[u]]))


# The steady point.


def test_steady_point_keeps_a_state_that_an_input_can_hold():
    drift = cubic()
    x, u = steady_point(drift, np.array([1.2]), np.array([0.0]))
    assert x == pytest.approx([1.2], abs=1e-12)
    f = 0.5 - 1.2 + 0.3 * 1.2 ** 2 - 0.2 * 1.2 ** 3
    assert u == pytest.approx([-f / 1.5], abs=1e-12)


def test_steady_point_of_two_states_and_one_input():
    # dx1/dt = -x1 + x2, dx2/dt = -x2 - x1^2 + u on a box of halves of the width 2 and 4
    wide = box([-2.0, -4.0], [2.0, 4.0], [-5.0], [5.0])
    drift = DriftModel(wide, 2, np.zeros((6, 2)), wide.input_matrix(np.array([[0.], [1.]])))
    orders = {tuple(row): k for k, row in enumerate(
        np.round(drift.features(np.array([[0.5, 1.0], [1.0, 0.5], [0.5, 0.5]])), 12).T)}
    for (values, row, value) in (((0.5, 1.0, 0.5), 0, -1.0), ((1.0, 0.5, 0.5), 0, 2.0),
                                 ((1.0, 0.5, 0.5), 1, -1.0), ((0.25, 1.0, 0.25), 1, -1.0)):
        drift.coefficients[orders[values], row] = value
    probe = np.array([1.5, -2.0])
    assert drift.rate(probe, np.array([0.7])) == pytest.approx([-3.5, 2.0 - 2.25 + 0.7])
    x, u = steady_point(drift, np.array([1.0, 1.6]), np.array([2.0]))
    assert x[0] == pytest.approx(x[1], abs=1e-9)
    assert u == pytest.approx(x[1:] + x[0] ** 2, abs=1e-8)
    # near where it was asked for, in units of the range
    assert np.all(np.abs(x - [1.0, 1.6]) < 0.6)


def test_steady_point_finds_the_root_where_the_input_does_nothing():
    # with one state and an input without effect only the state can move
    drift = cubic()
    still = DriftModel(BOX, 3, drift.coefficients, np.zeros((1, 1)))
    x, u = steady_point(still, np.array([1.0]), np.array([0.3]))
    root = brentq(lambda x: 0.5 - x + 0.3 * x ** 2 - 0.2 * x ** 3, -1.0, 3.0, xtol=1e-14)
    assert x == pytest.approx([root], abs=1e-9)
    assert u == pytest.approx([0.3])


@pytest.mark.parametrize('coefficients', [[1.0, 0.0, 0.3, 0.0], [1e3, 1.0, 0.0, 0.0],
                                          [0.1, 0.0, 0.0, 1e-9]])
def test_no_steady_point(coefficients):
    still = DriftModel(BOX, 3, np.array(coefficients)[:, None], np.zeros((1, 1)))
    with pytest.raises(ValueError, match='no steady state was found within the range of the epi'):
        steady_point(still, np.array([1.0]), np.array([0.0]))


# Samples.


def test_samples_lie_on_the_paths_of_the_drift():
    drift = cubic()
    records = tuple(held(drift, x0, u) for x0, u in ((2.5, -1.0), (-0.5, 1.5), (0.3, 0.2)))
    noisy = tuple(Episode(r.time, r.x + 0.05 * np.random.default_rng(k).standard_normal(r.x.shape),
                         r.input_time, r.u) for k, r in enumerate(records))
    samples = drift_samples(drift, noisy)
    assert len(samples) == 3 * 59
    assert np.array_equal(samples.dxdt, drift.rate(samples.x, samples.u))
    # free of the noise: the start of each path is fitted to 60 measurements of it
    true = np.concatenate([r.x[:-1] for r in records])
    error = samples.x - true
    assert np.sqrt(np.mean(error ** 2)) < 0.05 / 4.0
    # in the order of the segments and of their times
    assert samples.u[:, 0].tolist() == [-1.0] * 59 + [1.5] * 59 + [0.2] * 59


def test_segments_that_the_drift_does_not_follow_are_left_out():
    # above 1 it runs away
    drift = DriftModel(BOX, 3, np.array([[0.0], [-1.0], [0.0], [4.0]]), np.zeros((1, 1)))
    calm = held(drift, 1.4, 0.0)
    rising = Episode(calm.time, np.linspace(2.8, 3.0, 60)[:, None], calm.input_time, calm.u)
    samples = drift_samples(drift, (calm, rising))
    assert len(samples) == 59
    assert np.max(np.abs(samples.x)) < 3.0
    with pytest.raises(ValueError, match='the estimated drift follows none of the episodes'):
        drift_samples(drift, (rising,))


def test_samples_fill_the_range():
    # a thousand around 0, a few on the way out
    xi = np.concatenate([np.random.default_rng(0).uniform(-0.1, 0.1, 5000),
                         np.linspace(-1.0, 1.0, 40)])[:, None]
    kept = _spread(xi)
    assert len(kept) <= 2000
    assert np.all(np.diff(kept) > 0)
    # all that is rare is kept
    assert set(kept) >= {i for i in range(5000, 5040) if abs(xi[i, 0]) > 0.15}
    counts = np.histogram(xi[kept, 0], bins=20, range=(-1.0, 1.0))[0]
    assert counts.min() == 2
    assert counts.max() <= 1000


def test_few_samples_are_all_kept():
    xi = np.random.default_rng(0).uniform(-1.0, 1.0, (300, 2))
    assert np.array_equal(_spread(xi), np.arange(300))


def test_samples_are_the_same_to_the_bit():
    drift = cubic()
    records = tuple(cut([held(drift, 2.5, -1.0, 3000, 0.01)], 200))
    first, second = (drift_samples(drift, records) for _ in range(2))
    assert first.digest() == second.digest()
    # its shares take part in turn, so that each covers the range
    assert np.array_equal(first.episode[:12], [*range(10), 0, 1])
