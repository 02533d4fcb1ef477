# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Steady states of a plant, the inputs that hold them, their eigenvalues and their folds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq, root

from koopman_ros.plants.system import ControlAffineSystem, FloatArray

# The last Newton correction of a steady state, as a fraction of each state or of its nominal
# magnitude, whichever is larger.
CORRECTION_TOLERANCE = 1e-12
# At a double root Newton only halves the error: 1e-12 takes forty corrections.
_MAX_CORRECTIONS = 60


class EquilibriumError(ValueError):
    """There is no steady state, no holding input or no fold where one was asked for."""


def equilibrium(system: ControlAffineSystem, u: ArrayLike, guess: ArrayLike) -> FloatArray:
    """
    Find the steady state f(x) + B u = 0 that a constant input has near a guess.

    A trust-region root search (MINPACK hybrid) brings `guess` near, Newton corrections with the
    analytic Jacobian finish to 1e-12 of the state. Of several steady states it is the one that
    this search reaches: check what came back when they lie close together.

    :param u: the held input (n_u,).
    :param guess: where to start (n_x,).
    :return: the steady state (n_x,).
    :raises ValueError: when `u` or `guess` does not fit the system.
    :raises EquilibriumError: when no steady state is found within the state bounds.
    """
    held = system.checked_input('u', u)
    start = system.checked_state('guess', guess)
    scale = np.where(start != 0.0, np.abs(start), system.state_scale)

    def scaled_rate(y: FloatArray) -> FloatArray:
        return system.derivative(y * scale, held) / scale

    def scaled_jacobian(y: FloatArray) -> FloatArray:
        return system.drift_jacobian(y * scale) * scale / scale[:, None]

    # A trial far off may overflow; the checks below judge what comes of it.
    with np.errstate(all='ignore'):
        found = root(scaled_rate, start / scale, jac=scaled_jacobian, method='hybr', tol=1e-14)
        state, converged = _corrected(system, held, found.x * scale)
    if not (converged and _within_bounds(system, state)):
        raise EquilibriumError(
            f'{system.name}: no steady state found for {system.describe_input(held)} from '
            f'{system.describe_state(start)}; the search ended at {system.describe_state(state)}; '
            'start nearer to it, or choose an input that has one')
    return state


def _corrected(
    system: ControlAffineSystem, u: FloatArray, state: FloatArray,
) -> tuple[FloatArray, bool]:
    """Apply Newton corrections until they are small; the flag says whether they became so."""
    for _ in range(_MAX_CORRECTIONS):
        rate = system.derivative(state, u)
        if not np.any(rate):
            return state, True
        try:
            correction = np.linalg.solve(system.drift_jacobian(state), -rate)
        except np.linalg.LinAlgError:
            return state, False
        state = np.asarray(state + correction, dtype=np.float64)
        if _small(np.asarray(correction), state, system.state_scale):
            return state, True
    return state, False


def _small(correction: FloatArray, state: FloatArray, scale: FloatArray) -> bool:
    allowed = CORRECTION_TOLERANCE * np.maximum(np.abs(state), scale)
    return bool(np.all(np.abs(correction) <= allowed))


def _within_bounds(system: ControlAffineSystem, state: FloatArray) -> bool:
    return bool(np.all((state >= system.state_lower) & (state <= system.state_upper)))


def equilibrium_input(
    system: ControlAffineSystem, state: ArrayLike, *, tolerance: float = 1e-9,
) -> FloatArray:
    """
    Find the constant input that holds a state: B u = -f(x) by least squares.

    :param state: the state to hold (n_x,).
    :param tolerance: largest rate of each state that still counts as held, as a fraction of that
        state per time unit.
    :return: the input (n_u,).
    :raises ValueError: when `state` does not fit the system.
    :raises EquilibriumError: when no input holds that state.
    """
    held = system.checked_state('state', state)
    u = np.asarray(np.linalg.lstsq(system.B, -system.drift(held), rcond=None)[0], np.float64)
    rate = system.derivative(held, u)
    magnitude = np.where(held != 0.0, np.abs(held), system.state_scale)
    worst = int(np.argmax(np.abs(rate) / magnitude))
    if not abs(rate[worst]) <= tolerance * magnitude[worst]:
        raise EquilibriumError(
            f'{system.name}: no input holds {system.describe_state(held)}: '
            f'{system.state_names[worst]} still changes by {rate[worst]:.3g} '
            f'{system.state_units[worst]}/{system.time_unit}; '
            'choose a steady state, for instance one that equilibrium() found')
    return u


def eigenvalues(system: ControlAffineSystem, state: ArrayLike) -> NDArray[np.complex128]:
    """
    Compute the eigenvalues of df/dx at a state, in 1 per time unit.

    :param state: where to linearise (n_x,).
    :return: complex eigenvalues (n_x,), by rising real part, conjugates by rising imaginary part.
    :raises ValueError: when `state` does not fit the system.
    """
    jacobian = system.drift_jacobian(system.checked_state('state', state))
    return np.sort_complex(np.asarray(np.linalg.eigvals(jacobian), dtype=np.complex128))


def fold(system: ControlAffineSystem, lower: float, upper: float) -> tuple[FloatArray, FloatArray]:
    """
    Find the fold of a one-state system: where the slope df/dx, and so stability, changes sign.

    :param lower: lower end of the searched range, in state units.
    :param upper: upper end of it; the slope there has the opposite sign.
    :return: the state (1,) and the input (n_u,) that holds it.
    :raises ValueError: when the system has more than one state.
    :raises EquilibriumError: when the slope does not change sign in that range, or no input holds
        the state where it does.
    """
    if system.n_x != 1:
        raise ValueError(f'{system.name} has {system.n_x} states, a fold is sought for one state')

    def slope(x: float) -> float:
        return float(system.drift_jacobian(np.array([x]))[0, 0])

    unit = system.state_units[0]
    if not slope(lower) * slope(upper) <= 0.0:
        raise EquilibriumError(
            f'{system.name}: the slope df/dx does not change sign in [{lower:.10g}, {upper:.10g}] '
            f'{unit}: it is {slope(lower):.3g} and {slope(upper):.3g} 1/{system.time_unit} '
            'at the ends; widen the range')
    state = np.array([brentq(slope, lower, upper, xtol=1e-300, rtol=1e-14)])
    return state, equilibrium_input(system, state)
