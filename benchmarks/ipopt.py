# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The solver of the paper: casadi with IPOPT and an exact Hessian, from two kinds of graph.

`expanded` is one graph of scalars over all samples, as in the paper; `compiled`, the best
that casadi offers: compiled derivatives of one sample, summed over the samples, and the
Hessian of the whitening term written out. Both take the same steps.
"""

from collections.abc import Callable, Sequence
import os
import shutil
from typing import Any

import casadi
import numpy as np
import torch

from benchmarks.problems import PlanningCase, WHITENING
from benchmarks.solvers import CostTrace

# No stopping tests of its own: the trace ends it. All else are IPOPT's defaults, with MUMPS.
_OPTIONS: dict[str, Any] = {
    'print_time': False, 'ipopt.print_level': 0, 'ipopt.sb': 'yes', 'ipopt.max_iter': 10 ** 9,
    'ipopt.tol': 1e-14, 'ipopt.acceptable_iter': 0, 'ipopt.linear_solver': 'mumps'}
_COMPILER: dict[str, Any] = {'jit': True, 'compiler': 'shell', 'jit_options': {
    'flags': ['-O2', '-march=native', '-ffast-math']}}

Graph = tuple[dict[str, Any], dict[str, Any]]


def expanded(case: PlanningCase, trace: CostTrace) -> str:
    """Run IPOPT on one graph of scalars over all samples."""
    return _solve(case, trace, _expanded_graph)


def compiled(case: PlanningCase, trace: CostTrace) -> str:
    """Run IPOPT on compiled derivatives of one sample, summed over the samples."""
    if shutil.which('gcc') is None:
        raise RuntimeError('there is no C compiler: install gcc')
    return _solve(case, trace, _compiled_graph)


def _solve(case: PlanningCase, trace: CostTrace, build: Callable[[PlanningCase], Graph]) -> str:
    start = os.times()[:4]
    watch = _Watch(case.layout.size, trace)
    problem, derivatives = build(case)
    solver = casadi.nlpsol('solver', 'ipopt', problem,
                           {**_OPTIONS, **derivatives, 'iteration_callback': watch})
    # of this process and of the compiler
    trace.start(sum(os.times()[:4]) - sum(start))
    solver(x0=case.start)
    return str(solver.stats()['return_status'])


class _Watch(casadi.Callback):
    """Show every iterate to the trace, and stop IPOPT when that is done."""

    def __init__(self, size: int, trace: CostTrace) -> None:
        casadi.Callback.__init__(self)
        self._size, self._trace = size, trace
        self.construct('watch', {})

    def get_n_in(self) -> int:
        return int(casadi.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(casadi.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> casadi.Sparsity:
        name = casadi.nlpsol_out(i)
        if name in ('x', 'lam_x'):
            return casadi.Sparsity.dense(self._size)
        return casadi.Sparsity.scalar() if name == 'f' else casadi.Sparsity(0, 0)

    def eval(self, arguments: Sequence[casadi.DM]) -> list[int]:
        theta = torch.from_numpy(np.array(arguments[0]).ravel())
        return [int(self._trace.look(theta))]


def _parameters(case: PlanningCase, theta: casadi.SX) -> list[casadi.SX]:
    """Return W, b, V and A; casadi counts by columns, the layout by rows."""
    return [casadi.reshape(theta[at.start:at.stop], shape[::-1]).T if len(shape) == 2
            else theta[at.start:at.stop]
            for at, shape in zip(case.layout.slices, case.layout.shapes, strict=True)]


def _lift(case: PlanningCase, theta: casadi.SX, x: Any, f: Any) -> tuple[casadi.SX, casadi.SX]:
    """Return z (n_z, n) and the residual of the dynamics (n_z, n) at n samples (n_x, n)."""
    W, b, V, A = _parameters(case, theta)
    n = x.shape[1]
    t = casadi.tanh(casadi.repmat(b, 1, n) + W @ x)
    z = casadi.vertcat(x, V @ (t - casadi.repmat(casadi.tanh(b), 1, n)))
    return z, casadi.vertcat(f, V @ ((1 - t * t) * (W @ f))) - A @ z


def _moments(case: PlanningCase) -> tuple[list[tuple[int, int]], casadi.DM, casadi.DM]:
    """Return the entries of E[z z'] - I that vary, their targets and their weights."""
    layout = case.layout
    entries = [(i, j) for j in range(layout.n_x, layout.n_z) for i in range(j + 1)]
    return (entries, casadi.DM([float(i == j) for i, j in entries]),
            casadi.DM([WHITENING * (1.0 if i == j else 2.0) for i, j in entries]))


def _expanded_graph(case: PlanningCase) -> Graph:
    theta = casadi.SX.sym('theta', case.layout.size)
    N = len(case.x)
    x, f = (casadi.SX(casadi.DM(part.T)) for part in (case.x, case.f))
    z, residual = _lift(case, theta, x, f)
    entries, target, weight = _moments(case)
    moment = z @ z.T / N
    varying = casadi.vertcat(*(moment[i, j] for i, j in entries))
    cost = (0.5 / N * casadi.sumsqr(residual)
            + 0.5 * casadi.dot(weight, (varying - target) ** 2))
    return {'x': theta, 'f': cost}, {}


def _compiled_graph(case: PlanningCase) -> Graph:
    p, n_x, N = case.layout.size, case.layout.n_x, len(case.x)
    theta = casadi.SX.sym('theta', p)
    x, f = casadi.SX.sym('x', n_x), casadi.SX.sym('f', n_x)
    entries, target, weight = _moments(case)
    K = len(entries)
    z, residual = _lift(case, theta, x, f)
    own = 0.5 * casadi.sumsqr(residual)
    moment = casadi.vertcat(*(z[i] * z[j] for i, j in entries))
    multiplier = casadi.SX.sym('multiplier', K)
    hessian = casadi.triu(casadi.hessian(own + casadi.dot(multiplier, moment), theta)[0])

    def mean(name: str, inputs: list[casadi.SX], outputs: list[casadi.SX]) -> Any:
        function = casadi.Function(name, [theta, x, f, *inputs],
                                   [casadi.vec(part) for part in outputs], _COMPILER).map(N)
        data = [casadi.DM(part.T) for part in (case.x, case.f)]

        def call(at: casadi.MX, *more: casadi.MX) -> list[casadi.MX]:
            held = [casadi.repmat(part, 1, N) for part in more]
            values = function(at, *data, *held)
            return [casadi.sum2(part) / N for part in (
                values if isinstance(values, tuple) else (values,))]
        return call

    values = mean('values', [], [own, moment])
    gradients = mean('gradients', [], [own, moment, casadi.gradient(own, theta),
                                       casadi.jacobian(moment, theta)])
    curvature = mean('curvature', [multiplier], [hessian.nz[:]])

    at, none = casadi.MX.sym('at', p), casadi.MX.sym('none', 0)
    value, moments = values(at)
    cost = value + 0.5 * casadi.dot(weight, (moments - target) ** 2)
    _, moments, gradient, rates = gradients(at)
    rates = casadi.reshape(rates, K, p)
    tension = weight * (moments - target)
    total = casadi.MX(hessian.sparsity(), curvature(at, tension)[0]) + casadi.triu(
        rates.T @ casadi.diag(weight) @ rates)
    of_cost, of_constraints = casadi.MX.sym('of_cost'), casadi.MX.sym('of_constraints', 0)
    return {'x': at, 'f': cost}, {
        'grad_f': casadi.Function('nlp_grad_f', [at, none], [cost, gradient + rates.T @ tension],
                                  ['x', 'p'], ['f', 'grad_f_x']),
        'hess_lag': casadi.Function(
            'nlp_hess_l', [at, none, of_cost, of_constraints], [of_cost * total],
            ['x', 'p', 'lam_f', 'lam_g'], ['triu_hess_gamma_x_x'])}
