# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The laws against exact optima."""

from dataclasses import replace
import pickle

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from koopman_ros.control import Controller, State, Tuning
from koopman_ros.control.laws import averaged, feedback, Form, LAWS, recentred, riccati, Weights
from koopman_ros.control.steady_state import steady_state_target
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.core.status import StatusCode
from koopman_ros.estimation import Estimate
from koopman_ros.evaluation import run_closed_loop
from koopman_ros.evaluation.optimal_cost import cost_along, optimum, Task
from koopman_ros.model import Coordinates, linearised_model, NetworkObservables, Provenance
from koopman_ros.plants import two_state_example, two_state_reactor
from studies.paper.optimal_control import exact_two_state_model, scalar_optimal_cost
from support.closed_loops import (
    COOLANT,
    REACTOR,
    reactor_weights,
    run_reactor,
    SETPOINT,
    shipped,
    START,
    steady_state,
    UNIT,
)
from support.random_lifts import change_of_variable, random_lift


def setpoint_target(model, kelvin=SETPOINT):
    return steady_state_target(model, model.states.to_deviation(np.array([kelvin])))


# The steady state.

@pytest.mark.parametrize(('name', 'coolant', 'tolerance'), [
    ('reactor_nz3', 292.287569, 1e-3), ('reactor_nz4', 292.287569, 1e-3),
    ('reactor_linear', 295.421299, 1e-5)])
def test_feed_forward(name, coolant, tolerance):
    model = shipped(name)
    target = setpoint_target(model)
    assert model.inputs.to_physical(target.u)[0] == pytest.approx(coolant, abs=tolerance)
    assert target.residual < 1e-12
    # the nominal state needs the nominal input
    np.testing.assert_allclose(setpoint_target(model, START).u, [0.0], rtol=0, atol=1e-12)


def saddle_model():
    """Linearise the two-state reactor at its saddle, in units of 0.1 mol/L and 10 K."""
    system = two_state_reactor()
    saddle = steady_state(system, [300.0], [0.5, 350.0])
    scale = np.array([0.1, 10.0])
    return linearised_model(
        system.drift_jacobian(saddle), system.B,
        Coordinates(system.state_names, system.state_units, saddle, scale, saddle - scale,
                    saddle + scale),
        Coordinates(system.input_names, system.input_units, system.nominal_input,
                    np.array([10.0]), np.array([280.0]), np.array([320.0])),
        system.time_unit, Provenance(system.name))


def test_the_target_of_a_state_that_no_input_holds_is_the_nearest_steady_state():
    model = saddle_model()
    x = np.array([0.3, 0.0])
    target = steady_state_target(model, x)
    # the coolant acts on the temperature alone; steady states are on the line A[0] x = 0
    normal = model.A[0] / np.linalg.norm(model.A[0])
    nearest = x - normal * (normal @ x)
    np.testing.assert_allclose(target.x, nearest, rtol=0, atol=1e-12)
    assert target.u[0] == pytest.approx(-model.A[1] @ nearest / model.B[1, 0], rel=1e-10)
    assert target.residual < 1e-12


# The one-state reactor, from its nominal point to a set-point 10 K below.

def optimal_cost(R):
    return scalar_optimal_cost(REACTOR, START, SETPOINT, R, UNIT)


@pytest.mark.parametrize(('n_z', 'law', 'R'), [
    (3, recentred, 1.0), (3, averaged, 0.1), (4, recentred, 0.1), (4, averaged, 1.0)])
def test_cost_and_offset_on_the_true_reactor(n_z, law, R):
    cost, end = run_reactor(shipped(f'reactor_nz{n_z}'), law, R, minutes=30.0)
    ratio = cost / optimal_cost(R)
    # no law does better than the optimum, but for the errors of integration
    assert 1.0 - 1e-6 <= ratio <= 1.001
    assert abs(end - SETPOINT) < 1e-3


@pytest.mark.parametrize('model', [shipped('reactor_linear'), saddle_model()],
                         ids=['nominal', 'saddle'])
def test_laws_of_a_linear_model_are_the_regulator(model):
    weights = Weights(np.diag(1.0 + np.arange(model.n_x)), np.array([[0.3]]))
    target = steady_state_target(model, np.full(model.n_x, -0.4))
    P = solve_continuous_are(model.A, model.B, weights.Q, weights.R)
    K = np.linalg.solve(weights.R, model.B.T @ P)
    x = np.full(model.n_x, 0.2)
    for law, name in ((recentred, Form.RECENTRED), (averaged, Form.AVERAGED),
                      (feedback, Form.RECENTRED)):
        found = law(model, x, target, weights)
        assert found.form is name
        np.testing.assert_allclose(found.riccati.K, K, rtol=1e-9)
        np.testing.assert_allclose(found.u, target.u - K @ (x - target.x), rtol=1e-9)


# The paper's two-state example under its exact lift. A has the eigenvalue 1 and the lifted pair
# is stabilisable all the same.

def test_laws_of_the_two_state_example():
    def law(*arguments):
        return feedback(*arguments, max_gain=1e3, max_residual=1e-6)

    system, model = two_state_example(), exact_two_state_model()
    start, weights = np.array([5.0, 5.0]), Weights(np.eye(2), np.eye(1))
    target = steady_state_target(model, np.zeros(2))
    found = recentred(model, start, target, weights)
    np.testing.assert_allclose(found.riccati.K, [[0.0, 2.41421356, -1.49559737]], rtol=0,
                               atol=1e-6)
    assert not model.is_hurwitz
    # its one unstable mode is the plant's own
    assert law(model, start, target, weights).form is Form.RECENTRED
    for used, act, ratio, rel in ((model, law, 1.0, 1e-6), (model, averaged, 1.01, 0.01),
                                  (model.linearised, law, 4.529680, 1e-5)):
        run = run_closed_loop(used, system.derivative, start, np.zeros(2), weights, 90.0,
                              law=act, samples=2, escape=1e3, max_evaluations=100_000,
                              rtol=1e-6 if act is averaged else 1e-8)
        assert run.cost / 990.1798 == pytest.approx(ratio, rel=rel)
        # x1 decays as exp(-0.1 t) whatever the input does
        np.testing.assert_allclose(run.states[-1], [5.0 * np.exp(-9.0), 0.0], rtol=0, atol=1e-6)


# A pre-feedback changes what is learned, not what the law does.

@pytest.mark.parametrize('reference', [0.0, 0.4])
def test_weights_on_the_input_stay_so_under_a_pre_feedback(reference):
    """The same plant with A of its own and of the loop under K has the same gain on u."""
    K, weights = np.array([[0.3, -3.0]]), Weights(np.diag([1.0, 2.0]), np.array([[0.7]]))
    for model in (exact_two_state_model(), saddle_model()):
        A = np.array(model.A)
        A[:, :2] += model.jacobian(np.zeros(2)) @ model.B @ K
        closed = replace(model, A=A, pre_feedback=K)
        target, same = (steady_state_target(one, np.array([0.0, reference]))
                        for one in (model, closed))
        np.testing.assert_allclose(same.u, target.u, rtol=0, atol=1e-13)
        for law in (feedback, recentred, averaged):
            for interval in (0.0, 0.3):
                found, wanted = (
                    law(one, np.array([0.5, -0.8]), aim, weights, interval=interval)
                    for one, aim in ((closed, same), (model, target)))
                assert found.form is wanted.form
                np.testing.assert_allclose(found.riccati.K, wanted.riccati.K, rtol=1e-8,
                                           atol=1e-12)
                np.testing.assert_allclose(found.u, wanted.u, rtol=1e-8)
                np.testing.assert_allclose(found.loop, wanted.loop, rtol=1e-8, atol=1e-10)


# Choice of the law.

@pytest.mark.parametrize(('mu', 'adds', 'form'), [
    (-0.1, False, Form.RECENTRED),
    # x1^2 grows by itself, and no input reaches it
    (0.1, True, Form.AVERAGED)])
def test_a_lift_with_unstable_modes_of_its_own_is_controlled_by_the_averaged_law(mu, adds, form):
    model = exact_two_state_model(mu, -1.0)
    assert model.adds_unstable_modes is adds
    target = steady_state_target(model, np.zeros(2))
    # x1 is not moved by the input either
    found = feedback(model, np.array([0.5, 0.3]), target,
                     Weights(np.diag([0.0, 1.0]), np.eye(1)))
    assert found.form is form


@pytest.mark.parametrize(('rate', 'form'), [(-0.2, Form.RECENTRED), (-0.25, Form.AVERAGED)])
def test_a_lift_that_is_not_closed_is_controlled_by_the_averaged_law(rate, form):
    """x1^2 of x1' = -0.1 x1 decays at twice that rate."""
    model = exact_two_state_model()
    A = np.array(model.A)
    assert A[2, 2] == pytest.approx(-0.2)
    A[2, 2] = rate
    model = replace(model, A=A)
    assert not model.adds_unstable_modes
    found = feedback(model, np.array([0.5, 0.3]), steady_state_target(model, np.zeros(2)),
                     Weights(np.eye(2), np.eye(1)))
    assert found.form is form


def test_the_averaged_law_takes_over():
    model = shipped('reactor_nz4')
    # at the cold end the gain on the lifted state is the larger one
    arguments = (model, np.array([-1.7]), setpoint_target(model, 306.0),
                 reactor_weights(model, 1.0))
    lifted, plain = recentred(*arguments), averaged(*arguments)
    assert lifted.riccati.gain > 1.1 * plain.riccati.gain
    found = feedback(*arguments, max_gain=1.05 * plain.riccati.gain, max_residual=1e-6)
    assert found.solved
    assert found.form is Form.AVERAGED
    np.testing.assert_array_equal(found.u, plain.u)


# A free lift, z = tanh(x) with dz/dt = -z + J(x) B u, whose equations are scalar.

@pytest.mark.parametrize('x', [1.3, -0.8, 1e-3])
@pytest.mark.parametrize('reference', [0.0, 0.4])
@pytest.mark.parametrize('k', [0.0, -2.0])
def test_recentred_law_of_a_free_lift_by_hand(x, reference, k):
    """Under a pre-feedback dz/dt = -z + J(x) B (u - k x)."""
    q, r, b = 2.0, 0.3, 0.7
    model = replace(change_of_variable(gain=b), pre_feedback=np.array([[k]]) if k else None)
    target = steady_state_target(model, np.array([reference]))
    t, t_ref = np.tanh(x), np.tanh(reference)
    J, J_ref = 1.0 - t * t, 1.0 - t_ref * t_ref
    v_ref = t_ref / (b * J_ref)
    assert target.u[0] == pytest.approx(v_ref + k * reference, rel=1e-13, abs=1e-15)
    # e' = -e + (J - J_ref) B v_ref + J B v with e = t - t_ref, and (x - x_ref) = C e
    C = (x - reference) / (t - t_ref)
    a = -1.0 + (J - J_ref) * b * v_ref / (t - t_ref) - J * b * k * C
    p = r / (b * J) ** 2 * (a + np.sqrt(a * a + (b * J) ** 2 * q * C * C / r))
    found = recentred(model, np.array([x]), target, Weights(q * np.eye(1), r * np.eye(1)))
    assert found.solved
    assert found.u[0] == pytest.approx(target.u[0] - p * b * J / r * (t - t_ref), rel=1e-10)
    assert found.loop[0, 0] == pytest.approx(a - (b * J) ** 2 * p / r, rel=1e-10)


@pytest.mark.parametrize('x', [1.3, -0.8, 1e-3])
def test_averaged_law_of_a_free_lift_by_hand(x):
    model = change_of_variable(gain=0.7)
    q, r, b = 2.0, 0.3, 0.7
    target = steady_state_target(model, np.zeros(1))
    # the drift -tanh(x) cosh(x)^2 = -sinh(x) cosh(x) as a factor of x, its mean slope
    a = -np.sinh(x) * np.cosh(x) / x
    p = r / b ** 2 * (a + np.sqrt(a * a + b * b * q / r))
    found = averaged(model, np.array([x]), target, Weights(q * np.eye(1), r * np.eye(1)))
    assert found.solved
    assert found.u[0] == pytest.approx(-p * b / r * x, rel=1e-8)


def test_the_averaged_law_has_a_gain_where_the_secant_of_the_lift_has_none():
    """
    Of z = (x1 + g(x2), x2), g = tanh, which is linear, the input moving x2.

    Then f1 = x1 + g + b x2 - g' (x1 + g), and at (1, 1) the secant of the lift is
    [[1 - g', g + b - g' g], [1, g]]: with b = g' g - g no input reaches its growing mode.
    """
    g, slope = np.tanh(1.0), 1.0 - np.tanh(1.0) ** 2
    b = slope * g - g
    small = 1e-4
    lift = NetworkObservables(
        np.array([[small, 0.0], [0.0, small], [0.0, 1.0]]), np.zeros(3),
        np.array([[1.0 / small, 0.0, 1.0], [0.0, 1.0 / small, 0.0]]), identity=False)
    model = replace(saddle_model(), observables=lift, A=np.array([[1.0, b], [1.0, 0.0]]),
                    B=np.array([[0.0], [1.0]]))
    x, origin = np.ones(2), np.zeros(2)
    J, M, _ = lift.secants(x, origin, origin)
    secant = model.onto_states(J) @ model.A @ M
    np.testing.assert_allclose(secant, [[1.0 - slope, 0.0], [1.0, g]], rtol=0, atol=1e-7)
    assert not solve_riccati(secant, model.B, np.eye(2), np.eye(1), max_gain=1e3).solved
    # with the means of g', g'^2, s g'' and g g'' on the way, in parts
    mean_square = g - g ** 3 / 3.0
    across = g + b - mean_square - (slope - g) - (slope * g - mean_square)
    found = feedback(model, x, steady_state_target(model, origin),
                     Weights(np.eye(2), np.eye(1)))
    assert found.form is Form.AVERAGED
    np.testing.assert_allclose(found.loop + model.B @ found.riccati.K,
                               [[1.0 - g, across], [1.0, g]], rtol=0, atol=1e-5)
    assert found.solved
    assert found.riccati.gain < 10.0


@pytest.mark.parametrize(('identity', 'n_free'), [(False, 1), (False, 2), (True, 1)])
def test_a_free_lift_and_one_that_is_not_closed_take_the_averaged_law(identity, n_free):
    model = random_lift(1, identity=identity, n_free=n_free)
    model = replace(model, A=-np.eye(model.n_z), B=np.eye(1))
    target = steady_state_target(model, np.array([0.1]))
    found = feedback(model, np.array([0.3]), target, Weights(np.eye(1), np.eye(1)))
    assert found.solved
    assert found.form is Form.AVERAGED


# The sampled loop.

def sampled_loop(law, seconds, R, interval):
    """Step the true reactor to the set-point by a held input; return task, states and inputs."""
    model, h = shipped('reactor_nz4'), seconds / 60.0
    weights, target = reactor_weights(model, R), setpoint_target(model)
    task = Task(REACTOR, np.array([START]), np.array([SETPOINT]), np.array([COOLANT]),
                np.full(1, UNIT ** -2), np.full(1, R * UNIT ** -2), h, round(15.0 / h))
    states, inputs = [task.x0], []
    for _ in range(task.samples):
        found = law(model, model.states.to_deviation(states[-1]), target, weights,
                    interval=interval)
        assert found.solved
        inputs.append(model.inputs.to_physical(found.u))
        x = states[-1]
        for _ in range(task.substeps):
            x = runge_kutta_step(lambda x: REACTOR.derivative(x, inputs[-1]), x,
                                 h / task.substeps)
        states.append(x)
    return task, np.array(states), np.array(inputs)


@pytest.mark.parametrize('law', [recentred, averaged])
def test_a_sampled_law_is_nearly_optimal_at_long_intervals(law):
    task, states, inputs = sampled_loop(law, 15.0, 0.1, interval=0.25)
    least = optimum(task).cost
    assert least * (1.0 - 1e-6) < cost_along(task, states, inputs) < 1.002 * least
    assert states[-1][0] == pytest.approx(SETPOINT, abs=1e-3)
    unaware = sampled_loop(law, 15.0, 0.1, interval=0.0)
    assert cost_along(*unaware) > 1.5 * least


def test_an_interval_makes_gains_smaller_and_the_loop_stable():
    model = shipped('reactor_nz4')
    arguments = (model, np.array([-0.5]), setpoint_target(model), reactor_weights(model, 1e-6))
    unaware, aware = (feedback(*arguments, interval=h, max_gain=1e9) for h in (0.0, 1.0 / 60.0))
    assert unaware.solved
    assert aware.solved
    assert aware.riccati.gain < 0.5 * unaware.riccati.gain
    assert aware.growth(1.0 / 60.0) < 1.0
    # the continuous gain moves the input too far within a second
    a, b = model.averaged_drift_jacobian(arguments[1], arguments[2].x)[0, 0], model.B[0, 0]
    k = (arguments[2].u - unaware.u)[0] / (arguments[1] - arguments[2].x)[0]
    assert np.exp(a / 60.0) - np.expm1(a / 60.0) / a * b * k < -1.0


def test_the_linear_law_is_solved_for_the_interval():
    model = shipped('reactor_nz4')
    tuning = Tuning.for_model(model, input_weight=[0.003], max_gain=1e6)
    law, linear = LAWS['linear'](model, tuning, None), model.linearised
    weights = Weights.physical(model, tuning.state_weight, tuning.input_weight)
    target = setpoint_target(linear, 323.0)
    estimate = Estimate(linear.states.to_deviation(np.array([324.0])), np.zeros(1))
    for seconds in (1.0, 15.0, 1.0, 0.0):
        found = law.compute(estimate, target, None, seconds, None)
        K = solve_riccati(linear.A, linear.B, weights.Q, weights.R, interval=seconds / 60.0).K
        u = linear.inputs.to_physical(target.u - K @ (estimate.x - target.x))
        np.testing.assert_allclose(found.u, u, rtol=1e-12)


@pytest.mark.parametrize('law', ['mpc', 'sdre', 'linear'])
def test_a_controller_that_has_run_can_be_pickled(law):
    model = shipped('reactor_nz4')
    loop = Controller(model, Tuning.for_model(model, fallback_order=[law]))
    state, _, _ = loop.step(State(), model.states.center, 1)
    again, kept = pickle.loads(pickle.dumps((loop, state)))
    hot = model.states.center + 2.0
    _, command, report = loop.step(state, hot, 10 ** 9)
    assert report.level == law
    assert again.step(kept, hot, 10 ** 9)[1] == command


def test_a_law_that_is_predicted_unstable_is_not_used():
    model = shipped('reactor_nz4')
    estimate = Estimate(np.array([-0.5]), np.zeros(1))
    law = LAWS['sdre'](model, Tuning.for_model(model, input_weight=[1e-9], max_gain=1e9), None)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(riccati, 'feedback', lambda *arguments, **how: feedback(
            *arguments, **how)._replace(loop=np.array([[-1.01]])))
        rejected = law.compute(estimate, setpoint_target(model), None, 1.0, None)
    assert rejected.failure.code is StatusCode.PREDICTED_UNSTABLE
    assert rejected.failure.values['interval'] == 1.0
