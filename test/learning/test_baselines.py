# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The baselines against exact models, numpy's least squares and the linearisation."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.control import projected, run_closed_loop, steady_state_target, Weights
from koopman_ros.learning import Edmd, evaluate, fit, Linearisation
from koopman_ros.lifting import Box, linearised_model
from koopman_ros.plant_data import Plant, Samples
from support.small_plants import BENT, bent_samples, TWO_STATE, two_state_samples


@pytest.mark.parametrize('degree', [2, 3])
@pytest.mark.parametrize('B', [TWO_STATE.B, None], ids=['known B', 'learned B'])
def test_monomials_hold_the_exact_lift_of_the_two_state_example(degree, B):
    """The monomials hold (x1, x2, x1^2), which the drift maps into itself."""
    samples = two_state_samples()
    model = Edmd(degree).learn(replace(TWO_STATE, B=B), samples)
    assert model.n_z == {2: 5, 3: 9}[degree]
    x = model.states.to_deviation(samples.x)
    f = samples.dxdt / model.states.scale - model.inputs.to_deviation(samples.u) @ model.B.T
    z, J = model.lift_and_jacobian(x)
    residual = (J @ f[..., None])[..., 0] - z @ model.A.T
    # the other monomials are no part of it: their derivatives are not spanned
    np.testing.assert_allclose(residual[:, :3], 0.0, rtol=0, atol=1e-12)
    for value in (-0.2, -0.1, 1.0):
        assert np.min(np.abs(model.eigenvalues - value)) < 1e-9
    units = model.B * model.states.scale[:, None] / model.inputs.scale
    np.testing.assert_allclose(units, TWO_STATE.B, rtol=0, atol=1e-12)


def van_der_pol(x, u):
    """Return the rates (..., 2) of dx1/dt = x2, dx2/dt = (1 - x1^2) x2 - x1 + u."""
    return np.stack([x[..., 1], (1.0 - x[..., 0] ** 2) * x[..., 1] - x[..., 0] + u[..., 0]], -1)


VAN_DER_POL = Plant('Van der Pol', ('x1', 'x2'), ('1', '1'), ('u',), ('1',), 's', np.zeros(2),
                    np.zeros(1), np.array([[0.0], [1.0]]))


def van_der_pol_samples(count=400, seed=0):
    rng = np.random.default_rng(seed)
    x, u = rng.uniform(-2.0, 2.0, (count, 2)), rng.uniform(-1.0, 1.0, (count, 1))
    return Samples(x, van_der_pol(x, u), u, np.arange(count) // 40)


@pytest.mark.parametrize('degree', [3, 5])
@pytest.mark.parametrize('B', [VAN_DER_POL.B, None], ids=['known B', 'learned B'])
def test_a_drift_of_monomials_is_found_exactly(degree, B):
    """
    Van der Pol's drift is of degree 3; the rates of its other monomials are of degree 5.

    So no A fits those, and what they lack must not come into the rate of the state.
    """
    model = Edmd(degree).learn(replace(VAN_DER_POL, B=B), van_der_pol_samples())
    fresh = van_der_pol_samples(seed=1)
    found = fit(model, fresh.x, fresh.dxdt, fresh.u)
    assert found.rw > 1e-3
    assert found.rx < 1e-20
    xi = model.states.to_deviation(fresh.x)
    f = van_der_pol(fresh.x, np.zeros((400, 1)))
    np.testing.assert_allclose(model.drift(xi) * model.states.scale, f, rtol=0, atol=1e-10)
    # each alone as all at once, and the law's error dynamics are those of the same drift
    target = steady_state_target(model, xi[0])
    for x in xi[1:30]:
        np.testing.assert_allclose(
            model.drift(x) * model.states.scale,
            van_der_pol(model.states.to_physical(x), np.zeros(1)), rtol=0, atol=1e-10)
        law = projected(model, x, target, Weights(np.eye(2), np.eye(1)))
        np.testing.assert_allclose(law.drift @ (x - xi[0]), model.drift(x) - model.drift(xi[0]),
                                   rtol=0, atol=1e-10)
    np.testing.assert_allclose(model.linearised.A * model.states.scale[:, None]
                               / model.states.scale, [[0.0, 1.0], [-1.0, 1.0]],
                               rtol=0, atol=1e-10)


def test_a_linear_plant_is_fitted_exactly():
    samples = bent_samples()
    linear = replace(samples, dxdt=-(samples.x - 3.0) + 2.0 * (samples.u - 0.5))
    for degree in (1, 3):
        assert fit(Edmd(degree).learn(BENT, linear), linear.x, linear.dxdt, linear.u).rw < 1e-20


@pytest.mark.parametrize('learned', [True, False])
def test_degree_one_is_linear_regression(learned):
    samples = two_state_samples()
    model = Edmd(1).learn(replace(TWO_STATE, B=None) if learned else TWO_STATE, samples)
    if learned:
        both = np.linalg.lstsq(np.hstack([samples.x, samples.u]), samples.dxdt)[0].T
        A, B = both[:, :2], both[:, 2:]
    else:
        B = TWO_STATE.B
        A = np.linalg.lstsq(samples.x, samples.dxdt - samples.u @ B.T)[0].T
    scale = model.states.scale
    np.testing.assert_allclose(model.A * scale[:, None] / scale, A, rtol=0, atol=1e-13)
    np.testing.assert_allclose(model.B * scale[:, None] / model.inputs.scale, B,
                               rtol=0, atol=1e-13)


def test_scaling_may_be_given():
    samples = bent_samples()
    scaling = Box.of(BENT, bent_samples(seed=1).x, bent_samples(seed=1).u)
    for baseline in (Edmd(2), Linearisation(np.array([[-1.0]]))):
        model = baseline.learn(BENT, samples, scaling)
        assert model.states is scaling.states
        assert model.inputs is scaling.inputs


def test_where_a_baseline_comes_from():
    samples = bent_samples()
    for baseline in (Edmd(2), Linearisation(np.array([[-1.0]]))):
        origin = baseline.learn(BENT, samples).provenance
        assert (origin.plant, origin.seed, origin.data_digest) == (
            'bent', None, samples.digest())


def test_linearisation():
    samples, jacobian = two_state_samples(), np.array([[-0.1, 0.0], [0.0, 1.0]])
    model = Linearisation(jacobian).learn(TWO_STATE, samples)
    expected = linearised_model(jacobian, TWO_STATE.B, model.states, model.inputs, 's',
                                model.provenance)
    np.testing.assert_array_equal(model.A, expected.A)
    np.testing.assert_array_equal(model.B, expected.B)
    scaling = Box.of(TWO_STATE, samples.x, samples.u)
    np.testing.assert_array_equal(model.states.scale, scaling.states.scale)


def test_linearisation_needs_b():
    with pytest.raises(ValueError, match='a linearisation needs the B of the plant'):
        Linearisation(np.array([[-1.0]])).learn(replace(BENT, B=None), bent_samples())


@pytest.mark.parametrize('baseline', [Edmd(1), Edmd(3), Linearisation(np.array([[-1.0]]))],
                         ids=str)
def test_a_baseline_controls_and_is_judged_like_a_lift(baseline):
    samples = bent_samples()
    model = baseline.learn(BENT, samples)
    figures = evaluate(model, bent_samples(seed=1))
    assert figures.fit.rx < 0.1
    assert figures.eigenvalues.shape == (model.n_z,)

    def rate(x, u):
        return -(x - 3.0) - 0.3 * (x - 3.0) ** 2 + 2.0 * (u - 0.5)

    loop = run_closed_loop(model, rate, np.array([4.2]), np.array([3.0]),
                           Weights(np.eye(1), np.eye(1)), 8.0)
    assert loop.failure == ''
    assert np.isfinite(loop.cost)
    assert abs(loop.states[-1, 0] - 3.0) < 1e-3
