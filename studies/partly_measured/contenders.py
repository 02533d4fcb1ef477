# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controllers of this package, and a plain LQG, on a case."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from koopman_ros.control import Controller, State
from koopman_ros.core.arrays import Array
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.evaluation.loop import after_a_second
from koopman_ros.model import LiftedModel
from studies.partly_measured.cases import PartialCase

MARGIN = 0.3  # half-ranges of the training box by which the laws may leave that
_ENDLESS = 1e9  # bound on a gain in physical units, whatever these are


class Contender(Protocol):
    """A controller that answers the measurements of a case."""

    def step(self, y: Array, setpoint: Array) -> Array:
        """Return the input (n_u,) for outputs (n_y,) of the next sample, and a set-point."""


class Own:
    """A controller of this package with the extended Kalman filter."""

    def __init__(self, case: PartialCase, model: LiftedModel, laws: tuple[str, ...]) -> None:
        self._controller = Controller(model, case.tuning(
            model, fallback_order=laws, learned_model_margin=MARGIN,
            linear_model_margin=MARGIN), case.outputs)
        self._state = self._controller.initialise(State(), case.start[1])
        self._period_ns, self._number = round(case.period * NANOSECONDS), 0
        self._setpoint: Array | None = None

    def step(self, y: Array, setpoint: Array) -> Array:
        """Return the input (n_u,) for outputs (n_y,) of the next sample, and a set-point."""
        if self._setpoint is None or (setpoint != self._setpoint).any():
            self._setpoint = setpoint
            self._state, rejected = self._controller.request_setpoint(self._state, setpoint)
            if rejected is not None:
                raise ValueError(f'the set-point {setpoint.tolist()} is rejected: {rejected}')
        self._state, command, _ = self._controller.step(
            self._state, y, after_a_second(self._number * self._period_ns))
        self._number += 1
        return command


class LinearQuadraticGaussian:
    """
    A plain LQG: linearised once, a steady Kalman filter without disturbances, limits by clipping.

    See K. J. Astrom, B. Wittenmark, *Computer-Controlled Systems* (1997), chapter 11.
    """

    def __init__(self, case: PartialCase, x: Array, u: Array) -> None:
        """Linearise at a steady state (n_x,) and its input (n_u,)."""
        import control
        system, outputs = case.system, case.outputs
        A, B, C = system.slope(x, u), system.input_matrix(x), outputs.C
        interval = case.period / system.seconds_per_time_unit
        plant = control.ss(A, B, C, np.zeros((len(C), system.n_u))).sample(interval)
        self._A, self._B, self._C = plant.A, plant.B, plant.C
        self._K = solve_riccati(A, B, np.diag(case.Q), np.diag(case.R), interval=interval,
                                max_gain=_ENDLESS).K
        # an input that wanders, as for the others, from one sample to the next; what is returned
        # beside the covariance is the gain of a predictor, which lags by a sample
        noise = np.diag(case.noise ** 2)
        P = control.dlqe(self._A, self._B, self._C,
                         case.period * np.diag(case.disturbance_noise ** 2),
                         noise)[1]
        self._L = np.linalg.solve(self._C @ P @ self._C.T + noise, self._C @ P).T
        # what holds a set-point, as far as the linear model tells
        self._rows = np.eye(system.n_x)[[system.state_names.index(name)
                                         for name in case.setpoint]]
        self._held = np.linalg.pinv(np.block(
            [[A, B], [self._rows, np.zeros((len(self._rows), system.n_u))]]))
        self._about, self._limits = (x, u), case.limits
        self._x: Array = system.nominal_state - x
        self._first = True

    def step(self, y: Array, setpoint: Array) -> Array:
        """Return the input (n_u,) for outputs (n_y,) of the next sample, and a set-point."""
        x, u = self._about
        error = y - self._C @ (x + self._x)
        # nothing is known before the first but what it says itself
        gain = np.linalg.pinv(self._C) if self._first else self._L
        self._x, self._first = self._x + gain @ error, False
        x_ref, u_ref = np.split(self._held @ np.concatenate(
            (np.zeros(len(x)), setpoint - self._rows @ x)), [len(x)])
        command = self._limits.within(u + u_ref - self._K @ (self._x - x_ref))
        self._x = self._A @ self._x + self._B @ (command - u)
        return command


OWN: dict[str, Callable[[PartialCase], Contender]] = {
    '`mpc`, lift': lambda case: Own(case, case.lift, ('mpc', 'sdre')),
    '`sdre`, lift': lambda case: Own(case, case.lift, ('sdre',)),
    '`mpc`, true model': lambda case: Own(case, case.truth, ('mpc', 'sdre')),
    '`sdre`, true model': lambda case: Own(case, case.truth, ('sdre',)),
}
LINEAR: dict[str, Callable[[PartialCase], Contender]] = {
    'LQG at the set-point': lambda case: LinearQuadraticGaussian(case, *case.goal(case.system)),
    'LQG at the nominal point': lambda case: LinearQuadraticGaussian(
        case, case.system.nominal_state, case.system.nominal_input),
}
