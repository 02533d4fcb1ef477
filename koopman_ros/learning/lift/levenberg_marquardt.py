# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Levenberg-Marquardt on normal equations that it accumulates from residuals, in torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
import math

import torch
from torch import Tensor

# The damping rises by this when a step is rejected, and by twice as much each further time.
_FACTOR = 2.0
_MAX_DAMPING = 1e12
PATIENCE = 20  # accepted steps over which the decrease of the cost is judged


class MinimumStatus(Enum):
    """How a minimisation ended; the value is the sentence for the user."""

    CONVERGED = 'converged: a step no longer lowers the cost noticeably'
    MAX_ITERATIONS = ('reached the iteration limit while still improving: if the held-out errors '
                      'are too large, increase `max_iterations` or the number of starts')
    OUT_OF_TIME = 'stopped at its limit of processor time: name one class for more'
    STALLED = ('no damped step lowers the cost: the start is degenerate or the data contain '
               'values that are not finite; check the data and try another seed')
    INTERRUPTED = 'interrupted: the best parameters so far are kept'


@dataclass(frozen=True)
class LeastSquaresResult:
    """The outcome of a minimisation."""

    theta: Tensor  #: (p,) parameters with the lowest cost seen
    cost: float  #: half the sum of squares there
    iterations: int  #: accepted and rejected steps together
    status: MinimumStatus  #: why it ended
    #: at the limit of steps, the share of the cost that the last `patience` accepted ones took
    #: off; NaN otherwise, and where there was none
    decrease: float = math.nan
    from_keyboard: bool = False  #: whether the keyboard interrupted it, not the monitor


class NormalEquations:
    """
    Cost 0.5 ||r||^2 with gradient J'r and Gauss-Newton matrix J'J, summed over blocks of r.

    :param like: (p,) parameters, whose type and device the sums have.
    :param derivatives: whether gradient and matrix are wanted; they stay zero otherwise.
    """

    def __init__(self, like: Tensor, *, derivatives: bool) -> None:
        self.derivatives = derivatives
        self.gradient = torch.zeros_like(like)
        self.matrix = like.new_zeros((len(like), len(like)) if derivatives else (0, 0))
        self._cost = like.new_zeros(())

    @property
    def cost(self) -> float:
        """Half the sum of squares."""
        return float(self._cost)

    def add(self, r: Tensor, J: Tensor | None = None, count: int = 1) -> None:
        """Add residuals (...) with their J (..., p) where wanted, squares divided by a count."""
        self._cost += 0.5 * torch.sum(r * r) / count
        if J is not None:
            J = J.reshape(-1, len(self.gradient))
            self.gradient += J.T @ r.reshape(-1) / count
            # without another matrix of this size
            self.matrix.addmm_(J.T, J, alpha=1.0 / count)

    def add_sums(self, cost: Tensor | float, gradient: Tensor | None = None,
                 matrix: Tensor | None = None) -> None:
        """Add residuals whose structure allows for their sums without forming their J."""
        self._cost += cost
        if self.derivatives and gradient is not None and matrix is not None:
            self.gradient += gradient
            self.matrix += matrix


# residuals(theta, equations) adds the residuals at parameters (p,) to the equations
Residuals = Callable[[Tensor, NormalEquations], None]


def normal_equations(residuals: Residuals, theta: Tensor, *, derivatives: bool = True
                     ) -> NormalEquations:
    """Return the normal equations of residuals at parameters (p,)."""
    equations = NormalEquations(theta, derivatives=derivatives)
    residuals(theta, equations)
    return equations


# derivatives come with the residuals, so that torch need not take note of anything
@torch.inference_mode()
def minimise(residuals: Residuals, theta: Tensor, *, max_iterations: int,
             tolerance: float = 1e-3, patience: int = PATIENCE,
             monitor: Callable[[int, float], bool] | None = None) -> LeastSquaresResult:
    """
    Minimise 0.5 ||r(theta)||^2 by Levenberg-Marquardt with Marquardt's diagonal scaling.

    The damping follows the gain ratio (Nielsen's rule); the scaling never shrinks, so that the
    method does not depend on the units of single parameters (More, 1978). An interrupt from the
    keyboard ends it like the monitor does.

    :param theta: (p,) start, float64.
    :param max_iterations: limit on steps tried.
    :param tolerance: relative decrease over `patience` accepted steps taken as convergence.
    :param patience: number of accepted steps over which the decrease is judged.
    :param monitor: called with the iteration and cost after each step; True ends the run.
    """
    now = normal_equations(residuals, theta)
    if not math.isfinite(now.cost):
        return LeastSquaresResult(theta, math.inf, 0, MinimumStatus.STALLED)
    scaling = torch.clamp(now.matrix.diagonal().clone(), min=1e-12)
    damping, factor, costs, iteration = 1e-3, _FACTOR, [now.cost], 0

    def result(status: MinimumStatus, decrease: float = math.nan) -> LeastSquaresResult:
        return LeastSquaresResult(theta, now.cost, iteration, status, decrease)

    try:
        for iteration in range(1, max_iterations + 1):
            # after a step that was taken the next one mostly is, too: its derivatives at once
            trial = _step(residuals, theta, now, damping * scaling, derivatives=factor == _FACTOR)
            if trial is None:
                damping, factor = damping * factor, 2.0 * factor
            else:
                theta, now, gain = trial
                scaling = torch.maximum(scaling, now.matrix.diagonal())
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
                damping, factor = max(damping, 1e-15), _FACTOR
                costs.append(now.cost)
            if damping > _MAX_DAMPING:
                return result(MinimumStatus.CONVERGED if len(costs) > 1
                              else MinimumStatus.STALLED)
            if trial is not None and len(costs) > patience and (
                    costs[-1 - patience] - costs[-1] <= tolerance * costs[-1 - patience]):
                return result(MinimumStatus.CONVERGED)
            if monitor is not None and monitor(iteration, now.cost):
                return result(MinimumStatus.INTERRUPTED)
    except KeyboardInterrupt:
        return replace(result(MinimumStatus.INTERRUPTED), from_keyboard=True)
    before = costs[-1 - min(patience, len(costs) - 1)]
    return result(MinimumStatus.MAX_ITERATIONS, (
        (before - costs[-1]) / before if before > costs[-1] else math.nan))


def _step(residuals: Residuals, theta: Tensor, now: NormalEquations, damping: Tensor, *,
          derivatives: bool) -> tuple[Tensor, NormalEquations, float] | None:
    """Return parameters, equations and gain ratio of a damped step that lowers the cost."""
    factor, info = torch.linalg.cholesky_ex(now.matrix + torch.diag(damping))
    if int(info):
        return None
    step = -torch.cholesky_solve(now.gradient[:, None], factor)[:, 0]
    predicted = 0.5 * float(step @ (damping * step - now.gradient))
    moved = theta + step
    trial = normal_equations(residuals, moved, derivatives=derivatives)
    gain = (now.cost - trial.cost) / predicted if predicted > 0.0 else -1.0
    if not (math.isfinite(trial.cost) and gain > 0.0):
        return None
    return moved, trial if derivatives else normal_equations(residuals, moved), gain
