# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""From an estimated drift to a lift: samples, nominal point, training."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from koopman_ros.identification import (
    DriftModel,
    fitted_starts,
    Identified,
    longest_step,
    Record,
    Stretches,
)
from koopman_ros.learning import Growth, Plant, Samples, train, Trained
from koopman_ros.learning.training import Watch
from koopman_ros.lifting import LiftedModel

Array = NDArray[np.float64]

# More samples of a smooth drift tell nothing new.
_MAX_SAMPLES = 2000
# Cells a state by which samples are spread over the range.
_CELLS = 20
# Parts among which the samples are dealt out.
_SHARES = 10
# The range is that of noisy measurements.
_SLIGHTLY_OUTSIDE = 1.1
# A search that is so far outside does not come back.
_LOST = 1e3


def drift_samples(drift: DriftModel, records: tuple[Record, ...]) -> Samples:
    """
    Sample a drift along the paths that it predicts for some records, free of their noise.

    They are values of one smooth function, free of noise, so that training, choice and figures
    may share the range among them; the plant's own held-out stretches judge the lift.

    :param drift: the estimate.
    :param records: stretches; those that the drift does not follow are left out.
    :raises ValueError: when it follows none.
    """
    stretches = Stretches.of(records, longest_step(records))
    x0, squares = fitted_starts(drift.rate, stretches, drift.box.state_scale)
    followed = np.all(squares < drift.box.state_scale ** 2, axis=1)
    if not np.any(followed):
        raise ValueError('the estimated drift follows none of the records: record longer, with '
                         'steps of the input')
    path = stretches.path(drift.rate, x0)[:-1]
    inside = (stretches.steps > 0.0) & followed
    # stretch by stretch, each in the order of its times
    x, u = (np.swapaxes(a, 0, 1)[inside.T] for a in (path, stretches.u))
    kept = _spread(drift.box.state_deviation(x))
    x, u = x[kept], u[kept]
    return Samples(x, drift.rate(x, u), u, np.arange(len(x)) % _SHARES)


def _spread(xi: Array) -> NDArray[np.int64]:
    """
    Choose samples that fill the range as evenly as they can.

    A plant dwells around some states; a lift learned from all samples would know those best and
    tell its coordinates apart by the few others.

    :param xi: (N, n_x) in [-1, 1].
    :return: rising numbers of the chosen ones.
    """
    low, high = xi.min(axis=0), xi.max(axis=0)
    cell = np.minimum((_CELLS * (xi - low) / (high - low)).astype(int), _CELLS - 1)
    cell = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    # the rank of each sample within its cell, taken evenly along the record
    order = np.argsort(cell, kind='stable')
    sizes = np.bincount(cell)
    quota = _quota(sizes, _MAX_SAMPLES)
    chosen = []
    for rows in np.split(order, np.cumsum(sizes)[:-1]):
        take = min(len(rows), quota)
        chosen.append(rows[np.linspace(0, len(rows) - 1, take).round().astype(int)])
    return np.sort(np.concatenate(chosen))


def _quota(sizes: NDArray[np.int64], total: int) -> int:
    """Return the largest number a cell may give so that all together give at most `total`."""
    low, high = 1, int(np.max(sizes))
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if np.sum(np.minimum(sizes, middle)) <= total else (
            low, middle - 1)
    return low


def steady_point(drift: DriftModel, x: Array, u: Array) -> tuple[Array, Array]:
    """
    Find a state and an input near given ones under which the drift stands still.

    With as many inputs as states the state stays what it is; otherwise both move as little as
    they can, in units of their range.

    :param drift: the estimate.
    :param x: (n_x,) in state units.
    :param u: (n_u,) in input units.
    :raises ValueError: when there is none nearby.
    """
    box = drift.box
    xi, v = box.state_deviation(x), box.input_deviation(u)
    n_x = len(xi)
    held = np.linalg.matrix_rank(drift.B) == n_x
    for _ in range(50):
        rate = drift.scaled_rate(xi, v)
        slope = drift.scaled_slope(xi)
        change = -np.linalg.pinv(np.hstack([0.0 * slope if held else slope, drift.B])) @ rate
        xi, v = xi + change[:n_x], v + change[n_x:]
        # far outside, the polynomial means nothing and overflows at last
        if np.max(np.abs(change)) < 1e-13 or np.max(np.abs(xi)) > _LOST:
            break
    near = np.all(np.abs(xi) <= _SLIGHTLY_OUTSIDE)
    if not (near and np.all(np.abs(drift.scaled_rate(xi, v)) < 1e-9)):
        raise ValueError('no steady state was found within the range of the records: record '
                         'around a state that the plant can hold')
    center = 0.5 * (box.input_lower + box.input_upper)
    return (0.5 * (box.state_lower + box.state_upper) + xi * box.state_scale,
            center + v * box.input_scale)


def learn_lift(found: Identified, like: LiftedModel, n_z: int, *, seed: int, starts: int,
               watch: Watch | None = None) -> Trained:
    """
    Learn a lift of an estimated drift.

    :param found: the estimate with the records that it was fitted to.
    :param like: whose names, units and, where it suits, nominal point are taken over.
    :param n_z: number of coordinates.
    :param seed: of the training.
    :param starts: of each round.
    :param watch: sees the progress and can end it.
    :raises NoUsefulLift: when no lift is better than a linear model.
    :raises ValueError: when the records hold no steady state.
    """
    samples = drift_samples(found.drift, found.fitted)
    lower, upper = samples.x.min(axis=0), samples.x.max(axis=0)
    within = (like.states.center > lower) & (like.states.center < upper)
    x, u = steady_point(found.drift, np.where(within, like.states.center, 0.5 * (lower + upper)),
                        like.inputs.center)
    plant = Plant(like.provenance.plant, like.states.names, like.states.units, like.inputs.names,
                  like.inputs.units, like.time_unit, x, u, found.drift.input_matrix)
    return train(plant, samples, Growth(n_z), seed=seed, starts=starts, watch=watch)
