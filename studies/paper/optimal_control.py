# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Exact results for the controlled plants, as references for learned controllers."""

import numpy as np
from scipy.integrate import quad
from scipy.linalg import solve_continuous_lyapunov

from koopman_ros.core.arrays import Array
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.model import Coordinates, LiftedModel, PolynomialObservables, Provenance
from koopman_ros.plants import ControlAffineSystem, equilibrium_input

_Q = np.diag([1.0, 1.0, 0.0])
_B = np.array([[0.0], [1.0], [0.0]])


def exact_two_state_model(mu: float = -0.1, lambda_: float = 1.0) -> LiftedModel:
    """
    Return the lift z = (x1, x2, x1^2) of the paper's two-state example (eq. 33 and 34), unscaled.

    J(x) B = (0, 1, 0) at every state, so the lifted system is linear in state and input.
    """
    A = np.array([[mu, 0.0, 0.0], [0.0, lambda_, -lambda_], [0.0, 0.0, 2.0 * mu]])
    return LiftedModel(
        PolynomialObservables(np.array([[1, 0], [0, 1], [2, 0]])), A, _B[:2],
        Coordinates(('x1', 'x2'), ('1', '1'), np.zeros(2), np.ones(2), np.array([-6.0, -6.0]),
                    np.array([6.0, 8.0])),
        Coordinates(('u',), ('1/s',), np.zeros(1), np.ones(1), np.array([-50.0]),
                    np.array([50.0])),
        's', Provenance('two-state example'), readout=A[:2])


def exact_two_state_gain(R: float) -> Array:
    """Return the gain K (1, 3) on (x1, x2, x1^2) that is optimal for x1^2 + x2^2 + R u^2."""
    return solve_riccati(exact_two_state_model().A, _B, _Q, np.array([[R]])).K


def exact_two_state_cost(x0: Array, R: float) -> float:
    """
    Return the optimal cost of the paper's two-state example from `x0` to the origin.

    The exact lift makes it a linear-quadratic problem; its cost z' P z comes from the Lyapunov
    equation of the closed loop.
    """
    K = exact_two_state_gain(R)
    closed = exact_two_state_model().A - _B @ K
    P = solve_continuous_lyapunov(closed.T, -(_Q + R * K.T @ K))
    z = np.array([x0[0], x0[1], x0[0] ** 2])
    return float(z @ P @ z)


def scalar_optimal_cost(system: ControlAffineSystem, start: float, setpoint: float, R: float,
                        unit: float) -> float:
    """
    Return the optimal cost of moving a plant of one state and one input to a set-point.

    With e and v the deviations from the set-point and from the input that holds it, in `unit`s
    of state and input, R the weight of v^2 against e^2 and e' = F(e) + b v, the Hamilton-Jacobi
    equation e^2 + V' F - (b V')^2 / (4 R) = 0 is quadratic in V'; the root with the sign of e is
    the one whose closed loop decays.
    """
    b = float(system.input_matrix(system.nominal_state)[0, 0])
    held = equilibrium_input(system, [setpoint])

    def slope(e: float) -> float:
        F = float(system.derivative([setpoint + unit * e], held)[0]) / unit
        return 2.0 * R / b ** 2 * (F + float(np.copysign(np.sqrt(F * F + (b * e) ** 2 / R), e)))

    return float(quad(slope, 0.0, (start - setpoint) / unit, epsabs=1e-13, epsrel=1e-13)[0])
