# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A reactor whose feed flow is an input, so that B depends on the state, and its controller."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from koopman_ros.control import averaged, recentred, steady_state_target, Weights
from koopman_ros.core.datasets import DriftSamples
from koopman_ros.estimation import Estimate
from koopman_ros.estimation.disturbance_observer import simulated
from koopman_ros.evaluation import run_closed_loop
from koopman_ros.evaluation.closed_loop_test import evaluate_closed_loops
from koopman_ros.evaluation.model_comparison import PredictionWindows
from koopman_ros.learning import Edmd, fit, IncrementalTraining, NeuralDrift, train
from koopman_ros.learning.drift_sampling import learn_lift
from koopman_ros.learning.identification import identify
from koopman_ros.learning.lift.input_model import InputModel
from koopman_ros.model import Box
from koopman_ros.model.steady_state import resting_state
from koopman_ros.parameters.trainer_table import trainer_table
from koopman_ros.plants import (
    advance,
    box_episodes,
    describe,
    RandomStepDesign,
    simulate,
    steady_state,
)
from koopman_ros.plants.library.reactor import fed_reactor
from support.closed_loops import observing

PLANT = fed_reactor()
HALF_X, HALF_U = np.array([0.08, 8.0]), np.array([50.0, 10.0])
KNOWN = describe(PLANT)
UNKNOWN = replace(KNOWN, B=None, input_matrix_degree=1)


@cache
def samples() -> DriftSamples:
    """Sample the reactor around its cold steady state, between half and one and a half feeds."""
    x0, u0 = PLANT.nominal_state, PLANT.nominal_input
    design = RandomStepDesign(u0 - HALF_U, u0 + HALF_U, x0 - HALF_X, x0 + HALF_X, (0.05, 0.2),
                              0.05)
    return box_episodes(PLANT, design, 60, 0.6, seed=0)


@cache
def quartic(known: bool):
    """Fit monomials of degree 4 and, unless it is known, B(x) of degree 1."""
    return Edmd(4).learn(KNOWN if known else UNKNOWN, samples())


def wrong(matrix, x):
    """Return the largest error of B, (..., n_x, n_u) in units, at states as a share of B."""
    def scaled(B):
        return B * HALF_U / HALF_X[:, None]

    true = scaled(PLANT.input_matrix(x))
    return np.max(np.abs(scaled(matrix) - true)) / np.max(np.abs(true))


def matrix_of(model, x):
    B = model.input_matrix(model.states.to_deviation(x))
    return B * model.states.scale[:, None] / model.inputs.scale


@pytest.mark.parametrize('known', [True, False], ids=['function', 'learned'])
def test_the_input_matrix_is_that_of_the_plant_all_over_the_box(known):
    model, x = quartic(known), samples().x[::7]
    assert model.input_terms.degree == 1
    # one that is learned takes a part in what monomials of degree 4 leave of the drift
    assert wrong(matrix_of(model, x), x) < (1e-12 if known else 0.02)
    # a constant B errs by as much as the flow's part of it changes
    constant = Edmd(4).learn(replace(KNOWN, B=None), samples())
    assert constant.input_terms is None
    rx = [fit(one, samples().x, samples().dxdt, samples().u).rx for one in (constant, model)]
    assert rx[1] < 1e-4 < 0.1 * rx[0]


def test_a_function_that_is_no_polynomial_is_rejected_and_a_constant_one_is_a_constant():
    box = Box.of(KNOWN, samples().x, samples().u)
    wild = replace(KNOWN, B=lambda x: PLANT.input_matrix(x) * np.sign(x[..., 1:, None] - 324.0))
    with pytest.raises(ValueError, match='differs from a polynomial of degree 5'):
        InputModel.of(wild, box, samples().x)
    matrix = np.array([[0.0, 0.1], [-0.2, 2.0]])
    same = replace(KNOWN, B=lambda x: np.broadcast_to(matrix, (*x.shape, 2)))
    found = InputModel.of(same, box, samples().x)
    assert (found.degree, found.n_u) == (0, 2)
    np.testing.assert_array_equal(found.weights, box.input_matrix(matrix))


def test_targets_are_steady_states_of_the_plant():
    model = quartic(known=True)
    x_ref, u_ref = steady_state(PLANT, {'temperature': 321.0, 'concentration': 0.88})
    xi = model.states.to_deviation(x_ref)
    target = steady_state_target(model, xi)
    np.testing.assert_allclose(model.inputs.to_physical(target.u), u_ref, rtol=0, atol=0.05)
    assert target.residual < 1e-12
    np.testing.assert_allclose(target.forcing, model.input_matrix(xi) @ target.u, rtol=0,
                               atol=1e-12)
    # the temperature alone, with an input to spare
    free = steady_state_target(model, xi[1:], controlled=np.array([1]),
                               limits=(-np.ones(2), np.ones(2)))
    rate = model.rate_under(free.u)(free.x)
    assert free.x[1] == pytest.approx(xi[1], abs=1e-9)
    np.testing.assert_allclose(rate, 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(resting_state(model, target.u, np.zeros(2), np.zeros(2)), xi,
                               rtol=0, atol=1e-7)


@pytest.mark.parametrize('law', [averaged, recentred])
def test_the_error_obeys_the_equation_of_the_law(law):
    """Exactly so for a drift of degree 1, whose lift is closed: e' = loop e."""
    model = Edmd(1).learn(UNKNOWN, samples())
    target = steady_state_target(model, np.array([0.4, -0.3]))
    x = np.array([-0.6, 0.5])
    found = law(model, x, target, Weights(np.eye(2), np.eye(2)))
    assert found.solved
    rate = model.rate_under(found.u)(x)
    np.testing.assert_allclose(rate, found.loop @ (x - target.x), rtol=0, atol=1e-10)


def test_the_loop_reaches_a_set_point_that_needs_another_flow():
    model = quartic(known=True)
    x_ref, u_ref = steady_state(PLANT, {'temperature': 321.0, 'concentration': 0.88})
    loop = run_closed_loop(model, PLANT.derivative, PLANT.nominal_state, x_ref,
                           Weights(np.eye(2), np.eye(2)), 10.0, u_ref=u_ref)
    assert np.all(np.abs(loop.states[-1] - x_ref) < [1e-4, 0.02])
    assert abs(u_ref[0] - 100.0) > 10.0


def test_observer_and_optimum_use_the_input_matrix_at_each_state():
    model = quartic(known=True)
    x, u = PLANT.nominal_state + 0.5 * HALF_X, PLANT.nominal_input + 0.6 * HALF_U
    after = advance(PLANT, x, u, 0.2)
    v = model.inputs.to_deviation(u)
    predicted = simulated(model, Estimate(model.states.to_deviation(x), np.zeros(2)), v, 12.0)
    # by Heun's method with steps of a quarter of the fastest time constant
    assert np.all(np.abs(model.states.to_physical(predicted.x) - after) < [2e-4, 0.02])
    observer = observing(model, 0.1, 10.0)
    held, balance = steady_state(PLANT, {'temperature': 321.0, 'concentration': 0.88})
    found = observer.restart(None, model.states.to_deviation(held),
                             model.inputs.to_deviation(balance))
    assert np.max(np.abs(found.w)) < 0.01
    # in hindsight it predicts better than with B as it is in the middle
    rng = np.random.default_rng(0)
    inputs = PLANT.nominal_input + HALF_U * rng.uniform(-1.0, 1.0, (40, 2))
    episode = simulate(PLANT, x, inputs, 0.1)
    past = PredictionWindows(episode.x, episode.u, np.full(40, 6.0), np.arange(40).reshape(4, 10))
    errors, fixed = (past.squares(one, np.ones(2)).mean(axis=0)
                     for one in (model, replace(model, input_terms=None)))
    assert np.all(errors < 0.1 * fixed)


def test_lifts_and_drifts_are_learned_with_it():
    """Held to the true plant: the law holds all over the box, on the plant itself."""
    for plant, recipe in ((KNOWN, NeuralDrift(10, max_iterations=60)),
                          (UNKNOWN, IncrementalTraining(4, hidden_first=10, max_iterations=60))):
        model = train(plant, samples(), recipe, starts=1, loops=0).model
        fresh = samples()
        assert fit(model, fresh.x, fresh.dxdt, fresh.u).rx < 1e-4
        found = evaluate_closed_loops(model, PLANT.derivative, loops=8)
        assert found.accepted, found
        path = model.predict(fresh.x[0], fresh.u[:5], 0.05)
        assert np.all(np.abs(path[1:5] - fresh.x[1:5]) < [1e-3, 0.1])


def test_it_is_identified_and_lifted_from_noisy_samples():
    rng = np.random.default_rng(4)
    inputs = np.repeat(PLANT.nominal_input + HALF_U * rng.uniform(-1.0, 1.0, (60, 2)), 4,
                       axis=0)
    episode = simulate(PLANT, PLANT.nominal_state, inputs, 0.05)
    noisy = replace(episode, x=episode.x + rng.normal(0.0, [1e-4, 0.02], episode.x.shape))
    found = identify(UNKNOWN, [noisy], degrees=(1, 2))
    drift = found.drift
    assert drift.input_degree == 1
    x = episode.x[::25]
    assert wrong(drift.input_matrix_at(x), x) < 0.2 * wrong(drift.input_matrix, x)
    lift = learn_lift(found, UNKNOWN, 3, seed=0, starts=1).model
    np.testing.assert_allclose(matrix_of(lift, x), drift.input_matrix_at(x), rtol=1e-6, atol=1e-9)
    # it retrains as what it is
    assert (lift.plant.input_matrix_degree, lift.plant.B) == (1, None)
    table = trainer_table(lift, {'system': 'fed_reactor'})
    assert table.snapshot({}).input_matrix_degree == 1
    given = table.snapshot({'input_matrix': [0.0] * 4})
    assert table.check(given).startswith('input_matrix_degree is 1, must be 0 if input_matrix')
