# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimates of a drift by linear least squares: the weak form (weak SINDy)."""

from collections.abc import Sequence

import numpy as np
from numpy.polynomial.legendre import leggauss

from koopman_ros.core.datasets import Array, Episode
from koopman_ros.identification_methods import WeakFormParameters
from koopman_ros.learning.identification.base import (
    DriftEstimate,
    DriftProblem,
    IdentificationMethod,
)
from koopman_ros.learning.identification.drift import chooses_terms, DriftModel
from koopman_ros.learning.identification.term_selection import chosen_terms, OVERLAP
from koopman_ros.model import Box, InputTerms

# Exponent of the test functions (1 - s^2)^p, which are zero at the first and at the last sample.
_POWER = 3
_NARROWEST = 4  # samples of a window
# On [0, 1].
_NODES, _WEIGHTS = 0.5 * np.add(leggauss(3), [[1.0], [0.0]])


def regress(box: Box, degree: int, features: Array, inputs: Array, rates: Array,
            B: Array | None) -> DriftModel:
    """
    Fit rates = features @ coefficients + inputs @ B' by linear least squares.

    Features (K, 1 + m), inputs (K, n_u) and rates (K, n_x), or integrals of them, in deviations.
    Of too many, see :func:`chooses_terms`, those of nonlinear terms are chosen by
    :func:`chosen_terms`; the others are 0.

    :param B: (n_x, n_u) scaled, where it is known; None to fit it. Inputs and it may have more
        columns, see :class:`DriftModel`.
    :raises ValueError: when the samples do not determine the coefficients.
    """
    if B is not None:
        left, right = features, rates - inputs @ B.T
    else:
        left, right = np.hstack([features, inputs]), rates
    # columns of integrals differ in size with their monomial's degree
    norms = np.linalg.norm(left, axis=0)
    n_x, m = rates.shape[1], features.shape[1]
    chosen = chooses_terms(degree, n_x * m)
    always = [*range(1 + n_x), *range(m, left.shape[1])]
    # half of what the equations are worth is left to choose from
    if np.any(norms == 0.0) or len(left) < (
            2 * OVERLAP * len(always) if chosen else left.shape[1]):
        raise ValueError(f'{len(left)} equations do not determine {left.shape[1]} coefficients: '
                         'record more, or choose a lower degree')
    solution = (chosen_terms(left / norms, right, always) if chosen else np.linalg.lstsq(
        left / norms, right, rcond=1e-12)[0]) / norms[:, None]
    return DriftModel(box, degree, solution[:m], solution[m:].T if B is None else B)


class WeakForm(IdentificationMethod):
    """The weak form with windows of several lengths; the widest one knows B best."""

    Parameters = WeakFormParameters

    def __init__(self, parameters: WeakFormParameters | None = None) -> None:
        super().__init__(parameters)
        windows = self.parameters.windows
        if not all(window >= _NARROWEST for window in windows):
            raise ValueError(f'windows = {list(windows)} must have at least {_NARROWEST} samples '
                             'each')

    def estimate(self, problem: DriftProblem) -> Sequence[DriftEstimate]:
        """Return an estimate for each window that the segments are long enough for."""
        found, rejection = [], ''
        for window in map(int, self.parameters.windows):
            try:
                found.append(DriftEstimate(weak_form(
                    problem.episodes, problem.box, problem.degree, problem.B, window,
                    problem.input_degree), f'{window} samples'))
            except (ValueError, np.linalg.LinAlgError) as error:
                rejection = str(error)
        if not found:
            raise ValueError(rejection)
        return found


def weak_form(episodes: Sequence[Episode], box: Box, degree: int, B: Array | None,
              window: int, input_degree: int = 0) -> DriftModel:
    """
    Fit the drift to -integral(phi' x) = integral(phi f(x)) + integral(phi B(x) u).

    phi = (1 - s^2)^3 on windows that overlap by three quarters; x enters as measured. (Weak SINDy:
    Messenger and Bortz 2021.)

    :param B: weights of the inputs as :class:`DriftModel` has them, or None to learn them.
    :param window: samples of a window.
    :param input_degree: of the polynomial B(x) that is learned.
    :raises ValueError: when the window or the episodes are too short.
    """
    n_x, n_u = episodes[0].x.shape[1], episodes[0].u.shape[1]
    shape = DriftModel(box, degree, np.empty(0), np.empty((n_x, n_u)) if B is None else B)
    input_degree = input_degree if B is None else shape.input_degree
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
            inputs.append(_product_integral(episode, box, middle, half, input_degree)
                          if input_degree else _input_integral(episode, box, middle, half))
    if not features:
        raise ValueError(f'no episode has {window} samples: record longer')
    return regress(box, degree, np.array(features), np.array(inputs), np.array(rates), B)


def _trapezoid(t: Array) -> Array:
    """Return the weights of the trapezoidal rule."""
    steps = np.diff(t)
    return 0.5 * (np.append(steps, 0.0) + np.insert(steps, 0, 0.0))


def _input_integral(episode: Episode, box: Box, middle: float, half: float) -> Array:
    """Integrate phi times the scaled input exactly: it is linear between its changes."""
    inside = episode.input_time[np.abs(episode.input_time - middle) < half]
    edges = np.unique(np.concatenate(([middle - half], inside, [middle + half])))
    begin, end = map(box.inputs.to_deviation, episode.inputs_between(edges))
    s = (edges - middle) / half
    first, second = _antiderivatives(s)
    area = np.diff(first)
    return half * (area @ begin + (first[1:] - np.diff(second) / np.diff(s)) @ (end - begin))


def _product_integral(episode: Episode, box: Box, middle: float, half: float, degree: int
                      ) -> Array:
    """Integrate phi times the scaled input and its products with monomials, x as interpolated."""
    t = np.union1d(episode.time, episode.input_time)
    edges = np.unique(np.clip(t, middle - half, middle + half))
    begin, end = map(box.inputs.to_deviation, episode.inputs_between(edges))
    share = _NODES[:, None]
    times = edges[:-1] + share * np.diff(edges)
    s = (times - middle) / half
    weights = _WEIGHTS[:, None] * np.diff(edges) * (1.0 - s * s) ** _POWER
    x = np.stack([np.interp(times, episode.time, column) for column in episode.x.T], axis=-1)
    products = InputTerms.regressors(box.states.to_deviation(x),
                                     begin + share[..., None] * (end - begin), degree)
    return np.einsum('nk,nkj->j', weights, products)


def _antiderivatives(s: Array) -> tuple[Array, Array]:
    """Integrate (1 - s^2)^3 once and twice from 0."""
    return (s - s ** 3 + 0.6 * s ** 5 - s ** 7 / 7.0,
            s ** 2 / 2.0 - s ** 4 / 4.0 + 0.1 * s ** 6 - s ** 8 / 56.0)
