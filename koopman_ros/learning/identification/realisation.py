# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Linear models of an order with the measured signals as first states, from a record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import null_space, solve_discrete_lyapunov

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.learning.identification.dead_time import LinearModels, Sampled

# Time constants shorter than this share of an interval between samples are not resolved.
_SHORTEST = 0.5
_SLIGHT = 1e-12  # share of a Gramian that keeps it positive


def realised(episodes: Sequence[Episode], period: float, n_x: int
             ) -> tuple[Array, Array, Array] | None:
    """
    Return A (n_x, n_x), B (n_x, n_u) and c of dx/dt = A x + B u + c whose first states are y.

    Linear models of single outputs, see :func:`find_dead_times`, side by side; balanced truncation
    (Moore 1981) leaves the requested number of states.

    :param period: between samples, in time units.
    :param n_x: states, at least as many as outputs.
    :return: None where no stable model is found.
    """
    n_y = episodes[0].x.shape[1]
    order = min(n_x, 1 - (-n_x // n_y))
    data = [Sampled.of(episode, period, 0) for episode in episodes if len(episode) > 10 * order]
    found = LinearModels(data, order, n_y).state_space() if data else None
    if found is None:
        return None
    A, B, C = found
    try:
        rest = C @ np.linalg.solve(np.eye(len(A)) - A, B[:, -1])  # outputs without input
        A, B, C = _truncated(A, B[:, :-1], C, n_x)
        T = np.vstack((C, null_space(C).T))
        A, B = _continuous(np.linalg.solve(T.T, (T @ A).T).T, T @ B, period)
    except (ValueError, np.linalg.LinAlgError):
        return None
    c = -A[:, :n_y] @ rest
    return (A, B, c) if np.all(np.isfinite(A)) and np.all(np.isfinite(B)) else None


def _truncated(A: Array, B: Array, C: Array, n_x: int) -> tuple[Array, Array, Array]:
    """Return the states that inputs move and outputs show most."""
    if len(A) == n_x:
        return A, B, C
    # by Schur forms: the equations of all entries are singular to rounding where modes are slow
    left, right = (np.linalg.cholesky(W + _SLIGHT * np.trace(W) * np.eye(len(W))) for W in (
        solve_discrete_lyapunov(F, Q, method='bilinear')
        for F, Q in ((A, B @ B.T), (A.T, C.T @ C))))
    U, sizes, V = np.linalg.svd(right.T @ left)
    root = np.sqrt(sizes[:n_x])
    out, back = left @ V[:n_x].T / root, (U[:, :n_x] / root).T @ right.T
    return back @ A @ out, back @ B, C @ out


def _continuous(A: Array, B: Array, period: float) -> tuple[Array, Array]:
    """Return the rates of a model whose inputs are held over a period; gains are kept."""
    poles, V = np.linalg.eig(A)
    size = np.maximum(np.abs(poles), np.exp(-1.0 / _SHORTEST))
    # a negative pole changes sign from sample to sample, which no held input causes
    angle = np.where((poles.imag == 0.0), 0.0, np.angle(poles))
    rates = (np.log(size) + 1j * angle) / period
    modes = np.linalg.solve(V, B.astype(complex)) * (rates / (poles - 1.0))[:, None]
    return np.real(V * rates @ np.linalg.inv(V)), np.real(V @ modes)
