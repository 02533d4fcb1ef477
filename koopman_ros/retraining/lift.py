# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training of a lift on an estimated drift: samples, nominal point, recipe."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.identification import DriftModel, Identified
from koopman_ros.identification.drift import fitted_starts, longest_step, Segments
from koopman_ros.learning import Growth, train, Trained
from koopman_ros.learning.training import Watch
from koopman_ros.plant_data import Episode, Plant, Samples

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


def drift_samples(drift: DriftModel, episodes: tuple[Episode, ...]) -> Samples:
    """
    Sample a drift along the paths that it predicts for some episodes, free of their noise.

    They are values of one smooth function, free of noise, so that training, choice and figures
    may share the range among them; the plant's own held-out segments judge the lift. Episodes
    that the drift does not follow are left out; ValueError when it follows none.
    """
    segments = Segments.of(episodes, longest_step(episodes))
    x0, squares = fitted_starts(drift.rate, segments, drift.box.states.scale)
    followed = np.all(squares < drift.box.states.scale ** 2, axis=1)
    if not np.any(followed):
        raise ValueError('the estimated drift follows none of the episodes: record longer, with '
                         'steps of the input')
    path = segments.path(drift.rate, x0)[:-1]
    inside = (segments.steps > 0.0) & followed
    # segment by segment, each in the order of its times
    x, u = (np.swapaxes(a, 0, 1)[inside.T] for a in (path, segments.u))
    kept = _spread(drift.box.states.to_deviation(x))
    x, u = x[kept], u[kept]
    return Samples(x, drift.rate(x, u), u, np.arange(len(x)) % _SHARES)


def _spread(xi: Array) -> NDArray[np.int64]:
    """
    Choose samples (N, n_x) that fill the range as evenly as they can; return rising numbers.

    A plant dwells around some states; a lift learned from all samples would know those best and
    tell its coordinates apart by the few others.
    """
    low, high = xi.min(axis=0), xi.max(axis=0)
    cell = np.minimum((_CELLS * (xi - low) / (high - low)).astype(int), _CELLS - 1)
    cell = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    # the rank of each sample within its cell, taken evenly along the episode
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
    they can, in units of their range. ValueError when there is none nearby.

    :param x: (n_x,) in state units.
    :param u: (n_u,) in input units.
    """
    box = drift.box
    xi, v = box.states.to_deviation(x), box.inputs.to_deviation(u)
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
        raise ValueError('no steady state was found within the range of the episodes: record '
                         'around a state that the plant can hold')
    return box.states.to_physical(xi), box.inputs.to_physical(v)


def learn_lift(found: Identified, plant: Plant, n_z: int, *, seed: int, starts: int,
               watch: Watch | None = None) -> Trained:
    """
    Learn a lift of an estimated drift; the arguments are those of :func:`learning.train`.

    :param plant: names, units and, where the episodes surround it, the nominal point.
    :raises NoUsefulLift: when no lift is better than a linear model.
    :raises ValueError: when the episodes hold no steady state.
    """
    samples = drift_samples(found.drift, found.fitted)
    lower, upper = samples.x.min(axis=0), samples.x.max(axis=0)
    within = (plant.nominal_state > lower) & (plant.nominal_state < upper)
    x, u = steady_point(found.drift,
                        np.where(within, plant.nominal_state, 0.5 * (lower + upper)),
                        plant.nominal_input)
    known = replace(plant, nominal_state=x, nominal_input=u, B=found.drift.input_matrix)
    return train(known, samples, Growth(n_z), seed=seed, starts=starts, watch=watch)
