# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The least cost, against analytic optima."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_are, solve_discrete_are

from koopman_ros.evaluation.optimal_cost import cost_along, keeps, linear_law, optimum, Task
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


def sampled_optimal_cost(task):
    """Return x0' P x0 of the discrete Riccati equation of the sampled cost (Van Loan, 1978)."""
    n, m = B.shape
    F = np.zeros((n + m, n + m))
    F[:n, :n], F[:n, n:] = A, B
    weight = np.diag(np.concatenate([task.Q, task.R]))
    block = np.block([[-F.T, weight], [np.zeros_like(F), F]])
    exponential = expm(task.period * block)
    step = exponential[n + m:, n + m:]
    W = step.T @ exponential[:n + m, n + m:]
    P = solve_discrete_are(step[:n, :n], step[:n, n:], W[:n, :n], W[n:, n:], s=W[:n, n:])
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
    assert keeps(TASK, limited, limits, before)
    assert not keeps(TASK, free, limits, before)
    assert limited.cost > free.cost
