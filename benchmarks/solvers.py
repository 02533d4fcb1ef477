# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The solvers in torch: our learner, L-BFGS and Adam; the clock of all solvers; our cost."""

from collections.abc import Callable
import math
import time

import numpy as np
import torch
from torch import Tensor

from benchmarks.problems import PlanningCase, WHITENING
from benchmarks.process import allow, Tell
from koopman_ros.learning.lift.levenberg_marquardt import (
    minimise,
    normal_equations,
    NormalEquations,
)

# Of constant and falling rates from 0.003 to 0.03 this was the best over both systems.
_ADAM_RATE = 1e-2
_ADAM_HALVES_AFTER = 5000  # steps
# Of 20 and 100 the better one.
_LBFGS_HISTORY = 100
# torch's L-BFGS drops an update of its memory with y's <= 1e-10, whatever the units, and is stuck
# near rw = 1e-6 when the objective is not multiplied by a factor; of 1, 1e4 and 1e8 the best.
_FACTOR = 1e4
# Iterates are noted when rw has fallen by this factor, or passes a target.
_NOTED = 0.9
# A solver looks at its limit between two steps, and a step may be long; besides, its iterates are
# judged in the same process.
_GRACE, _SLACK = 10.0, 2.0  # s, 1


class Finished(Exception):  # noqa: N818 - an end, not an error
    """All targets are met, or the time is up."""


class CostTrace:
    """
    The progress of a solver, by a clock that stops while its iterates are judged.

    It counts the processor time of the one thread, which other programs disturb less; the time on
    the wall is noted, too. It ends at the last target for rw or at a limit in s.
    """

    def __init__(self, tell: Tell, case: PlanningCase, targets: list[float], limit: float) -> None:
        self._tell, self._case, self._targets, self._limit = tell, case, targets, limit
        self._best = math.inf
        self._start = _now()
        self._looks, self.done = 0, False

    def start(self, built: float = 0.0) -> None:
        """Start the clock; the argument is the time to build the problem, in s."""
        self._tell({'built': built})
        allow(self._tell, _SLACK * self._limit + _GRACE, f'stopped after {self._limit:g} s')
        self._judge(self._case.theta, 0.0, 0.0)
        self._start = _now()

    def look(self, theta: Tensor) -> bool:
        """Judge an iterate (p,); True ends the solver."""
        now = _now()
        seconds, wall = (float(passed) for passed in now - self._start)
        self._looks += 1
        in_time = seconds <= self._limit
        if in_time:
            self._judge(theta, seconds, wall)
        if not in_time or self._best <= min(self._targets):
            self.done = True
            self.end('' if in_time else f'stopped after {self._limit:g} s')
            self._tell({'ended': min(seconds, self._limit)})
        self._start += _now() - now
        return self.done

    def end(self, reason: str) -> None:
        """Note why a solver has ended."""
        self._tell({'end': reason, 'iterates': self._looks})

    def _judge(self, theta: Tensor, seconds: float, wall: float) -> None:
        rw = self._case.rw(theta)
        if rw < _NOTED * self._best or any(rw <= target < self._best for target in self._targets):
            self._best = rw
            self._tell({'seconds': seconds, 'wall': wall, 'rw': rw})


def _now() -> np.ndarray:
    """Return processor time and time on the wall, s."""
    return np.array([time.process_time(), time.perf_counter()])


def solve(tell: Tell, solver: str, case: PlanningCase, targets: list[float], limit: float,
          build_limit: float) -> None:
    """Run one solver on one case."""
    if solver.startswith('ipopt'):
        try:
            from benchmarks import ipopt
        except ImportError as error:
            raise RuntimeError('casadi is not installed: pip install -e ".[bench]"') from error
        run = {'ipopt': ipopt.expanded, 'ipopt_compiled': ipopt.compiled}[solver]
    else:
        run = {'ours': ours, 'lbfgs': lbfgs, 'adam': adam}[solver]
    allow(tell, build_limit, f'not built after {build_limit:g} s')
    trace = CostTrace(tell, case, targets, limit)
    reason = run(case, trace)
    if not trace.done:
        trace.end(reason)


def ours(case: PlanningCase, trace: CostTrace) -> str:
    """Run Levenberg-Marquardt with the hand-derived Jacobian."""
    problem, accepted = case.problem, case.theta

    def residuals(theta: Tensor, equations: NormalEquations) -> None:
        nonlocal accepted
        if equations.derivatives:
            accepted = theta
        problem.add_residuals(theta, equations)

    for derivatives in (True, False):  # what torch sets up at its first call is not timed
        normal_equations(problem.add_residuals, case.theta, derivatives=derivatives)
    trace.start()
    minimum = minimise(residuals, case.theta, max_iterations=10 ** 9, tolerance=0.0,
                       monitor=lambda *_: trace.look(accepted))
    return minimum.status.value


def lbfgs(case: PlanningCase, trace: CostTrace) -> str:
    """Run torch's L-BFGS with strong Wolfe line search, each point of which counts as reached."""
    theta, objective = _warm(case)
    solver = torch.optim.LBFGS(
        [theta], max_iter=10 ** 9, max_eval=10 ** 9, history_size=_LBFGS_HISTORY,
        tolerance_grad=0.0, tolerance_change=0.0, line_search_fn='strong_wolfe')

    def closure() -> Tensor:
        solver.zero_grad()
        value = objective(theta)
        value.backward()
        if trace.look(theta.detach()):
            raise Finished
        return value

    trace.start()
    try:
        before = math.inf
        while (value := solver.step(closure).item()) < before:
            before = value
    except Finished:
        return ''
    return 'the line search finds no lower point'


def adam(case: PlanningCase, trace: CostTrace) -> str:
    """Run torch's Adam on all samples, with a rate of 0.01 that halves every 5000 steps."""
    theta, objective = _warm(case)
    solver = torch.optim.Adam([theta], lr=_ADAM_RATE)
    schedule = torch.optim.lr_scheduler.ExponentialLR(solver, 0.5 ** (1.0 / _ADAM_HALVES_AFTER))
    trace.start()
    while True:
        solver.zero_grad()
        objective(theta).backward()
        solver.step()
        schedule.step()
        if trace.look(theta.detach()):
            return ''


def _warm(case: PlanningCase) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Return a leaf at the start and the objective in other units, both after a first call."""
    theta = case.theta.clone().requires_grad_(True)
    plain = differentiable(case)

    def objective(at: Tensor) -> Tensor:
        return _FACTOR * plain(at)

    objective(theta).backward()
    return theta, objective


def differentiable(case: PlanningCase) -> Callable[[Tensor], Tensor]:
    """Write the objective for automatic differentiation, with as few operations as it takes."""
    layout, x, f = case.layout, case.data.x, case.data.f
    at_W, at_b, at_V, at_A = layout.slices
    of_W, _, of_V, of_A = layout.shapes
    i, j = torch.triu_indices(layout.n_z, layout.n_z)
    varies = j >= layout.n_x
    i, j = i[varies], j[varies]
    eye = (i == j).to(x)
    weight = 0.5 * WHITENING * (2.0 - eye)

    def objective(theta: Tensor) -> Tensor:
        W, b = theta[at_W].view(of_W), theta[at_b]
        V, A = theta[at_V].view(of_V), theta[at_A].view(of_A)
        t = torch.tanh(torch.addmm(b, x, W.T))
        z = torch.cat([x, (t - torch.tanh(b)) @ V.T], 1)
        rate = torch.cat([f, ((1.0 - t * t) * (f @ W.T)) @ V.T], 1)
        residual = rate - z @ A.T
        moment = z.T @ z / len(x)
        return (0.5 / len(x) * residual.square().sum()
                + (weight * (moment[i, j] - eye).square()).sum())

    return objective
