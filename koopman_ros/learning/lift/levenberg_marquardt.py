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

# The damping rises by this when a step is refused, and by twice as much each further time.
_FACTOR = 2.0
_MAX_DAMPING = 1e12
PATIENCE = 20  # accepted steps over which the decrease of the cost is judged


class MinimumStatus(Enum):
    """How a minimisation ended; the value is the sentence for the user."""

    CONVERGED = 'converged: a step no longer lowers the cost noticeably'
    MAX_ITERATIONS = ('reached the iteration limit while still improving: where the held-out '
                      'figures do not suffice, increase `max_iterations` or the number of starts')
    STALLED = ('no damped step lowers the cost: the start is degenerate or the data hold values '
               'that are not finite; check the data and try another seed')
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
    state: _State | None = None
    try:
        now = normal_equations(residuals, theta)
        if not math.isfinite(now.cost):
            return LeastSquaresResult(theta, math.inf, 0, MinimumStatus.STALLED)
        state = _State(theta, now, torch.clamp(now.matrix.diagonal().clone(), min=1e-12))
        costs = [now.cost]
        for iteration in range(1, max_iterations + 1):
            state = replace(_step(residuals, state), iteration=iteration)
            if state.damping > _MAX_DAMPING:
                status = MinimumStatus.CONVERGED if len(costs) > 1 else MinimumStatus.STALLED
                return state.minimum(status)
            if state.factor == _FACTOR:
                costs.append(state.now.cost)
                if _converged(costs, tolerance, patience):
                    return state.minimum(MinimumStatus.CONVERGED)
            if monitor is not None and monitor(iteration, state.now.cost):
                return state.minimum(MinimumStatus.INTERRUPTED)
    except KeyboardInterrupt:
        if state is None:
            raise
        return state.minimum(MinimumStatus.INTERRUPTED)
    before = costs[-1 - min(patience, len(costs) - 1)]
    return replace(state.minimum(MinimumStatus.MAX_ITERATIONS),
                   decrease=(before - costs[-1]) / before if before > costs[-1] else math.nan)


@dataclass(frozen=True)
class _State:
    """Where a minimisation stands."""

    theta: Tensor
    now: NormalEquations
    scaling: Tensor
    damping: float = 1e-3
    factor: float = _FACTOR  # by which the damping rises when a step is refused; reset when taken
    iteration: int = 0

    def minimum(self, status: MinimumStatus) -> LeastSquaresResult:
        return LeastSquaresResult(self.theta, self.now.cost, self.iteration, status)


def _converged(costs: list[float], tolerance: float, patience: int) -> bool:
    return len(costs) > patience and (
        costs[-1 - patience] - costs[-1] <= tolerance * costs[-1 - patience])


def _step(residuals: Residuals, state: _State) -> _State:
    """Try one damped Gauss-Newton step; take it when it lowers the cost."""
    now, damping, scaling = state.now, state.damping, state.scaling
    factor, info = torch.linalg.cholesky_ex(now.matrix + torch.diag(damping * scaling))
    if int(info) == 0:
        step = -torch.cholesky_solve(now.gradient[:, None], factor)[:, 0]
        predicted = 0.5 * float(step @ (damping * scaling * step - now.gradient))
        # after a step that was taken the next one mostly is, too: its derivatives at once
        trial = normal_equations(residuals, state.theta + step,
                                 derivatives=state.factor == _FACTOR)
        gain = (now.cost - trial.cost) / predicted if predicted > 0.0 else -1.0
        if math.isfinite(trial.cost) and gain > 0.0:
            theta = state.theta + step
            now = trial if trial.derivatives else normal_equations(residuals, theta)
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            return _State(theta, now, torch.maximum(scaling, now.matrix.diagonal()),
                          max(damping, 1e-15))
    return replace(state, damping=damping * state.factor, factor=2.0 * state.factor)
