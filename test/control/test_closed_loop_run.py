# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A law in continuous time against the analytic cost of the linear regulator, and its failures."""

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from koopman_ros.control import feedback, run_closed_loop, Weights
from koopman_ros.control.laws import Feedback, Form
from koopman_ros.lifting import linearised_model, Provenance
from koopman_ros.solvers import solve_riccati
from support.random_lifts import coordinates

JACOBIAN = np.array([[0.4, 1.0], [-0.3, -0.5]])
B = np.array([[0.2], [1.5]])
WEIGHTS = Weights(np.diag([2.0, 0.5]), np.array([[0.7]]))
STATES, INPUTS = coordinates('x', 2), coordinates('u', 1)


def linear_model(jacobian=JACOBIAN, B=B):
    return linearised_model(jacobian, B, coordinates('x', len(jacobian)), INPUTS, 'min',
                            Provenance('linear'))


def rate(x, u):
    return JACOBIAN @ (x - STATES.center) + B @ (u - INPUTS.center)


def optimal_cost(model, deviation, weights=WEIGHTS):
    P = solve_continuous_are(model.A, model.B, weights.Q, weights.R)
    return deviation @ P @ deviation


def test_the_cost_of_the_linear_regulator():
    model, x0 = linear_model(), np.array([3.6, -0.4])
    loop = run_closed_loop(model, rate, x0, STATES.center, WEIGHTS, 40.0)
    assert loop.failure == ''
    assert loop.cost == pytest.approx(optimal_cost(model, STATES.to_deviation(x0)), rel=1e-7)
    assert (loop.times.shape, loop.states.shape, loop.inputs.shape) == ((301,), (301, 2), (301, 1))
    np.testing.assert_array_equal(loop.times, np.linspace(0.0, 40.0, 301))
    np.testing.assert_array_equal(loop.states[0], x0)
    np.testing.assert_allclose(loop.states[-1], STATES.center, rtol=0, atol=1e-5)
    np.testing.assert_allclose(loop.inputs[-1], INPUTS.center, rtol=0, atol=1e-5)


def test_the_first_input_is_that_of_the_law():
    model, x0 = linear_model(), np.array([3.6, -0.4])
    loop = run_closed_loop(model, rate, x0, STATES.center, WEIGHTS, 1.0, samples=2)
    K = solve_riccati(model.A, model.B, WEIGHTS.Q, WEIGHTS.R).K
    expected = INPUTS.to_physical(-K @ STATES.to_deviation(x0))
    np.testing.assert_allclose(loop.inputs[0], expected, rtol=1e-12)


SCALAR = linear_model(np.array([[-0.8]]), np.array([[0.6]]))
ONE = Weights(np.eye(1), np.eye(1))


def scalar_rate(x, u):
    return -0.8 * (x - SCALAR.states.center) + 0.6 * (u - INPUTS.center)


def test_another_setpoint_is_held_by_an_input_that_costs_nothing():
    x0, x_ref = np.array([3.7]), np.array([3.2])
    loop = run_closed_loop(SCALAR, scalar_rate, x0, x_ref, ONE, 40.0)
    distance = (x0 - x_ref) / SCALAR.states.scale
    assert loop.cost == pytest.approx(optimal_cost(SCALAR, distance, ONE), rel=1e-7)
    np.testing.assert_allclose(
        loop.inputs[-1], INPUTS.center + 0.8 / 0.6 * (x_ref - SCALAR.states.center), rtol=1e-7)


def test_u_ref_shifts_what_the_cost_counts_from():
    """At rest on the set-point the law costs R d^2 a minute, d from the reference to its input."""
    center, weights = SCALAR.states.center, Weights(np.eye(1), np.array([[0.3]]))
    u_ref = INPUTS.center + 2.0 * INPUTS.scale
    loop = run_closed_loop(SCALAR, scalar_rate, center, center, weights, 5.0, u_ref=u_ref)
    assert loop.cost == pytest.approx(5.0 * 0.3 * 2.0 ** 2, rel=1e-9)
    held = run_closed_loop(SCALAR, scalar_rate, center, center, weights, 5.0,
                           u_ref=INPUTS.center)
    assert held.cost == 0.0


def failing(law_input=None, solved=lambda x: True):
    """Return a law that pushes with `law_input` and has an answer where `solved` says so."""
    def law(model, x, target, weights):
        found = feedback(model, x, target, weights)
        u = found.u if law_input is None else law_input(x)
        riccati = found.riccati
        if not solved(x):
            riccati = solve_riccati(np.eye(1), np.zeros((1, 1)), np.eye(1), np.eye(1))
        return Feedback(u, Form.PROJECTED, riccati, found.drift, found.action)
    return law


def test_a_state_that_escapes():
    """Under u = 3 x the state grows as exp(t) and is twice its scale away after log 5."""
    scale = SCALAR.states.scale[0]
    law = failing(lambda x: 1.8 * scale * x / (0.6 * INPUTS.scale))
    loop = run_closed_loop(SCALAR, scalar_rate, SCALAR.states.center + 0.4 * scale,
                           SCALAR.states.center, ONE, 10.0, law=law, escape=2.0)
    assert loop.failure == 'the state escaped'
    assert loop.cost == np.inf
    # it is noticed at the end of a step
    assert np.log(5.0) - 10.0 / 300 < loop.times[-1] < 4.0
    np.testing.assert_allclose(
        loop.states[:, 0], SCALAR.states.center + 0.4 * scale * np.exp(loop.times), rtol=1e-6)
    assert len(loop.inputs) == len(loop.times)


def test_a_start_that_has_escaped():
    loop = run_closed_loop(SCALAR, scalar_rate, SCALAR.states.center + 3.0 * SCALAR.states.scale,
                           SCALAR.states.center, ONE, 10.0, escape=2.0)
    assert (loop.failure, loop.cost) == ('the state escaped', np.inf)
    assert loop.times[-1] < 1.0


def test_a_law_that_chatters():
    """A law with a jump at the set-point keeps the steps tiny."""
    law = failing(lambda x: -5.0 * np.sign(x))
    loop = run_closed_loop(SCALAR, scalar_rate, SCALAR.states.center + 0.1 * SCALAR.states.scale,
                           SCALAR.states.center, ONE, 10.0, law=law, max_evaluations=500)
    assert loop.failure == 'the law was evaluated 500 times before the end'
    assert loop.cost == np.inf


def assert_unsolved(loop, x0):
    assert loop.failure.startswith('no feedback gain: the Hamiltonian has no stable subspace')
    assert loop.cost == np.inf
    np.testing.assert_array_equal(loop.states[0], x0)
    assert len(loop.times) == len(loop.states) == len(loop.inputs)


def test_a_model_that_cannot_be_stabilised():
    model = linear_model(np.array([[0.5]]), np.zeros((1, 1)))
    x0 = np.array([3.1])
    loop = run_closed_loop(model, scalar_rate, x0, model.states.center, ONE, 5.0)
    assert_unsolved(loop, x0)
    assert loop.times.tolist() == [0.0]
    assert np.all(np.isnan(loop.inputs))


def test_a_law_without_an_answer_on_the_way():
    x0 = SCALAR.states.center + SCALAR.states.scale
    law = failing(solved=lambda x: x[0] > 0.5)
    loop = run_closed_loop(SCALAR, scalar_rate, x0, SCALAR.states.center, ONE, 5.0, law=law)
    assert_unsolved(loop, x0)
    # the path up to there is returned, under the law of the regulator: e' = -1 e
    assert 1 < len(loop.times) < 300
    deviation = SCALAR.states.to_deviation(loop.states[:, 0])
    assert np.min(deviation) > 0.5
    np.testing.assert_allclose(deviation, np.exp(-np.hypot(0.8, SCALAR.B[0, 0]) * loop.times),
                               rtol=1e-6)


def test_a_law_without_an_answer_at_a_time_of_the_report():
    """The integration steps over the state; the inputs to return need the law there."""
    x0 = SCALAR.states.center + SCALAR.states.scale
    calls = []

    def run(limit):
        calls.clear()

        def solved(x):
            calls.append(x)
            return len(calls) <= limit

        return run_closed_loop(SCALAR, scalar_rate, x0, SCALAR.states.center, ONE, 5.0,
                               law=failing(solved=solved), samples=3)

    assert run(10_000).failure == ''
    assert_unsolved(run(len(calls) - 1), x0)


def test_an_integration_that_fails():
    """Once the state is half a scale away, the rate grows without bound in finite time."""
    def explosive(x, u):
        return 1e3 * (1.0 + (x - SCALAR.states.center) ** 2)

    loop = run_closed_loop(SCALAR, explosive, SCALAR.states.center, SCALAR.states.center, ONE,
                           1.0, escape=1e200)
    assert 'integration failed' in loop.failure
    assert loop.cost == np.inf


def test_distance_from_the_training_box():
    """The box reaches two scales below and one above the center, three halves as its half."""
    scale = SCALAR.states.scale
    for start, expected in ((0.5, 0.0), (1.75, 0.5), (-2.5, 1.0 / 3.0)):
        loop = run_closed_loop(SCALAR, scalar_rate, SCALAR.states.center + start * scale,
                               SCALAR.states.center, ONE, 5.0)
        assert loop.distance(SCALAR) == pytest.approx(expected, abs=1e-9)
