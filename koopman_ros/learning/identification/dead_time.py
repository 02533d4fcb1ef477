# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Dead time of each input of a record, by simulations of linear models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, lstsq
from scipy.linalg.lapack import dtbtrs

from koopman_ros.core.datasets import Array, Episode, sample_interval
from koopman_ros.learning.identification.chance import block_gains, clearly_positive

_ORDERS = (1, 2, 3)  # of the linear models
LONGEST = 60  # samples of dead time that are tried, where the record is long enough
SHARE = 8  # of an episode, which the longest dead time may take
_ROUNDS = 3  # over all inputs
_ITERATIONS = 8  # of Steiglitz and McBride from nothing; from a neighbour's filter below
_FEW = 3
_WHITE = 0.3  # correlation of an error with the next one
_BLOCKS = 30  # in which errors are compared
_STABLE = 0.9999  # largest magnitude of a pole


@dataclass(frozen=True)
class DeadTimes:
    """The dead times that suit a record best."""

    samples: tuple[int, ...]  #: (n_u,) intervals between samples
    period: float  #: usual interval, in time units
    order: int  #: of the linear model of each output
    rmse: Array  #: (n_y,) error of its simulation, in state units

    @property
    def values(self) -> Array:
        """(n_u,) in time units."""
        return self.period * np.array(self.samples, dtype=np.float64)


def find_dead_times(episodes: Sequence[Episode], known: Sequence[bool] = (), *,
                    watch: Callable[[], object] = lambda: None) -> DeadTimes:
    """
    Find how many samples each input acts late.

    Each measured signal is simulated by linear models of rising order, their inputs moved by every
    number of samples in turn. The model with the least Bayesian information criterion (Schwarz
    1978) is taken. Where linear models do not explain the record, a dead time must also reduce the
    error of the best model without by more than chance. No dead time is found if all
    models are unstable, e.g. from closed-loop data of an unstable plant.

    The models are fitted by the iteration of Steiglitz and McBride (1965): least squares of the
    equation error, filtered by the denominator that was found before, which ends where the error
    of the simulation is least.

    :param known: (n_u,) inputs whose dead time the episodes have already; none by default.
    :param watch: called now and then; it may raise to end the search.
    """
    period = sample_interval(episodes)
    n_y, n_u = episodes[0].x.shape[1], episodes[0].u.shape[1]
    longest = min(LONGEST, max(len(episode) for episode in episodes) // SHARE)
    data = [Sampled.of(episode, period, longest) for episode in episodes
            if len(episode) > 2 * longest + 10 * _ORDERS[-1]]
    none = (0,) * n_u
    highest = tuple(0 if fixed else longest for fixed in known or (False,) * n_u)
    searches: list[LinearModels] = []
    delays = none
    for order in _ORDERS if data and any(highest) else ():
        for zeros in sorted({order - 1, 0}, reverse=True):
            search = LinearModels(data, order, n_y, zeros)
            delays = search.best(highest, watch, tuple(map(min, delays, highest)))
            search.model(none)
            searches.append(search)
        # a larger model needs no longer dead time, but for chance
        highest = tuple(min(most, d + 2) for most, d in zip(highest, delays, strict=True))
    tried = [model for search in searches for model in search.models]
    if not tried:
        return DeadTimes(none, period, 0, np.full(n_y, np.nan))
    best = _median(searches, tried)
    plain = min((one for one in tried if one.delays == none), key=lambda one: one.criterion,
                default=best)
    # coloured errors may come from a dead time or from a deficit of the models
    if not (_white(best.errors) or clearly_positive(
            block_gains(best.errors, plain.errors, _BLOCKS))):
        best = plain
    return DeadTimes(best.delays, period, best.order, best.rmse)


@dataclass(frozen=True)
class _LinearModel:
    """A linear model with dead times, and the errors (N, n_y) of its simulations."""

    order: int
    taps: int  # coefficients of each input
    delays: tuple[int, ...]
    errors: Array

    @property
    def rmse(self) -> Array:
        return np.sqrt(np.mean(self.errors ** 2, axis=0))

    @property
    def criterion(self) -> float:
        count, n_y = self.errors.shape
        size = n_y * (self.order + self.taps * len(self.delays)) + np.count_nonzero(self.delays)
        return float(2.0 * count * np.sum(np.log(self.rmse + 1e-300)) + size * np.log(count))


def _median(searches: Sequence[LinearModels], tried: Sequence[_LinearModel]) -> _LinearModel:
    """Return the best structure with the posterior medians of the dead times."""
    least = min(tried, key=lambda one: one.criterion)
    weights = np.exp(0.5 * (least.criterion - np.array([one.criterion for one in tried])))
    medians = []
    for values in np.array([one.delays for one in tried]).T:
        order = np.argsort(values)
        shares = np.cumsum(weights[order])
        medians.append(int(values[order[np.searchsorted(shares, 0.5 * shares[-1])]]))
    search = next(one for one in searches if least in one.models)
    return search.model(tuple(medians)) or least


def _white(errors: Array) -> bool:
    return bool(np.all(np.sum(errors[1:] * errors[:-1], axis=0) < _WHITE * np.sum(
        errors ** 2, axis=0)))


@dataclass(frozen=True)
class Sampled:
    """An episode at equal intervals; the inputs begin earlier than the measurements."""

    y: Array  #: (N, n_y)
    u: Array  #: (longest + N, n_u) means from one sample to the next

    @classmethod
    def of(cls, episode: Episode, period: float, longest: int) -> Sampled:
        """Return an episode every period, the measurements from sample `longest` on."""
        count = int((episode.time[-1] - episode.time[0]) / period * (1.0 + 1e-9)) + 1
        time = np.minimum(episode.time[0] + period * np.arange(count), episode.time[-1])
        y = np.column_stack([np.interp(time, episode.time, column)
                             for column in episode.interpolated().T])
        u = np.diff(episode.input_integral(time), axis=0) / period
        return cls(y[longest:], np.vstack((u, u[-1:])))

    def inputs(self, delays: Sequence[int], count: int) -> Array:
        """Return the inputs (N, n_u count) of the samples before, each late by its dead time."""
        rows = np.arange(len(self.u) - len(self.y), len(self.u))
        return np.column_stack([self.u[np.maximum(rows - d - k, 0), j]
                                for j, d in enumerate(delays) for k in range(1, 1 + count)])


class LinearModels:
    """Linear models of an order with any dead times, each output by itself."""

    def __init__(self, data: Sequence[Sampled], order: int, n_y: int, zeros: int | None = None
                 ) -> None:
        self._data, self._order, self._n_y = data, order, n_y
        self._taps = order if zeros is None else 1 + zeros
        self._variance = np.var(np.concatenate([one.y for one in data]), axis=0) + 1e-300
        self._filters: dict[int, Array] = {}  # the last denominator of each output
        self._found: dict[tuple[int, ...], _LinearModel | None] = {}

    @property
    def models(self) -> list[_LinearModel]:
        """All that were fitted."""
        return [model for model in self._found.values() if model is not None]

    def best(self, highest: tuple[int, ...], watch: Callable[[], object],
             start: tuple[int, ...] | None = None) -> tuple[int, ...]:
        """
        Return the dead times with the least error, one input after the other, then all.

        :param watch: True ends the search.
        """
        delays, n_u = start or (0,) * len(highest), len(highest)
        # a common lag and a common dead time are much alike
        sets = [{j} for j in range(n_u)] + [set(range(n_u))] * (n_u > 1)
        for _ in range(_ROUNDS if n_u > 1 else 1):
            before = delays
            for moved in sets:
                costs = []
                for shift in range(-min(delays[j] for j in moved),
                                   1 + min(highest[j] - delays[j] for j in moved)):
                    if watch():
                        return delays
                    tried = tuple(d + shift * (j in moved) for j, d in enumerate(delays))
                    model = self.model(tried)
                    costs.append((np.inf if model is None else float(np.sum(
                        model.rmse ** 2 / self._variance)), tried))
                delays = min(costs)[1]
            if delays == before:
                break
        return delays

    def model(self, delays: tuple[int, ...]) -> _LinearModel | None:
        """Return the model with some dead times; None where none is stable."""
        if delays not in self._found:
            errors = [self._errors(i, delays) for i in range(self._n_y)]
            self._found[delays] = None if any(own is None for own in errors) else _LinearModel(
                self._order, self._taps, delays,
                np.column_stack([own for own in errors if own is not None]))
        return self._found[delays]

    def state_space(self) -> tuple[Array, Array, Array] | None:
        """
        Return A, B and C of the models without dead time, of all outputs side by side.

        The last column of B is the effect of a constant 1. None where a model is not stable.
        """
        none = (0,) * (self._data[0].u.shape[1])
        if self.model(none) is None:
            return None
        A, B = [], []
        for i in range(self._n_y):
            denominator = self._filters[i]
            regressors, y = self._equations(i, none, denominator, simulated=True)
            found = lstsq(regressors, y, lapack_driver='gelsy')[0]
            own = np.eye(self._order, k=1)
            own[:, 0] = -denominator[1:]
            A.append(own)
            B.append(np.column_stack((
                found[:len(none) * self._order].reshape(len(none), -1).T,
                found[len(none) * self._order] * np.eye(self._order, 1))))
        return block_diag(*A), np.vstack(B), block_diag(*[np.eye(1, self._order)] * self._n_y)

    def _errors(self, i: int, delays: tuple[int, ...]) -> Array | None:
        known = self._filters.get(i)
        denominator = np.ones(1) if known is None else known
        best: tuple[float, Array, Array] | None = None
        for _ in range(_ITERATIONS if known is None else _FEW):
            A, y = self._equations(i, delays, denominator, simulated=False)
            denominator = np.append(1.0, lstsq(A, y, lapack_driver='gelsy')[0][:self._order])
            poles = np.roots(denominator)
            far = np.abs(poles) > _STABLE
            if np.any(far):
                # a filter must be stable; the next one may be so by itself
                denominator = np.real(np.poly(np.where(far, _STABLE ** 2 / poles.conj(), poles)))
                continue
            A, y = self._equations(i, delays, denominator, simulated=True)
            errors = y - A @ lstsq(A, y, lapack_driver='gelsy')[0]
            cost = float(np.mean(errors ** 2))
            if best is not None and cost >= best[0] * (1.0 - 1e-6):
                break
            best = cost, errors, denominator
        if best is None:
            return None
        self._filters[i] = best[2]
        return best[1]

    def _equations(self, i: int, delays: tuple[int, ...], denominator: Array, *, simulated: bool
                   ) -> tuple[Array, Array]:
        """
        Return A and y of the least squares for an output.

        :param simulated: whether the denominator is kept and y simulated; otherwise a better
            denominator is in front of the parameters.
        """
        shared, starts, outputs = [], [], []
        for one in self._data:
            y, order = one.y[:, i], self._order
            past = [] if simulated else [
                -np.concatenate((np.zeros(k), y[:-k])) for k in range(1, 1 + order)]
            regressors = np.column_stack((*past, one.inputs(delays, self._taps), np.ones(len(y))))
            # the filter 1 / denominator as a triangular system; scipy.signal takes 1 s to import
            columns, _ = dtbtrs(np.repeat(denominator[:, None], len(y), axis=1), np.hstack((
                regressors, np.eye(len(y), order), y[:, None])), uplo='L')
            shared.append(columns[:, :-1 - order])
            starts.append(columns[:, -1 - order:-1])
            outputs.append(y if simulated else columns[:, -1])
        return np.hstack((np.vstack(shared), block_diag(*starts))), np.concatenate(outputs)
