# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Algorithm 1: its start, its schedule of lambda and its two criteria of termination."""

import numpy as np
import pytest
from scipy.stats import kstest
import torch

from koopman_ros.learning import Algorithm1
from koopman_ros.learning.levenberg_marquardt import MinimumStatus, normal_equations
from koopman_ros.learning.network import Layout
from koopman_ros.learning.residuals import Problem, ResidualWeights, ScaledSamples
from support.small_plants import bent_samples

SMALL = {'n_z': 2, 'hidden': (3,), 'decoder': 3, 'max_iterations': 5}


@pytest.fixture(scope='module')
def data():
    samples = bent_samples(2)
    x, u = samples.x - 3.0, samples.u - 0.5
    return ScaledSamples(torch.from_numpy(x), torch.from_numpy(samples.dxdt - 2.0 * u))


def minimisations(recipe, data, seed=0):
    """Return what a start gives and the number of minimisations that it took."""
    steps = []
    grown = recipe.start(data, recipe.n_z, None, seed,
                         lambda iteration, cost: steps.append(iteration))
    return grown, steps.count(1)


@pytest.mark.parametrize(('change', 'message'), [
    ({'gamma': 1.0}, 'gamma must be above 1, got 1.0'),
    ({'lambda_initial': 0.0}, 'lambda_initial must be above 0, got 0.0'),
    ({'n_z': 0}, 'sizes and limits must be at least 1'),
    ({'decoder': 0}, 'sizes and limits must be at least 1'),
    ({'hidden': (4, 0)}, 'sizes and limits must be at least 1'),
    ({'max_rounds': 0}, 'sizes and limits must be at least 1'),
    ({'max_iterations': 0}, 'sizes and limits must be at least 1'),
    ({'hidden': ()}, 'hidden must name the units of at least one layer'),
    ({'activation': 'relu'}, "must be one of tanh, sigmoid, sine, softplus, got 'relu'"),
])
def test_a_recipe_without_sense(change, message):
    with pytest.raises(ValueError, match=message):
        Algorithm1(**{**SMALL, **change})


def test_there_is_one_round_of_starts():
    assert Algorithm1(5).rounds(3) == (5,)
    assert Algorithm1(3).rounds(3) == (3,)
    assert Algorithm1(4, identity=True).rounds(3) == (4,)


@pytest.mark.parametrize(('n_z', 'identity'), [(2, False), (3, True)])
def test_fewer_coordinates_than_a_lift_needs(n_z, identity):
    with pytest.raises(ValueError, match=f'n_z = {n_z} is too small for 3 states'):
        Algorithm1(n_z, identity=identity).rounds(3)


def unmoved(seed):
    """Return a start as it was drawn: where the cost is not a number, no step is taken."""
    nothing = ScaledSamples(*(torch.full((2, 1), torch.nan).double() for _ in range(3)))
    grown = Algorithm1(4, hidden=(40, 40), decoder=30).start(nothing, 4, None, seed)
    assert grown.status is MinimumStatus.STALLED
    return grown


def test_all_parameters_start_from_the_standard_normal_distribution():
    grown = unmoved(0)
    assert grown.layout == Layout(1, 4, (40, 40), False, n_u=1, decoder=30)
    assert kstest(grown.theta.numpy(), 'norm').pvalue > 0.01
    parts = grown.layout.split(grown.theta)
    for part in (parts.hidden[1][0], parts.V, parts.decoder[0]):
        assert kstest(part.flatten().numpy(), 'norm').pvalue > 0.01


def test_the_seed_decides_on_the_start():
    assert torch.equal(unmoved(1).theta, unmoved(1).theta)
    assert not torch.equal(unmoved(1).theta, unmoved(2).theta)


@pytest.mark.parametrize(('initial', 'gamma'), [(10.0, 10.0), (3.0, 2.0)])
def test_lambda_falls_by_gamma_from_one_minimisation_to_the_next(data, initial, gamma):
    recipe = Algorithm1(**SMALL, lambda_initial=initial, gamma=gamma, tolerance=0.0)
    for number in range(4):
        seen = []

        def monitor(iteration, cost, number=number, seen=seen):
            seen.append((iteration, cost))
            return [i for i, _ in seen].count(1) == number + 1

        grown = recipe.start(data, 2, None, 0, monitor)
        assert grown.status is MinimumStatus.INTERRUPTED
        weights = ResidualWeights(decoder=initial / gamma ** number)
        there = normal_equations(Problem(grown.layout, data, weights).add_residuals, grown.theta,
                                 derivatives=False)
        assert there.cost == pytest.approx(seen[-1][1], rel=1e-13)


def test_it_ends_when_the_parameters_hardly_move(data):
    grown, count = minimisations(Algorithm1(**SMALL, tolerance=1e9), data)
    assert (grown.status, count) == (MinimumStatus.CONVERGED, 1)


def test_it_ends_after_max_rounds(data):
    grown, count = minimisations(Algorithm1(**SMALL, tolerance=0.0, max_rounds=4), data)
    assert (grown.status, count) == (MinimumStatus.MAX_ITERATIONS, 4)


def test_inputs_and_identity_go_into_the_layout(data):
    with_inputs = ScaledSamples(data.x, data.f, torch.ones((len(data), 2), dtype=torch.float64))
    recipe = Algorithm1(3, identity=True, hidden=(4, 2), activation='sine', decoder=5,
                        max_rounds=1, max_iterations=1)
    grown = recipe.start(with_inputs, 3, None, 0)
    assert grown.layout == Layout(1, 3, (4, 2), True, 'sine', 2, 5)
    assert len(grown.theta) == grown.layout.size


def test_it_lowers_the_residual_of_the_dynamics(data):
    recipe = Algorithm1(2, identity=True, hidden=(4,), decoder=4, max_iterations=60)
    grown, _ = minimisations(recipe, data)
    problem = Problem(grown.layout, data, ResidualWeights())
    drift_alone = 0.5 * float(np.mean(data.f.numpy() ** 2))
    found = normal_equations(problem.add_residuals, grown.theta, derivatives=False)
    assert found.cost < 0.02 * drift_alone
