# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Growth of a lift: what a new coordinate starts from, and known eigenfunctions that it finds."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from koopman_ros.learning import Growth
from koopman_ros.learning.growth import least_squares
from koopman_ros.learning.levenberg_marquardt import MinimumStatus
from koopman_ros.learning.network import Pass
from koopman_ros.learning.residuals import ScaledSamples
from support.disturbance import disturbed_data
from support.small_plants import bent_samples, two_state_samples


def tensors(*arrays):
    return tuple(torch.from_numpy(array) for array in arrays)


def bent_data():
    """Return deviations of the bent plant and its drift."""
    samples = bent_samples()
    x, u = samples.x - 3.0, samples.u - 0.5
    return ScaledSamples(*tensors(x, samples.dxdt - 2.0 * u))


def two_state_data():
    """Return the two-state example in units of (6, 7)."""
    samples, scale = two_state_samples(), np.array([6.0, 7.0])
    drift = samples.dxdt - samples.u * np.array([0.0, 1.0])
    return ScaledSamples(*tensors(samples.x / scale, drift / scale))


def grow(recipe, data, seed=0, monitor=None):
    """Run one start a round."""
    grown = None
    for n_z in recipe.rounds(data.x.shape[1]):
        grown = recipe.start(disturbed_data(data), n_z, grown, seed, monitor)
    return grown


def lifted(grown, data):
    parts = grown.layout.split(grown.theta)
    return Pass(grown.layout, parts, data.x, data.drift(parts.B))


@pytest.mark.parametrize(('n_z', 'identity', 'n_x', 'expected'), [
    (2, True, 1, (2,)), (5, True, 1, (2, 3, 4, 5)), (5, True, 3, (4, 5)), (4, True, 3, (4,)),
    (1, False, 1, (1,)), (3, False, 1, (1, 2, 3)), (4, False, 2, (2, 3, 4)), (3, False, 3, (3,)),
])
def test_rounds(n_z, identity, n_x, expected):
    assert Growth(n_z, identity=identity).rounds(n_x) == expected


@pytest.mark.parametrize(('n_z', 'identity', 'n_x', 'hint'), [
    (1, True, 1, r': use Edmd\(degree=1\) for a linear model'), (2, True, 2, ' as its first'),
    (2, False, 3, '$')])
def test_fewer_coordinates_than_a_lift_needs(n_z, identity, n_x, hint):
    with pytest.raises(ValueError, match=f'n_z = {n_z} is too small for {n_x} states.*{hint}'):
        Growth(n_z, identity=identity).rounds(n_x)


@pytest.mark.parametrize(('change', 'message'), [
    ({'n_z': 0}, 'n_z must be at least 1, got 0'),
    ({'hidden_first': 0}, 'hidden units must be positive, got 0 first and 3 more'),
    ({'hidden_more': -1}, 'hidden units must be positive, got 8 first and -1 more'),
    ({'layers': 3}, 'layers must be 1 or 2, got 3'),
    ({'activation': 'relu'}, "must be one of tanh, sigmoid, sine, softplus, got 'relu'"),
])
def test_a_recipe_without_sense(change, message):
    with pytest.raises(ValueError, match=message):
        Growth(**{'n_z': 2, **change})


@pytest.mark.parametrize('layers', [1, 2])
@pytest.mark.parametrize('identity', [True, False])
@pytest.mark.parametrize('activation', ['tanh', 'softplus'])
def test_widening_leaves_the_coordinates_as_they_were(layers, identity, activation):
    data = two_state_data()
    recipe = Growth(5, identity=identity, hidden_first=4, hidden_more=2, layers=layers,
                    activation=activation, max_iterations=5)
    parent = grow(replace(recipe, n_z=4), data)
    # no step is taken, so that the start itself is returned
    child = replace(recipe, max_iterations=0).start(data, 5, parent, 3)
    assert child.layout.n_z == 5
    assert child.layout.hidden == tuple(h + 2 for h in parent.layout.hidden)
    for name in ('z', 'z_rate'):
        torch.testing.assert_close(getattr(lifted(child, data), name)[:, :4],
                                   getattr(lifted(parent, data), name), rtol=0, atol=1e-13)


def test_a_new_coordinate_starts_near_a_product_that_the_others_do_not_span():
    data = bent_data()
    child = Growth(2, hidden_first=30, max_iterations=0).start(data, 2, None, 0)
    # the only eigenfunction at hand is x, so that the product is x^2 less its share of x
    x = data.x
    target = x ** 2 - x @ least_squares(x, x ** 2)
    target = target / target.square().mean().sqrt()
    assert float((lifted(child, data).z[:, 1:] - target).square().mean()) < 1e-3


@pytest.mark.parametrize('layers', [1, 2])
@pytest.mark.parametrize('identity', [True, False])
def test_the_lift_of_zero_is_zero(layers, identity):
    grown = grow(Growth(3, identity=identity, layers=layers, max_iterations=10), bent_data())
    zero = torch.zeros((1, 1), dtype=torch.float64)
    assert torch.equal(lifted(grown, ScaledSamples(zero, zero)).z, torch.zeros((1, 3)).double())


@pytest.mark.parametrize(('identity', 'hidden'), [(True, (6,)), (False, (8,))])
def test_growth_adds_coordinates_and_hidden_units(identity, hidden):
    grown = grow(Growth(3, identity=identity, hidden_first=4, hidden_more=2, max_iterations=3),
                 bent_data())
    assert (grown.layout.n_z, grown.layout.hidden) == (3, hidden)
    assert len(grown.theta) == grown.layout.size


@pytest.mark.parametrize(('n_x', 'identity', 'asked', 'expected'), [
    (1, True, None, 0), (1, False, None, 0), (2, True, None, 0), (2, False, None, 8),
    (2, True, 5, 5), (2, False, 0, 0)])
def test_when_there_is_a_decoder(n_x, identity, asked, expected):
    data = bent_data() if n_x == 1 else two_state_data()
    recipe = Growth(3, identity=identity, decoder=asked, max_iterations=2)
    assert grow(recipe, data).layout.decoder == expected


def test_growth_ends_early_when_told_to():
    data, calls = bent_data(), []
    recipe = Growth(2, max_iterations=20)

    def monitor(iteration, cost):
        calls.append(cost)
        return iteration == 7

    grown = recipe.start(data, 2, None, 0, monitor)
    assert grown.status is MinimumStatus.INTERRUPTED
    assert len(calls) == 7


def test_the_seed_decides_on_the_random_units():
    data, recipe = bent_data(), Growth(2, max_iterations=3)
    one, same, other = (recipe.start(data, 2, None, seed) for seed in (1, 1, 2))
    assert torch.equal(one.theta, same.theta)
    assert not torch.equal(one.theta, other.theta)


def test_a_lift_that_cannot_grow_says_so():
    x = torch.tensor([[1.0], [-1.0], [1.0], [-1.0]], dtype=torch.float64)
    with pytest.raises(ValueError, match='no new coordinate can be started: the samples are spa'):
        grow(Growth(4), ScaledSamples(x, -x))


@pytest.mark.parametrize('activation', ['tanh', 'sigmoid', 'sine', 'softplus'])
def test_a_free_lift_finds_the_eigenfunction(activation):
    """With dx/dt = -x - 0.3 x^2, z = x / (1 + 0.3 x) obeys dz/dt = -z."""
    data = bent_data()
    grown = grow(Growth(1, identity=False, activation=activation, max_iterations=300), data)
    z, x = lifted(grown, data).z[:, 0].numpy(), data.x[:, 0].numpy()
    exact = x / (1.0 + 0.3 * x)
    cosine = z @ exact / np.sqrt((z @ z) * (exact @ exact))
    assert abs(cosine) > 1.0 - 1e-5
    assert float(grown.layout.split(grown.theta).A[0, 0]) == pytest.approx(-1.0, abs=1e-3)


def test_least_squares_of_full_and_of_short_rank():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(20, 3)), rng.normal(size=(20, 2))
    for matrix in (a, np.hstack([a, a])):
        found = least_squares(*tensors(matrix, b))
        np.testing.assert_allclose(found, np.linalg.lstsq(matrix, b)[0], rtol=0, atol=1e-13)
