# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

import math

import numpy as np
import pytest
from scipy.linalg import expm

from koopman_ros.core.integration import (
    adaptive,
    fastest_rate,
    integrate,
    runge_kutta_step,
    sensitivity_rate,
    StepRule,
    STEPS,
)


def test_linear_decay_is_the_taylor_polynomial_of_fourth_degree():
    x, h = np.array([[2.0], [-1.0]]), np.array([[0.1], [0.3]])
    a = -1.5 * h
    expected = x * (1.0 + a + a ** 2 / 2.0 + a ** 3 / 6.0 + a ** 4 / 24.0)
    np.testing.assert_allclose(runge_kutta_step(lambda x: -1.5 * x, x, h), expected, rtol=1e-15)


def test_error_over_a_time_falls_with_the_fourth_power_of_the_step():
    # dx/dt = x^2 from 1/2 reaches 1 at 1
    coarse, fine = (integrate(np.square, np.array([0.5]), 1.0, steps)[0] - 1.0
                    for steps in (20, 40))
    assert coarse / fine == pytest.approx(16.0, rel=0.1)


@pytest.mark.parametrize('n', [1, 2, 3, 5])
def test_the_fastest_rate_is_that_of_the_eigenvalues_or_a_little_more(n):
    rng = np.random.default_rng(n)
    for _ in range(50):
        # with modes of different rates, from a thousandth to a thousand
        A = 10.0 ** rng.uniform(-3.0, 3.0) * rng.normal(size=(n, n))
        largest = np.max(np.abs(np.linalg.eigvals(A)))
        assert largest * (1.0 - 1e-12) <= fastest_rate(A) <= 1.6 * largest


@pytest.mark.parametrize('size', [1e-200, 1.0, 1e100])
def test_the_fastest_rate_neither_overflows_nor_vanishes(size):
    assert fastest_rate(np.diag([size, 0.5 * size])) == pytest.approx(size, rel=1e-3)
    assert fastest_rate(np.zeros((2, 2))) == 0.0
    assert math.isnan(fastest_rate(np.array([[math.nan, 0.0], [0.0, 1.0]])))
    assert fastest_rate(np.array([[math.inf, 0.0], [0.0, 1.0]])) == math.inf


def test_steps_follow_the_fastest_mode_and_are_bounded():
    rule = StepRule(time_constants=0.5, most=10)
    assert [rule.count(duration, 2.0) for duration in (0.0, 0.25, 0.2500001, 1.0, 2.5)] == [
        1, 1, 2, 4, 10]
    # an interval of a whole number of steps takes as many however it is rounded
    assert rule.count(0.1 * 3.0, 5.0) == rule.count(0.3, 5.0) == 3
    for fastest in (4.1, math.inf, math.nan):
        assert rule.count(2.5, fastest) is None


@pytest.mark.parametrize('rate', [-3.0, 0.7])
def test_the_rule_keeps_the_error_of_a_mode_below_a_thousandth(rate):
    steps = STEPS.count(2.0, abs(rate))
    end = integrate(lambda x: rate * x, np.array([1.0]), 2.0, steps)[0]
    # relative to the largest value on the way
    assert abs(end - math.exp(2.0 * rate)) < 1e-3 * max(1.0, math.exp(2.0 * rate))


def test_sensitivities_are_those_of_the_matrix_exponential():
    A, B = np.array([[-1.0, 2.0], [0.5, -3.0]]), np.array([[0.0], [1.0]])
    x, u, h = np.array([0.3, -0.4]), np.array([0.2]), 0.8
    whole = integrate(
        sensitivity_rate(lambda x: (A @ x + B @ u, A), np.hstack((np.zeros((2, 2)), B))),
        np.hstack((x[:, None], np.eye(2), np.zeros((2, 1)))), h, 200)
    over = expm(h * np.block([[A, B], [np.zeros((1, 3))]]))[:2]
    np.testing.assert_allclose(whole[:, 0], over @ np.append(x, u), atol=1e-9)
    np.testing.assert_allclose(whole[:, 1:], over, atol=1e-9)


def test_the_adaptive_reference_is_exact_and_says_where_it_ended():
    def square(_, x):
        return x ** 2

    options = {'rtol': 1e-11, 'atol': 1e-12, 'most': 1000}
    end, arrived = adaptive(square, np.array([0.5]), 1.0, **options)
    assert arrived
    assert end.y[0] == pytest.approx(1.0, abs=1e-10)
    assert adaptive(square, np.array([0.5]), 0.0, **options)[1]
    # infinite at 2
    with np.errstate(all='ignore'):
        end, arrived = adaptive(square, np.array([0.5]), 3.0, **options)
    assert not arrived
    assert end.t < 2.001
    end, arrived = adaptive(square, np.array([0.5]), 1.9, **options | {'most': 3})
    assert not arrived
    assert end.t < 1.9
    end, arrived = adaptive(square, np.array([0.5]), 1.9, **options,
                            inside=lambda x: bool(x[0] < 2.0))
    assert not arrived
    assert end.y[0] >= 2.0
