# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Multiple shooting of a plan: its course linearised, condensed to the inputs, and its cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.lifting import LiftedModel


@dataclass(frozen=True, slots=True)
class Horizon:
    """What a plan of one sample goes by; all in scaled deviations and the model's time unit."""

    start: Array  #: (n_x,) where it begins
    w: Array  #: (n_x,) disturbance of the state's rate
    x_ref: Array  #: (n_x,) where it goes to
    u_ref: Array  #: (n_u,) what holds it there
    lengths: Array  #: (N,) of the intervals
    steps: int  #: m, of the integration in an interval
    Q: Array  #: (n_x, n_x) weight of the state's error
    R: Array  #: (n_u, n_u) and of the input's
    terminal: Array  #: (n_x, n_x) cost of the error at the end


@dataclass(frozen=True, slots=True)
class Program:
    """The cost of a change v (N n_u,) of a plan's inputs, v' H v / 2 + f' v, and what moves."""

    nodes: Array  #: (N + 1, n_x) without a change, and without the gaps of the plan's own nodes
    by_inputs: Array  #: (N + 1, n_x, N n_u) their derivative by the inputs
    H: Array  #: (N n_u, N n_u) symmetric
    f: Array  #: (N n_u,)


def slope_at(model: LiftedModel, x: Array) -> Array:
    """Return the Jacobian (n_x, n_x) of the drift at a state (n_x,)."""
    return model.drift_and_jacobian(x)[1]


def program(model: LiftedModel, horizon: Horizon, u: Array, x: Array) -> Program | None:
    """
    Set up the program about a course of inputs (N, n_u) and nodes (N + 1, n_x).

    :return: None where the course is not finite.
    """
    course = _course(model, horizon, u, x[:-1])
    if not np.isfinite(course.by_state).all() or not np.isfinite(course.states).all():
        return None
    nodes, by_inputs = _condensed(course, x, horizon.start)
    return Program(nodes, by_inputs, *_cost(horizon, course, x, u, nodes, by_inputs))


@dataclass(frozen=True)
class _Course:
    """How the plant goes from nodes (N, n_x) under inputs (N, n_u), each held for an interval."""

    #: (N, 2 m + 1, n_x) the state from the beginning of each interval to its end, in m steps
    states: Array
    by_state: Array  #: (N, 2 m + 1, n_x, n_x) its derivative by the node
    by_input: Array  #: (N, 2 m + 1, n_x, n_u) and by the input


def _course(model: LiftedModel, horizon: Horizon, u: Array, nodes: Array) -> _Course:
    n, m = model.n_x, horizon.steps
    h = (horizon.lengths / m)[:, None]
    x, S = nodes, np.zeros((len(u), n, n + model.n_u))
    S[:, :, :n] = np.eye(n)
    forced = np.zeros_like(S)

    def rates(x: Array, S: Array) -> tuple[Array, Array]:
        f, J = model.drift_and_jacobian(x)
        forced[:, :, n:] = model.input_matrix(x)
        if model.input_terms is not None:
            J = J + model.forcing_jacobian(x, u)
        return f + model.forcing(x, u) + horizon.w, J @ S + forced

    states, slopes = [x], [S]
    H = h[..., None]
    for _ in range(m):
        k1, s1 = rates(x, S)
        k2, s2 = rates(x + 0.5 * h * k1, S + 0.5 * H * s1)
        k3, s3 = rates(x + 0.5 * h * k2, S + 0.5 * H * s2)
        k4, s4 = rates(x + h * k3, S + H * s3)
        ahead = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        turned = S + H / 6.0 * (s1 + 2.0 * s2 + 2.0 * s3 + s4)
        # the middle by the rates at both ends (Hermite), for Simpson's rule
        states += [0.5 * (x + ahead) + 0.125 * h * (k1 - k4), ahead]
        slopes += [0.5 * (S + turned) + 0.125 * H * (s1 - s4), turned]
        x, S = ahead, turned
    every = np.stack(slopes, axis=1)
    return _Course(np.stack(states, axis=1), every[..., :n], every[..., n:])


def _condensed(course: _Course, x: Array, start: Array) -> tuple[Array, Array]:
    """
    Return the nodes (N + 1, n_x) of the linearised course, and their derivative by the inputs.

    The latter is (N + 1, n_x, N n_u). The nodes are those from `start` on, without the gaps that
    the course has at its own nodes x (N + 1, n_x).
    """
    N, _, n, n_u = course.by_input.shape
    nodes, by_inputs = np.empty((N + 1, n)), np.zeros((N + 1, n, N * n_u))
    nodes[0] = start
    ends, A, B = course.states[:, -1], course.by_state[:, -1], course.by_input[:, -1]
    for k in range(N):
        nodes[k + 1] = ends[k] + A[k].dot(nodes[k] - x[k])
        width = k * n_u
        by_inputs[k + 1, :, :width] = A[k].dot(by_inputs[k, :, :width])
        by_inputs[k + 1, :, width:width + n_u] = B[k]
    return nodes, by_inputs


def _cost(horizon: Horizon, course: _Course, x: Array, u: Array, nodes: Array, by_inputs: Array
          ) -> tuple[Array, Array]:
    """Return H and f of the cost v' H v / 2 + f' v of a change v (N n_u,) of the inputs."""
    (N, points), n_u, lengths = course.states.shape[:2], u.shape[1], horizon.lengths
    # of each point, as if the inputs stayed, and how it changes with all of them
    error = course.states + (course.by_state @ (nodes[:-1] - x[:-1])[:, None, :, None])[
        ..., 0] - horizon.x_ref
    slope = course.by_state @ by_inputs[:-1, None]
    for k in range(N):
        slope[k, :, :, k * n_u:(k + 1) * n_u] += course.by_input[k]
    simpson = np.full(points, 2.0)
    simpson[1::2] = 4.0
    simpson[[0, -1]] = 1.0
    share = (lengths[:, None] * simpson / (3.0 * (points - 1)))[..., None]
    G, weighted = slope.reshape(-1, N * n_u), (share * (error @ horizon.Q)).reshape(-1)
    GQ = (share[..., None] * (horizon.Q @ slope)).reshape(-1, N * n_u)
    end, last = by_inputs[-1], nodes[-1] - horizon.x_ref
    H = G.T @ GQ + end.T @ horizon.terminal @ end
    f = G.T @ weighted + end.T @ (horizon.terminal @ last)
    for k in range(N):
        own = slice(k * n_u, (k + 1) * n_u)
        H[own, own] += lengths[k] * horizon.R
    f += (lengths[:, None] * ((u - horizon.u_ref) @ horizon.R)).reshape(-1)
    return np.ascontiguousarray(0.5 * (H + H.T)), f
