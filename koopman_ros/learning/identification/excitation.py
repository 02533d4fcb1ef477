# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Whether the inputs of a record moved enough, and independently, for B to be estimated."""

from collections.abc import Sequence

import numpy as np

from koopman_ros.core.datasets import Array, Episode, PlantDescription

# Samples over which inputs are averaged: the noise of a measured input moves no plant, and hides
# that two inputs move together.
_WINDOW = 10
# Condition indices of weak and of strong collinearity (Belsley, Kuh and Welsch 1980): of two
# inputs, correlations of 0.923 and 0.9978.
_WEAK, _STRONG = 5.0, 30.0
_LEAST = 1e-12  # eigenvalue of a correlation matrix; smaller ones are rounding
# An input has a part in collinearity from this share of the largest one on.
_PART = 0.3
_SIGMAS = 5.0
_MEDIAN = 0.6745  # of the magnitude of a normal deviate


def check_inputs(plant: PlantDescription, episodes: Sequence[Episode]) -> tuple[str, ...]:
    """
    Check that the effect of each input can be estimated, where B is not known.

    :return: warnings for the user.
    :raises ValueError: for inputs that moved together, and for a measured input that moved no
        more than white noise does.
    """
    if plant.B is not None:
        return ()
    means = _window_means(episodes)
    noise = _noise_of_means(plant.input_names, episodes, means)
    if means.shape[1] < 2 or len(means) < 2:
        return ()
    covariance = np.cov(means, rowvar=False, bias=True) - np.diag(noise)
    deviation = np.sqrt(np.diag(covariance))
    if not np.all(deviation > 0.0):
        return ()
    correlation = covariance / np.outer(deviation, deviation)
    values, vectors = np.linalg.eigh(correlation)
    index = float(np.sqrt(values[-1] / max(values[0], _LEAST)))
    if index < _WEAK:
        return ()
    share = np.abs(vectors[:, 0])
    together = np.flatnonzero(share > _PART * np.max(share)).tolist()
    names = [plant.input_names[j] for j in together]
    measure = (f'correlation {np.clip(correlation[together[0], together[1]], -1.0, 1.0):.4g}'
               if len(names) == 2 else f'condition index {index:.3g}')
    sentence = f'{", ".join(names[:-1])} and {names[-1]} moved together ({measure})'
    if index >= _STRONG:
        raise ValueError(f'{sentence}: their separate effects cannot be identified; step them '
                         'independently')
    return (f'{sentence}: their separate effects are uncertain; step them independently',)


def _window_means(episodes: Sequence[Episode]) -> Array:
    """Return the means (K, n_u) of the inputs over windows of the same number of samples."""
    means = []
    for episode in episodes:
        edges = episode.time[::_WINDOW]
        if len(edges) > 1:
            means.append(np.diff(episode.input_integral(edges), axis=0) / np.diff(edges)[:, None])
    return np.concatenate(means) if means else np.empty((0, episodes[0].u.shape[1]))


def _noise_of_means(names: Sequence[str], episodes: Sequence[Episode], means: Array) -> Array:
    """
    Return the variance (n_u,) that the noise of measured inputs adds to their means.

    Held inputs are commands, which have none.

    :raises ValueError: for a measured input whose means move no more than those of noise.
    """
    noise = np.zeros(len(names))
    for j, name in enumerate(names):
        if len(means) < 2 or not all(episode.linear and episode.linear[j] for episode in episodes):
            continue
        samples = [episode.inputs_at(episode.time)[:, j] for episode in episodes]
        deviation, variance = float(np.std(np.concatenate(samples))), np.var(means[:, j])
        chance = _SIGMAS * np.sqrt(2.0 / len(means))
        if 0.0 < variance < (1.0 + chance) * deviation ** 2 / _WINDOW:
            raise ValueError(
                f'{name} did not move more than white noise (standard deviation {deviation:.3g}): '
                'step it, and hold each step for several measurements')
        # the median is not moved by steps; an input that changes at each sample is no noise
        steps = np.abs(np.concatenate([np.diff(part) for part in samples]))
        sigma = float(np.median(steps)) / (_MEDIAN * np.sqrt(2.0))
        noise[j] = min(sigma ** 2 / _WINDOW, 0.5 * variance)
    return noise
