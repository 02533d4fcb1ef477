# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Box and polynomial drift: scaling, slope, and the regression that finds it."""

import numpy as np
import pytest

from koopman_ros.identification import (
    box_of,
    DriftModel,
)
from koopman_ros.identification.drift import regress
from koopman_ros.plant_data import Episode
from support.known_plants import box, CUBIC

BOX = box([300.0, 0.2], [330.0, 0.9], [280.0], [305.0])


def model(degree=3, seed=0):
    rng = np.random.default_rng(seed)
    count = {1: 3, 2: 6, 3: 10}[degree]
    return DriftModel(BOX, degree, rng.standard_normal((count, 2)), rng.standard_normal((2, 1)))


def test_box_is_the_range_of_all_episodes():
    episodes = [Episode(np.arange(3.0), np.array([[1.0], [5.0], [2.0]]), np.array([0.0, 1.0]),
                        np.array([[7.0], [9.0]])),
                Episode(np.arange(2.0), np.array([[-3.0], [0.0]]), np.array([-1.0, 0.5]),
                        np.array([[8.0], [20.0]]))]
    found = box_of(CUBIC.plant, episodes)
    assert (found.states.lower, found.states.upper) == ([-3.0], [5.0])
    assert (found.inputs.lower, found.inputs.upper) == ([7.0], [20.0])
    assert found.states.to_deviation(np.array([-3.0, 1.0, 5.0])).tolist() == [-1.0, 0.0, 1.0]
    assert found.inputs.to_deviation(np.array([7.0, 20.0])).tolist() == [-1.0, 1.0]


def test_rate_in_units():
    # dx/dt = 2 x - 3 u + 4 on boxes with other centers and scales
    narrow = box([1.0], [5.0], [10.0], [20.0])
    # x = 3 + 2 xi, u = 15 + 5 v; dxi/dt = (2 (3 + 2 xi) - 3 (15 + 5 v) + 4) / 2
    drift = DriftModel(narrow, 1, np.array([[-17.5], [2.0]]), np.array([[-7.5]]))
    x, u = np.array([[1.0], [4.0]]), np.array([[12.0], [0.0]])
    assert drift.rate(x, u) == pytest.approx(2.0 * x - 3.0 * u + 4.0, abs=1e-12)
    assert drift.input_matrix == pytest.approx(np.array([[-3.0]]))
    assert drift.slope(np.array([2.0])) == pytest.approx(np.array([[2.0]]))
    assert narrow.input_matrix(np.array([[-3.0]])) == pytest.approx(drift.B)


@pytest.mark.parametrize('degree', [1, 2, 3])
def test_slopes_against_differences(degree):
    drift, x, u = model(degree), np.array([312.0, 0.7]), np.array([290.0])
    step = 1e-6 * BOX.states.scale
    differences = np.stack([(drift.rate(x + h, u) - drift.rate(x - h, u)) / (2.0 * h.sum())
                            for h in np.diag(step)], axis=-1)
    # rounding of rates of some ten over a step of 1e-6 of the range
    assert drift.slope(x) == pytest.approx(differences, rel=1e-7)
    scaled = drift.scaled_slope(BOX.states.to_deviation(x))
    assert scaled * BOX.states.scale[:, None] / BOX.states.scale == pytest.approx(drift.slope(x))


@pytest.mark.parametrize('known', [True, False])
def test_regression_finds_the_coefficients(known):
    drift = model()
    rng = np.random.default_rng(1)
    xi, v = rng.uniform(-1.0, 1.0, (60, 2)), rng.uniform(-1.0, 1.0, (60, 1))
    features = drift.features(xi)
    found = regress(BOX, 3, features, v, drift.scaled_rate(xi, v), drift.B if known else None)
    # a well-conditioned system of ten unknowns
    assert found.coefficients == pytest.approx(drift.coefficients, abs=1e-12)
    assert np.max(np.abs(found.B - drift.B)) < 1e-12
    assert (found.degree, found.box) == (3, BOX)


def test_regression_does_not_depend_on_the_size_of_columns():
    drift = model()
    rng = np.random.default_rng(1)
    xi, v = rng.uniform(-1.0, 1.0, (60, 2)), rng.uniform(-1.0, 1.0, (60, 1))
    small = 1e-14
    found = regress(BOX, 3, drift.features(xi), small * v,
                    drift.scaled_rate(xi, v), None)
    assert found.B * small == pytest.approx(drift.B, abs=1e-12)


def test_regression_needs_enough_that_moves():
    features = model().features(np.zeros((60, 2)))
    with pytest.raises(ValueError, match='60 equations do not determine 11 coefficients: record'):
        regress(BOX, 3, features, np.ones((60, 1)), np.ones((60, 2)), None)
    with pytest.raises(ValueError, match='4 equations do not determine 10 coefficients'):
        regress(BOX, 3, np.ones((4, 10)), np.ones((4, 1)), np.ones((4, 2)), np.ones((2, 1)))
