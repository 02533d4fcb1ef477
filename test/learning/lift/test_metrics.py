# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Held-out figures and roll-outs against systems whose answers are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, expm

from koopman_ros.core.datasets import DriftSamples
from koopman_ros.learning import (
    evaluate,
    Fit,
    fit,
    LiftMetrics,
    rollout_rmse,
)
from koopman_ros.model import (
    Coordinates,
    LiftedModel,
    linearised_model,
    NetworkObservables,
    Provenance,
)
from support.random_lifts import coordinates, random_lift

JACOBIAN = np.array([[-1.0, 4.0], [-2.0, -0.5]])
B = np.array([[0.3], [2.0]])


def linear_model(jacobian=JACOBIAN):
    return linearised_model(jacobian, B, coordinates('x', 2), coordinates('u', 1), 's',
                            Provenance('test'))


def test_a_wrong_slope_is_measured_and_none_where_the_model_is_exact():
    """The drift -3 x modelled as -2 x leaves a third of it: squared, 1/9."""
    samples = linear_episodes()
    exact = fit(linear_model(), samples.x, samples.dxdt, samples.u)
    assert max(exact.rw, exact.rx) < 1e-28
    c = coordinates('x', 1)
    model = linearised_model([[-2.0]], [[1.0]], c, coordinates('u', 1), 's', Provenance('test'))
    x, u = np.linspace(c.lower, c.upper, 20), np.linspace(-1.0, 2.0, 20)[:, None]
    figures = fit(model, x, -3.0 * (x - c.center) + (u - model.inputs.center), u)
    assert (figures.rw, figures.rx, figures.cond) == pytest.approx((1 / 9, 1 / 9, 1), rel=1e-12)


def test_figures_under_a_pre_feedback_are_those_of_the_plant_under_it():
    """The plant with the slope -1 + 2 under u = -1.5 x, modelled as -2 x + 0.1 x there."""
    c, K = coordinates('x', 1), np.array([[-1.5]])
    model = replace(linearised_model([[-1.9]], [[2.0]], c, replace(c, names=('u',)), 's',
                                     Provenance('test')), pre_feedback=K)
    x, u = np.linspace(c.lower, c.upper, 20), np.linspace(-1.0, 2.0, 20)[:, None]
    dxdt = (x - c.center) + 2.0 * (u - c.center)
    figures = fit(model, x, dxdt, u)
    assert figures.rw == pytest.approx((0.1 / 2.0) ** 2, rel=1e-10)
    # of the drift itself, which is smaller
    assert figures.rx == pytest.approx(0.1 ** 2, rel=1e-10)


def test_rw_is_the_residual_in_whitened_coordinates():
    model = random_lift(2, 8, identity=False)
    rng = np.random.default_rng(6)
    x, dxdt, u = rng.normal(size=(90, 2)), rng.normal(size=(90, 2)), rng.normal(size=(90, 1))
    xi = model.states.to_deviation(x)
    f = dxdt / model.states.scale - model.inputs.to_deviation(u) @ model.B.T
    S = np.mean([np.outer(z, z) for z in model.lift(xi)], axis=0)
    values, vectors = np.linalg.eigh(S)
    whiten = vectors @ np.diag(values ** -0.5) @ vectors.T
    residual = reference = 0.0
    for point, slope in zip(xi, f, strict=True):
        dz = model.jacobian(point) @ slope
        residual += np.sum((whiten @ (dz - model.A @ model.lift(point))) ** 2)
        reference += np.sum((whiten @ dz) ** 2)
    found = fit(model, x, dxdt, u)
    assert found.rw == pytest.approx(residual / reference, rel=1e-10)
    assert found.cond == pytest.approx(values[-1] / values[0], rel=1e-9)


def test_states_that_move_together_are_not_coordinates_that_collapsed():
    rng = np.random.default_rng(7)
    x = rng.normal(size=(200, 1)) + 1e-3 * rng.normal(size=(200, 2))
    dxdt, u = rng.normal(size=(200, 2)), rng.normal(size=(200, 1))
    states = fit(random_lift(n_free=0), x, dxdt, u)
    assert states.cond == states.cond_of_states > 100.0
    lift = fit(random_lift(n_free=1), x, dxdt, u)
    assert lift.cond_of_states == pytest.approx(states.cond, rel=1e-9)
    assert lift.cond > lift.cond_of_states


@pytest.mark.parametrize('movement', [0.0, 1e-5])
def test_samples_that_hardly_move_are_rejected(movement):
    still = 3.5 + movement * np.random.default_rng(0).normal(size=(40, 1))
    with pytest.raises(ValueError, match='over the 40 samples'):
        fit(random_lift(1, n_free=2), still, np.zeros((40, 1)), np.zeros((40, 1)))


def test_roll_out_of_a_linear_model_against_the_matrix_exponential():
    model, rng = linear_model(), np.random.default_rng(1)
    inputs, x0 = rng.uniform(-3.0, 3.0, (25, 1)), np.array([2.2, 1.7])
    # all inputs held equally long, and each for a time of its own
    for periods in (0.3, rng.uniform(0.1, 0.5, 25)):
        path = model.predict(x0, inputs, periods)
        assert path.shape == (26, 2)
        np.testing.assert_array_equal(path[0], x0)
        deviation = x0 - model.states.center
        for state, u, h in zip(path[1:], inputs, np.broadcast_to(periods, 25), strict=True):
            step = expm(h * block_diag(np.hstack([JACOBIAN, B]), np.zeros((1, 0))))
            deviation = (step @ np.concatenate([deviation, u - model.inputs.center]))[:2]
            np.testing.assert_allclose(state - model.states.center, deviation, rtol=0, atol=1e-7)


def test_roll_out_follows_the_projected_drift():
    """A free lift of n_z = n_x = 1 is a change of variable: z = tanh(x) decays as exp(-t)."""
    c = Coordinates(('x',), ('1',), np.zeros(1), np.ones(1), -np.ones(1), np.ones(1))
    observables = NetworkObservables(np.eye(1), np.zeros(1), np.eye(1), identity=False)
    model = LiftedModel(observables, -np.eye(1), np.eye(1), c, c, 's', Provenance('test'))
    path = model.predict(np.array([1.2]), np.zeros((20, 1)), 0.2)
    expected = np.arctanh(np.tanh(1.2) * np.exp(-0.2 * np.arange(21)))
    np.testing.assert_allclose(path[:, 0], expected, rtol=0, atol=1e-8)


def test_a_roll_out_without_inputs_and_one_that_diverges():
    x0 = np.array([2.2, 1.7])
    np.testing.assert_array_equal(linear_model().predict(x0, np.zeros((0, 1)), 0.3), [x0])
    with pytest.raises(RuntimeError, match=r'diverged after \d+ samples: keep the inputs within'):
        linear_model(50.0 * np.eye(2)).predict(np.ones(2), np.zeros((40, 1)), 1.0)


def test_a_roll_out_into_a_state_where_the_lift_is_singular_ends():
    """With dz/dt = z a coordinate leaves its maximum, at x = 1.5, where the drift is infinite."""
    c = Coordinates(('x',), ('1',), np.zeros(1), np.ones(1), -np.ones(1), np.ones(1))
    observables = NetworkObservables(np.ones((2, 1)), np.array([-0.5, -2.5]),
                                     np.array([[1.0, -1.0]]), identity=False)
    model = LiftedModel(observables, np.eye(1), np.eye(1), c, c, 's', Provenance('test'))
    path = model.predict(np.array([0.5]), np.zeros((7, 1)), 0.1)
    z = model.lift(path)
    np.testing.assert_allclose(z, z[0] * np.exp(0.1 * np.arange(8))[:, None], rtol=1e-7)
    with pytest.raises(RuntimeError, match='diverged after 9 samples'):
        model.predict(np.array([0.5]), np.zeros((9, 1)), 0.1)


@pytest.mark.parametrize('change', [
    {'x0': [2.2]}, {'inputs': [1.0, 2.0]}, {'inputs': [1.0]}, {'x0': [[2.2, 1.7]] * 3},
    {'sample_period': [0.1] * 3}, {'sample_period': -0.1}], ids=str)
def test_a_roll_out_of_mismatched_arguments_is_an_error(change):
    usual = {'x0': [2.2, 1.7], 'inputs': [[1.0], [2.0]], 'sample_period': 0.1}
    assert linear_model().predict(**usual).shape == (3, 2)
    with pytest.raises(ValueError, match=r'expected|must be above 0 s'):
        linear_model().predict(**{**usual, **change})


def test_samples_of_another_plant_are_no_fit():
    # a single column would stand for both
    with pytest.raises(ValueError, match='incompatible dxdt'):
        fit(linear_model(), np.zeros((9, 2)), np.zeros((9, 1)), np.zeros((9, 1)))


def test_roll_outs_side_by_side_are_those_one_by_one():
    model, rng = random_lift(2, 6), np.random.default_rng(3)
    # slow enough to stay where the lift was drawn
    model = replace(model, A=0.1 * model.A)
    x0 = rng.uniform(model.states.lower, model.states.upper, (2, 3, 2))
    inputs = rng.uniform(-1.0, 1.0, (2, 3, 7, 1))
    together = model.predict(x0, inputs, 0.2)
    assert together.shape == (2, 3, 8, 2)
    for i, j in np.ndindex(2, 3):
        np.testing.assert_allclose(together[i, j], model.predict(x0[i, j], inputs[i, j], 0.2),
                                   rtol=0, atol=1e-7)


def linear_episodes(jacobian=JACOBIAN, lengths=(6, 9), shift=0.0, period=0.2):
    """Return episodes of the linear system, `shift` away from it but in their first samples."""
    rng, model = np.random.default_rng(7), linear_model(jacobian)
    x, u, time, episode = [], [], [], []
    for number, length in enumerate(lengths):
        inputs = rng.uniform(-1.0, 1.0, (length, 1))
        path = model.predict(rng.uniform([2.5, 0.0], [3.5, 2.0]), inputs[:-1], period)
        path[1:] += shift
        x, u = [*x, path], [*u, inputs]
        time.append(5.0 + period * np.arange(length))
        episode.append(np.full(length, number))
    x, u = np.concatenate(x), np.concatenate(u)
    dxdt = (x - model.states.center) @ jacobian.T + (u - model.inputs.center) @ B.T
    return DriftSamples(x, dxdt, u, np.concatenate(episode), np.concatenate(time))


def test_the_error_of_roll_outs_is_measured_over_all_episodes():
    samples = linear_episodes(shift=np.array([0.3, -0.2]))
    np.testing.assert_allclose(rollout_rmse(linear_model(), linear_episodes()), 0.0, atol=1e-8)
    error = rollout_rmse(linear_model(), samples)
    np.testing.assert_allclose(error, [0.3, 0.2], rtol=1e-6)
    # an episode of one sample predicts nothing
    single = linear_episodes(lengths=(6, 9, 1), shift=np.array([0.3, -0.2]))
    np.testing.assert_allclose(rollout_rmse(linear_model(), single), error, rtol=1e-12)
    assert rollout_rmse(linear_model(), linear_episodes(lengths=(1, 1))) is None
    # without times there is no roll-out, and one that diverges errs infinitely
    assert rollout_rmse(linear_model(), replace(samples, time=None)) is None
    assert np.all(np.isinf(rollout_rmse(linear_model(50.0 * np.eye(2)), samples)))
    np.testing.assert_array_equal(evaluate(linear_model(), samples).rollout_rmse, error)


def test_finite_figures_by_name():
    for error, names, expected in ((None, ('T',), {}),
                                   (np.array([0.5]), ('T',), {'rollout_rmse': 0.5}),
                                   (np.array([np.inf, 0.1]), ('T', 'c'), {'rollout_rmse_c': 0.1})):
        figures = LiftMetrics(Fit(0.1, np.nan, 3.0), np.ones(1), error)
        assert figures.metrics(names) == {'rw': 0.1, 'cond': 3.0, **expected}
