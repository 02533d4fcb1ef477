# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Levenberg-Marquardt on accumulated normal equations, in torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
import math

import torch
from torch import Tensor

from koopman_ros.learning.residuals import NormalEquations

# The damping grows by this when a step is refused, and by twice as much each further time.
_GROWTH = 2.0
_MAX_DAMPING = 1e12


class Status(Enum):
    """How a minimisation ended; the value is the sentence for the user."""

    CONVERGED = 'converged: a step no longer lowers the cost noticeably'
    MAX_ITERATIONS = ('reached the iteration limit while still improving: where the held-out '
                      'figures do not suffice, increase `max_iterations` or the number of starts')
    STALLED = ('no damped step lowers the cost: the start is degenerate or the data hold values '
               'that are not finite; check the data and try another seed')
    INTERRUPTED = 'interrupted: the best parameters so far are kept'


@dataclass(frozen=True)
class Minimum:
    """
    The outcome of a minimisation.

    :param theta: (p,) parameters with the lowest cost seen.
    :param cost: half the sum of squares there.
    :param iterations: accepted and rejected steps together.
    :param status: why it ended.
    """

    theta: Tensor
    cost: float
    iterations: int
    status: Status


def minimise(evaluate: Callable[..., NormalEquations], theta: Tensor, *, max_iterations: int,
             tolerance: float = 1e-3, patience: int = 20,
             monitor: Callable[[int, float], bool] | None = None) -> Minimum:
    """
    Minimise 0.5 ||r(theta)||^2 by Levenberg-Marquardt with Marquardt's diagonal scaling.

    The damping follows the gain ratio (Nielsen's rule); the scaling never shrinks, so that the
    method does not depend on the units of single parameters (More, 1978). An interrupt from the
    keyboard ends it like the monitor does.

    :param evaluate: ``evaluate(theta, derivatives=...)`` giving the normal equations.
    :param theta: (p,) start, float64.
    :param max_iterations: limit on steps tried.
    :param tolerance: relative decrease over `patience` accepted steps taken as convergence.
    :param patience: number of accepted steps over which the decrease is judged.
    :param monitor: called with the iteration and cost after each step; True ends the run.
    """
    state: _State | None = None
    try:
        now = evaluate(theta, derivatives=True)
        if not math.isfinite(now.cost):
            return Minimum(theta, math.inf, 0, Status.STALLED)
        assert now.matrix is not None
        state = _State(theta, now, torch.clamp(now.matrix.diagonal().clone(), min=1e-12))
        costs = [now.cost]
        for iteration in range(1, max_iterations + 1):
            state = replace(_step(evaluate, state), iteration=iteration)
            if state.damping > _MAX_DAMPING:
                status = Status.CONVERGED if len(costs) > 1 else Status.STALLED
                return state.minimum(status)
            if state.growth == _GROWTH:
                costs.append(state.now.cost)
                if _converged(costs, tolerance, patience):
                    return state.minimum(Status.CONVERGED)
            if monitor is not None and monitor(iteration, state.now.cost):
                return state.minimum(Status.INTERRUPTED)
    except KeyboardInterrupt:
        if state is None:
            raise
        return state.minimum(Status.INTERRUPTED)
    return state.minimum(Status.MAX_ITERATIONS)


@dataclass(frozen=True)
class _State:
    """
    Where a minimisation stands.

    :param growth: by what the damping grows when a step is refused; back at _GROWTH after a step
        that was taken.
    """

    theta: Tensor
    now: NormalEquations
    scaling: Tensor
    damping: float = 1e-3
    growth: float = _GROWTH
    iteration: int = 0

    def minimum(self, status: Status) -> Minimum:
        return Minimum(self.theta, self.now.cost, self.iteration, status)


def _converged(costs: list[float], tolerance: float, patience: int) -> bool:
    return len(costs) > patience and (
        costs[-1 - patience] - costs[-1] <= tolerance * costs[-1 - patience])


def _step(evaluate: Callable[..., NormalEquations], state: _State) -> _State:
    """Try one damped Gauss-Newton step; take it when it lowers the cost."""
    now, damping, scaling = state.now, state.damping, state.scaling
    assert now.matrix is not None and now.gradient is not None
    factor, info = torch.linalg.cholesky_ex(now.matrix + torch.diag(damping * scaling))
    if int(info) == 0:
        step = -torch.cholesky_solve(now.gradient[:, None], factor)[:, 0]
        predicted = 0.5 * float(step @ (damping * scaling * step - now.gradient))
        trial = evaluate(state.theta + step, derivatives=False)
        gain = (now.cost - trial.cost) / predicted if predicted > 0.0 else -1.0
        if math.isfinite(trial.cost) and gain > 0.0:
            theta = state.theta + step
            now = evaluate(theta, derivatives=True)
            assert now.matrix is not None
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            return _State(theta, now, torch.maximum(scaling, now.matrix.diagonal()),
                          max(damping, 1e-15))
    return replace(state, damping=damping * state.growth, growth=2.0 * state.growth)
