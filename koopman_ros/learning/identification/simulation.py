# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Simulation of segments: many steps at once by Newton's method, or one after the other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from koopman_ros.core.arrays import Array

# step(rows, x): the states (N, n_x) after steps, of which segment m has number M k + m
Step = Callable[[slice | NDArray[np.int64], Array], Array]

_BLOCK = 500  # steps that are taken at once
_FEW = 64  # most states of all segments for which that is faster
_MOST, _SLOW = 10, 0.1  # Newton steps; share of a change, above which slopes are evaluated again
_DIFFERENCE, _CONVERGED, _LOST = 1e-6, 1e-10, 1e6  # of states, in units of their size
# Of starts: Gauss-Newton steps, differences, and the share of the squares that ends them.
_SEARCHES, _SHIFT, _GAIN = 3, 1e-4, 1e-6


def simulated(step: Step, x0: Array, count: int, scale: Array, guess: Array | None = None
              ) -> Array:
    """
    Return the states (count + 1, M, n_x) from starts (M, n_x), not finite after divergence.

    Of few segments Newton's method solves the equations of many steps together (A. Bellen, M.
    Zennaro, Journal of Computational and Applied Mathematics 25, 1989): a few evaluations of many
    states take a fraction of the time of many evaluations of few. Where it does not converge the
    steps follow each other.

    :param scale: (n_x,) size of the states.
    :param guess: (count + 1, M, n_x) similar states.
    """
    M, path = len(x0), np.empty((count + 1, *x0.shape))
    path[0] = x0
    with np.errstate(all='ignore'):
        for first in range(0, count, _BLOCK):
            last = min(first + _BLOCK, count)
            path[first + 1:last + 1] = path[first] if guess is None else guess[first + 1:last + 1]
            if x0.size > _FEW or not _solved(step, first, path[first:last + 1], scale):
                for k in range(first, last):
                    path[k + 1] = step(slice(M * k, M * (k + 1)), path[k])
    return path


def fitted(errors: Callable[[Array], Array], tried: Array) -> tuple[Array, Array]:
    """
    Return the starts (M, n_x) from which simulations err least, by Gauss-Newton steps.

    :param errors: errors(starts) (S, K, M, n) of simulations from starts (S, M, n_x).
    :param tried: (S, M, n_x) starts, of which the best one of each segment is refined.
    :return: with the sums of their squared errors (M, n), infinite on divergence.
    """
    def best_of(starts: Array) -> tuple[Array, Array, Array]:
        """Return the best of starts for each segment, its squares and its errors (K, M, n)."""
        found = errors(starts)
        squares = np.sum(found ** 2, axis=1)
        squares = np.where(np.isfinite(squares), squares, np.inf)
        chosen = np.argmin(np.sum(squares, axis=-1), axis=0)[None, :, None]
        return (*(np.take_along_axis(one, chosen, axis=0)[0] for one in (starts, squares)),
                np.take_along_axis(found, chosen[:, None], axis=0)[0])

    with np.errstate(all='ignore'):
        best, least, current = best_of(tried)
        shifts = _SHIFT * np.eye(best.shape[1])[:, None]
        for _ in range(_SEARCHES):
            slopes = np.moveaxis(errors(best + shifts) - current, 0, -1) / _SHIFT
            normal = np.einsum('kmij,kmil->mjl', slopes, slopes)
            right = np.einsum('kmij,kmi->mj', slopes, current)
            if not (np.all(np.isfinite(normal)) and np.all(np.isfinite(right))):
                break
            inverse = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
            offer, own, proposed = best_of((best - (inverse @ right[..., None])[..., 0])[None])
            before = np.sum(least, axis=-1)
            better = np.sum(own, axis=-1) < before
            best, least = (np.where(better[:, None], *both) for both in (
                (offer, best), (own, least)))
            current = np.where(better[:, None], proposed, current)
            if np.all(np.sum(least, axis=-1) >= (1.0 - _GAIN) * before):
                break
    return best, least


def _solved(step: Step, first: int, path: Array, scale: Array) -> bool:
    """Move all but the first of states (k + 1, M, n_x) until steps lead from each to the next."""
    (count, M, n_x), before = path[1:].shape, np.inf
    rows = np.arange(M * first, M * (first + count))
    shifts = _DIFFERENCE * np.concatenate((np.zeros((1, n_x)), np.diag(scale)))[:, None, None]
    band = None
    for _ in range(_MOST):
        tried = path[:-1] + (shifts if band is None else shifts[:1])
        found = step(np.tile(rows, len(tried)), tried.reshape(-1, n_x)).reshape(tried.shape)
        if band is None:
            # by segment, step, state and place below the diagonal of the matrix of all equations
            band = np.zeros((M, count, n_x, 2 * n_x))
            for j, change in enumerate((found[0] - found[1:]) / _DIFFERENCE):
                band[:, :-1, j, n_x - j:2 * n_x - j] = change[1:].swapaxes(0, 1) / scale[j]
        changes = dtbtrs(band.reshape(-1, 2 * n_x).T, (found[0] - path[1:]).swapaxes(0, 1).reshape(
            -1, 1), uplo='L', diag='U')[0].reshape(M, count, n_x).swapaxes(0, 1)
        largest = np.max(np.abs(changes) / (scale + np.abs(path[1:])))
        if not largest < _LOST:
            return False
        path[1:] += changes
        if largest < _CONVERGED:
            return True
        if largest > _SLOW * before:
            band = None
        before = largest
    return False
