# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The drift read out of hidden units, recovered where they span it; a network for it alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from koopman_ros.core.datasets import DriftSamples, split_by_episode
from koopman_ros.learning import fit, IncrementalTraining, NeuralDrift, train
from koopman_ros.learning.lift.levenberg_marquardt import normal_equations
from koopman_ros.learning.lift.network import Layout
from koopman_ros.learning.lift.neural_drift import NeuralDriftProblem, with_readout
from koopman_ros.learning.lift.residuals import ScaledSamples
from support.random_lifts import random_lift
from support.small_plants import BENT, bent_samples, TWO_STATE, two_state_samples
from support.tensors import assert_close


def samples_of(model, count=60, seed=1):
    """Sample the drift of a model, with inputs."""
    rng = np.random.default_rng(seed)
    xi, v = rng.uniform(-1.5, 1.5, (count, model.n_x)), rng.normal(size=(count, model.n_u))
    rate = model.states.scale * (model.drift(xi) + v @ model.B.T)
    return DriftSamples(model.states.to_physical(xi), rate, model.inputs.to_physical(v),
                        np.arange(count) // 10)


@pytest.mark.parametrize('identity', [True, False])
def test_a_drift_in_the_span_of_the_features_is_recovered_to_rounding(identity):
    lift = random_lift(2, 6, identity=identity)
    weights = np.random.default_rng(2).normal(size=(2, 8))
    found = with_readout(lift, samples_of(replace(lift, readout=weights)))
    np.testing.assert_allclose(found.readout, weights, rtol=0, atol=1e-9)
    fresh = samples_of(replace(lift, readout=weights), seed=3)
    assert fit(found, fresh.x, fresh.dxdt, fresh.u).rx < 1e-25


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
    recipe = Given(IncrementalTraining(plant.B.shape[0] + 1, hidden_first=6, max_iterations=20))
    model = train(plant, samples, recipe, starts=1, loops=0).model
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
    rough = DriftSamples(samples.x[few], (samples.dxdt + noise)[few], samples.u[few],
                         samples.episode[few])
    assert train(plant, rough, recipe, starts=1, reject=False).model.readout is None


# A network for the drift alone.

@pytest.mark.parametrize('n_u', [0, 2], ids=['known B', 'learned B'])
def test_the_sums_of_a_drift_are_those_of_its_differentiated_residual(n_u):
    generator = torch.Generator().manual_seed(0)
    x, f, u = (torch.randn(70, n, generator=generator, dtype=torch.float64) for n in (3, 3, 2))
    layout = Layout(3, 3, 5, False, n_u)
    theta = torch.randn(layout.size, generator=generator, dtype=torch.float64)
    data = ScaledSamples(x, f, u if n_u else None)
    found = normal_equations(NeuralDriftProblem(layout, data).add_residuals, theta)

    def residual(theta):
        parts = layout.split(theta)
        h, zero = torch.tanh(x @ parts.W.T + parts.b), torch.tanh(parts.b)
        of_input = u @ parts.B.T if n_u else 0.0
        return ((f - of_input - x @ parts.A.T - (h - zero) @ parts.V.T) / 70 ** 0.5).ravel()

    J, r = torch.autograd.functional.jacobian(residual, theta), residual(theta)
    assert found.cost == pytest.approx(float(0.5 * r @ r), rel=1e-13)
    assert_close(found.gradient, J.T @ r, rtol=0, atol=1e-13)
    assert_close(found.matrix, J.T @ J, rtol=0, atol=1e-13)


@pytest.mark.parametrize('B', [TWO_STATE.B, None], ids=['known B', 'learned B'])
def test_a_neural_drift_is_learned(B):
    """The paper's two-state example, whose quadratic drift no tanh spans."""
    trained = train(replace(TWO_STATE, B=B), two_state_samples(400),
                    NeuralDrift(6, max_iterations=100), starts=1, loops=0)
    model = trained.model
    assert (model.n_z, model.identity, model.readout.shape) == (2, True, (2, 8))
    assert trained.figures.fit.rx < 1e-4 * trained.linear.fit.rx
    units = model.B * model.states.scale[:, None] / model.inputs.scale
    np.testing.assert_allclose(units, TWO_STATE.B, rtol=0, atol=1e-3)
    # z = x: the lifted A is the linear fit
    np.testing.assert_array_equal(model.lift(np.array([0.3, -0.2])), [0.3, -0.2])
