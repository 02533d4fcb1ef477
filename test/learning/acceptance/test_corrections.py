# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Corrections of a drift: their posterior beside exact least squares, and their groups."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode
from koopman_ros.learning.acceptance import (
    correction_posterior,
    missing_structure,
    OwnTerms,
    Thresholds,
)
from koopman_ros.learning.acceptance.missing_structure import Cause
from koopman_ros.learning.acceptance.rate_band import rate_band
from koopman_ros.learning.identification import DriftModel
from koopman_ros.learning.identification.drift import fitted_starts, longest_step, Segments
from koopman_ros.learning.legendre_basis import LegendreBasis
from support.known_plants import box

PERIOD, GAIN = 0.1, 1.5
BOX = box([-2.0], [2.0], [-1.0], [1.0])
# dx/dt = -x + 1.5 u in deviations of half-widths 2 and 1
LINEAR = DriftModel(BOX, 1, np.array([[0.0], [-1.0]]), np.array([[0.5 * GAIN]]))
OWN = OwnTerms(1, 0)


def recorded(effect, rho=0.0, sigma=0.01, count=400, seed=0):
    """Return a record of dx/dt = -x + effect(u), exact but for its noise of first order."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, 1 + count // 8), 8)[:count]
    x, noise, decay = np.zeros(count), np.zeros(count), np.exp(-PERIOD)
    noise[0] = rng.standard_normal() / np.sqrt(1.0 - rho ** 2)
    for k in range(count - 1):
        x[k + 1] = decay * x[k] + (1.0 - decay) * effect(u[k])
        noise[k + 1] = rho * noise[k] + rng.standard_normal()
    time = PERIOD * np.arange(count)
    return Episode(time, (x + sigma * noise)[:, None], time, u[:, None])


@pytest.mark.parametrize('rho', [0.0, 0.8])
def test_posterior_of_a_linear_plant_is_that_of_generalised_least_squares(rho):
    """The solution of the plant by two constants, an offset and its start, differenced."""
    episode = recorded(lambda u: GAIN * u, rho)
    settings = Thresholds(own_deviation=1e4, least_deviation=1e-9, deviations=1, decays=(1.0,),
                          degree_of_one_state=2)
    found = correction_posterior(LINEAR, OWN, [episode], settings)
    assert found.autocorrelation == pytest.approx([rho], abs=0.12)
    assert found.sigma == pytest.approx([0.005], rel=0.1)
    L = found.factors[0]
    P = found.deviations[0][:, None] * found.deviations[0]
    covariance = P * np.linalg.inv(L @ L.T)
    own = np.flatnonzero(found.own)

    def path(theta):
        # in deviations: dxi/dt = c0 + c_x sqrt(3) xi + c_u sqrt(3) v - xi + 0.75 v
        constant, of_u, of_x, xi = theta
        a = -1.0 + np.sqrt(3.0) * of_x
        xs = []
        for v in episode.u[:, 0]:
            xs.append(xi)
            g = constant + (0.5 * GAIN + np.sqrt(3.0) * of_u) * v
            xi = np.exp(a * PERIOD) * xi + np.expm1(a * PERIOD) / a * g
        return np.array(xs)

    # the products in the order of the basis: 1, u, x
    assert found.basis.exponents[own].tolist() == [[0, 0], [0, 1], [1, 0]]
    start = np.array([0.0, 0.0, 0.0, 0.5 * float(fitted_starts(
        LINEAR.rate, Segments.of([episode], longest_step([episode])), np.full(1, 2.0))[0][0, 0])])
    J = np.column_stack([(path(start + e) - path(start - e)) / 2e-5 for e in 1e-5 * np.eye(4)])
    steps = np.abs(np.subtract.outer(np.arange(len(J)), np.arange(len(J))))
    r, s = float(found.autocorrelation[0]), float(found.sigma[0])
    noise = s ** 2 / (1.0 - r ** 2) * r ** steps
    expected = np.linalg.inv(J.T @ np.linalg.solve(noise, J))[:3, :3]
    np.testing.assert_allclose(covariance[np.ix_(own, own)], expected, rtol=2e-3,
                               atol=2e-3 * np.diag(expected).max())


def test_products_are_orthonormal_over_the_box():
    basis = LegendreBasis.of(1, 1, 4, 400)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    grid = np.array([(a, b) for a in nodes for b in nodes])
    phi = basis(grid[:, :1], grid[:, 1:])
    w = 0.25 * np.outer(weights, weights).ravel()
    np.testing.assert_allclose(phi.T @ (w[:, None] * phi), np.eye(15), atol=1e-12)


def test_degree_is_reduced_to_few_coefficients():
    assert LegendreBasis.of(1, 1, 8, 400).exponents.sum(axis=1).max() == 8
    assert LegendreBasis.of(2, 1, 7, 400).exponents.sum(axis=1).max() == 7
    large = LegendreBasis.of(6, 3, 4, 400)
    assert 200 < 6 * len(large.exponents) <= 400


def test_a_nonlinear_effect_of_the_input_is_found_and_named():
    episode = recorded(lambda u: GAIN * u + 0.5 * u ** 2, count=600, sigma=0.005)
    found = correction_posterior(LINEAR, OWN, [episode])
    u = np.linspace(-0.8, 0.8, 17)[:, None]
    x = np.zeros_like(u)
    added = found.draw(1)[0]
    added = replace(added.correction, coefficients=found.mean.T)(x, u)
    assert added[:, 0] == pytest.approx(0.5 * u[:, 0] ** 2, abs=0.03)
    missing = missing_structure(found)
    assert missing is not None
    assert missing.cause is Cause.input_nonlinear
    assert 'characteristic' in missing.text
    shares = found.shares()
    assert all(shares[name] < 0.3 * missing.share for name in shares if name != missing.cause.name)


def test_nothing_is_missing_of_the_right_structure():
    found = correction_posterior(LINEAR, OWN, [recorded(lambda u: GAIN * u)])
    assert missing_structure(found) is None
    assert found.used == 1.0


def test_known_disturbances_of_episodes_leave_the_constant_determined():
    episodes = [replace(recorded(lambda u, own=own: GAIN * u + own, seed=seed),
                        disturbance=np.array([own])) for seed, own in enumerate((0.3, -0.2))]
    found = correction_posterior(LINEAR, OWN, episodes)
    assert missing_structure(found) is None
    constants = [one.correction(np.zeros(1), np.zeros(1))[0] for one in found.draw(40)]
    assert np.all(np.abs(constants) < 0.01)


def test_the_band_covers_the_error_of_an_estimate_and_falls_with_the_noise():
    """Of the gain, by two standard deviations."""
    errors = []
    for sigma in (0.02, 0.002):
        found = correction_posterior(LINEAR, OWN, [recorded(lambda u: GAIN * u, sigma=sigma)])
        episode = recorded(lambda u: GAIN * u)
        band = rate_band(LINEAR, found.draw(40), episode.x, episode.inputs_at(episode.time),
                         BOX.states)
        errors.append(2.0 * float(band.error[0]))
        true = GAIN * np.linspace(-1.0, 1.0, 11) - 0.3
        assert np.all(np.abs(LINEAR.rate(np.full((11, 1), 0.3), np.linspace(
            -1.0, 1.0, 11)[:, None])[:, 0] - true) <= errors[-1])
        assert np.all(band.lower <= band.upper)
        assert np.all(np.abs(band.upper - band.rates) < 2.0 * band.error)
        assert np.all(np.diff(band.values, axis=0) > 0.0)
    assert 0.01 < errors[0] < 0.3
    assert errors[1] < 0.3 * errors[0]


def test_a_record_that_no_free_run_follows_has_no_posterior():
    episode = recorded(lambda u: GAIN * u)
    far = replace(episode, x=episode.x + 20.0 * np.sin(np.arange(len(episode)))[:, None])
    with pytest.raises(ValueError, match='follow no part'):
        correction_posterior(LINEAR, OWN, [far])


def test_states_that_are_measured_rarely_count_where_they_are_measured():
    """Every fourth value of an autoregressive noise of 0.8 has one of 0.8^4."""
    episode = recorded(lambda u: GAIN * u, 0.8, count=1600)
    x = np.repeat(episode.x, 2, axis=1)
    x[np.arange(len(x)) % 4 > 0, 1] = np.nan
    two = DriftModel(box([-2.0] * 2, [2.0] * 2, [-1.0], [1.0]), 1,
                     np.array([[0.0, 0.0], [-1.0, 0.0], [0.0, -1.0]]), np.full((2, 1), 0.5 * GAIN))
    found = correction_posterior(two, OWN, [replace(episode, x=x)], Thresholds(degree=2))
    assert found.autocorrelation == pytest.approx([0.8, 0.41], abs=0.15)
