# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Levenberg-Marquardt on accumulated normal equations, in torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
import math

from koopman_ros.lifting.residuals import NormalEquations
import torch
from torch import Tensor


class Status(Enum):
    """How a minimisation ended; the value is the sentence for the user."""

    CONVERGED = 'converged: a step no longer lowers the cost noticeably'
    MAX_ITERATIONS = ('stopped at the iteration limit before convergence: '
                      'increase `max_iterations` or start elsewhere (another seed)')
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
             tolerance: float = 1e-9, patience: int = 10,
             interrupted: Callable[[int, float], bool] | None = None) -> Minimum:
    """
    Minimise 0.5 ||r(theta)||^2 by Levenberg-Marquardt with Marquardt's diagonal scaling.

    The damping follows the gain ratio (Nielsen's rule); the scaling never shrinks, so that the
    method does not depend on the units of single parameters (More, 1978).

    :param evaluate: ``evaluate(theta, derivatives=...)`` giving the normal equations.
    :param theta: (p,) start, float64.
    :param max_iterations: limit on steps tried.
    :param tolerance: relative decrease over `patience` accepted steps taken as convergence.
    :param patience: number of accepted steps over which the decrease is judged.
    :param interrupted: called with the iteration and cost after each step; True ends the run.
    """
    now = evaluate(theta, derivatives=True)
    if not math.isfinite(now.cost):
        return Minimum(theta, math.inf, 0, Status.STALLED)
    damping, growth = 1e-3, 2.0
    assert now.matrix is not None
    scaling = torch.clamp(now.matrix.diagonal().clone(), min=1e-12)
    costs = [now.cost]
    for iteration in range(1, max_iterations + 1):
        assert now.matrix is not None and now.gradient is not None
        damped = now.matrix + torch.diag(damping * scaling)
        factor, info = torch.linalg.cholesky_ex(damped)
        accepted = False
        if int(info) == 0:
            step = -torch.cholesky_solve(now.gradient[:, None], factor)[:, 0]
            predicted = 0.5 * float(step @ (damping * scaling * step - now.gradient))
            trial = evaluate(theta + step, derivatives=False)
            gain = (now.cost - trial.cost) / predicted if predicted > 0.0 else -1.0
            accepted = math.isfinite(trial.cost) and gain > 0.0
        if accepted:
            theta = theta + step
            now = evaluate(theta, derivatives=True)
            assert now.matrix is not None
            scaling = torch.maximum(scaling, now.matrix.diagonal())
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            damping, growth = max(damping, 1e-15), 2.0
            costs.append(now.cost)
            if len(costs) > patience and costs[-1 - patience] - now.cost <= (
                    tolerance * costs[-1 - patience]):
                return Minimum(theta, now.cost, iteration, Status.CONVERGED)
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > 1e12:
                status = Status.CONVERGED if len(costs) > 1 else Status.STALLED
                return Minimum(theta, now.cost, iteration, status)
        if interrupted is not None and interrupted(iteration, now.cost):
            return Minimum(theta, now.cost, iteration, Status.INTERRUPTED)
    return Minimum(theta, now.cost, max_iterations, Status.MAX_ITERATIONS)
