# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Held-out figures and roll-outs against systems whose answers are known."""

from dataclasses import replace

from koopman_ros.lifting import Coordinates, LiftedModel, linearised_model
from koopman_ros.lifting.validation import fit, roll_out
import numpy as np
import pytest
from random_lifts import coordinates, random_lift
from scipy.linalg import block_diag, expm

JACOBIAN = np.array([[-1.0, 4.0], [-2.0, -0.5]])
B = np.array([[0.3], [2.0]])


def linear_model(jacobian=JACOBIAN):
    return linearised_model(jacobian, B, coordinates('x', 2), coordinates('u', 1), 's',
                            random_lift().provenance)


def linear_samples(count=50, seed=2):
    """Return x, dx/dt and u of the linear system around the center of its coordinates."""
    rng = np.random.default_rng(seed)
    states, inputs = coordinates('x', 2), coordinates('u', 1)
    x = rng.uniform(states.lower, states.upper, (count, 2))
    u = rng.uniform(inputs.lower, inputs.upper, (count, 1))
    return x, (x - states.center) @ JACOBIAN.T + (u - inputs.center) @ B.T, u


def test_a_linear_system_is_fitted_exactly():
    figures = fit(linear_model(), *linear_samples())
    assert figures.rw < 1e-28
    assert figures.rx < 1e-28


def test_a_wrong_slope_is_measured():
    """The drift -3 x modelled as -2 x leaves a third of it: squared, 1/9."""
    c = coordinates('x', 1)
    model = linearised_model([[-2.0]], [[1.0]], c, coordinates('u', 1), 's',
                             random_lift().provenance)
    x = np.linspace(c.lower, c.upper, 20)
    u = np.linspace(-1.0, 2.0, 20)[:, None]
    dxdt = -3.0 * (x - c.center) + (u - model.inputs.center)
    figures = fit(model, x, dxdt, u)
    assert figures.rw == pytest.approx(1.0 / 9.0, rel=1e-12)
    assert figures.rx == pytest.approx(1.0 / 9.0, rel=1e-12)
    assert figures.cond == 1.0


def test_condition_number_of_the_second_moment():
    x = np.array([[3.5, 1.0], [2.5, 1.0], [3.0, 31.0], [3.0, -29.0]])
    # deviations +-1 in the first and +-20 in the second coordinate: S = diag(1/2, 200)
    figures = fit(linear_model(), x, np.ones((4, 2)), np.zeros((4, 1)))
    assert figures.cond == pytest.approx(400.0, rel=1e-12)


def transformed(model: LiftedModel, T: np.ndarray) -> LiftedModel:
    """Return the lift z -> T z of a free lift."""
    return replace(model, output=T @ model.output, A=T @ model.A @ np.linalg.inv(T))


@pytest.mark.parametrize('n_x', [1, 2, 3])
def test_rw_does_not_depend_on_the_coordinates_of_z(n_x):
    model = random_lift(n_x, (8,), identity=False, n_free=4)
    rng = np.random.default_rng(5)
    x = rng.uniform(model.states.lower, model.states.upper, (200, n_x))
    dxdt, u = rng.normal(size=(200, n_x)), rng.normal(size=(200, 1))
    rw = fit(model, x, dxdt, u).rw
    assert rw > 0.1
    for T in (1e-6 * np.eye(4), np.diag([1.0, 30.0, 0.1, 4.0]), rng.normal(size=(4, 4))):
        assert fit(transformed(model, T), x, dxdt, u).rw == pytest.approx(rw, rel=1e-9)


def test_rw_is_the_residual_in_whitened_coordinates():
    model = random_lift(2, (8,), identity=False)
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
    assert fit(model, x, dxdt, u).rw == pytest.approx(residual / reference, rel=1e-10)


@pytest.mark.parametrize('movement', [0.0, 1e-12, 1e-5])
def test_samples_that_hardly_move_are_refused(movement):
    model = random_lift(1, n_free=2)
    still = 3.5 + movement * np.random.default_rng(0).normal(size=(40, 1))
    with pytest.raises(ValueError, match='40 samples do not tell 3 coordinates apart: judge by'):
        fit(model, still, np.zeros((40, 1)), np.zeros((40, 1)))


def test_roll_out_of_a_linear_model_against_the_matrix_exponential():
    model = linear_model()
    inputs = np.random.default_rng(1).uniform(-3.0, 3.0, (25, 1))
    period = 0.3
    step = expm(period * block_diag(np.hstack([JACOBIAN, B]), np.zeros((1, 0))))
    x0 = np.array([2.2, 1.7])
    path = roll_out(model, x0, inputs, period)
    assert path.shape == (26, 2)
    np.testing.assert_array_equal(path[0], x0)
    deviation = x0 - model.states.center
    for state, u in zip(path[1:], inputs, strict=True):
        held = np.concatenate([deviation, u - model.inputs.center])
        deviation = (step @ held)[:2]
        np.testing.assert_allclose(state - model.states.center, deviation, rtol=0, atol=1e-7)


def test_roll_out_follows_the_projected_drift():
    """A free lift of n_z = n_x = 1 is a change of variable: z = tanh(x) decays as exp(-t)."""
    c = Coordinates(('x',), ('1',), np.zeros(1), np.ones(1), -np.ones(1), np.ones(1))
    model = LiftedModel(((np.eye(1), np.zeros(1)),), np.eye(1), -np.eye(1), np.eye(1), False, c,
                        c, 's', random_lift().provenance)
    path = roll_out(model, np.array([1.2]), np.zeros((20, 1)), 0.2)
    expected = np.arctanh(np.tanh(1.2) * np.exp(-0.2 * np.arange(21)))
    np.testing.assert_allclose(path[:, 0], expected, rtol=0, atol=1e-8)


def test_roll_out_without_inputs_is_the_start():
    x0 = np.array([2.2, 1.7])
    np.testing.assert_array_equal(roll_out(linear_model(), x0, np.zeros((0, 1)), 0.3), [x0])


def test_a_diverging_roll_out_is_reported():
    with pytest.raises(RuntimeError, match=r'diverged after \d+ samples: keep the inputs within'):
        roll_out(linear_model(50.0 * np.eye(2)), np.ones(2), np.zeros((40, 1)), 1.0)
