# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The solvers in torch: our learner, L-BFGS and Adam."""

from collections.abc import Callable
import math

import torch
from torch import Tensor

from koopman_ros.learning.levenberg_marquardt import minimise, normal_equations, NormalEquations
from validation.benchmarks.training.problems import Case, WHITENING
from validation.benchmarks.training.trace import Finished, Trace

# Of constant and falling rates from 0.003 to 0.03 this was the best over both systems.
_ADAM_RATE = 1e-2
_ADAM_HALVES_AFTER = 5000  # steps
# Of 20 and 100 the better one.
_LBFGS_HISTORY = 100
# torch's L-BFGS drops an update of its memory with y's <= 1e-10, whatever the units, and is stuck
# near rw = 1e-6 when the objective is not multiplied by a factor; of 1, 1e4 and 1e8 the best.
_FACTOR = 1e4


def ours(case: Case, trace: Trace) -> str:
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


def lbfgs(case: Case, trace: Trace) -> str:
    """
    Run torch's L-BFGS with strong Wolfe line search.

    Every point of a line search counts as reached, and the search is started again where it ends.
    """
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


def adam(case: Case, trace: Trace) -> str:
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


def _warm(case: Case) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Return a leaf at the start and the objective in other units, both after a first call."""
    theta = case.theta.clone().requires_grad_(True)
    plain = differentiable(case)

    def objective(at: Tensor) -> Tensor:
        return _FACTOR * plain(at)

    objective(theta).backward()
    return theta, objective


def differentiable(case: Case) -> Callable[[Tensor], Tensor]:
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
