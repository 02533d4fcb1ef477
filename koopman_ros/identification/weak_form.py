# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drift from integrals against test functions: the weak form, without derivatives."""

from collections.abc import Sequence

import numpy as np

from koopman_ros.identification.drift import DriftModel, regress
from koopman_ros.lifting import Box
from koopman_ros.plant_data import Array, Episode

# Exponent of the test functions (1 - s^2)^p.
_POWER = 3
# It is zero at the first and at the last sample.
_SHORTEST = 4


def weak_form(episodes: Sequence[Episode], box: Box, degree: int, B: Array | None,
              window: int) -> DriftModel:
    """
    Fit the drift to -integral(phi' x) = integral(phi f(x)) + B integral(phi u).

    phi = (1 - s^2)^3 on windows that overlap by three quarters; x enters as measured. (Weak SINDy:
    Messenger and Bortz 2021.)

    :param B: (n_x, n_u) scaled, or None to learn it.
    :param window: samples of a window, at least 4.
    :raises ValueError: when the window or the episodes are too short.
    """
    if window < _SHORTEST:
        raise ValueError(f'a window of {window} samples is too short, at least {_SHORTEST} are '
                         'needed')
    n_x, n_u = episodes[0].x.shape[1], episodes[0].u.shape[1]
    shape = DriftModel(box, degree, np.empty(0), np.empty((n_x, n_u)))
    features, inputs, rates = [], [], []
    for episode in episodes:
        xi = box.states.to_deviation(episode.x)
        P = shape.features(xi)
        for start in range(0, len(episode) - window + 1, max(1, window // 4)):
            rows = slice(start, start + window)
            t = episode.time[rows]
            middle, half = 0.5 * (t[0] + t[-1]), 0.5 * (t[-1] - t[0])
            s = (t - middle) / half
            phi = (1.0 - s * s) ** _POWER
            slope = -2.0 * _POWER * s * (1.0 - s * s) ** (_POWER - 1) / half
            weights = _trapezoid(t)
            features.append((weights * phi) @ P[rows])
            rates.append(-(weights * slope) @ xi[rows])
            inputs.append(_input_integral(episode, box, middle, half))
    if not features:
        raise ValueError(f'no episode has {window} samples: record longer')
    return regress(box, degree, np.array(features), np.array(inputs), np.array(rates), B)


def _trapezoid(t: Array) -> Array:
    """Return the weights of the trapezoidal rule."""
    steps = np.diff(t)
    return 0.5 * (np.append(steps, 0.0) + np.insert(steps, 0, 0.0))


def _input_integral(episode: Episode, box: Box, middle: float, half: float) -> Array:
    """Integrate phi times the scaled input exactly: it is constant between its changes."""
    inside = episode.input_time[np.abs(episode.input_time - middle) < half]
    edges = np.concatenate(([middle - half], inside, [middle + half]))
    held = box.inputs.to_deviation(episode.inputs_at(edges[:-1]))
    return half * np.diff(_antiderivative((edges - middle) / half)) @ held


def _antiderivative(s: Array) -> Array:
    """Integrate (1 - s^2)^3 from 0."""
    return s - s ** 3 + 0.6 * s ** 5 - s ** 7 / 7.0
