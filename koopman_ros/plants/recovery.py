# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""States from which a limited input can bring an unstable plant back."""

from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.plants.system import checked_vector, ControlAffineSystem

# Of half the box: so near the nominal state the linear law holds the plant.
_HOME = 0.1
# Of the slowest mode under the law, in which it must get there.
_TIME_CONSTANTS = 10.0
# Steps of a tenth of the fastest mode's time constant: the box is checked after each.
_STEP = 0.1


def recoverable(system: ControlAffineSystem, x: Array, *, input_lower: ArrayLike,
                input_upper: ArrayLike, state_lower: ArrayLike, state_upper: ArrayLike
                ) -> NDArray[np.bool_]:
    """
    Return from which states a limited input can return the plant to its nominal one.

    Tried is the linear-quadratic law of the plant linearised there, with states and inputs weighed
    in halves of their ranges, and limited. The state may not leave its box on the way.

    :param x: (N, n_x) states, in their units.
    :param input_lower: lowest input, a scalar or (n_u,); `input_upper` the highest.
    :param state_lower: lower corner of the box, a scalar or (n_x,); `state_upper` the upper one.
    :return: (N,) whether each is brought back.
    :raises ValueError: when a range does not fit or is empty, or no input reaches a mode of the
        linearised plant that grows.
    """
    x0, u0 = system.nominal_state, system.nominal_input
    lower, upper = (checked_vector(name, bound, system.n_x) for name, bound in (
        ('state_lower', state_lower), ('state_upper', state_upper)))
    lowest, highest = (checked_vector(name, bound, system.n_u) for name, bound in (
        ('input_lower', input_lower), ('input_upper', input_upper)))
    for name, low, middle, high in (('state', lower, x0, upper), ('input', lowest, u0, highest)):
        if not np.all((low < middle) & (middle < high)):
            raise ValueError(f'{name}_lower {low} and {name}_upper {high} must lie on both sides '
                             f'of the nominal {name} {middle}')
    half, half_u = 0.5 * (upper - lower), 0.5 * (highest - lowest)
    A, B = system.slope(x0, u0), system.input_matrix(x0)
    riccati = solve_riccati(A, B, np.diag(half ** -2.0), np.diag(half_u ** -2.0))
    if not riccati.solved:
        raise ValueError(f'{system.name}: no state feedback stabilises its nominal state; choose '
                         'another nominal state, or add an input that acts on the unstable modes')
    closed = np.linalg.eigvals(A - B @ riccati.K)
    fastest = max(np.max(np.abs(closed)), np.max(np.abs(np.linalg.eigvals(A))))
    step = _STEP / fastest
    found = np.zeros(len(x), dtype=bool)
    number, state = np.arange(len(x)), np.asarray(x, dtype=np.float64)
    # a diverging run may overflow before it is left out
    with np.errstate(all='ignore'):
        for _ in range(int(_TIME_CONSTANTS / (np.min(-closed.real) * step))):
            inside = np.all((state >= lower) & (state <= upper), axis=1)
            home = np.max(np.abs((state - x0) / half), axis=1) <= _HOME
            found[number[inside & home]] = True
            number, state = (a[inside & ~home] for a in (number, state))
            if not len(number):
                break
            u = np.clip(u0 - (state - x0) @ riccati.K.T, lowest, highest)
            state = runge_kutta_step(partial(system.derivative, u=u), state, step)
    return found
