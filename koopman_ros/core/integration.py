# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Integration of dx/dt = f(x): fixed Runge-Kutta steps by one rule, and an adaptive reference.

Fixed steps are those of filters, predictions, plans, trial loops and identification: they cost the
same at every sample, also where a model is wrong. The adaptive pair simulates plants, and is the
reference of tests of the fixed steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Any, TYPE_CHECKING

import numpy as np

from koopman_ros.core.arrays import Array

if TYPE_CHECKING:
    from scipy.integrate import DOP853

__all__ = ['STEPS', 'StepRule', 'adaptive', 'fastest_rate', 'integrate', 'runge_kutta_step',
           'sensitivity_rate']


@dataclass(frozen=True)
class StepRule:
    """
    How many fixed steps an interval takes.

    The local error of a Runge-Kutta step of order 4 is (h r)^5 / 120 of a mode of rate r: 3e-4 for
    the longest step, below the noise that a filter sees.
    """

    time_constants: float = 0.5  #: longest step, as a share of the fastest local time constant
    most: int = 40  #: steps in an interval

    def count(self, duration: float, fastest: float) -> int | None:
        """
        Return the number of steps of an interval; None for more than the rule allows.

        :param duration: of the interval, >= 0.
        :param fastest: rate of the fastest mode there, of :func:`fastest_rate`.
        """
        # Rounding must not add a step where the interval is a whole number of them.
        steps = duration * fastest / self.time_constants - 1e-9
        return max(1, math.ceil(steps)) if steps <= self.most else None


#: the rule where nothing else is documented
STEPS = StepRule()


def fastest_rate(jacobian: Array) -> float:
    """
    Return the size of the fastest mode of a Jacobian (n, n), at most some percent too large.

    ``|J^8|^(1/8)`` bounds the spectral radius from above, by Gelfand's formula. It takes three
    products in place of eigenvalues, in C as here.
    """
    flat = jacobian.ravel()
    size = math.sqrt(flat.dot(flat))
    if not 0.0 < size < math.inf:
        return size
    # of size 1, so that no power of it overflows
    power = jacobian / size
    for _ in range(3):
        power = power.dot(power)
    flat = power.ravel()
    return size * math.sqrt(flat.dot(flat)) ** 0.125


def runge_kutta_step(rate: Callable[[Array], Array], x: Array, h: Array | float) -> Array:
    """Step dx/dt = rate(x) by h, which broadcasts with x, by the Runge-Kutta method of order 4."""
    k1 = rate(x)
    k2 = rate(x + 0.5 * h * k1)
    k3 = rate(x + 0.5 * h * k2)
    k4 = rate(x + h * k3)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def integrate(rate: Callable[[Array], Array], x: Array, duration: Array | float, steps: int
              ) -> Array:
    """
    Integrate dx/dt = rate(x) over an interval in equal Runge-Kutta steps.

    :param duration: of the interval; it broadcasts with x.
    :param steps: their number, e.g. of :meth:`StepRule.count`.
    """
    for _ in range(steps):
        x = runge_kutta_step(rate, x, duration / steps)
    return x


def sensitivity_rate(rate_and_jacobian: Callable[[Array], tuple[Array, Array]],
                     forcing: Array | Callable[[Array], Array]) -> Callable[[Array], Array]:
    """
    Return the rate of a state together with its sensitivities to p parameters.

    With y = (x, S), S = dx/dp: dx/dt = f(x), dS/dt = J(x) S + df/dp (H. K. Khalil, *Nonlinear
    Systems* (2002), section 3.3).

    :param rate_and_jacobian: f (..., n) and J (..., n, n) of x (..., n).
    :param forcing: (..., n, p) df/dp, or a function of x.
    :return: a function of y (..., n, 1 + p).
    """
    def rate(y: Array) -> Array:
        f, J = rate_and_jacobian(y[..., 0])
        df_dp = forcing(y[..., 0]) if callable(forcing) else forcing
        return np.concatenate((f[..., None], J @ y[..., 1:] + df_dp), axis=-1)

    return rate


def adaptive(rate: Callable[[float, Array], Array], x: Array, duration: float, *, rtol: float,
             atol: Array | float, most: int, inside: Callable[[Array], bool] = lambda _: True
             ) -> tuple[DOP853, bool]:
    """
    Integrate by the explicit Runge-Kutta pair DOP853, from a first step over the whole interval.

    LSODA has to build up its history again after every kink of a held input: over one sample it is
    not quicker, and its error at the same tolerance is larger by orders of magnitude.

    :param most: accepted steps.
    :param inside: whether a state may be passed through; it is asked after each step.
    :return: the solver where it ended, with its time ``t`` and state ``y``, and whether that is
        the end of the interval.
    """
    from scipy.integrate import DOP853  # slow to import

    options: dict[str, Any] = {} if duration == 0.0 else {'first_step': duration}
    solver = DOP853(rate, 0.0, x, duration, rtol=rtol, atol=atol, **options)
    for _ in range(most):
        if solver.status != 'running':
            break
        solver.step()
        if not inside(solver.y):
            return solver, False
    return solver, solver.status == 'finished'
