# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Polynomial drift and its regression; segments: grids, the Runge-Kutta path, fitted starts."""

import numpy as np
import pytest

from koopman_ros.core.datasets import cut, Episode
from koopman_ros.learning.identification import (
    box_of,
    DriftModel,
    fitted_starts,
    longest_step,
    prediction_error,
    Segments,
)
from koopman_ros.learning.identification.weak_form import regress
from koopman_ros.plants import one_state_reactor, simulate, two_state_example
from support.known_plants import box, CUBIC, PAIR

BOX = box([300.0, 0.2], [330.0, 0.9], [280.0], [305.0])


def model(degree=3, seed=0):
    rng = np.random.default_rng(seed)
    count = {1: 3, 2: 6, 3: 10}[degree]
    return DriftModel(BOX, degree, rng.standard_normal((count, 2)), rng.standard_normal((2, 1)))


def test_box_is_the_range_of_all_episodes():
    found = box_of(CUBIC.plant, [
        Episode(np.arange(2.0), np.array([x]).T, np.array([0.0, 1.0]), np.array([u]).T)
        for x, u in (([1.0, 5.0], [7.0, 9.0]), ([-3.0, 0.0], [8.0, 20.0]))])
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


@pytest.mark.parametrize(('known', 'size'), [(True, 1.0), (False, 1.0), (False, 1e-14)])
def test_regression_finds_the_coefficients_whatever_the_size_of_columns(known, size):
    drift, rng = model(), np.random.default_rng(1)
    xi, v = rng.uniform(-1.0, 1.0, (60, 2)), rng.uniform(-1.0, 1.0, (60, 1))
    found = regress(BOX, 3, drift.features(xi), size * v, drift.scaled_rate(xi, v),
                    drift.B if known else None)
    # a well-conditioned system of ten unknowns
    assert found.coefficients == pytest.approx(drift.coefficients, abs=1e-12)
    assert np.max(np.abs(found.B * size - drift.B)) < 1e-12
    assert (found.degree, found.box) == (3, BOX)


def test_regression_needs_enough_that_moves():
    features = model().features(np.zeros((60, 2)))
    with pytest.raises(ValueError, match='60 equations do not determine 11 coefficients: record'):
        regress(BOX, 3, features, np.ones((60, 1)), np.ones((60, 2)), None)
    with pytest.raises(ValueError, match='4 equations do not determine 10 coefficients'):
        regress(BOX, 3, np.ones((4, 10)), np.ones((4, 1)), np.ones((4, 2)), np.ones((2, 1)))


def test_grid_has_samples_changes_and_steps_between():
    record = Episode(np.array([0.0, 1.0, 3.5]), np.array([[1.0], [2.0], [3.0]]),
                     np.array([-1.0, 0.25, 9.0]), np.array([[5.0], [6.0], [7.0]]))
    grid = Segments.of([record], 1.0)
    # 2.5 from the second to the third sample is halved twice at most 1 apart
    assert np.concatenate(([0.0], np.cumsum(grid.steps[:, 0]))) == pytest.approx(
        [0.0, 0.25, 1.0, 1.0 + 2.5 / 3, 1.0 + 5.0 / 3, 3.5])
    assert grid.u[:, 0, 0].tolist() == [5.0, 6.0, 6.0, 6.0, 6.0]
    assert grid.sampled[:, 0].tolist() == [True, False, True, False, False, True]
    assert grid.x[grid.sampled[:, 0], 0, 0].tolist() == [1.0, 2.0, 3.0]


def test_longest_step_is_two_usual_periods_and_one_that_fits_is_not_halved():
    record = Episode(np.array([0.0, 1.0, 2.0, 3.0, 30.0]), np.zeros((5, 1)), np.zeros(1),
                     np.zeros((1, 1)))
    assert longest_step([record]) == 2.0
    even = Episode(0.1 * np.arange(4), np.ones((4, 1)), np.zeros(1), np.ones((1, 1)))
    assert Segments.of([even], 0.1).steps.shape == (3, 1)


def test_shorter_stretches_are_padded():
    records = [CUBIC.excited(30, 0.1), CUBIC.excited(11, 0.1, seed=1)]
    both = Segments.of(records, 0.2)
    x0 = np.stack([record.x[0] for record in records])
    path = both.path(CUBIC.rate, x0)
    for j, record in enumerate(records):
        alone = Segments.of([record], 0.2)
        k = len(alone.steps)
        assert path[:k + 1, j] == pytest.approx(
            alone.path(CUBIC.rate, x0[[j]])[:, 0], rel=1e-13, abs=1e-13)
        # it stands still to the end, and nothing is measured there
        assert path[k:, j] == pytest.approx(np.broadcast_to(
            path[k, j], path[k:, j].shape), rel=1e-13, abs=1e-13)
        assert not np.any(both.measured[k + 1:, j])


@pytest.mark.parametrize('system', [one_state_reactor(), two_state_example()],
                         ids=lambda system: system.name)
def test_path_against_the_plants_integrator(system):
    rng = np.random.default_rng(0)
    inputs = system.nominal_input + rng.uniform(-1.0, 1.0, (30, 1))
    start = system.nominal_state + 0.1
    record = simulate(system, start, inputs, 0.05)
    errors = [np.max(np.abs(Segments.of([record], h).errors(system.derivative, start[None])))
              for h in (0.05, 0.025)]
    # one step a sample; the method is of fourth order, halving the step takes the error to 1/16
    assert 1e-11 < errors[0] < 1e-5
    assert 10.0 < errors[0] / errors[1] < 25.0


def test_model_that_diverges_has_infinite_error():
    record = CUBIC.excited(200, 0.1, noise=0.01)
    segments = Segments.of(cut([record], 50), 0.2)
    for rate in (lambda x, u: x ** 3 + 2.0, lambda x, u: 1e6 * x):
        assert np.all(prediction_error(rate, segments, np.ones(1)) == np.inf)
        assert not np.all(np.isfinite(segments.path(rate, np.ones((5, 1)))))


def test_starts_are_fitted_to_all_measurements():
    # for dx/dt = -x + u the fit is linear regression on exp(-t)
    rng = np.random.default_rng(0)
    t = 0.1 * np.arange(30)
    x = 2.0 * np.exp(-t) + 0.05 * rng.standard_normal(30)
    record = Episode(t, x[:, None], np.zeros(1), np.zeros((1, 1)))
    starts, squares = fitted_starts(lambda x, u: u - x, Segments.of([record], 0.1), np.ones(1))
    basis = np.exp(-t)
    expected = basis @ x / (basis @ basis)
    # Runge-Kutta steps of 0.1 are exact to 0.1^5 / 120
    assert starts == pytest.approx(np.array([[expected]]), abs=1e-6)
    assert squares == pytest.approx(np.array([[np.mean((expected * basis - x) ** 2)]]), rel=1e-5)


def test_starts_do_not_depend_on_units():
    record = PAIR.excited(60, 0.1, noise=0.05)
    segments = Segments.of([record], 0.1)
    units = np.array([1e3, 1e-3])
    other = Segments.of([Episode(record.time, record.x * units, record.input_time, record.u)], 0.1)
    starts, squares = fitted_starts(PAIR.rate, segments, np.ones(2))
    scaled, scaled_squares = fitted_starts(
        lambda x, u: units * PAIR.rate(x / units, u), other, units)
    # differences of 1e-4 of the scale are exact to 1e-8 of the slope
    assert scaled / units == pytest.approx(starts, abs=1e-7)
    assert scaled_squares / units ** 2 == pytest.approx(squares, rel=1e-6)


def test_prediction_error_weighs_stretches_by_their_measurements():
    records = [CUBIC.excited(30, 0.1, noise=0.1), CUBIC.excited(90, 0.1, noise=0.2, seed=1)]
    both = prediction_error(CUBIC.rate, Segments.of(records, 0.2), np.ones(1))
    single = [prediction_error(CUBIC.rate, Segments.of([r], 0.2), np.ones(1)) for r in records]
    assert both == pytest.approx(np.sqrt((30 * single[0] ** 2 + 90 * single[1] ** 2) / 120))
