# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The least cost of a case's step under its limits, all known: IPOPT on the true equations."""

import casadi
import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.plants.optimum import Course, Task
from validation.equations import EQUATIONS
from validation.partly_measured.cases import Case


def least_course(case: Case, x0: Array) -> Course:
    """
    Find the course of least cost of the step of the set-point from a state (n_x,), without noise.

    Limits of the states hold at the samples.

    :raises RuntimeError: where IPOPT finds none.
    """
    task, n = case.task(x0), case.system.n_x
    opti = casadi.Opti()
    u, x = opti.variable(case.system.n_u, task.samples), opti.variable(n, task.samples + 1)
    unit = case.system.state_scale
    move = _sample(case, task).map(task.samples)
    moved = move(unit[:, None] * x[:, :-1], u)
    opti.subject_to(x[:, 1:] == moved[:n, :] / unit[:, None])
    opti.subject_to(x[:, 0] == task.x0 / unit)
    for i in range(len(case.lower)):
        opti.subject_to(opti.bounded(float(case.lower[i]), u[i, :], float(case.upper[i])))
    for i in np.flatnonzero(np.isfinite(case.state_upper)).tolist():
        opti.subject_to(x[i, 1:] <= case.state_upper[i] / unit[i])
    opti.minimize(casadi.sum2(moved[n, :]))
    share = np.linspace(0.0, 1.0, task.samples + 1)
    opti.set_initial(x, (task.x0[:, None] + (task.x_ref - task.x0)[:, None] * share)
                     / unit[:, None])
    opti.set_initial(u, np.tile(task.u_ref[:, None], (1, task.samples)))
    opti.solver('ipopt', {'print_time': False}, {'print_level': 0, 'sb': 'yes', 'tol': 1e-10})
    found = opti.solve()
    return Course(unit * np.asarray(found.value(x)).T, np.reshape(found.value(u), u.shape).T,
                  float(found.value(opti.f)))


def _sample(case: Case, task: Task) -> casadi.Function:
    """Return state and cost (n_x + 1,) after a sample, by Runge-Kutta steps."""
    x0, u = casadi.SX.sym('x', case.system.n_x), casadi.SX.sym('u', case.system.n_u)

    def rate(y: casadi.SX) -> casadi.SX:
        e, v = y[:-1] - task.x_ref, u - task.u_ref
        return casadi.vertcat(EQUATIONS[case.plant](y[:-1], u),
                              casadi.dot(task.Q * e, e) + casadi.dot(task.R * v, v))

    y, h = casadi.vertcat(x0, 0.0), task.period / task.substeps
    for _ in range(task.substeps):
        k1 = rate(y)
        k2 = rate(y + 0.5 * h * k1)
        k3 = rate(y + 0.5 * h * k2)
        y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(y + h * k3))
    return casadi.Function('sample', [x0, u], [y])
