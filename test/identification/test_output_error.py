# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Output error: exact derivatives, exact recovery, and the statistics of maximum likelihood."""

import numpy as np
import pytest
from scipy.stats import chi2
import torch

from koopman_ros.identification import (
    box_of,
    longest_step,
    output_error,
    Segments,
    weak_form,
)
from koopman_ros.identification.output_error import _Problem
from koopman_ros.learning.levenberg_marquardt import normal_equations
from koopman_ros.plant_data import cut, Episode
from support.known_plants import CUBIC, PAIR

NOISE = 0.02


def start_of(plant, records, degree, B=None):
    """Return a weak-form estimate of the records, and their segments."""
    box = box_of(plant.plant, records)
    known = None if B is None else box.input_matrix(B)
    model = weak_form(records, box, degree, known, 10)
    return model, Segments.of(records, longest_step(records))


def two_of_different_length(noise=0.0):
    return [PAIR.excited(60, 0.1, noise=noise, seed=2), PAIR.excited(45, 0.1, noise=noise, seed=3)]


@pytest.mark.parametrize('learn', [True, False])
def test_normal_equations_against_differences(learn):
    records = two_of_different_length(0.05)
    model, segments = start_of(PAIR, records, 2)
    problem = _Problem(model, segments, learn)
    theta = problem.start()
    theta = theta + 0.03 * torch.from_numpy(np.random.default_rng(0).standard_normal(len(theta)))
    box, count = model.box, np.sum(segments.measured)
    assert count == 105

    def residuals(values):
        # by the path in units, which shares no line with the derivatives
        drift, starts = problem.split(values)
        middle = box.states.center
        errors = segments.errors(drift.rate, middle + starts * box.states.scale)
        return (errors / box.states.scale).ravel() / np.sqrt(count)

    base = residuals(theta.numpy())
    steps = 1e-5 * np.eye(len(theta))
    J = np.stack([(residuals(theta.numpy() + h) - residuals(theta.numpy() - h)) / 2e-5
                  for h in steps], axis=-1)
    found = normal_equations(problem.add_residuals, theta)
    assert len(theta) == 12 + (4 if learn else 0) + 4
    assert found.cost == pytest.approx(0.5 * base @ base, rel=1e-12)
    # central differences: 1e-10 of the third derivative, 1e-16 / 1e-5 of rounding
    assert found.gradient.numpy() == pytest.approx(J.T @ base, abs=1e-8)
    assert found.matrix.numpy() == pytest.approx(J.T @ J, abs=1e-7)
    only = normal_equations(problem.add_residuals, theta, derivatives=False)
    assert only.cost == found.cost


def test_a_model_that_diverges_has_infinite_cost():
    model, segments = start_of(CUBIC, [CUBIC.excited(100, 0.1)], 3)
    problem = _Problem(model, segments, True)
    theta = problem.start() + 1e8
    assert normal_equations(problem.add_residuals, theta).cost == np.inf
    assert normal_equations(problem.add_residuals, theta, derivatives=False).cost == np.inf


@pytest.mark.parametrize('known', [True, False])
@pytest.mark.parametrize(('plant', 'degree'), [(CUBIC, 3), (PAIR, 2)])
def test_recovers_the_drift_without_noise(plant, degree, known):
    records = cut([plant.excited(300, 0.1), plant.excited(170, 0.1, seed=1)], 120)
    model, segments = start_of(plant, records, degree, plant.B if known else None)
    found = output_error(model, segments, learn_input_matrix=not known)
    # what Runge-Kutta steps of 0.1 leave at rates up to 2: 0.1^4 2^5 / 120
    assert plant.misfit(found) < 3e-5
    assert plant.misfit(model) > 5e-4
    if known:
        assert np.array_equal(found.B, model.B)
    else:
        assert found.input_matrix == pytest.approx(plant.B, abs=1e-4)


def test_error_falls_with_the_fourth_power_of_the_step():
    records = cut([CUBIC.excited(200, 0.1)], 100)
    model, _ = start_of(CUBIC, records, 3)
    misfits = [CUBIC.misfit(output_error(model, Segments.of(records, h), learn_input_matrix=True))
               for h in (0.1, 0.05)]
    assert 10.0 < misfits[0] / misfits[1] < 25.0


def test_irregular_samples_and_inputs_between_them():
    rng = np.random.default_rng(5)
    times = np.cumsum(rng.uniform(0.02, 0.18, 300))
    changes = np.concatenate(([0.0], np.sort(rng.uniform(0.0, times[-1], 120))))
    record = PAIR.record(times, changes, rng.uniform(-1.0, 1.0, (121, 2)))
    records = cut([record], 80)
    model, segments = start_of(PAIR, records, 2)
    found = output_error(model, segments, learn_input_matrix=True)
    # steps of up to 0.18: 0.18^4 2^5 / 120
    assert PAIR.misfit(found) < 3e-4


def cramer_rao(records, polynomial):
    """Return the Fisher information of (f's coefficients, B, starts) by plain differences."""
    starts = [record.x[0] for record in records]

    def predicted(theta):
        plant = type(CUBIC)(CUBIC.terms, tuple(theta[:4]), theta[4:5, None])
        return np.concatenate([
            plant.states([start], r.time, r.input_time, r.u)[:, 0]
            for r, start in zip(records, theta[5:], strict=True)])

    theta = np.concatenate((polynomial, np.ravel(starts)))
    J = np.stack([(predicted(theta + h) - predicted(theta - h)) / 2e-5
                  for h in 1e-5 * np.eye(len(theta))], axis=-1)
    covariance = NOISE ** 2 * np.linalg.inv(J.T @ J)
    return np.linalg.inv(covariance[:5, :5])


def test_errors_are_those_of_the_best_estimate_possible():
    lengths = (100, 60, 80)
    clean = [CUBIC.excited(n, 0.1, seed=i) for i, n in enumerate(lengths)]
    noisy = [CUBIC.excited(n, 0.1, noise=NOISE, seed=i) for i, n in enumerate(lengths)]
    model, segments = start_of(CUBIC, noisy, 3)
    found = output_error(model, segments, learn_input_matrix=True)
    x = np.linspace(found.box.states.lower, found.box.states.upper, 8)
    f = found.rate(x, np.zeros((8, 1)))[:, 0]
    error = np.append(np.polynomial.polynomial.polyfit(x[:, 0], f, 3), found.input_matrix)
    true = np.append(CUBIC.coefficients, CUBIC.B)
    error -= true
    # in units of the Cramer-Rao bound the error is chi-squared with as many degrees of freedom
    distance = error @ cramer_rao(clean, true) @ error
    assert chi2.ppf(1e-3, 5) < distance < chi2.ppf(0.999, 5)


def test_monitor_sees_the_cost_fall_and_ends_it():
    records = cut([CUBIC.excited(200, 0.1, noise=NOISE)], 60)
    model, segments = start_of(CUBIC, records, 3)
    costs = []

    def monitor(_, cost):
        costs.append(cost)
        return len(costs) == 2

    output_error(model, segments, learn_input_matrix=True, monitor=monitor)
    assert len(costs) == 2
    assert costs[1] <= costs[0]


def test_keeps_the_start_where_the_model_diverges():
    record = CUBIC.excited(300, 0.1)
    model, segments = start_of(CUBIC, [record], 3)
    wild = type(model)(model.box, 3, model.coefficients + 50.0, model.B)
    found = output_error(wild, segments, learn_input_matrix=True)
    assert np.array_equal(found.coefficients, wild.coefficients)


def test_of_one_stretch_with_few_samples():
    record = CUBIC.excited(300, 0.1)
    short = Episode(record.time[:3], record.x[:3], record.input_time[:1], record.u[:1])
    model, _ = start_of(CUBIC, [record], 3)
    found = output_error(model, Segments.of([short], 0.2), learn_input_matrix=True)
    # three samples do not determine five coefficients: damping keeps it near its start
    assert np.max(np.abs(found.coefficients - model.coefficients)) < 1.0
