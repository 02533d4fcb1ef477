# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models, closed loops and exact solutions that the tests of the control laws share."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad, solve_ivp

from koopman_ros.control import Feedback, steady_state_target, Weights
from koopman_ros.lifting import Coordinates, LiftedModel, load, NetworkObservables, Provenance
from koopman_ros.plants import (
    ControlAffineSystem,
    equilibrium_input,
    one_state_reactor,
    two_state_exact_lift,
    two_state_example,
)

Array = NDArray[np.float64]
Law = Callable[..., Feedback]

REACTOR = one_state_reactor()
START = float(REACTOR.nominal_state[0])
SETPOINT = START - 10.0
COOLANT = float(equilibrium_input(REACTOR, [SETPOINT])[0])
# K, of temperature and of coolant: what the costs are measured in
UNIT = 10.0


def shipped(name: str) -> LiftedModel:
    return load(Path(__file__).parents[2] / 'config' / 'models' / f'{name}.safetensors')


def reactor_weights(model: LiftedModel, R: float) -> Weights:
    """Weigh squared deviations in units of 10 K by 1 and by R."""
    return Weights(np.diag(np.square(model.states.scale / UNIT)),
                   R * np.diag(np.square(model.inputs.scale / UNIT)))


def run_reactor(model: LiftedModel, law: Law, R: float, minutes: float) -> tuple[float, float]:
    """Drive the true reactor to the set-point; return its cost and its last temperature."""
    weights = reactor_weights(model, R)
    target = steady_state_target(model, model.states.to_deviation(np.array([SETPOINT])))

    def rate(_: float, y: Array) -> list[float]:
        found = law(model, model.states.to_deviation(y[:1]), target, weights)
        assert found.solved
        u = model.inputs.to_physical(found.u)
        e, v = (y[0] - SETPOINT) / UNIT, (u[0] - COOLANT) / UNIT
        return [REACTOR.derivative(y[:1], u)[0], e * e + R * v * v]

    end = solve_ivp(rate, (0.0, minutes), [START, 0.0], method='DOP853', rtol=1e-10,
                    atol=1e-12).y[:, -1]
    return float(end[1]), float(end[0])


def optimal_slope(e: float, R: float) -> float:
    """
    Evaluate dV/de, V the optimal cost of the reactor at e above the set-point, in units of 10 K.

    With e' = F(e) + b v the Hamilton-Jacobi equation e^2 + V' F - (b V')^2 / (4 R) = 0 of a
    scalar plant is quadratic in V'; the root with the sign of e is the one that decays.
    """
    b = REACTOR.B[0, 0]
    F = REACTOR.derivative([SETPOINT + UNIT * e], [COOLANT])[0] / UNIT
    return 2.0 * R / b ** 2 * (F + np.copysign(np.sqrt(F * F + (b * e) ** 2 / R), e))


def optimal_cost(R: float) -> float:
    """Integrate the slope of the optimal cost from the set-point to the start."""
    return float(quad(optimal_slope, 0.0, (START - SETPOINT) / UNIT, args=(R,), epsabs=1e-13,
                      epsrel=1e-13)[0])


def two_state_model() -> LiftedModel:
    """
    Return the paper's exact lift (x1, x2, x1^2) of its two-state example to about 1e-9.

    x1^2 is the second difference of tanh about 0.66, with weights of sixth order, over a step
    that is small enough for the truncation and large enough for the rounding.
    """
    system, step = two_state_example(), 3e-3
    k = np.array([1.0, 2.0, 3.0])
    # sum of w (tanh(c + k h x) + tanh(c - k h x)) = h^2 x^2 tanh''(c) + O(h^8)
    w = np.linalg.solve(np.stack([k ** 2, k ** 4, k ** 6]), [1.0, 0.0, 0.0])
    t = np.tanh(0.66)
    curvature = -2.0 * t * (1.0 - t * t)
    W = np.zeros((6, 2))
    W[:, 0] = step * np.concatenate([k, -k])
    output = np.concatenate([w, w])[None, :] / (curvature * step ** 2)
    return LiftedModel(
        NetworkObservables(((W, np.full(6, 0.66)),), output, identity=True),
        two_state_exact_lift().A, system.B,
        Coordinates(('x1', 'x2'), ('1', '1'), np.zeros(2), np.ones(2), np.array([-6.0, -6.0]),
                    np.array([6.0, 8.0])),
        Coordinates(('u',), ('1/s',), np.zeros(1), np.ones(1), np.array([-50.0]),
                    np.array([50.0])),
        's', Provenance(system.name))


def run_two_state(system: ControlAffineSystem, model: LiftedModel, law: Law, R: float, x0: Array,
                  seconds: float) -> tuple[float, Array]:
    """Drive a plant in unit coordinates to the origin; return its cost and its last state."""
    weights = Weights(np.eye(2), R * np.eye(1))
    target = steady_state_target(model, np.zeros(2))

    def rate(_: float, y: Array) -> list[float]:
        found = law(model, y[:2], target, weights)
        assert found.solved
        return [*system.derivative(y[:2], found.u), y[:2] @ y[:2] + R * found.u @ found.u]

    end = solve_ivp(rate, (0.0, seconds), [*x0, 0.0], method='DOP853', rtol=1e-8,
                    atol=1e-8).y[:, -1]
    return float(end[2]), end[:2]
