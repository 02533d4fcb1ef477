# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Sparse convex quadratic programs."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from koopman_ros.core.arrays import Array


def solve_quadratic_program(H: sparse.sparray, g: Array, A: sparse.sparray, C: sparse.sparray,
                            d: Array, *, size: float, accuracy: float = 1e-12,
                            max_iterations: int = 100) -> Array:
    """
    Minimise w' H w / 2 + g' w over w (p,) with A w = 0 and C w <= d, where w = 0 is feasible.

    By the primal-dual interior-point method with predictor and corrector (Mehrotra, 1992), as in
    Nocedal and Wright, *Numerical Optimization*, algorithm 16.4. Each step solves one sparse
    system.

    :param H: (p, p), positive definite where A w = 0.
    :param size: of the cost, to which the accuracy relates; above 0.
    :param accuracy: largest distance of the cost from the least one, as a share of `size`.
    :raises ValueError: when it is not reached.
    """
    m, p = C.shape
    slack = np.maximum(d, 0.1 * np.max(d, initial=0.0))
    # w, the multipliers of A, the slack of C w <= d, and its multipliers
    point = [np.zeros(p), np.zeros(A.shape[0]), slack, size / max(m, 1) / slack]
    left = 1.0  # share of the first residuals of the equations
    for _ in range(max_iterations):
        w, y, slack, z = point
        gap = float(slack @ z)
        if gap <= accuracy * size and left <= accuracy:
            return w
        dual, primal = H @ w + g + C.T @ z + A.T @ y, C @ w + slack - d
        factors = splu(sparse.block_array([
            [H + C.T @ sparse.diags_array(z / slack) @ C, A.T], [A, None]], format='csc'))
        change = [np.zeros_like(values) for values in point]
        centre = 0.0
        for corrected in (False, True):
            product = slack * z - centre + change[2] * change[3]
            solved = factors.solve(np.concatenate([
                C.T @ ((product - z * primal) / slack) - dual, -(A @ w)]))
            ds = -primal - C @ solved[:p]
            change = [solved[:p], solved[p:], ds, -(product + z * ds) / slack]
            length = min(_longest(slack, change[2]), _longest(z, change[3]))
            if m and not corrected:
                after = (slack + length * change[2]) @ (z + length * change[3])
                centre = float(after) ** 3 / gap ** 2 / m
        length = min(1.0, 0.995 * length)
        point = [values + length * step for values, step in zip(point, change, strict=True)]
        left *= 1.0 - length
    raise ValueError(f'the quadratic program is not solved after {max_iterations} iterations: its '
                     f'cost may be {gap:.3g} above the least')


def _longest(values: Array, change: Array) -> float:
    """Return the longest step, at most 1 / 0.995, that leaves values at least 0."""
    falling = change < 0.0
    return float(np.min(-values[falling] / change[falling], initial=1.0 / 0.995))
