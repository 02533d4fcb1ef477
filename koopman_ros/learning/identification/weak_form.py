# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimates of a drift by linear least squares: the weak form and total variation."""

from collections.abc import Sequence

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.linalg import lapack

from koopman_ros.learning.identification.drift import Drift, DriftModel
from koopman_ros.lifting import Box, InputTerms
from koopman_ros.plant_data import Array, Episode

# Exponent of the test functions (1 - s^2)^p, which are zero at the first and at the last sample.
_POWER = 3
_NARROWEST = 4
# On [0, 1].
_NODES, _WEIGHTS = 0.5 * np.add(leggauss(3), [[1.0], [0.0]])

# Of total variation: steps towards the weight, and samples that an episode needs.
_SWEEPS = 30
_BISECTIONS = 14
_SHORTEST = 8


def regress(box: Box, degree: int, features: Array, inputs: Array, rates: Array,
            B: Array | None) -> DriftModel:
    """
    Fit rates = features @ coefficients + inputs @ B' by linear least squares.

    Features (K, 1 + m), inputs (K, n_u) and rates (K, n_x), or integrals of them, in deviations.

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
    if len(left) < left.shape[1] or np.any(norms == 0.0):
        raise ValueError(f'{len(left)} equations do not determine {left.shape[1]} coefficients: '
                         'record more, or choose a lower degree')
    solution = np.linalg.lstsq(left / norms, right, rcond=1e-12)[0] / norms[:, None]
    m = features.shape[1]
    return DriftModel(box, degree, solution[:m], solution[m:].T if B is None else B)


def weak_form(episodes: Sequence[Episode], box: Box, degree: int, B: Array | None,
              window: int, input_degree: int = 0) -> DriftModel:
    """
    Fit the drift to -integral(phi' x) = integral(phi f(x)) + integral(phi B(x) u).

    phi = (1 - s^2)^3 on windows that overlap by three quarters; x enters as measured. (Weak SINDy:
    Messenger and Bortz 2021.)

    :param B: weights of the inputs as :class:`DriftModel` has them, or None to learn them.
    :param window: samples of a window, at least 4.
    :param input_degree: of the polynomial B(x) that is learned.
    :raises ValueError: when the window or the episodes are too short.
    """
    return regress(box, degree, *weak_rows(episodes, box, degree, B, window, input_degree), B)


def weak_rows(episodes: Sequence[Episode], box: Box, degree: int, B: Array | None, window: int,
              input_degree: int = 0) -> tuple[Array, Array, Array]:
    """Return features, inputs and rates of :func:`weak_form`, as :func:`regress` takes them."""
    if window < _NARROWEST:
        raise ValueError(f'a window of {window} samples is too short, at least {_NARROWEST} are '
                         'needed')
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
    return np.array(features), np.array(inputs), np.array(rates)


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
    once, twice = _antiderivatives(s)
    area = np.diff(once)
    return half * (area @ begin + (once[1:] - np.diff(twice) / np.diff(s)) @ (end - begin))


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
        raise ValueError('total variation needs a rough B: take one from the weak form')
    if assumed.shape[1] != len(box.inputs):
        raise ValueError('total variation needs a constant B: take the weak form')
    shape = DriftModel(box, degree, np.empty(0), assumed)
    features, inputs, rates = [], [], []
    episodes = [episode for episode in episodes if len(episode) >= _SHORTEST]
    shifts = [_moved(episode, box, assumed) for episode in episodes]
    curves = _smoothed([(episode.time, box.states.to_deviation(episode.x) - moved)
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


def smoothed(time: Array, values: Array) -> Array:
    """
    Smooth signals (N, n) as far as their noise allows, with few bends of the derivative.

    min 0.5 ||g - y||^2 + a ||D^3 g||_1 by iterated weights; `a` is such that what is taken away
    has the size of the noise, which third differences tell (discrepancy principle).
    """
    return _smoothed([(time, values)])[0]


def _smoothed(records: Sequence[tuple[Array, Array]]) -> list[Array]:
    """Return what :func:`smoothed` does for each of many times and signals, all at once."""
    found = [values.copy() for _, values in records]
    pieces, sizes = [], []
    for values, (time, _) in zip(found, records, strict=True):
        D = _third_differences(time)
        for y in values.T:
            size = _noise(D, y)
            if size > 1e-9 * float(np.ptp(y) or 1.0):
                pieces.append((D, y))
                sizes.append(size)
    if pieces:
        filters, noise = _TrendFilters(pieces), np.array(sizes)
        low, high = np.full(len(noise), -6.0), np.full(len(noise), 8.0)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            more = filters.taken_away(filters.filtered(noise * 10.0 ** middle)) < noise
            low, high = np.where(more, middle, low), np.where(more, high, middle)
        curves = filters.split(filters.filtered(noise * 10.0 ** low))
        for (_, y), curve in zip(pieces, curves, strict=True):
            y[:] = curve
    return found


class _TrendFilters:
    """
    The l1 trend filters (Kim, Koh, Boyd, Gorinevsky 2009) of pieces, by iterated weights.

    :param pieces: rows (N - 3, 4) of third differences, and the signal (N,), of each.
    """

    def __init__(self, pieces: Sequence[tuple[Array, Array]]) -> None:
        self._y = np.concatenate([y for _, y in pieces])
        self._lengths = np.array([len(y) for _, y in pieces])
        self._starts = np.cumsum(self._lengths) - self._lengths
        # as one signal, whose differences across the ends of pieces count for nothing
        D, self._floor = np.zeros((len(self._y) - 3, 4)), np.ones(len(self._y) - 3)
        for start, (rows, y) in zip(self._starts, pieces, strict=True):
            inside = slice(start, start + len(rows))
            D[inside], self._floor[inside] = rows, 1e-6 * float(np.std(_apply(rows, y)))
        self._D, self._columns = D, np.ascontiguousarray(D.T)

    def filtered(self, weights: Array) -> Array:
        """Solve the filters of weights, one a piece; the solutions one after the other."""
        D, columns, weight = self._D, self._columns, np.repeat(weights, self._lengths)[:-3]
        g, bands = self._y, np.empty((4, len(self._y)))
        for _ in range(_SWEEPS):
            w = weight / np.maximum(np.abs(_apply(D, g)), self._floor)
            bands.fill(0.0)
            for i, weighted in enumerate(w * columns):
                for end in range(i, 4):
                    # (D' W D)[k + i, k + end] gathers D[k, i] D[k, end]
                    bands[3 - end + i, end:end + len(D)] += weighted * columns[end]
            bands[3] += 1.0
            # as scipy.linalg.solveh_banded does, which takes as long again to look at its
            # arguments
            _, g, info = lapack.dpbsv(bands, self._y)
            if info:
                raise np.linalg.LinAlgError('the weights of a trend filter are out of range')
        return g

    def taken_away(self, g: Array) -> Array:
        """Return the root mean square of each piece less its solution."""
        rms: Array = np.sqrt(np.add.reduceat((g - self._y) ** 2, self._starts) / self._lengths)
        return rms

    def split(self, g: Array) -> list[Array]:
        """Return the solution of each piece."""
        return np.split(g, self._starts[1:])


def _third_differences(time: Array) -> Array:
    """Return the rows (N - 3, 4) of third differences, as on an even grid of the mean period."""
    period = (time[-1] - time[0]) / (len(time) - 1)
    t = time / period
    points = np.column_stack([t[i:len(t) - 3 + i] for i in range(4)])
    rows = np.empty_like(points)
    for i in range(4):
        others = [j for j in range(4) if j != i]
        rows[:, i] = 6.0 / np.prod(points[:, [i]] - points[:, others], axis=1)
    return rows


def _apply(D: Array, y: Array) -> Array:
    # the general view takes longer to make than the product
    windows: Array = np.ndarray(
        (len(y) - 3, 4), buffer=y, strides=2 * y.strides) if y.flags.c_contiguous else (
        np.lib.stride_tricks.sliding_window_view(y, 4))
    return np.einsum('ki,ki->k', D, windows)
