# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models, closed loops and exact solutions that the tests of the control laws share."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import root

from koopman_ros.control import Feedback, run_closed_loop, Weights
from koopman_ros.lifting import LiftedModel, load
from koopman_ros.plants import ControlAffineSystem, equilibrium_input, one_state_reactor

Law = Callable[..., Feedback]

REACTOR = one_state_reactor()
START = float(REACTOR.nominal_state[0])
SETPOINT = START - 10.0
COOLANT = float(equilibrium_input(REACTOR, [SETPOINT])[0])
# K, of temperature and of coolant: what the costs are measured in
UNIT = 10.0


def shipped(name: str) -> LiftedModel:
    return load(Path(__file__).parents[2] / 'config' / 'models' / f'{name}.safetensors')


def steady_state(system: ControlAffineSystem, u: list[float], guess: list[float]) -> np.ndarray:
    """Return the steady state that a constant input has near a guess."""
    found = root(lambda x: system.derivative(x, u), guess, jac=system.drift_jacobian, tol=1e-13)
    assert found.success
    return found.x


def reactor_weights(model: LiftedModel, R: float) -> Weights:
    """Weigh squared deviations in units of 10 K by 1 and by R."""
    return Weights(np.diag(np.square(model.states.scale / UNIT)),
                   R * np.diag(np.square(model.inputs.scale / UNIT)))


def run_reactor(model: LiftedModel, law: Law, R: float, minutes: float) -> tuple[float, float]:
    """Drive the true reactor to the set-point; return its cost and its last temperature."""
    run = run_closed_loop(
        model, REACTOR.derivative, np.array([START]), np.array([SETPOINT]),
        reactor_weights(model, R), minutes, law=law, samples=2, rtol=1e-10,
        u_ref=np.array([COOLANT]))
    assert not run.failure
    return run.cost, float(run.states[-1, 0])
