# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Model predictive control by casadi's SQP, as generated C where there is a compiler."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
import subprocess
from typing import Any

import casadi
import numpy as np

from koopman_ros.core.arrays import Array
from studies.equations import Rates, with_cost

# Its own solver of quadratic programs can be generated as C together with the rest.
_OPTIONS: dict[str, Any] = {
    'qpsol': 'qrqp', 'max_iter': 10, 'tol_du': 1e-4, 'tol_pr': 1e-5,
    'convexify_strategy': 'regularize', 'error_on_fail': False, 'print_header': False,
    'print_iteration': False, 'print_status': False, 'print_time': False,
    'qpsol_options': {'error_on_fail': False, 'print_iter': False, 'print_header': False,
                      'print_info': False}}


@dataclass(frozen=True, eq=False)
class SqpProblem:
    """The problem of each sample: the least cost of the way to a target."""

    rates: Rates  #: of the state, per time unit
    lengths: Array  #: (N,) of the intervals, in time units, each with one input
    Q: Array  #: (n_x,) weights of squared state errors
    R: Array  #: (n_u,) of squared input deviations
    P: Array  #: (n_x, n_x) cost to go from the end on
    lower: Array  #: (n_u,) range of the inputs, to `upper` (n_u,)
    upper: Array
    scale: tuple[Array, Array]  #: (n_x,) and (n_u,), of the size of states and inputs


class Sqp:
    """Multiple shooting, a Runge-Kutta step an interval; each plan begins with the one before."""

    def __init__(self, problem: SqpProblem, solver: Any) -> None:
        """Plan by the result of :func:`solver_of`, without a start."""
        self._problem, self._solver = problem, solver
        n, n_u = (len(scale) for scale in problem.scale)
        self._n, self._size = n, n + n_u
        free, count = np.full(n, np.inf), len(problem.lengths)
        self._bounds = [np.concatenate([*([side * free, bound / problem.scale[1]] * count),
                                        side * free])
                        for side, bound in ((-1.0, problem.lower), (1.0, problem.upper))]
        self._plan: Array | None = None
        self._multipliers: dict[str, Any] = {}

    def step(self, x: Array, x_ref: Array, u_ref: Array) -> Array:
        """Return the first input (n_u,) of the plan from a state (n_x,) to a target."""
        unit, unit_u = self._problem.scale
        if self._plan is None:
            share = np.linspace(0.0, 1.0, len(self._problem.lengths) + 1)[:, None]
            nodes = (x + share * (x_ref - x)) / unit
            self._plan = np.column_stack(
                [nodes, np.tile(u_ref / unit_u, (len(nodes), 1))]).ravel()[:-len(u_ref)]
        found = self._solver(
            x0=self._plan, p=np.concatenate((x, x_ref, u_ref)), lbg=0.0, ubg=0.0,
            lbx=self._bounds[0], ubx=self._bounds[1], **self._multipliers)
        plan = np.asarray(found['x']).ravel()
        self._multipliers = {'lam_x0': found['lam_x'], 'lam_g0': found['lam_g']}
        # an interval later: the first ones are a sample long
        self._plan = np.concatenate((plan[self._size:], plan[-self._size:]))
        return np.asarray(plan[self._n:self._size] * unit_u)


def solver_of(problem: SqpProblem, folder: Path | None = None, compiler: str | None = None) -> Any:
    """
    Return the solver of a problem: generated C, its quadratic programs in it, if compiled.

    :param folder: for the generated code.
    :param compiler: command of a C compiler; None for casadi's virtual machine.
    """
    solver = casadi.nlpsol('sqp', 'sqpmethod', _program(problem), _OPTIONS)
    if compiler is None or folder is None:
        return solver
    with contextlib.chdir(folder):
        solver.generate('sqp.c')
    library = folder / 'sqp.so'
    # more is not quicker here, and takes minutes
    subprocess.run([compiler, '-O1', '-fPIC', '-shared', folder / 'sqp.c', '-o', library, '-lm'],
                   check=True)
    return casadi.external('sqp', str(library))


def _program(problem: SqpProblem) -> dict[str, Any]:
    unit, unit_u = problem.scale
    n, n_u = len(unit), len(unit_u)
    given = casadi.SX.sym('given', 2 * n + n_u)
    x_now, x_ref, u_ref = given[:n], given[n:2 * n], given[2 * n:]
    step = with_cost(problem.rates, problem.Q, problem.R, (x_ref, u_ref))
    nodes = casadi.SX.sym('x', n, len(problem.lengths) + 1)
    inputs = casadi.SX.sym('u', n_u, len(problem.lengths))
    cost, rest, variables = 0.0, [(unit * nodes[:, 0] - x_now) / unit], []
    for k, h in enumerate(problem.lengths.tolist()):
        y = step(casadi.vertcat(unit * nodes[:, k], 0.0), unit_u * inputs[:, k], h)
        cost += y[n]
        rest.append(y[:n] / unit - nodes[:, k + 1])
        variables += [nodes[:, k], inputs[:, k]]
    e = unit * nodes[:, -1] - x_ref
    return {'x': casadi.vertcat(*variables, nodes[:, -1]), 'p': given,
            'f': cost + e.T @ problem.P @ e, 'g': casadi.vertcat(*rest)}
