# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimates of a drift from derivatives by total variation, and the level of the noise."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solveh_banded

from koopman_ros.core.datasets import Array, Episode
from koopman_ros.learning.identification.base import (
    DriftEstimate,
    DriftProblem,
    IdentificationMethod,
)
from koopman_ros.learning.identification.drift import Drift, DriftModel
from koopman_ros.learning.identification.weak_form import regress
from koopman_ros.model import Box

# Steps towards the weight, and samples that an episode needs.
_SWEEPS = 30
_BISECTIONS = 14
_SHORTEST = 8


class TotalVariation(IdentificationMethod):
    """Derivatives by total variation, with B of an earlier method taken off."""

    def estimate(self, problem: DriftProblem) -> Sequence[DriftEstimate]:
        """Return one estimate, see :func:`total_variation`."""
        return [DriftEstimate(total_variation(
            problem.episodes, problem.box, problem.degree, problem.B, problem.rough))]


def total_variation(episodes: Sequence[Episode], box: Box, degree: int, B: Array | None,
                    assumed: Array | None) -> DriftModel:
    """
    Fit the drift to derivatives found by total variation on x - integral(B u).

    That difference has no kink where the input steps; its derivative is f(x) alone.
    (Rudin, Osher, Fatemi 1992; Chartrand 2011. Here the variation of the second derivative is
    held down, so that the first one may bend and need not be made of stairs.)

    :param B: (n_x, n_u) scaled, or None to learn it.
    :param assumed: (n_x, n_u) scaled B that is taken off before smoothing; it need not be exact.
    :raises ValueError: when no episode is long enough, or without a B to take off.
    """
    if assumed is None:
        raise ValueError('total variation needs an approximate B: use that of the weak form')
    if assumed.shape[1] != len(box.inputs):
        raise ValueError('total variation needs a constant B: use the weak form')
    shape = DriftModel(box, degree, np.empty(0), assumed)
    features, inputs, rates = [], [], []
    episodes = [episode for episode in episodes if len(episode) >= _SHORTEST]
    shifts = [_moved(episode, box, assumed) for episode in episodes]
    curves = smoothed([(episode.time, box.states.to_deviation(episode.x) - moved)
                       for episode, moved in zip(episodes, shifts, strict=True)])
    for episode, moved, smooth in zip(episodes, shifts, curves, strict=True):
        v = box.inputs.to_deviation(episode.inputs_at(episode.time))
        rate = np.gradient(smooth, episode.time, axis=0, edge_order=2)
        # one-sided differences at the ends are poor
        inner = slice(2, -2)
        features.append(shape.features((smooth + moved)[inner]))
        inputs.append(v[inner])
        rates.append(rate[inner] + v[inner] @ assumed.T)
    if not features:
        raise ValueError(f'no episode has {_SHORTEST} samples: record longer')
    return regress(box, degree, np.concatenate(features), np.concatenate(inputs),
                   np.concatenate(rates), B)


def noise_level(episodes: Sequence[Episode], model: Drift) -> Array:
    """
    Return the standard deviation (n_x,) of the measurement noise, in state units.

    From third differences of x - integral(B u), in which a motion that is well resolved leaves
    nothing but noise. ValueError when no episode is long enough.
    """
    found = []
    # in the middle: kinks of the few steps of an input do not move the median
    B = model.scaled_input_matrix(np.zeros(len(model.box.states)))
    for episode in episodes:
        if len(episode) >= _SHORTEST:
            rest = model.box.states.to_deviation(episode.x) - _moved(episode, model.box, B)
            D = _third_differences(episode.time)
            found.append([_noise(D, rest[:, j]) for j in range(rest.shape[1])])
    if not found:
        raise ValueError(f'no episode has {_SHORTEST} samples: record longer')
    return model.box.states.scale * np.median(np.array(found), axis=0)


def _moved(episode: Episode, box: Box, B: Array) -> Array:
    """Return the integral of B times the input's deviation (N, n_x), in deviations."""
    span = episode.time - episode.time[0]
    center = box.inputs.center
    moved: Array = (episode.input_integral(episode.time) - center * span[:, None]
                    ) / box.inputs.scale @ B.T
    return moved


def _noise(D: Array, y: Array) -> float:
    # the median is not moved by the few places where the motion bends
    return float(np.median(np.abs(_apply(D, y)) / np.sqrt(np.sum(D ** 2, axis=1))) / 0.6745)


def smoothed(records: Sequence[tuple[Array, Array]]) -> list[Array]:
    """
    Smooth signals (N, n) of several times as far as their noise allows.

    min 0.5 ||g - y||^2 + a ||D^3 g||_1 by iterated weights: the l1 trend filter (Kim, Koh, Boyd,
    Gorinevsky 2009), with few bends of the derivative. `a` is such that the part that is removed
    has the size of the noise, which third differences tell (discrepancy principle).
    """
    found = [values.copy() for _, values in records]
    pieces: list[tuple[Array, Array]] = []
    sizes: list[float] = []
    for values, (time, _) in zip(found, records, strict=True):
        D = _third_differences(time)
        for y in values.T:
            size = _noise(D, y)
            if size > 1e-9 * float(np.ptp(y) or 1.0):
                pieces.append((D, y))
                sizes.append(size)
    if not pieces:
        return found
    lengths, noise = np.array([len(y) for _, y in pieces]), np.array(sizes)
    starts = np.cumsum(lengths) - lengths
    # all pieces as one signal, whose differences across the ends of pieces count for nothing
    joined = np.concatenate([y for _, y in pieces])
    D, floor = np.zeros((len(joined) - 3, 4)), np.ones(len(joined) - 3)
    for start, (rows, y) in zip(starts, pieces, strict=True):
        inside = slice(start, start + len(rows))
        D[inside], floor[inside] = rows, 1e-6 * float(np.std(_apply(rows, y)))

    def filtered(weights: Array) -> Array:
        weight, g = np.repeat(weights, lengths)[:-3], joined
        for _ in range(_SWEEPS):
            g = _filter_step(D, weight / np.maximum(np.abs(_apply(D, g)), floor), joined)
        return g

    low, high = np.full(len(noise), -6.0), np.full(len(noise), 8.0)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        removed = np.add.reduceat((filtered(noise * 10.0 ** middle) - joined) ** 2, starts)
        more = np.sqrt(removed / lengths) < noise
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    for (_, y), curve in zip(pieces, np.split(filtered(noise * 10.0 ** low), starts[1:]),
                             strict=True):
        y[:] = curve
    return found


def _filter_step(D: Array, w: Array, y: Array) -> Array:
    """Solve (I + D' W D) g = y, D with rows of four entries."""
    bands = np.zeros((4, len(y)))
    for i in range(4):
        for end in range(i, 4):
            # (D' W D)[k + i, k + end] gathers D[k, i] D[k, end]
            bands[3 - end + i, end:end + len(D)] += w * D[:, i] * D[:, end]
    bands[3] += 1.0
    g: Array = solveh_banded(bands, y, check_finite=False)
    return g


def _third_differences(time: Array) -> Array:
    """Return the rows (N - 3, 4) of third differences, as on an even grid of the mean period."""
    t = time * (len(time) - 1) / (time[-1] - time[0])
    points = np.lib.stride_tricks.sliding_window_view(t, 4)
    rows = np.empty(points.shape)
    for i in range(4):
        rows[:, i] = 6.0 / np.prod(points[:, [i]] - np.delete(points, i, axis=1), axis=1)
    return rows


def _apply(D: Array, y: Array) -> Array:
    return np.einsum('ki,ki->k', D, np.lib.stride_tricks.sliding_window_view(y, 4))
