# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Likely causes of an error that is not noise, with the parameters that would try them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.learning.identification import fitted_starts, Identified, longest_step, Segments

# Of the mean squared error that a cause must explain, in segments that it was not fitted to.
_EXPLAINED = 0.2
_DELAYS = (1, 2, 4, 8)  # samples by which an input might act later
_MEMORIES = (3, 12, 48)  # samples of filters whose states may be like the unmeasured ones


def likely_causes(found: Identified, i: int) -> list[tuple[float, str]]:
    """
    Return the likely causes of the errors of a measured state, likeliest first.

    The errors of the drift in each segment are regressed on the response of a linear state with
    the drift's slope to the rate due to each cause that was not searched for: inputs that act
    later, or change between samples, products of inputs and states, filtered inputs.

    :param i: number of the state.
    :return: the explained share of the mean square, cross-validated over the segments, and the
        parameter that would try the cause.
    """
    episodes = [*found.fitted, *found.held_out]
    segments = Segments.of(episodes, longest_step(episodes))
    box, rate = found.drift.box, found.drift.rate
    starts = fitted_starts(rate, segments, box.states.scale)[0]
    errors = -segments.errors(rate, starts)[..., i] / box.states.scale[i]
    slope = float(found.drift.scaled_slope(np.zeros(len(box.states)))[i, i])
    causes = _causes(found, episodes)
    shares = []
    for parameter, columns in causes.items():
        explained = _cross_validated([
            (errors[rows, j], _responses(episode, one, min(slope, 0.0)))
            for j, (episode, one) in enumerate(zip(episodes, columns, strict=True))
            if len(rows := np.flatnonzero(segments.measured[:, j, i])) == len(episode)])
        if explained > _EXPLAINED:
            shares.append((explained, parameter))
    return sorted(shares, reverse=True)


def _causes(found: Identified, episodes: Sequence[Episode]) -> dict[str, list[Array]]:
    """Return terms of the rate due to each cause, (N, p) at the samples of each episode."""
    box = found.drift.box
    causes: dict[str, list[Array]] = {}
    for episode in episodes:
        period = float(np.median(np.diff(episode.time)))
        xi = box.states.to_deviation(episode.interpolated())
        v = box.inputs.to_deviation(episode.inputs_at(episode.time))
        late = np.array([box.inputs.to_deviation(episode.inputs_at(np.maximum(
            episode.time - count * period, episode.input_time[0]))) - v for count in _DELAYS])
        early = np.vstack((v[1:], v[-1:])) - v
        for j, name in enumerate(box.inputs.names):
            causes.setdefault(f'dead_time of {name}', []).append(late[..., j].T)
            # one may be measured in some episodes alone
            held = not any(episode.linear[j:j + 1])
            causes.setdefault(f'linear for {name}', []).append(held * early[:, [j]])
        if not (found.constants or found.hidden or found.drift.varying_input_matrix
                or 'input_matrix_degree' in found.searched):
            causes.setdefault('input_matrix_degree', []).append(
                (xi[:, :, None] * v[:, None]).reshape(len(xi), -1))
        if not (found.constants or 'unmeasured_states' in found.searched):
            # past states would also contain the effects of disturbances
            causes.setdefault('unmeasured_states', []).append(np.hstack([
                _filtered(episode.time, v, -1.0 / (count * period)) / (count * period)
                for count in _MEMORIES]))
    return causes


def _filtered(time: Array, g: Array, slope: float) -> Array:
    """Return s (N, p) with ds/dt = slope s + g, from 0, for g (N, p) held between samples."""
    s = np.zeros_like(g)
    for k, h in enumerate(np.diff(time)):
        decay = np.exp(slope * h)
        s[k + 1] = decay * s[k] + (h if slope == 0.0 else (decay - 1.0) / slope) * g[k]
    return s


def _responses(episode: Episode, g: Array, slope: float) -> Array:
    """Return the responses to causes, and those to a start and to a constant."""
    time = episode.time - episode.time[0]
    constant = _filtered(time, np.ones((len(time), 1)), slope)
    return np.hstack([_filtered(time, g, slope), constant, np.exp(slope * time)[:, None]])


def _cross_validated(segments: Sequence[tuple[Array, Array]]) -> float:
    """Return the share of squared errors that the columns but the last two explain elsewhere."""
    rest = []
    for errors, columns in segments:
        # start and constant are of each segment
        own = np.linalg.qr(columns[:, -2:])[0]
        y, X = errors[:, None], columns[:, :-2]
        rest.append((y - own @ (own.T @ y), X - own @ (own.T @ X)))
    left = total = 0.0
    for fold in (0, 1):
        fit, test = rest[fold::2], rest[1 - fold::2]
        if not (fit and test):
            return 0.0
        y, X = (np.vstack(parts) for parts in zip(*fit, strict=True))
        weights = np.linalg.lstsq(X, y, rcond=1e-6)[0]
        left += sum(float(np.sum((y - X @ weights) ** 2)) for y, X in test)
        total += sum(float(np.sum(y ** 2)) for y, _ in test)
    return 1.0 - left / total if total > 0.0 else 0.0
