# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The disturbance observer against its own design, and against exact disturbances."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from koopman_ros.control import Controller, InputLimits, Settings, State
from koopman_ros.estimation import DisturbanceObserver, equivalent_bias, Estimate
from koopman_ros.solvers import runge_kutta_step
from support.closed_loops import shipped, START
from validation.paper.optimal_control import exact_two_state_model

MODEL = shipped('reactor_nz4')
NO_BOUND = np.array([np.inf])


@pytest.mark.parametrize('bandwidth', [0.5 / 60.0, 6.0 / 60.0, 1.0])
@pytest.mark.parametrize('seconds', [0.1, 1.0, 5.0])
def test_both_poles_of_the_error_are_where_they_were_put(bandwidth, seconds):
    # about the nominal point, where the drift is A x within a thousandth
    observer, size = DisturbanceObserver(MODEL.linearised, bandwidth, NO_BOUND), 1e-6
    columns = []
    for dx, dw in np.eye(2) * size:
        before = Estimate(np.array([dx]), np.array([dw]))
        after = observer.correct(
            observer.predict(before, np.zeros(1), seconds), np.zeros(1), seconds)
        columns.append([after.x[0], after.w[0]])
    poles = np.linalg.eigvals(np.array(columns).T / size)
    p = np.exp(-bandwidth * seconds)
    # the model's own motion within a sample is neglected in the design
    moved = abs(np.expm1(MODEL.linearised.A[0, 0] * seconds / 60.0))
    np.testing.assert_allclose(np.abs(poles), p, rtol=0, atol=2.0 * np.sqrt(moved))
    assert np.max(np.abs(poles)) < 1.0
    assert np.prod(poles).real == pytest.approx(p * p, rel=2.0 * moved + 1e-3)


def test_prediction_is_that_of_the_differential_equation():
    estimate, u = Estimate(np.array([-0.5]), np.array([0.3])), np.array([0.4])
    observer = DisturbanceObserver(MODEL, 0.1, NO_BOUND)
    exact = solve_ivp(lambda _, x: MODEL.drift(x) + MODEL.B @ u + estimate.w, (0.0, 1.0),
                      estimate.x, rtol=1e-10, atol=1e-12).y[:, -1]
    predicted = observer.predict(estimate, u, 60.0)
    np.testing.assert_allclose(predicted.x, exact, rtol=0, atol=1e-3)
    state = estimate
    for _ in range(60):
        state = observer.predict(state, u, 1.0)
    np.testing.assert_allclose(state.x, exact, rtol=0, atol=2e-5)


def test_after_very_long_nothing_is_predicted():
    observer = DisturbanceObserver(MODEL, 0.1, NO_BOUND)
    assert observer.predict(Estimate(np.zeros(1), np.zeros(1)), np.zeros(1), 3600.0) is None


def test_the_disturbance_is_bounded():
    observer = DisturbanceObserver(MODEL, 0.1, np.array([0.5]))
    huge = observer.correct(Estimate(np.zeros(1), np.zeros(1)), np.array([1e6]), 1.0)
    np.testing.assert_allclose(np.abs(observer.as_input(huge.w)), 0.5, rtol=1e-12)
    np.testing.assert_array_equal(observer.bounded(np.array([np.nan])), [0.0])
    np.testing.assert_array_equal(observer.bounded(np.array([np.inf])), [0.0])


@pytest.mark.parametrize('kelvin', [308.0, 316.0, START])
@pytest.mark.parametrize('bias', [-1.5, 0.7, 2.0])
def test_equivalent_bias_is_the_bias(kelvin, bias):
    true = MODEL.states.to_deviation(np.array([kelvin]))
    x = true + bias / MODEL.states.scale
    # at rest under the input that holds the true state
    estimate = Estimate(x, MODEL.drift(true) - MODEL.drift(x))
    found = equivalent_bias(MODEL, estimate) * MODEL.states.scale
    np.testing.assert_allclose(found, [bias], rtol=0, atol=1e-5)


def test_no_bias_explains_a_disturbance_that_is_too_large():
    assert np.isnan(equivalent_bias(MODEL.linearised, Estimate(np.zeros(1), np.array([1e9]))))[0]


def test_several_states_have_a_disturbance_each():
    model = exact_two_state_model()
    bounds = InputLimits(np.array([-50.0]), np.array([50.0]), np.array([np.inf]))
    loop = Controller(model, Settings.for_model(
        model, state_weight=np.ones(2), input_weight=np.ones(1), limits=bounds,
        observer_bandwidth=2.0))
    state, x, w = State(), np.array([1.0, 2.0]), np.array([0.05, -0.4])
    state, refused = loop.request_setpoint(state, np.zeros(2))
    assert refused is None
    command = np.zeros(1)
    for k in range(400):
        state, command, report = loop.step(state, x, 10 ** 9 + k * 5 * 10 ** 7)
        x = runge_kutta_step(lambda y, u=command: model.drift(y) + model.B @ u + w, x, 0.05)
    np.testing.assert_allclose(state.estimate.w, w, rtol=0, atol=1e-3)
    # the input cannot balance what acts on the first state, and the report says how much that is
    assert report.target.residual == pytest.approx(0.05, rel=1e-2)
    assert abs(float(x[1])) < 0.2
