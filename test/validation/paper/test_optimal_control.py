# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Optima that learned controllers are measured by, against closed forms and simulation."""

import numpy as np
import pytest

from koopman_ros.plants import ControlAffineSystem, one_state_reactor
from validation.paper import reactor, two_state
from validation.paper.optimal_control import (
    exact_two_state_cost,
    exact_two_state_gain,
    scalar_optimal_cost,
)


# K on (x1, x2, x1^2) and cost from (5, 5), from an independent Riccati solver
@pytest.mark.parametrize(('R', 'gain', 'cost'), [
    (1.0, [0.0, 2.41421356, -1.49559737], 990.1798),
    (0.1, [0.0, 4.31662479, -1.22749086], 253.2680),
    (0.001, [0.0, 32.6385840, -1.02512675], 127.1212)])
def test_two_state_optimum(R, gain, cost):
    np.testing.assert_allclose(exact_two_state_gain(R)[0], gain, rtol=1e-8, atol=1e-8)
    assert exact_two_state_cost(np.array([5.0, 5.0]), R) == pytest.approx(cost, abs=5e-5)


def test_the_exact_path_costs_what_the_riccati_equation_says():
    loop = two_state.exact_loop(1.0)
    rate = np.sum(loop.states ** 2, axis=1) + loop.inputs[:, 0] ** 2
    assert np.trapezoid(rate, loop.times) == pytest.approx(loop.cost, rel=1e-3)
    assert np.linalg.norm(loop.states[-1]) < 0.002


def linear_plant(a, b):
    return ControlAffineSystem(
        name='linear', state_names=('x',), state_units=('K',), input_names=('u',),
        input_units=('K',), time_unit='min', drift=lambda x: a * x,
        drift_jacobian=lambda x: np.full((*x.shape, 1), a), B=np.array([[b]]),
        nominal_state=np.zeros(1), nominal_input=np.zeros(1))


@pytest.mark.parametrize('a', [-1.5, 0.5])
@pytest.mark.parametrize('R', [1.0, 0.1])
def test_scalar_optimum_of_a_linear_plant(a, R):
    """P of the scalar Riccati equation 2 a P - P^2 b^2 / R + 1 = 0, for deviations from x_ref."""
    b, unit = 2.0, 10.0
    P = R / b ** 2 * (a + np.sqrt(a * a + b * b / R))
    cost = scalar_optimal_cost(linear_plant(a, b), 7.0, 2.0, R, unit)
    assert cost == pytest.approx(P * (5.0 / unit) ** 2, rel=1e-9)


def test_no_gain_does_better_than_the_optimum_on_the_reactor():
    """Constant gains with the true feed-forward come near the optimum and never below it."""
    system = one_state_reactor()
    optimum = scalar_optimal_cost(system, reactor.START, reactor.SETPOINT, 1.0, reactor.UNIT)
    costs = [_proportional(system, gain) for gain in (0.2, 0.4, 0.6, 0.8)]
    assert min(costs) > optimum
    assert min(costs) < 1.1 * optimum


def _proportional(system, gain):
    held = reactor.equilibrium_input(system, [reactor.SETPOINT])[0]

    def rate(_, y):
        e = (y[0] - reactor.SETPOINT) / reactor.UNIT
        u = held - gain * e * reactor.UNIT
        return [system.derivative(y[:1], [u])[0], e * e + (gain * e) ** 2]

    return reactor.solve_ivp(rate, (0.0, 30.0), [reactor.START, 0.0], rtol=1e-9,
                             atol=1e-9).y[1, -1]
