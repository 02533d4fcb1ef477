# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""States from which a limited input can bring an unstable plant back."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import integrate, STEPS
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.plants.system import checked_vector, ControlAffineSystem


@dataclass(frozen=True)
class RecoverySettings:
    """Settings of the simulations that show from where a plant returns."""

    home: float = 0.1  #: share of half the box in which the linear law holds the plant
    duration: float = 10.0  #: in slowest time constants under the law, in which it must get there
    interval: float = 0.1  #: between checks of the box, in fastest time constants


def recoverable(system: ControlAffineSystem, x: Array, *, input_lower: ArrayLike,
                input_upper: ArrayLike, state_lower: ArrayLike, state_upper: ArrayLike,
                settings: RecoverySettings = RecoverySettings()) -> NDArray[np.bool_]:
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
    interval = settings.interval / fastest
    steps = STEPS.count(interval, fastest)
    assert steps is not None
    found = np.zeros(len(x), dtype=bool)
    number, state = np.arange(len(x)), np.asarray(x, dtype=np.float64)
    # a diverging run may overflow before it is left out
    with np.errstate(all='ignore'):
        for _ in range(int(settings.duration / (np.min(-closed.real) * interval))):
            inside = np.all((state >= lower) & (state <= upper), axis=1)
            home = np.max(np.abs((state - x0) / half), axis=1) <= settings.home
            found[number[inside & home]] = True
            number, state = (a[inside & ~home] for a in (number, state))
            if not len(number):
                break
            u = np.clip(u0 - (state - x0) @ riccati.K.T, lowest, highest)
            state = integrate(partial(system.derivative, u=u), state, interval, steps)
    return found
