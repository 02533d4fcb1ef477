# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The least cost of moving a plant, on its true equations, to measure controllers by."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from scipy import sparse

from koopman_ros.core.arrays import Array
from koopman_ros.core.declaration import UNBOUNDED
from koopman_ros.core.integration import integrate
from koopman_ros.core.quadratic_program import solve_quadratic_program
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.core.steady_state import Goal, steady_state
from koopman_ros.plants.system import ControlAffineSystem
from koopman_ros.tuning import InputLimits

_MAX_ITERATIONS = 200
_SHORTEST_STEP = 2.0 ** -20


@dataclass(frozen=True, eq=False)
class Task:
    """Moving a plant to a set-point, its input held between samples."""

    system: ControlAffineSystem  #: the plant
    x0: Array  #: (n_x,) start
    x_ref: Array  #: (n_x,) set-point; only its weighted states count
    u_ref: Array  #: (n_u,) input that holds it, from which the cost counts
    Q: Array  #: (n_x,) weights of squared state errors
    R: Array  #: (n_u,) weights of squared input deviations, above 0
    period: float  #: of the samples, in time units
    samples: int  #: how many there are
    substeps: int = 4  #: Runge-Kutta steps in a period


@dataclass(frozen=True, eq=False)
class OptimalTrajectory:
    """The trajectory of a plant in a task."""

    states: Array  #: (samples + 1, n_x)
    inputs: Array  #: (samples, n_u), each held for a period
    cost: float  #: integral of e' Q e + v' R v; infinite where the plant escaped


def cost_along(task: Task, states: Array, inputs: Array) -> float:
    """
    Return the cost of a trajectory: states (N + 1 or N, n_x) and inputs (N, n_u) held.

    Each sample is integrated from its own state, so that nothing adds up on an unstable plant.
    """
    y = np.concatenate([states[:len(inputs)], np.zeros((len(inputs), 1))], axis=1)
    return float(np.sum(_after_a_period(task, y, inputs)[:, -1]))


def linear_law(task: Task, limits: InputLimits | None = None,
               before: Array | None = None) -> OptimalTrajectory:
    """
    Apply the linear-quadratic law of the plant linearised at its nominal point.

    Its feed-forward is its own: the input that, to the linearised plant, holds the weighted
    states at the set-point.

    :param limits: of the inputs; none by default.
    :param before: (n_u,) input before the start, from which the rate counts; by default nominal.
    """
    system = task.system
    A, weighted = system.slope(system.nominal_state, system.nominal_input), task.Q > 0.0
    B = system.input_matrix(system.nominal_state)
    n, unit = system.n_x, np.concatenate([system.state_scale, np.where(
        system.nominal_input != 0.0, np.abs(system.nominal_input), 1.0)])
    J = np.hstack([A, B]) * unit / unit[:n, None]
    endless, places = np.full(len(unit), np.inf), np.flatnonzero(weighted)
    y = steady_state(lambda y: J @ y, lambda y: J, np.zeros(len(unit)), -endless, endless, Goal(
        places, ((task.x_ref - system.nominal_state) / unit[:n])[places]))
    assert y is not None  # the nominal point is one
    x, u = np.split(y * unit, [n])
    K = solve_riccati(A, B, np.diag(task.Q), np.diag(task.R)).K
    return _constant_law(task, system.nominal_input + u, K, system.nominal_state + x, limits,
                         system.nominal_input if before is None else before)


def _largest_change(task: Task, limits: InputLimits) -> Array:
    """Return by how much each input (n_u,) may change from sample to sample."""
    return limits.rate * task.period * task.system.seconds_per_time_unit


def _limited(task: Task, u: Array, last: Array, limits: InputLimits) -> Array:
    """Return the inputs nearest to u that keep the range, and the rate after the last ones."""
    change = _largest_change(task, limits)
    return limits.within(np.minimum(np.maximum(u, last - change), last + change))


def optimum(task: Task, limits: InputLimits | None = None, before: Array | None = None
            ) -> OptimalTrajectory:
    """
    Find the inputs of least cost by the iterated linear-quadratic regulator (Gauss-Newton).

    It begins with the linear-quadratic law at the set-point, so that an unstable plant stays with
    it from the first step on. With limits each iteration solves a quadratic program, whose
    solution keeps them.

    :param limits: of the inputs; none by default.
    :param before: (n_u,) input before the start, from which the rate counts; by default nominal.
    :raises ValueError: when that law loses the plant, or the iteration does not end.
    """
    system = task.system
    riccati = solve_riccati(system.slope(task.x_ref, task.u_ref), system.input_matrix(task.x_ref),
                            np.diag(task.Q), np.diag(task.R))
    K = riccati.K if riccati.solved else np.zeros_like(riccati.K)
    before = system.nominal_input if before is None else before
    trajectory = _constant_law(task, task.u_ref, K, task.x_ref, limits, before)
    if not math.isfinite(trajectory.cost):
        raise ValueError(f'{system.name}: the linear law does not stabilise the plant from '
                         f'{system.describe_state(task.x0)}: start nearer to the set-point')
    for _ in range(_MAX_ITERATIONS):
        change, gains, gain = _improvement(task, trajectory, limits, before)
        if gain <= 1e-10 * trajectory.cost:
            return trajectory
        length, better = 1.0, trajectory
        while better.cost >= trajectory.cost and length >= _SHORTEST_STEP:
            better = _roll_out(task, trajectory.inputs + length * change, gains,
                               trajectory.states, limits, before)
            length *= 0.5
        if better.cost >= trajectory.cost:
            break
        trajectory = better
    raise ValueError(f'{system.name}: no optimum found: the cost is {trajectory.cost:.6g} and '
                     f'could still fall by {gain:.3g}; shorten the horizon or the period')


def _constant_law(task: Task, u: Array, K: Array, x: Array, limits: InputLimits | None = None,
                  before: Array | None = None) -> OptimalTrajectory:
    return _roll_out(task, np.tile(u, (task.samples, 1)), np.tile(K, (task.samples, 1, 1)),
                     np.tile(x, (task.samples, 1)), limits, before)


def _roll_out(task: Task, inputs: Array, K: Array, about: Array,
              limits: InputLimits | None = None, before: Array | None = None
              ) -> OptimalTrajectory:
    """Apply inputs[k] - K[k] (x - about[k]): (N, n_u), (N, n_u, n_x) and (N or more, n_x)."""
    states, applied = np.empty((len(inputs) + 1, task.system.n_x)), np.empty_like(inputs)
    y = np.append(task.x0, 0.0)
    with np.errstate(all='ignore'):
        for k, u in enumerate(inputs):
            states[k] = y[:-1]
            applied[k] = u - K[k].dot(states[k] - about[k])
            if limits is not None and before is not None:
                applied[k] = before = _limited(task, applied[k], before, limits)
            y = _after_a_period(task, y, applied[k])
    states[-1] = y[:-1]
    return OptimalTrajectory(states, applied, float(y[-1]) if np.all(np.isfinite(y)) else math.inf)


def _after_a_period(task: Task, y: Array, u: Array) -> Array:
    """Return states with the cost so far (..., n_x + 1) a period later, u (..., n_u) held."""
    system, effort = task.system, (u - task.u_ref) ** 2 @ task.R
    held = None if callable(system.B) else system.forcing(y[..., :-1], u)

    def rate(y: Array) -> Array:
        x, found = y[..., :-1], np.empty_like(y)
        found[..., :-1] = system.drift(x) + (system.forcing(x, u) if held is None else held)
        found[..., -1] = (x - task.x_ref) ** 2 @ task.Q + effort
        return found

    return integrate(rate, y, task.period, task.substeps)


def _improvement(task: Task, trajectory: OptimalTrajectory, limits: InputLimits | None,
                 before: Array) -> tuple[Array, Array, float]:
    """Return a change of the inputs, its gains (N, n_u, n_x), and how far the cost would fall."""
    n = task.system.n_x
    F, g, H = _expansion(task, trajectory)
    change, gains = np.empty_like(trajectory.inputs), np.empty((len(F), task.system.n_u, n))
    slope, curvature, gain = np.zeros(n), np.zeros((n, n)), 0.0
    for k in reversed(range(len(F))):
        h = g[k] + F[k].T @ slope
        W = H[k] + F[k].T @ curvature @ F[k]
        solved = np.linalg.solve(W[n:, n:], np.column_stack([h[n:], W[n:, :n]]))
        change[k], gains[k] = -solved[:, 0], solved[:, 1:]
        gain += 0.5 * float(h[n:] @ solved[:, 0])
        slope = h[:n] - W[:n, n:] @ solved[:, 0]
        curvature = W[:n, :n] - W[:n, n:] @ gains[k]
    if limits is None:
        return change, gains, gain
    w = _within_limits(task, (F, g, H), trajectory, limits, before)
    gain = -float(np.sum(g * w) + 0.5 * np.einsum('ki,kij,kj->', w, H, w))
    # what the gains add to the inputs at the new states is part of w
    return w[:, n:] + np.einsum('kij,kj->ki', gains, w[:, :n]), gains, gain


def _within_limits(task: Task, expansion: tuple[Array, Array, Array],
                   trajectory: OptimalTrajectory, limits: InputLimits, before: Array) -> Array:
    """Return the best changes (N, n_x + n_u) of states and inputs that keep the limits."""
    F, g, H = expansion
    N, n, p = F.shape
    at, begins = np.arange(N), np.arange(N + 1)
    late = np.maximum(begins - 1, 0)

    def blocks(block: Array) -> sparse.bsr_array:
        """Return a matrix with the same block for each sample."""
        return sparse.bsr_array((np.tile(block, (N, 1, 1)), at, begins))

    states, inputs = (blocks(rows) for rows in np.split(np.eye(p), [n]))
    followed = sparse.bsr_array((F[:-1], at[:-1], late), shape=states.shape)
    changes = inputs - sparse.bsr_array(
        (np.tile(np.eye(p)[n:], (N - 1, 1, 1)), at[:-1], late), shape=inputs.shape)
    u, last = trajectory.inputs, np.vstack([before, trajectory.inputs[:-1]])
    change = _largest_change(task, limits)
    room = np.concatenate([one.ravel() for one in (
        limits.upper - u, u - limits.lower, change - (u - last), change + (u - last))])
    kept = room < UNBOUNDED
    C = sparse.vstack([inputs, -inputs, changes, -changes], format='csr')[kept]
    return solve_quadratic_program(
        sparse.bsr_array((H, at, begins)), g.ravel(), states - followed, C,
        np.maximum(room[kept], 0.0), size=trajectory.cost).reshape(N, p)


def _expansion(task: Task, trajectory: OptimalTrajectory) -> tuple[Array, Array, Array]:
    """
    Expand all samples at once by state and input at their beginning, p = n_x + n_u in number.

    :return: of the state at the end its slope (N, n_x, p), of the cost on the way its slope
        (N, p) and the curvature (N, p, p) that the plant's own curvature has no part in.
    """
    system = task.system
    n, N = system.n_x, task.samples
    p = n + system.n_u
    effort = np.concatenate([np.zeros((N, n)), 2.0 * task.R * (trajectory.inputs - task.u_ref)], 1)
    weight = np.diag(np.concatenate([np.zeros(n), 2.0 * task.R]))
    from_input = np.eye(p)[n:]
    ends = np.cumsum([n, n * p, p, p * p])

    def rate(y: Array) -> Array:
        x, F = y[:, :n], y[:, ends[0]:ends[1]].reshape(N, n, p)
        QF = 2.0 * task.Q[:, None] * F
        return np.concatenate([part.reshape(N, -1) for part in (
            system.derivative(x, trajectory.inputs),
            system.slope(x, trajectory.inputs) @ F + system.input_matrix(x) @ from_input,
            np.einsum('kip,ki->kp', QF, x - task.x_ref) + effort,
            F.transpose(0, 2, 1) @ QF + weight)], axis=1)

    y = np.zeros((N, ends[-1]))
    y[:, :n] = trajectory.states[:-1]
    y[:, n:ends[1]] = np.eye(n, p).ravel()
    y = integrate(rate, y, task.period, task.substeps)
    return (y[:, ends[0]:ends[1]].reshape(N, n, p), y[:, ends[1]:ends[2]],
            y[:, ends[2]:].reshape(N, p, p))
