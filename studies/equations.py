# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plants of the library as expressions of casadi, for the programs that are compared with."""

from collections.abc import Callable
from typing import Any, TypeAlias

import casadi

from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.plants.library.pendulum import Pendulum
from koopman_ros.plants.library.quadruple_tank import QuadrupleTank
from koopman_ros.plants.library.reactor import FedReactor, ReactorParameters, TwoStateReactor
from koopman_ros.plants.library.tanks import GRAVITY

# Rates of the state (n_x,) from state and input (n_u,), expressions all.
Rates: TypeAlias = Callable[[Any, Any], Any]
_NO_LESS = 1e-6  # m, so that the outflow has a slope


def pendulum(x: Any, u: Any) -> Any:
    """Return the rates of the pendulum."""
    p = Pendulum()
    inertia = p.mass * p.length ** 2
    return casadi.vertcat(x[1], p.gravity / p.length * casadi.sin(x[0]) + (
        u[0] - p.friction * x[1]) / inertia)


def quadruple_tank(x: Any, u: Any) -> Any:
    """Return the rates of the four levels, in m/s."""
    p = QuadrupleTank()
    q = [orifice * casadi.sqrt(2.0 * GRAVITY * casadi.fmax(x[i], _NO_LESS))
         for i, orifice in enumerate((p.orifice_1, p.orifice_2, p.orifice_3, p.orifice_4))]
    flow_1, flow_2 = p.pump_gain_1 * u[0], p.pump_gain_2 * u[1]
    return casadi.vertcat(
        (q[2] - q[0] + p.split_1 * flow_1) / p.tank_area_1,
        (q[3] - q[1] + p.split_2 * flow_2) / p.tank_area_2,
        ((1.0 - p.split_2) * flow_2 - q[2]) / p.tank_area_3,
        ((1.0 - p.split_1) * flow_1 - q[3]) / p.tank_area_4)


def fed_reactor(x: Any, u: Any) -> Any:
    """Return the rates of concentration and temperature, per minute, from feed and coolant."""
    p = FedReactor()
    return _reactor(p, x, u[0], u[1])


def two_state(x: Any, u: Any) -> Any:
    """Return the rates of the two-state reactor, per minute."""
    p = TwoStateReactor()
    return _reactor(p, x, p.flow_rate, u[0])


def reactor(x: Any, u: Any) -> Any:
    """Return the rate of the temperature of the one-state reactor, per minute."""
    p = ReactorParameters()
    return _reactor(p, casadi.vertcat(p.concentration, x), p.flow_rate, u[0])[1]


def with_cost(rates: Rates, Q: Array, R: Array, goal: tuple[Any, Any]
              ) -> Callable[[Any, Any, float], Any]:
    """
    Return a Runge-Kutta step of a state and its cost so far (n_x + 1,), by input and length.

    :param Q: (n_x,) weights of squared distances from the state of the goal.
    :param R: (n_u,) the same of its input.
    """
    def step(y: Any, u: Any, length: float) -> Any:
        def rate(y: Any) -> Any:
            e, v = y[:-1] - goal[0], u - goal[1]
            return casadi.vertcat(rates(y[:-1], u), casadi.dot(Q * e, e) + casadi.dot(R * v, v))

        return runge_kutta_step(rate, y, length)

    return step


def _reactor(p: ReactorParameters, x: Any, flow: Any, coolant: Any) -> Any:
    reaction = p.pre_exponential_factor * casadi.exp(-p.activation_temperature / x[1]) * x[0]
    fed = flow / p.volume
    return casadi.vertcat(
        fed * (p.feed_concentration - x[0]) - reaction,
        fed * (p.feed_temperature - x[1]) + p.heating_per_conversion * reaction
        + p.cooling_rate * (coolant - x[1]))


EQUATIONS: dict[str, Rates] = {
    'fed_reactor': fed_reactor, 'pendulum': pendulum, 'quadruple_tank': quadruple_tank,
    'reactor': reactor, 'two_state': two_state}
