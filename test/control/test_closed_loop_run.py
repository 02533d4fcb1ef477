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
    K = solve_riccati(model.A, model.B, WEIGHTS.Q, WEIGHTS.R).K
    np.testing.assert_allclose(
        loop.inputs[0], INPUTS.to_physical(-K @ STATES.to_deviation(x0)), rtol=1e-12)


# A plant of one state, in deviations of its scale from its center.
SCALAR = linear_model(np.array([[-0.8]]), np.array([[0.6]]))
ONE = Weights(np.eye(1), np.eye(1))
CENTER, SCALE = SCALAR.states.center, SCALAR.states.scale


def scalar_rate(x, u):
    return -0.8 * (x - CENTER) + 0.6 * (u - INPUTS.center)


def run(start=0.0, duration=10.0, *, goal=CENTER, model=SCALAR, rate=scalar_rate, weights=ONE,
        **others):
    return run_closed_loop(
        model, rate, CENTER + start * SCALE, goal, weights, duration, **others)


def test_another_setpoint_is_held_by_an_input_that_costs_nothing():
    goal = np.array([3.2])
    loop = run(1.4, 40.0, goal=goal)
    assert loop.cost == pytest.approx(optimal_cost(
        SCALAR, 1.4 - (goal - CENTER) / SCALE, ONE), rel=1e-7)
    np.testing.assert_allclose(
        loop.inputs[-1], INPUTS.center + 0.8 / 0.6 * (goal - CENTER), rtol=1e-7)


def test_u_ref_shifts_what_the_cost_counts_from():
    """At rest on the set-point the law costs R d^2 a minute, d from the reference to its input."""
    weights = Weights(np.eye(1), np.array([[0.3]]))
    u_ref = INPUTS.center + 2.0 * INPUTS.scale
    assert run(0.0, 5.0, weights=weights, u_ref=u_ref).cost == pytest.approx(
        5.0 * 0.3 * 2.0 ** 2, rel=1e-9)
    assert run(0.0, 5.0, weights=weights, u_ref=INPUTS.center).cost == 0.0


def test_distance_from_the_training_box():
    """The box reaches two scales below and one above the center, three halves as its half."""
    for start, expected in ((0.5, 0.0), (1.75, 0.5), (-2.5, 1.0 / 3.0)):
        assert run(start, 5.0).distance(SCALAR) == pytest.approx(expected, abs=1e-9)


# Failures.

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


UNSOLVED = 'no feedback gain: the Hamiltonian has no stable subspace'
STUCK = linear_model(np.array([[0.5]]), np.zeros((1, 1)))
# u = 3 x lets the state grow as exp(t), so that it is twice its scale away after log 5
PUSHING = failing(lambda x: 1.8 * SCALE * x / (0.6 * INPUTS.scale))


@pytest.mark.parametrize(('start', 'others', 'failure', 'earliest', 'latest'), [
    # noticed at the end of a step
    (0.4, {'law': PUSHING, 'escape': 2.0}, 'the state escaped', np.log(5.0) - 10.0 / 300, 4.0),
    (3.0, {'escape': 2.0}, 'the state escaped', 0.0, 1.0),
    # a law with a jump at the set-point keeps the steps tiny
    (0.1, {'law': failing(lambda x: -5.0 * np.sign(x)), 'max_evaluations': 500},
     'the law was evaluated 500 times before the end', 0.0, 10.0),
    # once the state is half a scale away, the rate grows without bound in finite time
    (0.0, {'rate': lambda x, u: 1e3 * (1.0 + (x - CENTER) ** 2), 'escape': 1e200},
     'the integration failed', 0.0, 1.0),
    (0.2, {'model': STUCK}, UNSOLVED, 0.0, 0.0),
    (1.0, {'law': failing(solved=lambda x: x[0] > 0.5)}, UNSOLVED, 0.1, 2.0),
], ids=['escapes', 'has escaped', 'chatters', 'explodes', 'not stabilisable', 'on the way'])
def test_a_loop_that_fails_returns_the_path_up_to_there(start, others, failure, earliest, latest):
    loop = run(start, **others)
    assert loop.failure.startswith(failure)
    assert loop.cost == np.inf
    np.testing.assert_array_equal(loop.states[0], CENTER + start * SCALE)
    assert len(loop.times) == len(loop.states) == len(loop.inputs)
    assert earliest <= loop.times[-1] <= latest
    deviation = SCALAR.states.to_deviation(loop.states[:, 0])
    if others.get('law') is PUSHING:
        np.testing.assert_allclose(deviation, 0.4 * np.exp(loop.times), rtol=1e-6)
    elif failure == UNSOLVED and 'law' in others:
        # under the law of the regulator: e' = -1 e
        assert np.min(deviation) > 0.5
        np.testing.assert_allclose(
            deviation, np.exp(-np.hypot(0.8, SCALAR.B[0, 0]) * loop.times), rtol=1e-6)
    elif failure == UNSOLVED:
        assert np.all(np.isnan(loop.inputs))


def test_a_law_without_an_answer_at_a_time_of_the_report():
    """The integration steps over the state; the inputs to return need the law there."""
    calls = []

    def limited(limit):
        calls.clear()

        def solved(x):
            calls.append(x)
            return len(calls) <= limit

        return run(1.0, 5.0, law=failing(solved=solved), samples=3)

    assert limited(10_000).failure == ''
    loop = limited(len(calls) - 1)
    assert loop.failure.startswith(UNSOLVED)
    assert len(loop.times) == len(loop.states) == len(loop.inputs)
