# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The Runge-Kutta step against its Taylor polynomial, its order and steps of no length."""

import numpy as np
import pytest

from koopman_ros.solvers import runge_kutta_step


def test_linear_decay_is_the_taylor_polynomial_of_fourth_degree():
    x, h = np.array([[2.0], [-1.0]]), np.array([[0.1], [0.3]])
    a = -1.5 * h
    expected = x * (1.0 + a + a ** 2 / 2.0 + a ** 3 / 6.0 + a ** 4 / 24.0)
    np.testing.assert_allclose(runge_kutta_step(lambda x: -1.5 * x, x, h), expected, rtol=1e-15)


def test_error_over_a_time_falls_with_the_fourth_power_of_the_step():
    def end(steps):
        x = np.array([0.5])
        for _ in range(steps):
            x = runge_kutta_step(np.square, x, 1.0 / steps)
        return x[0]

    # dx/dt = x^2 from 1/2 reaches 1 at 1
    assert (end(20) - 1.0) / (end(40) - 1.0) == pytest.approx(16.0, rel=0.1)


def test_a_step_of_no_length_stays():
    x = np.array([[1.0, 2.0], [3.0, 4.0]])
    h = np.array([[0.0], [0.1]])
    moved = runge_kutta_step(lambda x: -x, x, h)
    np.testing.assert_array_equal(moved[0], x[0])
    assert np.all(moved[1] < x[1])
