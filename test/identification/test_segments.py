# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Segments: grids, the Runge-Kutta path against the plants' integrator, and fitted starts."""

import numpy as np
import pytest

from koopman_ros.identification import fitted_starts, longest_step, prediction_error, Segments
from koopman_ros.plant_data import cut, Episode
from koopman_ros.plants import one_state_reactor, simulate, two_state_example
from support.known_plants import CUBIC, PAIR


def test_grid_has_samples_changes_and_steps_between():
    record = Episode(np.array([0.0, 1.0, 3.5]), np.array([[1.0], [2.0], [3.0]]),
                    np.array([-1.0, 0.25, 9.0]), np.array([[5.0], [6.0], [7.0]]))
    grid = Segments.of([record], 1.0)
    # 2.5 from the second to the third sample is halved twice at most 1 apart
    assert np.concatenate(([0.0], np.cumsum(grid.steps[:, 0]))) == pytest.approx(
        [0.0, 0.25, 1.0, 1.0 + 2.5 / 3, 1.0 + 5.0 / 3, 3.5])
    assert grid.u[:, 0, 0].tolist() == [5.0, 6.0, 6.0, 6.0, 6.0]
    assert grid.measured[:, 0].tolist() == [True, False, True, False, False, True]
    assert grid.x[grid.measured[:, 0], 0, 0].tolist() == [1.0, 2.0, 3.0]


def test_a_step_that_fits_is_not_halved():
    record = Episode(0.1 * np.arange(4), np.ones((4, 1)), np.zeros(1), np.ones((1, 1)))
    assert Segments.of([record], 0.1).steps.shape == (3, 1)


def test_longest_step_is_two_usual_periods():
    record = Episode(np.array([0.0, 1.0, 2.0, 3.0, 30.0]), np.zeros((5, 1)), np.zeros(1),
                    np.zeros((1, 1)))
    assert longest_step([record]) == 2.0


def test_shorter_stretches_are_padded():
    records = [CUBIC.excited(30, 0.1), CUBIC.excited(11, 0.1, seed=1)]
    both = Segments.of(records, 0.2)
    x0 = np.stack([record.x[0] for record in records])
    path = both.path(CUBIC.rate, x0)
    for j, record in enumerate(records):
        alone = Segments.of([record], 0.2)
        k = len(alone.steps)
        assert np.array_equal(path[:k + 1, j], alone.path(CUBIC.rate, x0[[j]])[:, 0])
        # it stands still to the end, and nothing is measured there
        assert np.all(path[k:, j] == path[k, j])
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


def test_path_follows_inputs_that_change_between_samples():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.05, 0.15, 60))
    changes = np.concatenate(([0.0], np.sort(rng.uniform(0.1, times[-1], 40))))
    record = PAIR.record(times, changes, rng.uniform(-1.0, 1.0, (41, 2)))
    errors = Segments.of([record], 0.05).errors(PAIR.rate, record.x[:1])
    # the classical Runge-Kutta method at rates up to 2: 0.05^4 2^5 / 120
    assert np.max(np.abs(errors)) < 2e-6


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
