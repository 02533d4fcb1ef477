# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Growth of a lift, known eigenfunctions that it finds, and the training around it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from koopman_ros.core.datasets import DriftSamples, PlantDescription, split_by_episode
from koopman_ros.learning import Edmd, evaluate, fit, IncrementalTraining, train
from koopman_ros.learning.lift.incremental import least_squares
from koopman_ros.learning.lift.levenberg_marquardt import MinimumStatus
from koopman_ros.learning.lift.metrics import lifted_rate
from koopman_ros.learning.lift.network import Pass
from koopman_ros.learning.lift.residuals import ScaledSamples
from koopman_ros.learning.lift.training import PreparedSamples
from koopman_ros.model import Box
from koopman_ros.plants import scalar_example
from support import small_plants
from support.disturbance import disturbed_data
from support.small_plants import BENT, bent_samples, bits, SMALL, UNFORCED, unforced_samples
from support.tensors import assert_close


def tensors(*arrays):
    return tuple(torch.from_numpy(array) for array in arrays)


def bent_data():
    """Return deviations of the bent plant and its drift."""
    samples = bent_samples()
    x, u = samples.x - 3.0, samples.u - 0.5
    return ScaledSamples(*tensors(x, samples.dxdt - 2.0 * u))


def two_state_data():
    """Return the two-state example in units of (6, 7)."""
    samples, scale = small_plants.two_state_samples(), np.array([6.0, 7.0])
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
    (2, True, 1, (2,)), (5, True, 3, (4, 5)), (1, False, 1, (1,)), (4, False, 2, (2, 3, 4)),
    (2, True, 2, None), (2, False, 3, None)])
def test_rounds(n_z, identity, n_x, expected):
    recipe = IncrementalTraining(n_z, identity=identity)
    if expected:
        assert recipe.rounds(n_x) == expected
        return
    with pytest.raises(ValueError, match=f'n_z = {n_z} is too small for {n_x} states'):
        recipe.rounds(n_x)


@pytest.mark.parametrize('identity', [True, False])
def test_widening_leaves_the_coordinates_as_they_were(identity):
    data = two_state_data()
    recipe = IncrementalTraining(5, identity=identity, hidden_first=4, hidden_more=2,
                                 max_iterations=5)
    parent = grow(replace(recipe, n_z=4), data)
    # no step is taken, so that the start itself is returned
    child = replace(recipe, max_iterations=0).start(data, 5, parent, 3)
    assert (child.layout.n_z, child.layout.hidden) == (5, parent.layout.hidden + 2)
    for name in ('z', 'z_rate'):
        assert_close(getattr(lifted(child, data), name)[:, :4],
                     getattr(lifted(parent, data), name), rtol=0, atol=1e-13)
    # the lift of zero is zero
    zero = torch.zeros((1, 2), dtype=torch.float64)
    assert not lifted(child, ScaledSamples(zero, zero)).z.any()


def test_a_new_coordinate_starts_near_a_product_that_the_others_do_not_span():
    data = bent_data()
    child = IncrementalTraining(2, hidden_first=30, max_iterations=0).start(data, 2, None, 0)
    # the only eigenfunction at hand is x, so that the product is x^2 less its share of x
    x = data.x
    target = x ** 2 - x @ least_squares(x, x ** 2)
    target = target / target.square().mean().sqrt()
    assert float((lifted(child, data).z[:, 1:] - target).square().mean()) < 1e-3


def test_a_free_lift_finds_the_eigenfunction():
    """With dx/dt = -x - 0.3 x^2, z = x / (1 + 0.3 x) obeys dz/dt = -z."""
    data = bent_data()
    grown = grow(IncrementalTraining(1, identity=False, max_iterations=300), data)
    z, x = lifted(grown, data).z[:, 0].numpy(), data.x[:, 0].numpy()
    exact = x / (1.0 + 0.3 * x)
    cosine = z @ exact / np.sqrt((z @ z) * (exact @ exact))
    assert abs(cosine) > 1.0 - 1e-5
    assert float(grown.layout.split(grown.theta).A[0, 0]) == pytest.approx(-1.0, abs=1e-3)


@pytest.fixture(scope='module')
def small():
    """Train the bent plant's small lift once."""
    return train(BENT, bent_samples(), SMALL, starts=1)


def test_the_model_describes_its_origin(small):
    everything, model = bent_samples(), small.model
    assert model.provenance.plant == 'bent'
    assert model.provenance.data_digest == everything.digest()
    assert (model.n_z, model.states.names, model.inputs.units) == (2, ('level',), ('m/s',))
    np.testing.assert_array_equal(model.states.center, [3.0])
    np.testing.assert_array_equal(model.states.lower, everything.x.min(axis=0))
    np.testing.assert_array_equal(model.states.upper, everything.x.max(axis=0))
    np.testing.assert_allclose(
        model.B * model.states.scale / model.inputs.scale, [[2.0]], rtol=1e-14)
    start, rest = small.status.split('; with n_z = 2 the last 20 steps took ')
    assert start == MinimumStatus.MAX_ITERATIONS.value
    assert 0.1 < float(rest.removesuffix(' % off the cost')) < 100.0
    # the law of the better model costs less than the linear one's, here by little
    assert small.law_check.arrived == small.law_check.loops == 128
    assert 0.9 < small.law_check.median_ratio < 1.0


def test_a_law_is_tried_on_the_drift_that_predicts_best(small):
    """The plant's is a polynomial of degree 2."""
    prepared = PreparedSamples.of(BENT, bent_samples())
    x, u = np.array([[2.2], [3.9]]), np.array([[0.1], [1.2]])
    true = -(x - 3.0) - 0.3 * (x - 3.0) ** 2 + 2.0 * (u - 0.5)
    found = prepared.reference_drift(small.model)(x, u)
    np.testing.assert_allclose(found, true, rtol=0, atol=1e-12)
    # 12 samples are too few for any but the linear one, and the lift is better than that
    few = replace(prepared, parts=(bent_samples(1, 12), *prepared.parts[1:]))
    found = few.reference_drift(small.model)(x, u)
    own = lifted_rate(small.model, 1.0)(x, u)
    np.testing.assert_array_equal(found, own)
    assert np.max(np.abs(own - true)) > 1e-6


def test_figures_come_from_the_untouched_episodes(small):
    training, _, held_out = split_by_episode(bent_samples(), 0)
    assert small.figures.fit == fit(small.model, held_out.x, held_out.dxdt, held_out.u)
    assert small.model.provenance.metrics == small.figures.metrics(('level',))
    linear = Edmd(1).learn(BENT, training, Box(small.model.states, small.model.inputs, 's'))
    assert small.linear.fit == evaluate(linear, held_out).fit
    assert small.figures.fit.rw < 2e-3 < small.linear.fit.rw


def test_there_is_a_model_for_every_size():
    held_out = split_by_episode(bent_samples(), 0)[2]
    trained = train(BENT, bent_samples(),
                    IncrementalTraining(4, hidden_first=3, max_iterations=60), starts=1, loops=16)
    assert [model.n_z for model in trained.path] == [2, 3, 4]
    assert trained.path[-1] is trained.model
    for model in trained.path:
        assert model.provenance.metrics == evaluate(model, held_out).metrics(('level',))
    figures = [model.provenance.metrics['rw'] for model in trained.path]
    assert figures[0] > figures[1] > figures[2]


def test_same_seed_gives_the_same_bits():
    recipe = replace(SMALL, n_z=3)
    seen = set()
    for pattern in ([0, 0, 0], [0, 1, 0], [2, 3, 1]):
        # What lay in memory before must not matter: leave small arrays of integers behind, at
        # every step, for what is allocated next.
        def litter(_, pattern=pattern):
            used = [torch.tensor(pattern, dtype=torch.int32) for _ in range(16)]
            del used
            return False
        trained = train(UNFORCED, unforced_samples(), recipe, seed=1, starts=2, watch=litter)
        seen.add(bits(trained.model))
    assert len(seen) == 1


@pytest.mark.parametrize(('plant', 'samples'), [
    (BENT, bent_samples()), (small_plants.TWO_STATE, small_plants.two_state_samples())],
    ids=['bent', 'two states'])
def test_b_is_learned(plant, samples):
    trained = train(replace(plant, B=None), samples, IncrementalTraining(3, max_iterations=150),
                    starts=1, loops=0)
    model = trained.model
    B = model.B * model.states.scale[:, None] / model.inputs.scale
    np.testing.assert_allclose(B, plant.B, rtol=0, atol=1e-3)
    assert trained.figures.fit.rx < 1e-5


@pytest.mark.parametrize('B', [np.zeros((1, 0)), None], ids=['known B', 'no B'])
def test_a_plant_without_inputs(B):
    """The paper's first example, dx/dt = x^2, over [0, 5]."""
    system = scalar_example()
    plant = PlantDescription(system.name, system.state_names, system.state_units, (), (), 's',
                             np.zeros(1),
                             np.zeros(0), B)
    x = np.random.default_rng(0).uniform(0.0, 5.0, (200, 1))
    samples = DriftSamples(x, x * x, np.zeros((200, 0)), np.arange(200) // 20)
    trained = train(plant, samples, IncrementalTraining(2, max_iterations=150), starts=1)
    assert trained.law_check is None
    assert (trained.model.n_u, trained.model.B.shape) == (0, (1, 0))
    assert trained.figures.fit.rx < 1e-2 * trained.linear.fit.rx
