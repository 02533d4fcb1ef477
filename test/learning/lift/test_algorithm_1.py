# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""EDMD and linearisation against exact models; Algorithm 1's start, schedule and two criteria."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import kolmogi, ndtr
import torch

from koopman_ros.core.datasets import DriftSamples
from koopman_ros.learning import Algorithm1, Edmd, fit, Linearisation
from koopman_ros.learning.lift.levenberg_marquardt import MinimumStatus, normal_equations
from koopman_ros.learning.lift.residuals import LiftProblem, ResidualWeights, ScaledSamples
from koopman_ros.model import Box
from support.small_plants import bent_samples, TWO_STATE, two_state_samples


@pytest.mark.parametrize(('degree', 'B'), [(2, TWO_STATE.B), (3, None)])
def test_monomials_hold_the_exact_lift_of_the_two_state_example(degree, B):
    """The monomials hold (x1, x2, x1^2), which the drift maps into itself."""
    samples = two_state_samples()
    model = Edmd(degree).learn(replace(TWO_STATE, B=B), samples)
    assert model.n_z == {2: 5, 3: 9}[degree]
    x = model.states.to_deviation(samples.x)
    f = samples.dxdt / model.states.scale - model.inputs.to_deviation(samples.u) @ model.B.T
    z, J = model.lift_and_jacobian(x)
    residual = (J @ f[..., None])[..., 0] - z @ model.A.T
    # the other monomials are no part of it: their derivatives are not spanned
    np.testing.assert_allclose(residual[:, :3], 0.0, rtol=0, atol=1e-12)
    for value in (-0.2, -0.1, 1.0):
        assert np.min(np.abs(model.eigenvalues - value)) < 1e-9
    units = model.B * model.states.scale[:, None] / model.inputs.scale
    np.testing.assert_allclose(units, TWO_STATE.B, rtol=0, atol=1e-12)


def van_der_pol(x, u):
    """Return the rates (..., 2) of dx1/dt = x2, dx2/dt = (1 - x1^2) x2 - x1 + u."""
    return np.stack([x[..., 1], (1.0 - x[..., 0] ** 2) * x[..., 1] - x[..., 0] + u[..., 0]], -1)


VAN_DER_POL = replace(TWO_STATE, B=np.array([[0.0], [1.0]]))


def van_der_pol_samples(count=400, seed=0):
    rng = np.random.default_rng(seed)
    x, u = rng.uniform(-2.0, 2.0, (count, 2)), rng.uniform(-1.0, 1.0, (count, 1))
    return DriftSamples(x, van_der_pol(x, u), u, np.arange(count) // 40)


@pytest.mark.parametrize(('degree', 'B'), [(3, VAN_DER_POL.B), (5, None)])
def test_a_drift_of_monomials_is_found_exactly(degree, B):
    """
    Van der Pol's drift is of degree 3; the rates of its other monomials are of degree 5.

    So no A fits those, and what they lack must not come into the rate of the state.
    """
    model = Edmd(degree).learn(replace(VAN_DER_POL, B=B), van_der_pol_samples())
    fresh = van_der_pol_samples(seed=1)
    found = fit(model, fresh.x, fresh.dxdt, fresh.u)
    assert found.rw > 1e-3
    assert found.rx < 1e-20
    np.testing.assert_allclose(model.linearised.A * model.states.scale[:, None]
                               / model.states.scale, [[0.0, 1.0], [-1.0, 1.0]],
                               rtol=0, atol=1e-10)


def test_linearisation():
    samples, jacobian = two_state_samples(), np.array([[-0.1, 0.0], [0.0, 1.0]])
    model = Linearisation(jacobian).learn(TWO_STATE, samples)
    scale = model.states.scale
    np.testing.assert_allclose(model.A * scale[:, None] / scale, jacobian, rtol=0, atol=1e-15)
    np.testing.assert_allclose(model.B * scale[:, None] / model.inputs.scale, TWO_STATE.B,
                               rtol=0, atol=1e-15)
    np.testing.assert_array_equal(scale, Box.of(TWO_STATE, samples.x, samples.u).states.scale)
    with pytest.raises(ValueError, match='B is unknown'):
        Linearisation(jacobian).learn(replace(TWO_STATE, B=None), samples)


# Algorithm 1.

SMALL = {'n_z': 2, 'hidden': 3, 'decoder': 3, 'max_iterations': 5}


@pytest.fixture(scope='module')
def data():
    samples = bent_samples(2)
    x, u = samples.x - 3.0, samples.u - 0.5
    return ScaledSamples(torch.from_numpy(x), torch.from_numpy(samples.dxdt - 2.0 * u))


def test_all_parameters_start_from_the_standard_normal_distribution():
    # where the cost is not a number, no step is taken
    nothing = ScaledSamples(*(torch.full((2, 1), torch.nan).double() for _ in range(3)))
    first, again, other = (Algorithm1(4, identity=True, hidden=60, decoder=30).start(
        nothing, 4, None, seed) for seed in (4, 4, 2))
    assert first.status is MinimumStatus.STALLED
    parts = first.layout.split(first.theta)
    for part in (first.theta, parts.W, parts.V, parts.decoder[0]):
        shares = np.sort(ndtr(part.flatten().numpy()))
        ranks = np.arange(len(shares) + 1) / len(shares)
        # the test of Kolmogorov and Smirnov, with 1 % of error
        assert max(np.max(ranks[1:] - shares), np.max(shares - ranks[:-1])) < (
            kolmogi(0.01) / np.sqrt(len(shares)))
    assert torch.equal(first.theta, again.theta)
    assert not torch.equal(first.theta, other.theta)


@pytest.mark.parametrize(('initial', 'gamma'), [(10.0, 10.0), (3.0, 2.0)])
def test_lambda_falls_by_gamma_from_one_minimisation_to_the_next(data, initial, gamma):
    recipe = Algorithm1(**SMALL, lambda_initial=initial, gamma=gamma, tolerance=0.0)
    for number in range(3):
        seen = []

        def monitor(iteration, cost, number=number, seen=seen):
            seen.append((iteration, cost))
            return [i for i, _ in seen].count(1) == number + 1

        grown = recipe.start(data, 2, None, 0, monitor)
        assert grown.status is MinimumStatus.INTERRUPTED
        weights = ResidualWeights(decoder=initial / gamma ** number)
        there = normal_equations(LiftProblem(grown.layout, data, weights).add_residuals,
                                 grown.theta, derivatives=False)
        assert there.cost == pytest.approx(seen[-1][1], rel=1e-13)


def test_it_lowers_the_residual_of_the_dynamics(data):
    recipe = Algorithm1(2, identity=True, hidden=4, decoder=4, max_iterations=60)
    grown = recipe.start(data, 2, None, 0)
    problem = LiftProblem(grown.layout, data, ResidualWeights())
    found = normal_equations(problem.add_residuals, grown.theta, derivatives=False)
    assert found.cost < 0.02 * 0.5 * float(np.mean(data.f.numpy() ** 2))
