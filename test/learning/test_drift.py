# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The drift read out of hidden units: recovered where they span it, kept where it is better."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.learning import fit, Growth, train
from koopman_ros.learning.drift import with_readout
from koopman_ros.plant_data import Samples, split_by_episode
from support.random_lifts import random_lift
from support.small_plants import BENT, bent_samples, TWO_STATE, two_state_samples


def samples_of(model, count=60, seed=1):
    """Sample the drift of a model, with inputs."""
    rng = np.random.default_rng(seed)
    xi, v = rng.uniform(-1.5, 1.5, (count, model.n_x)), rng.normal(size=(count, model.n_u))
    rate = model.states.scale * (model.drift(xi) + v @ model.B.T)
    return Samples(model.states.to_physical(xi), rate, model.inputs.to_physical(v),
                   np.arange(count) // 10)


@pytest.mark.parametrize('identity', [True, False])
def test_a_drift_in_the_span_of_the_features_is_recovered_to_rounding(identity):
    lift = random_lift(2, (6,), identity=identity)
    weights = np.random.default_rng(2).normal(size=(2, 8))
    found = with_readout(lift, samples_of(replace(lift, readout=weights)))
    np.testing.assert_allclose(found.readout, weights, rtol=0, atol=1e-9)
    fresh = samples_of(replace(lift, readout=weights), seed=3)
    assert fit(found, fresh.x, fresh.dxdt, fresh.u).rx < 1e-25


def test_units_that_say_nothing_and_units_that_say_the_same_do_no_harm():
    """One unit is 0 everywhere and two are alike, so that the weights are not determined."""
    lift = random_lift(2, (6,))
    W, b = (np.array(a) for a in lift.observables.hidden[0])
    W[0], W[2], b[2] = 0.0, W[1], b[1]
    lift = replace(lift, observables=replace(lift.observables, hidden=((W, b),)))
    truth = replace(lift, readout=np.random.default_rng(2).normal(size=(2, 8)))
    found, fresh = with_readout(lift, samples_of(truth)), samples_of(truth, seed=3)
    assert fit(found, fresh.x, fresh.dxdt, fresh.u).rx < 1e-25
    assert np.max(np.abs(found.readout)) < 10.0
    np.testing.assert_array_equal(found.readout[:, 2], 0.0)


class Given:
    """A recipe that has its result already, or keeps it."""

    def __init__(self, recipe=None):
        self.recipe, self.grown = recipe, None

    def rounds(self, n_x):
        return (n_x + 1,)

    def start(self, data, n_z, parent, seed, monitor=None):
        if self.grown is None:
            self.grown = self.recipe.start(data, n_z, parent, seed, monitor)
        return self.grown


@pytest.mark.parametrize(('plant', 'samples'), [
    (BENT, bent_samples()), (TWO_STATE, two_state_samples(300))], ids=['bent', 'two states'])
def test_training_keeps_the_read_out_that_is_better_on_validation_episodes(plant, samples):
    recipe = Given(Growth(plant.B.shape[0] + 1, hidden_first=6, max_iterations=20))
    model = train(plant, samples, recipe, starts=1).model
    training, validation, _ = split_by_episode(samples, 0)
    by_features = with_readout(model, training)
    rx = [fit(m, validation.x, validation.dxdt, validation.u).rx
          for m in (replace(model, readout=None), by_features)]
    assert rx[1] < rx[0]
    np.testing.assert_array_equal(model.readout, by_features.readout)
    # fitted to a few noisy samples it follows their errors, which the lift has not seen
    few = ~np.isin(samples.episode, training.episode) | (np.arange(len(samples.x)) % 11 == 0)
    noise = 0.3 * np.std(samples.dxdt) * np.random.default_rng(0).normal(size=samples.x.shape)
    noise[~np.isin(samples.episode, training.episode)] = 0.0
    rough = Samples(samples.x[few], (samples.dxdt + noise)[few], samples.u[few],
                    samples.episode[few])
    assert train(plant, rough, recipe, starts=1, refuse=False).model.readout is None
