# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The least cost of a task under limits, all known: IPOPT on the plant's true equations."""

import casadi
import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.evaluation.optimal_cost import OptimalTrajectory, Task
from studies.equations import Rates, with_cost


def least_course(task: Task, rates: Rates, lower: Array, upper: Array, *,
                 state_upper: Array | None = None, step: Array | None = None,
                 guess: OptimalTrajectory | None = None) -> OptimalTrajectory:
    """
    Find the course of least cost, without noise.

    :param rates: of the plant, as expressions.
    :param lower: (n_u,) range of the inputs, to `upper` (n_u,).
    :param state_upper: (n_x,) limits of the states at the samples, infinite for none.
    :param step: (n_u,) most that an input changes between samples, where there is a limit; the
        first sample then holds the first input of `guess`, as a controller does that receives its
        set-point there.
    :param guess: where to begin.
    :raises RuntimeError: where IPOPT finds none.
    """
    opti, n, n_u = casadi.Opti(), task.system.n_x, task.system.n_u
    u, x = opti.variable(n_u, task.samples), opti.variable(n, task.samples + 1)
    unit = task.system.state_scale
    move = _sample(task, rates).map(task.samples)
    moved = move(unit[:, None] * x[:, :-1], u)
    opti.subject_to(x[:, 1:] == moved[:n, :] / unit[:, None])
    opti.subject_to(x[:, 0] == task.x0 / unit)
    share = np.linspace(0.0, 1.0, task.samples + 1)
    states = (task.x0[:, None] + (task.x_ref - task.x0)[:, None] * share
              if guess is None else guess.states[:task.samples + 1].T)
    inputs = np.tile(task.u_ref[:, None], (1, task.samples)) if guess is None else guess.inputs.T
    for i in range(n_u):
        opti.subject_to(opti.bounded(float(lower[i]), u[i, :], float(upper[i])))
        if step is not None:
            most = float(step[i])
            opti.subject_to(opti.bounded(-most, u[i, 1:] - u[i, :-1], most))
            opti.subject_to(u[i, 0] == float(inputs[i, 0]))
    if state_upper is not None:
        for i in np.flatnonzero(np.isfinite(state_upper)).tolist():
            opti.subject_to(x[i, 1:] <= state_upper[i] / unit[i])
    opti.minimize(casadi.sum2(moved[n, :]))
    opti.set_initial(x, states / unit[:, None])
    opti.set_initial(u, inputs)
    opti.solver('ipopt', {'print_time': False}, {'print_level': 0, 'sb': 'yes', 'tol': 1e-10})
    found = opti.solve()
    return OptimalTrajectory(unit * np.asarray(found.value(x)).T,
                             np.reshape(found.value(u), u.shape).T,
                             float(found.value(opti.f)))


def _sample(task: Task, rates: Rates) -> casadi.Function:
    """Return state and cost (n_x + 1,) after a sample, by Runge-Kutta steps."""
    x0, u = casadi.SX.sym('x', task.system.n_x), casadi.SX.sym('u', task.system.n_u)
    step, y = with_cost(rates, task.Q, task.R, (task.x_ref, task.u_ref)), casadi.vertcat(x0, 0.0)
    for _ in range(task.substeps):
        y = step(y, u, task.period / task.substeps)
    return casadi.Function('sample', [x0, u], [y])
