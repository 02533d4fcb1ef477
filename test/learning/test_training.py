# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training: what is reported, what the recipe and the plant change, invariance, same bits."""

from dataclasses import replace
import math

import numpy as np
import pytest
import torch

from koopman_ros.learning import Algorithm1, Edmd, evaluate, fit, Growth, train
from koopman_ros.learning.levenberg_marquardt import MinimumStatus
from koopman_ros.lifting import Box
from koopman_ros.plant_data import Plant, Samples, split_by_episode
from koopman_ros.plants import scalar_example
from support.small_plants import (
    BENT,
    bent_samples,
    bits,
    SMALL,
    TWO_STATE,
    two_state_samples,
    UNFORCED,
    unforced_samples,
)


@pytest.fixture(scope='module')
def small():
    """Train the bent plant's small lift once."""
    return train(BENT, bent_samples(), SMALL, starts=1)


def test_the_model_describes_its_origin(small):
    everything, model = bent_samples(), small.model
    assert model.provenance.plant == 'bent'
    assert model.provenance.data_digest == everything.digest()
    assert (model.n_x, model.n_u, model.n_z, model.identity) == (1, 1, 2, True)
    assert (model.states.names, model.states.units) == (('level',), ('m',))
    assert (model.inputs.names, model.inputs.units) == (('flow',), ('m/s',))
    np.testing.assert_array_equal(model.states.center, [3.0])
    np.testing.assert_array_equal(model.states.lower, everything.x.min(axis=0))
    np.testing.assert_array_equal(model.states.upper, everything.x.max(axis=0))
    np.testing.assert_allclose(
        model.B * model.states.scale / model.inputs.scale, [[2.0]], rtol=1e-14)


def test_figures_come_from_the_untouched_episodes():
    everything = bent_samples()
    trained = train(BENT, everything, SMALL, starts=1, split_seed=3)
    training, _, held_out = split_by_episode(everything, 3)
    assert trained.figures.fit == fit(trained.model, held_out.x, held_out.dxdt, held_out.u)
    assert trained.model.provenance.metrics == trained.figures.metrics(('level',))
    linear = Edmd(1).learn(BENT, training, Box.of(BENT, everything.x, everything.u))
    assert trained.linear.fit == evaluate(linear, held_out).fit
    assert trained.figures.fit.rw < 2e-3 < trained.linear.fit.rw


def test_there_is_a_model_for_every_size():
    held_out = split_by_episode(bent_samples(), 0)[2]
    trained = train(BENT, bent_samples(), Growth(4, hidden_first=3, max_iterations=60), starts=2)
    assert [model.n_z for model in trained.path] == [2, 3, 4]
    assert trained.path[-1] is trained.model
    assert trained.starts == 6
    for model in trained.path:
        assert model.provenance.metrics == evaluate(model, held_out).metrics(('level',))
    figures = [model.provenance.metrics['rw'] for model in trained.path]
    assert figures[0] > figures[1] > figures[2]


def test_the_closed_loop_is_compared(small):
    assert small.closed_loop.arrived == small.closed_loop.linear_arrived == 3
    # the law of the better model costs less, here by little
    assert 0.9 < small.closed_loop.cost_ratio < 1.0


def test_how_it_ended(small):
    assert small.status == MinimumStatus.MAX_ITERATIONS.value
    converged = train(UNFORCED, unforced_samples(), replace(SMALL, tolerance=0.99), starts=1)
    assert converged.status == MinimumStatus.CONVERGED.value


@pytest.mark.parametrize('n_z', [2, 3])
def test_same_seed_gives_the_same_bits(n_z):
    recipe = replace(SMALL, n_z=n_z)
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


def test_another_seed_gives_another_lift():
    one, other = (train(UNFORCED, unforced_samples(), SMALL, seed=seed, starts=1)
                  for seed in (0, 1))
    assert bits(one.model) != bits(other.model)
    assert one.model.provenance.seed != other.model.provenance.seed


@pytest.mark.parametrize('sizes', [{}, {'layers': 2, 'hidden_first': 5}, {'activation': 'sine'}])
@pytest.mark.parametrize('identity', [True, False])
def test_the_recipe_shapes_the_model(sizes, identity):
    recipe = Growth(2, identity=identity, max_iterations=100, **sizes)
    model = train(UNFORCED, unforced_samples(), recipe, starts=1).model
    assert model.identity is identity
    assert model.observables.activation == recipe.activation
    assert len(model.observables.hidden) == recipe.layers
    assert model.provenance.metrics['rw'] < 2e-3
    np.testing.assert_array_equal(model.lift(np.zeros(1)), np.zeros(2))


@pytest.mark.parametrize('plant', [BENT, TWO_STATE], ids=lambda plant: plant.name)
def test_b_is_learned(plant):
    samples = bent_samples() if plant is BENT else two_state_samples()
    trained = train(replace(plant, B=None), samples, Growth(3, max_iterations=150), starts=1)
    model = trained.model
    B = model.B * model.states.scale[:, None] / model.inputs.scale
    np.testing.assert_allclose(B, plant.B, rtol=0, atol=1e-3)
    assert trained.figures.fit.rx < 1e-5


def test_the_recipe_of_the_paper():
    recipe = Algorithm1(2, identity=True, hidden=(4,), decoder=4, max_rounds=3, max_iterations=60)
    trained = train(BENT, bent_samples(), recipe, starts=2)
    assert trained.model.n_z == 2
    assert trained.figures.fit.rx < trained.linear.fit.rx


@pytest.mark.parametrize('B', [np.zeros((1, 0)), None], ids=['known B', 'no B'])
def test_a_plant_without_inputs(B):
    """The paper's first example, dx/dt = x^2, over [0, 5]."""
    system = scalar_example()
    plant = Plant(system.name, system.state_names, system.state_units, (), (), 's', np.zeros(1),
                  np.zeros(0), B)
    x = np.random.default_rng(0).uniform(0.0, 5.0, (200, 1))
    samples = Samples(x, x * x, np.zeros((200, 0)), np.arange(200) // 20)
    trained = train(plant, samples, Growth(2, max_iterations=150), starts=1)
    assert trained.closed_loop is None
    assert (trained.model.n_u, trained.model.B.shape) == (0, (1, 0))
    assert trained.figures.fit.rx < 1e-2 * trained.linear.fit.rx


def test_the_time_unit_does_not_matter():
    samples = bent_samples()
    recipe = replace(SMALL, max_iterations=30)
    per_second = train(BENT, samples, recipe, starts=1)
    per_minute = train(replace(BENT, time_unit='min', B=60.0 * BENT.B),
                       replace(samples, dxdt=60.0 * samples.dxdt), recipe, starts=1)
    assert per_minute.figures.fit.rw == pytest.approx(per_second.figures.fit.rw, rel=1e-2)
    np.testing.assert_allclose(per_minute.model.eigenvalues, 60.0 * per_second.model.eigenvalues,
                               rtol=1e-2)


def test_an_integrator_is_trained():
    """The linear model's eigenvalue 0 must not make the comparison of closed loops endless."""
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1.0, 1.0, (300, 2)), rng.uniform(-1.0, 1.0, (300, 2))
    plant = Plant('tank', ('level', 'heat'), ('m', 'K'), ('flow', 'power'), ('m/s', 'K/s'), 's',
                  np.zeros(2), np.zeros(2), np.eye(2))
    bent = -x[:, 1] - 0.3 * x[:, 1] ** 2
    samples = Samples(x, np.stack([0.0 * bent, bent], 1) + u, u, np.arange(300) // 30)
    trained = train(plant, samples, Growth(3, max_iterations=100), starts=1)
    assert math.isclose(trained.linear.eigenvalues[0].real, 0.0, abs_tol=1e-12)
    assert trained.closed_loop.linear_arrived == trained.closed_loop.starts


def test_torch_keeps_its_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        within = set()
        train(BENT, bent_samples(), SMALL, starts=1,
              watch=lambda now: bool(now.iteration and within.add(torch.get_num_threads())))
        assert within == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
