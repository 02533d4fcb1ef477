# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Total variation, the weak form and output error on plants whose drift is known.

Exact derivatives and recovery, order of the quadrature, what noise does, and what fails.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import chdtri
import torch

from koopman_ros.core.datasets import cut, Episode
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.learning.identification import (
    box_of,
    DriftModel,
    longest_step,
    noise_level,
    output_error,
    Segments,
    total_variation,
    weak_form,
)
from koopman_ros.learning.identification.output_error import _Problem, PolynomialCoefficients
from koopman_ros.learning.identification.total_variation import smoothed
from koopman_ros.learning.identification.weak_form import _input_integral
from koopman_ros.learning.lift.levenberg_marquardt import normal_equations
from support.known_plants import box, CUBIC, PAIR

NOISE = 0.02


def start_of(plant, records, degree, B=None):
    """Return a weak-form estimate of the records, and their segments."""
    box = box_of(plant.plant, records)
    known = None if B is None else box.input_matrix(B)
    model = weak_form(records, box, degree, known, 10)
    return model, Segments.of(records, longest_step(records))


@pytest.mark.parametrize(('learn', 'smooth', 'corrected'), [
    (False, True, False), (True, False, True), (True, True, True)])
def test_normal_equations_against_differences(learn, smooth, corrected):
    """Of a simulation, and of a filter that measures the first state alone."""
    records = [PAIR.irregular(count, 40, (0.05, 0.15), seed=count) for count in (30, 25)]
    model, whole = start_of(PAIR, records, 2)
    n_y = 1 if corrected else 2
    segments = replace(whole, x=whole.x[..., :n_y], measured=whole.measured[..., :n_y])
    rng = np.random.default_rng(0)
    gain, starts = corrected * rng.uniform(0.1, 0.4, (2, n_y)), rng.uniform(-0.5, 0.5, (2, 2))
    deviation, settling = np.array([0.3, 0.2])[:n_y], 5 * corrected
    problem = _Problem(PolynomialCoefficients(model, learn), segments, gain, starts, deviation,
                       settling, smooth)
    theta = problem.start()
    theta = theta + 0.03 * torch.from_numpy(rng.standard_normal(len(theta)))
    box = model.box
    scale = box.states.scale

    def residuals(values):
        # sample by sample and in units, which shares no line with the derivatives
        model, K, starts = problem.split(values)
        drift, found = model.drift, []
        for j, record in enumerate(records):
            x, taken = box.states.to_physical(starts[j]), 0
            for k in range(len(segments.sampled)):
                if segments.sampled[k, j]:
                    error = (segments.x[k, j] - x[:n_y]) / scale[:n_y]
                    if taken >= settling:
                        found.append(error / deviation)
                    x = x + scale * (K @ error)
                    taken += 1
                if k < len(segments.steps):
                    x = runge_kutta_step(lambda x, u=segments.u[k, j]: drift.rate(x, u), x,
                                         segments.steps[k, j])
            assert taken == len(record)
        return np.concatenate(found) / np.sqrt(len(found))

    base = residuals(theta.numpy())
    J = np.stack([(residuals(theta.numpy() + h) - residuals(theta.numpy() - h)) / 2e-5
                  for h in 1e-5 * np.eye(len(theta))], axis=-1)
    found = normal_equations(problem.add_residuals, theta)
    assert len(theta) == 12 + (4 if learn else 0) + (4 if smooth else 2)
    assert found.cost == pytest.approx(0.5 * base @ base, rel=1e-12)
    # central differences: 1e-10 of the third derivative, 1e-16 / 1e-5 of rounding
    assert found.gradient.numpy() == pytest.approx(J.T @ base, abs=1e-7)
    assert found.matrix.numpy() == pytest.approx(J.T @ J, abs=1e-6)
    # the simulation begins with that before, and rounds differently
    assert normal_equations(problem.add_residuals, theta, derivatives=False).cost == (
        pytest.approx(found.cost, rel=1e-14))
    theta = theta + 1e8
    for derivatives in (True, False):
        diverging = normal_equations(problem.add_residuals, theta, derivatives=derivatives)
        assert diverging.cost == np.inf


@pytest.mark.parametrize(('plant', 'degree', 'known'), [(CUBIC, 3, True), (PAIR, 2, False)])
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
    assert chdtri(5, 0.999) < distance < chdtri(5, 1e-3)


def estimate(method, plant, records, degree, B=None, window=20):
    box = box_of(plant.plant, records)
    known = None if B is None else box.input_matrix(B)
    if method == 'weak form':
        return weak_form(records, box, degree, known, window)
    return total_variation(records, box, degree, known, box.input_matrix(plant.B))


@pytest.mark.parametrize(('method', 'plant', 'degree', 'known'), [
    ('weak form', CUBIC, 3, True), ('weak form', PAIR, 2, False),
    ('total variation', CUBIC, 3, False), ('total variation', PAIR, 2, True)])
def test_recovers_the_drift(method, plant, degree, known):
    records = [plant.excited(400, 0.05), plant.excited(250, 0.05, seed=1)]
    B = plant.B if known else None
    found = estimate(method, plant, records, degree, B)
    # both are of second order in a period of 0.05 at rates up to 2; smoothing takes some more
    assert plant.misfit(found) < 1e-2
    assert found.input_matrix == pytest.approx(plant.B, abs=1e-12 if known else 2e-2)


@pytest.mark.parametrize('method', ['weak form', 'total variation'])
def test_irregular_samples_with_inputs_between_them(method):
    record = PAIR.irregular(800, 100, (0.01, 0.09), seed=5)
    assert PAIR.misfit(estimate(method, PAIR, [record], 2)) < 3e-2


def test_total_variation_bears_a_rough_input_matrix():
    record = CUBIC.excited(600, 0.05)
    box = box_of(CUBIC.plant, [record])
    rough = box.input_matrix(1.2 * CUBIC.B)
    found = total_variation([record], box, 3, None, rough)
    assert CUBIC.misfit(found) < 5e-2
    # it is taken off again, not believed
    assert found.input_matrix == pytest.approx(CUBIC.B, rel=5e-2)


def test_noise_level():
    clean = PAIR.excited(1500, 0.02, hold=60)
    box = box_of(PAIR.plant, [clean])
    model = DriftModel(box, 1, np.zeros((3, 2)), box.input_matrix(PAIR.B))
    # the curvature that is left without noise: a period of 0.02 cubed at rates up to 2
    assert np.all(noise_level([clean], model) < 1e-4)
    sigma = np.array([0.03, 0.005])
    rng = np.random.default_rng(0)
    noisy = Episode(clean.time, clean.x + sigma * rng.standard_normal(clean.x.shape),
                    clean.input_time, clean.u)
    # of 1500 deviations the median strays by 3 %, twice that as third differences overlap
    assert noise_level([noisy], model) == pytest.approx(sigma, rel=0.12)
    # on irregular times
    times = np.cumsum(rng.uniform(0.01, 0.03, 1500))
    record = Episode(times, np.cos(times)[:, None] + 0.02 * rng.standard_normal((1500, 1)),
                     np.array([0.0, 5.0]), np.array([[0.0], [1.0]]))
    model = DriftModel(box_of(CUBIC.plant, [record]), 1, np.zeros((2, 1)), np.zeros((1, 1)))
    assert noise_level([record], model) == pytest.approx([0.02], rel=0.12)


def test_smoothing_takes_away_noise_alone():
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 6.0, 400)
    # the derivative of the second one bends sharply
    true = np.column_stack([np.sin(t), np.where(t < 3.0, t, 6.0 - t) ** 2])
    sigma = np.array([0.02, 0.1])
    found = smoothed([(t, true + sigma * rng.standard_normal(true.shape))])[0]
    # two thirds of the noise go; what is taken away has its size (discrepancy principle)
    assert np.all(np.sqrt(np.mean((found - true) ** 2, axis=0)) < sigma / 3.0)


def test_smoothing_recovers_a_parabola_and_keeps_noise_free_data():
    t = np.arange(240) / 60.0
    true = (0.1 + 0.2 * t + 0.3 * t ** 2)[:, None]
    for seed in range(3):
        noisy = true + 0.01 * np.random.default_rng(seed).standard_normal((240, 1))
        # third differences of a parabola are zero, so that any weight is right but the smallest
        assert np.max(np.abs(smoothed([(t, noisy)])[0] - true)) < 0.015
    assert np.max(np.abs(smoothed([(t, true)])[0] - true)) < 1e-8
    assert np.array_equal(smoothed([(t, np.ones((240, 1)))])[0], np.ones((240, 1)))


@pytest.mark.parametrize(('call', 'words'), [
    (lambda r, b: weak_form([r], b, 3, None, 40), 'no episode has 40 samples: record longer'),
    (lambda r, b: weak_form([r], b, 3, None, 20), '3 equations do not determine 5 coefficients'),
    (lambda r, b: total_variation([r.part(0, 7)], b, 3, None, np.ones((1, 1))),
     'no episode has 8 samples'),
    (lambda r, b: noise_level([r.part(0, 7)], weak_form([r], b, 1, None, 10)),
     'no episode has 8 samples'),
])
def test_too_short(call, words):
    record = CUBIC.excited(30, 0.1)
    with pytest.raises(ValueError, match=words):
        call(record, box_of(CUBIC.plant, [record]))


@pytest.mark.parametrize('linear', [False, True])
def test_weak_form_integrates_inputs_exactly(linear):
    episode = Episode(np.array([0.0, 1.0, 4.0]), np.zeros((3, 1)), np.array([-1.0, 0.7, 1.9, 5.0]),
                      np.array([[1.0], [-2.0], [4.0], [0.5]]), (linear,) if linear else ())
    unit = box([-1.0], [1.0], [-1.0], [1.0])

    def integrand(t):
        return (1.0 - ((t - 2.0) / 2.0) ** 2) ** 3 * episode.inputs_at(np.array([t]))[0, 0]

    expected, _ = quad(integrand, 0.0, 4.0, points=[0.7, 1.9], epsabs=1e-13)
    assert _input_integral(episode, unit, 2.0, 2.0) == pytest.approx([expected], abs=1e-12)
