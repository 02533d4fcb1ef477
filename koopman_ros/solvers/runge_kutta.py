# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The classical Runge-Kutta method of order four, for many states at once."""

from collections.abc import Callable

from koopman_ros.arrays import Array


def runge_kutta_step(rate: Callable[[Array], Array], x: Array, h: Array | float) -> Array:
    """
    Take one step of dx/dt = rate(x).

    :param rate: of the states, in their shape.
    :param x: (...) states.
    :param h: length of the step, or one that broadcasts with the states.
    """
    k1 = rate(x)
    k2 = rate(x + 0.5 * h * k1)
    k3 = rate(x + 0.5 * h * k2)
    k4 = rate(x + h * k3)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
