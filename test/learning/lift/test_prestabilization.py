# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lifts of unstable plants, learned under a pre-feedback, and the change of their data."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.control import feedback, Form, Weights
from koopman_ros.control.steady_state import steady_state_target
from koopman_ros.core.datasets import DriftSamples, PlantDescription
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.learning import IncrementalTraining, train
from koopman_ros.learning.lift.input_model import InputModel
from koopman_ros.learning.lift.prestabilization import PrestabilizedFrame
from koopman_ros.model import NetworkObservables
from support.small_plants import BENT

# dx/dt = x + 0.3 x^2 + 2 u in deviations from 3 m and 0.5 m/s
GROWING = replace(BENT, name='growing')
# of a pendulum about its upright position, x2' = 4 sin x1 - 0.2 x2 + 3 u
UPRIGHT = PlantDescription('upright', ('angle', 'rate'), ('rad', 'rad/s'), ('torque',), ('N m',),
                           's',
                           np.zeros(2), np.zeros(1), np.array([[0.0], [3.0]]))


def growing(x):
    return x + 0.3 * x * x


def upright(x):
    return np.stack([x[..., 1], 4.0 * np.sin(x[..., 0]) - 0.2 * x[..., 1]], axis=-1)


def samples_of(plant, drift, half, count=400):
    """Return samples all over a box of half-ranges about the nominal state."""
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-half, half, (count, len(half))), rng.uniform(-1.0, 1.0, (count, 1))
    return DriftSamples(x + plant.nominal_state, drift(x) + u @ plant.B.T,
                        u + plant.nominal_input, np.arange(count) // (count // 10))


def learned(plant, samples, recipe, starts=1):
    return train(plant, samples, recipe, starts=starts, reject=False).model


RECIPE = IncrementalTraining(1, identity=False, hidden_first=6, max_iterations=80,
                             pre_feedback=0.1)
CASES = {
    'known': (GROWING, growing, [0.8], RECIPE, 1e-7),
    'learned': (replace(GROWING, B=None), growing, [0.8], RECIPE, 1e-7),
    'identity': (GROWING, growing, [0.8], replace(RECIPE, n_z=3, identity=True), 1e-5),
    'free': (UPRIGHT, upright, [1.0, 2.0], replace(
        RECIPE, n_z=2, decoder=0, hidden_first=16, max_iterations=300), 1e-5),
}


@pytest.mark.parametrize(('plant', 'drift', 'half', 'recipe', 'promised'), CASES.values(),
                         ids=CASES)
def test_a_lift_of_an_unstable_plant(plant, drift, half, recipe, promised):
    known = GROWING if plant.name == 'growing' else UPRIGHT
    samples = samples_of(known, drift, np.array(half))
    model = learned(plant, samples, recipe)
    assert model.pre_feedback is not None
    assert model.is_hurwitz
    figures = model.provenance.metrics
    assert max(figures['rw'], figures['rx']) <= promised
    assert figures['cond'] < 20.0
    # drift and inputs are those of the plant itself, and not of the plant under the feedback
    x = np.random.default_rng(1).uniform(-np.array(half), half, (200, len(half)))
    found = model.drift(x / model.states.scale) * model.states.scale
    error = np.sqrt(np.mean((found - drift(x)) ** 2) / np.mean(drift(x) ** 2))
    assert error <= np.sqrt(promised)
    np.testing.assert_allclose(
        model.B * model.states.scale[:, None] / model.inputs.scale, known.B, rtol=0, atol=2e-3)
    # and so are the weights: the gain at the nominal point is that of the plant's own regulator
    Q, R = [2.0] + [0.5] * (len(half) - 1), [0.7]
    weights = Weights.physical(model, Q, R)
    origin = np.zeros(len(half))
    target = steady_state_target(model, origin)
    law = feedback(model, origin, target, weights)
    slope = np.stack([(drift(1e-5 * e) - drift(-1e-5 * e)) / 2e-5 for e in np.eye(len(half))], 1)
    wanted = solve_riccati(slope, known.B, np.diag(Q), np.diag(R)).K
    gain = np.stack([(target.u - feedback(model, 1e-6 * e, target, weights).u) / 1e-6
                     for e in np.eye(len(half))], 1)
    gain *= model.inputs.scale[:, None] / model.states.scale
    np.testing.assert_allclose(known.B @ gain, known.B @ wanted, rtol=0.02, atol=1e-3)
    assert model.identity or law.form is Form.AVERAGED


def test_the_same_plant_without_a_pre_feedback_has_another_lift():
    samples = samples_of(GROWING, growing, np.array([0.8]))
    model, plain = (learned(GROWING, samples, one)
                    for one in (RECIPE, replace(RECIPE, pre_feedback=None)))
    assert plain.pre_feedback is None
    # A of a change of coordinates has the plant's own eigenvalue
    assert plain.eigenvalues[0].real == pytest.approx(1.0, abs=0.01)
    K = model.pre_feedback * model.inputs.scale / model.states.scale
    assert model.eigenvalues[0].real == pytest.approx(1.0 + 2.0 * K[0, 0], rel=0.01)


def a_frame(identity=True, terms=False):
    """Return a frame, samples in scaled deviations, regressors where B is learned, and a lift."""
    rng = np.random.default_rng(2)
    x = rng.normal(size=(60, 2)) @ np.array([[1.0, -0.8], [0.0, 0.3]])
    u = rng.normal(size=(60, 1))
    inputs = InputModel(1, int(terms), None if terms else np.array([[0.2], [1.5]]))
    f = x @ np.array([[1.0, 0.4], [0.3, -0.5]]) + 0.1 * np.sin(x) + (
        u * (1.0 + x) if terms else 0.0)
    regressors = np.hstack([u, u * x]) if terms else None
    frame = PrestabilizedFrame.of(inputs, x, f, regressors, 0.5)
    lift = NetworkObservables(rng.normal(size=(5, 2)), rng.normal(size=5),
                              rng.normal(size=(3, 5)), identity)
    return frame, (x, f, regressors), lift


@pytest.mark.parametrize('identity', [True, False])
@pytest.mark.parametrize('terms', [False, True], ids=['known B', 'learned B'])
def test_a_lift_changed_to_another_frame_and_back_is_unchanged(identity, terms):
    """With z = L z', residuals are L r', whatever lift, A and B are."""
    frame, given, lift = a_frame(identity, terms)
    rng = np.random.default_rng(3)
    A = rng.normal(size=(lift.n_z, lift.n_z))
    weights = rng.normal(size=(2, 3)) if terms else None
    x, f, regressors = given
    inside = frame.enter(*given)

    def residual(lift, A, weights, x, f, regressors):
        z, J = lift.lift_and_jacobian(x)
        rate = f if regressors is None else f - regressors @ weights.T
        return z, (J @ rate[..., None])[..., 0] - z @ A.T

    z_inside, r_inside = residual(lift, A, weights, *inside)
    back, A, weights = frame.leave(lift, A, weights)
    B = frame.B if weights is None else weights[:, :1]
    # the plant under the pre-feedback
    z, r = residual(back, A, weights, x, f + x @ frame.K.T @ B.T, regressors)
    L = np.linalg.lstsq(z_inside, z, rcond=None)[0].T
    np.testing.assert_allclose(z, z_inside @ L.T, atol=1e-9)
    np.testing.assert_allclose(r, r_inside @ L.T, atol=1e-8)


def test_the_frame_is_white_and_stable():
    frame, given, _ = a_frame()
    x, f, _ = frame.enter(*given)
    np.testing.assert_allclose(x.T @ x / len(x), np.eye(2), atol=1e-12)
    plain, inside = (np.linalg.eigvals(np.linalg.lstsq(a, b, rcond=None)[0])
                     for a, b in ((given[0], given[1]), (x, f)))
    assert np.max(plain.real) > 0.0 > np.max(inside.real)


@pytest.mark.parametrize(('B', 'states', 'message'), [
    (np.zeros((2, 0)), np.eye(2), 'without inputs'),
    # x2 decays, and it alone is moved
    (np.array([[0.0], [1.0]]), np.eye(2), 'no feedback of the inputs stabilises'),
    (np.array([[1.0], [1.0]]), np.ones((2, 2)), 'do not move independently')])
def test_samples_without_a_frame_are_an_error(B, states, message):
    x = np.random.default_rng(0).normal(size=(50, 2)) @ states
    with pytest.raises(ValueError, match=message):
        PrestabilizedFrame.of(InputModel(B.shape[1], 0, B), x, x * np.array([1.0, -1.0]), None,
                              1.0)


def test_of_two_whitening_weights_validation_takes_the_better_one():
    samples = samples_of(GROWING, growing, np.array([0.8]))
    recipe = IncrementalTraining(3, hidden_first=6, max_iterations=30)
    both = train(GROWING, samples, replace(recipe, other_whitenings=(1e6,)), starts=2,
                 reject=False)
    assert both.starts == 4
    # nothing is left of the dynamics beside so large a weight
    poor = learned(GROWING, samples, replace(recipe, whitening=1e6))
    assert both.figures.fit.rw < 0.1 * poor.provenance.metrics['rw']
