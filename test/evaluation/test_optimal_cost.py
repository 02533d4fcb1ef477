# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The least cost, against analytic optima."""

from dataclasses import replace

import daqp
import numpy as np
import pytest
from scipy import sparse
from scipy.linalg import expm, solve_continuous_are, solve_discrete_are
from scipy.optimize import linprog

from koopman_ros.evaluation.optimal_cost import cost_along, linear_law, optimum, Task
from koopman_ros.plants import ControlAffineSystem, plant_class, two_state_example
from koopman_ros.tuning import InputLimits

A = np.array([[0.5, 1.0, 0.0], [-1.0, 0.2, 0.3], [0.0, 0.4, -0.8]])
B = np.array([[0.0, 0.2], [1.0, 0.0], [0.0, 0.7]])
LINEAR = ControlAffineSystem(
    name='linear', state_names=('a', 'b', 'c'), state_units=('1',) * 3, input_names=('u', 'v'),
    input_units=('1',) * 2, time_unit='s', drift=lambda x: x @ A.T,
    drift_jacobian=lambda x: np.broadcast_to(A, (*x.shape, 3)), B=B, nominal_state=np.zeros(3),
    nominal_input=np.zeros(2))
# held at x_ref by u_ref = 0, so that the way there is that of the error to the origin
TASK = Task(LINEAR, np.array([1.0, -2.0, 0.5]), np.zeros(3), np.zeros(2),
            np.array([1.0, 0.5, 2.0]), np.array([0.7, 0.3]), 0.2, 200, substeps=20)


def sampled(task):
    """Return transition (n, n + m) and weight (n + m, n + m) of a sample (Van Loan, 1978)."""
    n, m = B.shape
    F = np.zeros((n + m, n + m))
    F[:n, :n], F[:n, n:] = A, B
    weight = np.diag(np.concatenate([task.Q, task.R]))
    block = np.block([[-F.T, weight], [np.zeros_like(F), F]])
    exponential = expm(task.period * block)
    step = exponential[n + m:, n + m:]
    return step[:n], step.T @ exponential[:n + m, n + m:]


def sampled_optimal_cost(task):
    """Return x0' P x0 of the discrete Riccati equation of the sampled cost."""
    n = len(A)
    step, W = sampled(task)
    P = solve_discrete_are(step[:, :n], step[:, n:], W[:n, :n], W[n:, n:], s=W[:n, n:])
    return float(task.x0 @ P @ task.x0)


def test_optimum_of_a_linear_plant_that_is_unstable_is_that_of_its_riccati_equation():
    assert np.max(np.linalg.eigvals(A).real) > 0.0
    best = optimum(TASK)
    assert best.cost == pytest.approx(sampled_optimal_cost(TASK), rel=1e-7)
    assert cost_along(TASK, best.states, best.inputs) == pytest.approx(best.cost, rel=1e-12)
    np.testing.assert_allclose(best.states[-1], 0.0, atol=1e-6)
    # no other input does better
    assert linear_law(TASK).cost > best.cost
    # what is measured from a set-point is the same, wherever that is
    x_ref = np.array([3.0, -1.0, 2.0])
    moved = replace(LINEAR, drift=lambda x: (x - x_ref) @ A.T, nominal_state=x_ref)
    shifted = replace(TASK, system=moved, x0=TASK.x0 + x_ref, x_ref=x_ref)
    assert optimum(shifted).cost == pytest.approx(best.cost, rel=1e-8)


def test_the_linear_law_has_the_cost_of_its_riccati_solution_when_sampled_fast():
    P = solve_continuous_are(A, B, np.diag(TASK.Q), np.diag(TASK.R))
    fast = replace(TASK, period=0.01, samples=3000, substeps=1)
    assert linear_law(fast).cost == pytest.approx(TASK.x0 @ P @ TASK.x0, rel=1e-3)


def test_optimum_and_linear_law_of_the_two_state_example():
    # 990.1798 is the cost of the exact lift's regulator for x1^2 + x2^2 + u^2 in continuous time,
    # and the linear one's is 4.54 times that when sampled every 10 ms
    task = Task(two_state_example(), np.array([5.0, 5.0]), np.zeros(2), np.zeros(1),
                np.ones(2), np.ones(1), 0.05, 1600)
    best = optimum(task)
    assert 990.1798 < best.cost < 990.1798 * 1.0001
    assert 4.4 < linear_law(task).cost / best.cost < 4.7


def test_linear_law_misses_a_set_point_by_its_feed_forward():
    system = plant_class('two_tanks')().system()
    task = Task(system, system.nominal_state, np.array([0.10, 0.15]), np.array([7.5596, 1.6989]),
                np.full(2, 1e4), np.ones(2), 1.0, 120)
    miss = np.abs(linear_law(task).states[-1] - task.x_ref)
    assert 1e-4 < np.max(miss) < 1e-2
    np.testing.assert_allclose(optimum(task).states[60], task.x_ref, atol=1e-5)


def test_a_plant_that_no_law_holds_is_named():
    runaway = replace(LINEAR, drift=lambda x: x @ A.T + x ** 3, drift_jacobian=None,
                      B=np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r'law does not stabilise .* a = 1, b = -2'):
        optimum(replace(TASK, system=runaway))
    assert linear_law(replace(TASK, system=runaway)).cost == np.inf


def test_the_linear_law_keeps_range_and_rate_from_the_input_before():
    limits = InputLimits(lower=[-0.6, -1.0], upper=[0.9, 1.0], rate=[0.5, np.inf])
    before, free = np.array([0.2, 0.0]), linear_law(TASK)
    limited = linear_law(TASK, limits, before)
    assert np.all(limited.inputs >= limits.lower)
    assert np.all(limited.inputs <= limits.upper)
    changes = np.abs(np.diff(np.vstack([before, limited.inputs])[:, 0]))
    assert np.max(changes) == pytest.approx(0.5 * TASK.period)
    assert limited.cost > free.cost


LIMITS = InputLimits(lower=[-0.9, -0.3], upper=[0.9, 0.6], rate=[2.0, 0.7])


def inequalities(task, limits, before):
    """Return C (4 N m, N m) and d with C u <= d where inputs u (N m,) keep the limits."""
    m, N = len(before), task.samples
    one = sparse.eye_array(N * m)
    changes = one - sparse.eye_array(N * m, k=-m)
    last = np.concatenate([before, np.zeros((N - 1) * m)])
    lower, upper, rate = (np.tile(values, N) for values in (
        limits.lower, limits.upper, limits.rate * task.period * (
            task.system.seconds_per_time_unit)))
    return (sparse.vstack([one, -one, changes, -changes]),
            np.concatenate([upper, -lower, rate + last, rate - last]))


def test_within_limits_it_is_the_quadratic_program_of_a_linear_plant():
    task, before = replace(TASK, samples=60), np.array([0.2, 0.0])
    (n, m), N = B.shape, task.samples
    step, W = sampled(task)
    # states and inputs (N, n + m) by the inputs, and where these are 0
    by_inputs, alone = np.zeros((N, n + m, N * m)), np.zeros((N, n + m))
    alone[0, :n] = task.x0
    for k in range(N):
        by_inputs[k, n:, k * m:(k + 1) * m] = np.eye(m)
        if k + 1 < N:
            by_inputs[k + 1, :n] = step @ by_inputs[k]
            alone[k + 1, :n] = step @ alone[k]
    C, d = inequalities(task, LIMITS, before)
    u, cost, flag, _ = daqp.solve(
        2.0 * np.einsum('kip,ij,kjq->pq', by_inputs, W, by_inputs),
        2.0 * np.einsum('kip,ij,kj->p', by_inputs, W, alone), C.toarray(), d,
        np.full(len(d), -1e30), np.zeros(len(d), np.int32))
    assert flag == 1
    best = optimum(task, LIMITS, before)
    assert best.cost == pytest.approx(
        cost + np.einsum('ki,ij,kj->', alone, W, alone), rel=1e-7)
    np.testing.assert_allclose(best.inputs, u.reshape(N, m), atol=1e-4)
    assert np.all(C @ best.inputs.ravel() <= d + 1e-9)
    # both inputs are at their limits, of range and rate
    active = np.abs(C @ u - d).reshape(4, N, m) < 1e-6
    assert active[:2].any(axis=(0, 1)).all()
    assert active[2:].any(axis=(0, 1)).all()
    assert 1.001 * optimum(task).cost < best.cost < linear_law(task, LIMITS, before).cost


def test_limits_that_are_not_reached_change_nothing():
    wide = InputLimits(lower=-50.0, upper=50.0, rate=[1e3, 0.0])
    free, best = optimum(TASK), optimum(TASK, wide)
    assert best.cost == pytest.approx(free.cost, rel=1e-12)
    np.testing.assert_allclose(best.inputs, free.inputs, rtol=0, atol=1e-6)


def costs(task, inputs):
    """Return the costs (M,) of inputs (M, N, m), by steps half as long."""
    x, cost = np.tile(task.x0, (len(inputs), 1)), np.zeros(len(inputs))
    h = task.period / (2 * task.substeps)

    def rate(x, u):
        return task.system.derivative(x, u), (x - task.x_ref) ** 2 @ task.Q + (
            u - task.u_ref) ** 2 @ task.R

    for u in np.repeat(inputs.swapaxes(0, 1), 2 * task.substeps, axis=0):
        k1, c1 = rate(x, u)
        k2, c2 = rate(x + 0.5 * h * k1, u)
        k3, c3 = rate(x + 0.5 * h * k2, u)
        k4, c4 = rate(x + h * k3, u)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        cost += h / 6.0 * (c1 + 2.0 * c2 + 2.0 * c3 + c4)
    return cost


def test_within_limits_no_input_that_keeps_them_costs_less_on_a_nonlinear_plant():
    system = plant_class('two_tanks')().system()
    task = Task(system, system.nominal_state, np.array([0.10, 0.15]), np.array([7.5596, 1.6989]),
                np.full(2, 1e4), np.ones(2), 2.0, 40)
    limits = InputLimits(lower=[2.0, 2.0], upper=[9.0, 5.0], rate=[0.8, 0.6])
    before = np.clip(system.nominal_input, limits.lower, limits.upper)
    best = optimum(task, limits, before)
    assert costs(task, best.inputs[None])[0] == pytest.approx(best.cost, rel=1e-7)
    C, d = inequalities(task, limits, before)
    room = d - C @ best.inputs.ravel()
    assert np.min(room) > -1e-9
    assert (np.abs(room).reshape(4, -1) < 1e-6).any(axis=1).sum() >= 3
    # the first-order condition: along no direction to another such input does the cost fall
    around = best.inputs + 1e-4 * np.concatenate([np.eye(80), -np.eye(80)]).reshape(160, 40, 2)
    up, down = np.split(costs(task, around), 2)
    gradient = (up - down) / 2e-4
    least = linprog(gradient, C, d, bounds=(None, None))
    assert gradient @ (least.x - best.inputs.ravel()) > -1e-5 * best.cost
    # nor is a random one of them better, near or far
    others = limited(np.random.default_rng(0), 400, limits, before, task)
    for share in (1.0, 0.1, 0.01):
        assert np.min(costs(task, best.inputs + share * (others - best.inputs))) >= best.cost


def limited(rng, count, limits, before, task):
    """Return random inputs (count, N, m) that keep the limits."""
    found, last = [], np.tile(before, (count, 1))
    for _ in range(task.samples):
        change = limits.rate * task.period * rng.uniform(-1.0, 1.0, last.shape)
        last = np.clip(last + change, limits.lower, limits.upper)
        found.append(last)
    return np.stack(found, axis=1)
