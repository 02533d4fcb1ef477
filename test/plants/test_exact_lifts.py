# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The lifts known in closed form, and the optimal control that follows from them."""

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from koopman_ros.plants import (
    ControlAffineSystem,
    ExactLift,
    simulate,
    two_state_exact_lift,
    two_state_example,
)

START = np.array([5.0, 5.0])
STATE_WEIGHT = np.diag([1.0, 1.0])


def _lqr_gain(A, B, Q, R):
    P = solve_continuous_are(A, B, Q, R)
    return np.linalg.solve(R, B.T @ P)


def _closed_loop_cost(K, lift, input_weight):
    """Integrate x'x + R u^2 under u = -K z from the start as a third state until it settles."""
    plant = two_state_example()

    def rates(y):
        x = y[..., :2]
        u = -lift(x) @ K.T
        cost = np.sum(x * x, axis=-1, keepdims=True) + input_weight * u * u
        return np.concatenate([plant.derivative(x, u), cost], axis=-1)

    loop = ControlAffineSystem(
        name='closed loop', state_names=('x1', 'x2', 'cost'), state_units=('1', '1', '1'),
        input_names=(), input_units=(), time_unit='s', drift=rates,
        drift_jacobian=lambda y: np.zeros((*y.shape, 3)), B=np.zeros((3, 0)),
        nominal_state=np.zeros(3), nominal_input=np.zeros(0))
    return simulate(loop, [*START, 0.0], np.zeros((1, 0)), 120.0).x[-1, 2]


@pytest.mark.parametrize(('system', 'exact', 'states'), [
    (two_state_example(), two_state_exact_lift(), np.array([[5.0, 5.0], [-3.0, 0.5]])),
    (two_state_example(0.3, -2.0), two_state_exact_lift(0.3, -2.0), np.array([[1.5, -2.0]])),
])
def test_lift_makes_the_drift_linear(system, exact, states):
    lifted_rate = (exact.jacobian(states) @ system.drift(states)[..., None])[..., 0]
    np.testing.assert_allclose(lifted_rate, exact.lift(states) @ exact.A.T, rtol=1e-13)


def test_jacobian_agrees_with_central_differences():
    exact, states = two_state_exact_lift(), np.array([[5.0, 5.0], [-3.0, 0.5]])
    for j in range(states.shape[1]):
        step = np.zeros(states.shape[1])
        step[j] = 1e-6
        slope = (exact.lift(states + step) - exact.lift(states - step)) / 2e-6
        np.testing.assert_allclose(exact.jacobian(states)[..., j], slope, atol=1e-8)


def test_two_state_eigenvalues():
    eigenvalues = np.sort(np.linalg.eigvals(two_state_exact_lift().A))
    np.testing.assert_allclose(eigenvalues, [-0.2, -0.1, 1.0], rtol=1e-14)


@pytest.mark.parametrize(('input_weight', 'gain', 'cost', 'linear_ratio'), [
    (1.0, [0.0, 2.41421356, -1.49559737], 990.1798, 4.529680),
    (0.1, [0.0, 4.31662479, -1.22749086], 253.2680, 1.929557),
    (0.001, [0.0, 32.6385840, -1.02512675], 127.1212, 1.012917),
])
def test_two_state_optimal_control(input_weight, gain, cost, linear_ratio):
    exact, plant = two_state_exact_lift(), two_state_example()
    B = exact.jacobian(np.zeros(2)) @ plant.B
    R = np.array([[input_weight]])
    K = _lqr_gain(exact.A, B, np.diag([1.0, 1.0, 0.0]), R)
    np.testing.assert_allclose(K[0], gain, atol=1e-7)
    optimal = _closed_loop_cost(K, exact.lift, input_weight)
    assert optimal == pytest.approx(cost, abs=1e-4)

    linear = _lqr_gain(plant.drift_jacobian(np.zeros(2)), plant.B, STATE_WEIGHT, R)
    ratio = _closed_loop_cost(linear, lambda x: x, input_weight) / optimal
    assert ratio == pytest.approx(linear_ratio, abs=1e-6)


@pytest.mark.parametrize('build', [two_state_example, two_state_exact_lift])
@pytest.mark.parametrize(('rates', 'message'), [
    ({'mu': np.nan}, 'mu is nan 1/s, must be finite'),
    ({'lambda_': np.inf}, 'lambda_ is inf 1/s, must be finite'),
])
def test_rates_must_be_finite(build, rates, message):
    with pytest.raises(ValueError, match=message):
        build(**rates)


def test_lifted_dynamics_must_be_square():
    with pytest.raises(ValueError, match=r'incompatible A: expected \(2, 2\), got \(2, 3\)'):
        ExactLift(A=np.zeros((2, 3)), lift=np.sin, jacobian=np.cos)
