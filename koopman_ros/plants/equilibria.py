# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The inputs that hold a plant at a state."""

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.plants.system import ControlAffineSystem, FloatArray


class EquilibriumError(ValueError):
    """There is no steady state or no holding input where one was asked for."""


def equilibrium_input(system: ControlAffineSystem, state: ArrayLike, *, tolerance: float = 1e-9
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
            'choose a steady state')
    return u
