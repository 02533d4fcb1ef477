# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Total variation and the weak form: recovery, order of the quadrature, noise, and what fails."""

import numpy as np
import pytest

from koopman_ros.identification import (
    box_of,
    DriftModel,
    noise_level,
    total_variation,
    weak_form,
)
from koopman_ros.identification.total_variation import smoothed
from koopman_ros.plant_data import Episode
from support.known_plants import CUBIC, PAIR


def estimate(method, plant, records, degree, B=None, window=20):
    box = box_of(plant.plant, records)
    known = None if B is None else box.input_matrix(B)
    if method == 'weak form':
        return weak_form(records, box, degree, known, window)
    return total_variation(records, box, degree, known, box.input_matrix(plant.B))


METHODS = ['weak form', 'total variation']


# Without noise: as good as the quadrature or the differences.


@pytest.mark.parametrize('known', [True, False])
@pytest.mark.parametrize(('plant', 'degree'), [(CUBIC, 3), (PAIR, 2)])
@pytest.mark.parametrize('method', METHODS)
def test_recovers_the_drift(method, plant, degree, known):
    records = [plant.excited(400, 0.05), plant.excited(250, 0.05, seed=1)]
    B = plant.B if known else None
    found = estimate(method, plant, records, degree, B)
    # both are of second order in a period of 0.05 at rates up to 2; smoothing takes some more
    assert plant.misfit(found) < 1e-2
    assert found.input_matrix == pytest.approx(plant.B, abs=1e-12 if known else 2e-2)


@pytest.mark.parametrize('method', METHODS)
def test_error_falls_with_the_square_of_the_period(method):
    misfits = [CUBIC.misfit(estimate(
        method, CUBIC, [CUBIC.excited(300 * n, 0.1 / n, hold=20 * n)], 3, window=10 * n))
        for n in (1, 2)]
    # a factor of four; inputs of other levels make it uneven
    assert misfits[1] < 0.4 * misfits[0]


def test_weak_form_integrates_the_input_exactly():
    # f = 0: -integral(phi' x) = B integral(phi u), whatever the times at which u changes
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.01, 0.02, 2000))
    changes = np.concatenate(([0.0], np.sort(rng.uniform(0.0, times[-1], 400))))
    bare = Episode(times, np.zeros((2000, 1)), changes, rng.uniform(-1.0, 1.0, (401, 1)))
    record = Episode(times, 1.7 * bare.input_integral(times), changes, bare.u)
    found = estimate('weak form', CUBIC, [record], 1, window=40)
    # what is left is the trapezoidal rule on phi' x, which has kinks between samples
    assert found.input_matrix == pytest.approx(np.array([[1.7]]), rel=2e-3)


@pytest.mark.parametrize('method', METHODS)
def test_irregular_samples_with_inputs_between_them(method):
    rng = np.random.default_rng(5)
    times = np.cumsum(rng.uniform(0.01, 0.09, 800))
    changes = np.concatenate(([0.0], np.sort(rng.uniform(0.0, times[-1], 100))))
    record = PAIR.record(times, changes, rng.uniform(-1.0, 1.0, (101, 2)))
    assert PAIR.misfit(estimate(method, PAIR, [record], 2)) < 3e-2


def test_total_variation_bears_a_rough_input_matrix():
    record = CUBIC.excited(600, 0.05)
    box = box_of(CUBIC.plant, [record])
    rough = box.input_matrix(1.2 * CUBIC.B)
    found = total_variation([record], box, 3, None, rough)
    assert CUBIC.misfit(found) < 5e-2
    # it is taken off again, not believed
    assert found.input_matrix == pytest.approx(CUBIC.B, rel=5e-2)


# With noise: within a few times what the best estimate possible would make of it.


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize(('method', 'bound'), [('weak form', 3.0), ('total variation', 12.0)])
def test_noise_does_little_harm(method, bound, seed):
    noise, count = 0.02, 600
    record = CUBIC.excited(count, 0.05, noise=noise, seed=seed)
    misfit = CUBIC.misfit(estimate(method, CUBIC, [record], 3))
    # The Cramer-Rao bound of one coefficient whose feature moves the state by about its scale
    # over a time constant is about noise / sqrt(count); five are shared, and the corners of the
    # box, where the misfit is largest, multiply it by about five more.
    best = 5.0 * np.sqrt(5.0) * noise / np.sqrt(count)
    assert misfit < bound * best


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


def test_noise_level_on_irregular_times():
    rng = np.random.default_rng(1)
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
    found = smoothed(t, true + sigma * rng.standard_normal(true.shape))
    # two thirds of the noise go; what is taken away has its size (discrepancy principle)
    assert np.all(np.sqrt(np.mean((found - true) ** 2, axis=0)) < sigma / 3.0)


@pytest.mark.parametrize('seed', range(3))
def test_smoothing_of_a_parabola_finds_it(seed):
    t = np.arange(240) / 60.0
    true = 0.1 + 0.2 * t + 0.3 * t ** 2
    noisy = true + 0.01 * np.random.default_rng(seed).standard_normal(240)
    # third differences of a parabola are zero, so that any weight is right but the smallest
    assert np.max(np.abs(smoothed(t, noisy[:, None])[:, 0] - true)) < 0.015


def test_smoothing_leaves_what_has_no_noise():
    t = np.linspace(0.0, 1.0, 50)
    parabola = (1.0 + t + t ** 2)[:, None]
    assert np.max(np.abs(smoothed(t, parabola) - parabola)) < 1e-8
    assert np.array_equal(smoothed(t, np.ones((50, 1))), np.ones((50, 1)))


# What cannot be done.


@pytest.mark.parametrize(('call', 'words'), [
    (lambda r, b: weak_form([r], b, 3, None, 40), 'no episode has 40 samples: record longer'),
    (lambda r, b: weak_form([r], b, 3, None, 3), 'a window of 3 samples is too short'),
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
