# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Steady states nearest to a goal within limits, against independent solvers and by hand."""

import numpy as np
import pytest
from scipy.optimize import brentq, lsq_linear, minimize

from koopman_ros.core.steady_state import (
    bounded_least_squares,
    Goal,
    steady_state,
    steady_states_near,
)


def linear(A, B, w, goal, places, lower, upper, start=None):
    """Return the steady state of x' = A x + B u + w nearest to a goal of some states."""
    n, m = B.shape
    J, endless = np.hstack([A, B]), np.full(n, np.inf)
    return steady_state(
        lambda y: J @ y + w, lambda y: J, np.zeros(n + m) if start is None else start,
        np.concatenate([-endless, lower]), np.concatenate([endless, upper]),
        Goal(np.array(places), goal))


@pytest.mark.parametrize(('n', 'm', 'controlled'), [
    (2, 2, 2), (3, 3, 3), (4, 4, 4), (3, 2, 3), (4, 1, 2), (2, 3, 2), (3, 5, 2), (1, 3, 1)])
def test_of_random_linear_plants_it_is_the_bounded_least_squares_solution(n, m, controlled):
    rng = np.random.default_rng(10 * n + m)
    for _ in range(40):
        A, B = rng.normal(size=(n, n)) - 3.0 * np.eye(n), rng.normal(size=(n, m))
        w, goal = rng.normal(size=n), 2.0 * rng.normal(size=controlled)
        lower, upper = -rng.uniform(0.2, 1.0, m), rng.uniform(0.2, 1.0, m)
        y = linear(A, B, w, goal, range(controlled), lower, upper)
        gain, rest = -np.linalg.solve(A, B)[:controlled], -np.linalg.solve(A, w)[:controlled]
        best = lsq_linear(gain, goal - rest, (lower, upper), method='bvls', tol=1e-14)
        np.testing.assert_allclose(A @ y[:n] + B @ y[n:] + w, 0.0, rtol=0, atol=1e-9)
        assert ((y[n:] >= lower) & (y[n:] <= upper)).all()
        # what is controlled is unique, also where the inputs are not
        np.testing.assert_allclose(y[:controlled], gain @ best.x + rest, rtol=0, atol=1e-7)


def test_inputs_to_spare_are_nearest_to_the_nominal_point():
    rng = np.random.default_rng(3)
    for _ in range(15):
        gain, value, upper = rng.normal(size=(1, 3)), rng.normal(size=1), rng.uniform(0.2, 1.0, 3)
        y = bounded_least_squares(((gain, value), (np.eye(3), np.zeros(3))), -upper, upper,
                                  np.zeros(3))
        reachable = np.sum(np.abs(gain) * upper)
        wanted = np.clip(value, -reachable, reachable)
        best = minimize(lambda u: u @ u, np.zeros(3), jac=lambda u: 2.0 * u, method='SLSQP',
                        bounds=list(zip(-upper, upper, strict=True)), tol=1e-14, constraints={
                            'type': 'eq', 'fun': lambda u, g=gain, r=wanted: g @ u - r,
                            'jac': lambda u, g=gain: g})
        np.testing.assert_allclose(y, best.x, rtol=0, atol=1e-6)


@pytest.mark.parametrize('curvature', [0.5, 2.0, 8.0])
@pytest.mark.parametrize('goal', [(0.5, -0.5), (0.5, -3.0), (2.0, -1.0), (-0.1, -0.3)])
def test_the_nearest_rest_to_a_goal_out_of_reach_is_exact_where_rests_lie_on_a_curve(
        curvature, goal):
    # y = c x^2 / 2 is at rest; a whole step along its tangent goes up to 25 times too far
    ends = np.full(2, 50.0)
    found = steady_state(
        lambda y: np.array([y[1] - 0.5 * curvature * y[0] ** 2]),
        lambda y: np.array([[-curvature * y[0], 1.0]]), np.array([1.0, 2.0]), -ends, ends,
        Goal(np.arange(2), np.array(goal)))
    # where the distance is stationary
    x = np.roots([0.5 * curvature ** 2, 0.0, 1.0 - curvature * goal[1], -goal[0]])
    x = x[np.abs(x.imag) < 1e-12].real
    rests = np.stack((x, 0.5 * curvature * x ** 2), axis=1)
    nearest = rests[np.argmin(np.linalg.norm(rests - goal, axis=1))]
    np.testing.assert_allclose(found, nearest, rtol=0, atol=1e-9)


def test_an_input_that_was_put_to_its_limit_is_released():
    # least squares without limits has both inputs beyond theirs, with them one is within
    gain, u = np.array([[-0.541, 1.147], [-0.088, -0.153]]), np.array([2.947, 2.568])
    y = linear(-np.eye(2), gain, np.zeros(2), gain @ u, [0, 1], -np.ones(2), np.ones(2))
    best = lsq_linear(gain, gain @ u, (-1.0, 1.0), method='bvls')
    assert -1.0 < best.x[0] < 1.0
    np.testing.assert_allclose(y[2:], best.x, rtol=0, atol=1e-9)


@pytest.mark.parametrize('w', [0.0, 0.4])
def test_a_plant_that_integrates_rests_where_its_inputs_balance_the_load(w):
    y = linear(np.zeros((1, 1)), np.array([[1.0, 1.0]]), np.array([w]), np.array([3.0]), [0],
               -np.ones(2), np.ones(2))
    np.testing.assert_allclose(y, [3.0, -0.5 * w, -0.5 * w], rtol=0, atol=1e-9)


def test_where_no_input_within_range_brings_a_plant_to_rest_nothing_is_found():
    assert linear(np.zeros((1, 1)), np.array([[1.0, 1.0]]), np.array([2.5]), np.array([3.0]), [0],
                  -np.ones(2), np.ones(2)) is None
    assert steady_state(lambda y: y * np.nan, lambda y: np.eye(1), np.ones(1), -np.ones(1),
                        np.ones(1)) is None


def tanks(flow, levels=2.0 * 9.81):
    """Return rate and slope of two tanks in series, x = levels and u = flows into both."""
    def rate(y):
        out = np.sqrt(levels * np.maximum(y[:2], 1e-9))
        return np.array([y[2] - flow * out[0], flow * out[0] + y[3] - flow * out[1]])

    def slope(y):
        out = 0.5 * flow * np.sqrt(levels / np.maximum(y[:2], 1e-9))
        return np.array([[-out[0], 0.0, 1.0, 0.0], [out[0], -out[1], 0.0, 1.0]])

    return rate, slope


def test_levels_of_two_tanks_within_the_range_of_their_pumps():
    rate, slope = tanks(0.1)
    rng = np.random.default_rng(1)
    lower, upper = np.array([1e-6, 1e-6, 0.0, 0.0]), np.array([9.0, 9.0, 0.5, 0.3])
    for _ in range(30):
        goal = rng.uniform(0.1, 6.0, 2)
        y = steady_state(rate, slope, np.array([1.0, 1.0, 0.4, 0.0]), lower, upper,
                         Goal(np.arange(2), goal))
        np.testing.assert_allclose(rate(y), 0.0, rtol=0, atol=1e-8)

        # Torricelli's law gives the levels of any flows
        def away(q, goal=goal):
            return float(np.sum((np.cumsum(q) ** 2 / (0.01 * 2.0 * 9.81) - goal) ** 2))

        best = min((minimize(away, start, bounds=[(0.0, 0.5), (0.0, 0.3)], method='L-BFGS-B',
                             options={'ftol': 1e-15, 'gtol': 1e-12})
                    for start in ([0.2, 0.1], [0.4, 0.2], [0.5, 0.0])), key=lambda one: one.fun)
        assert away(y[2:]) <= best.fun + 1e-6


def parabola(y):
    return np.array([y[2] - y[0], y[0] ** 2 - y[1]])


def bend(y):
    return np.array([[-1.0, 0.0, 1.0], [2.0 * y[0], -1.0, 0.0]])


@pytest.mark.parametrize('start', [1.0, -1.0, 0.05])
@pytest.mark.parametrize('wanted', [0.81, 4.0, 0.0, -0.5])
def test_the_branch_of_the_start_is_followed_and_a_fold_is_the_end_of_the_way(start, wanted):
    endless = np.full(3, np.inf)
    y = steady_state(parabola, bend, np.array([start, 1.0, start]), -endless, endless,
                     Goal(np.array([1]), np.array([wanted])))
    np.testing.assert_allclose(parabola(y), 0.0, rtol=0, atol=1e-9)
    if wanted > 0.0:
        np.testing.assert_allclose(y[:2], [np.sign(start) * np.sqrt(wanted), wanted], atol=1e-9)
    else:
        # y = x^2 is never below 0
        assert y[1] == pytest.approx(0.0, abs=1e-4)


def test_a_search_from_far_away_arrives():
    # x' = u - sinh(x) with the input held at sinh(30)
    held = np.sinh(30.0)
    y = steady_state(lambda y: y[1:] / held - np.sinh(y[:1]) / held,
                     lambda y: np.array([[-np.cosh(y[0]), 1.0]]) / held, np.array([25.0, held]),
                     np.array([-np.inf, held]), np.array([np.inf, held]))
    assert y[0] == pytest.approx(brentq(lambda x: np.sinh(x) - held, 20.0, 40.0), abs=1e-6)


def test_many_at_once_are_the_nearest_ones_of_linear_plants():
    rng = np.random.default_rng(5)
    J, w = rng.normal(size=(2, 5)), rng.normal(size=2)
    start, endless = rng.normal(size=(20, 5)), np.full(5, np.inf)
    found = steady_states_near(lambda y: y @ J.T + w, lambda y: np.tile(J, (len(y), 1, 1)), start,
                               longest=1e3)
    np.testing.assert_allclose(found, [steady_state(
        lambda y: J @ y + w, lambda y: J, one, -endless, endless, anchor=one) for one in start],
        rtol=0, atol=1e-9)


def test_of_many_those_that_find_no_rest_are_left_out():
    # x^2 = u with u given: nothing rests for u < 0, and the rate is no number below -2
    def rate(y):
        return np.where(y[:, 1:] < -2.0, np.nan, y[:, :1] ** 2 - y[:, 1:])

    def slope(y):
        return np.stack([2.0 * y[:, :1], 0.0 * y[:, :1]], axis=2)

    found = steady_states_near(rate, slope, np.array(
        [[1.0, 4.0], [1.0, -1.0], [0.0, -1.0], [1.0, -3.0], [-2.0, 9.0]]))
    np.testing.assert_allclose(found, [[2.0, 4.0], [-3.0, 9.0]], rtol=0, atol=1e-9)
