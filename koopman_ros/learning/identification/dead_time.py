# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Dead time of each input of a record, by simulations of linear models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lstsq
from scipy.signal import lfilter

from koopman_ros.core.datasets import Array, Episode

_ORDERS = (1, 2, 3)  # of the linear models
_LONGEST = 60  # samples of dead time that are tried, where the record is long enough
_SHARE = 8  # of an episode, which the longest dead time may take
_ROUNDS = 3  # over all inputs
_ITERATIONS = 8  # of Steiglitz and McBride from nothing; from a neighbour's filter below
_FEW = 3
_SIGMAS = 2.0  # by which a dead time must reduce the error, of the difference's standard errors
_BLOCKS = 30  # in which errors are compared
_STABLE = 0.9999  # largest magnitude of a pole


@dataclass(frozen=True)
class DeadTimes:
    """The dead times that suit a record best."""

    samples: tuple[int, ...]  #: (n_u,) intervals between samples
    period: float  #: usual interval, in time units
    order: int  #: of the linear model of each output
    rmse: Array  #: (n_y,) error of its simulation, in state units
    rmse_without: Array  #: (n_y,) that of the best model without dead time

    @property
    def values(self) -> Array:
        """(n_u,) in time units."""
        return self.period * np.array(self.samples, dtype=np.float64)


def find_dead_times(episodes: Sequence[Episode], watch: Callable[[], object] = lambda: None
                    ) -> DeadTimes:
    """
    Find how many samples each input acts late.

    Each measured signal is simulated by linear models of rising order, their input moved by every
    number of samples in turn. The model with the least error is taken, or a smaller one where the
    difference might be chance; a dead time, too, must reduce the error by more than chance does.
    A record whose models are all unstable, as of a plant that only a controller holds, tells no
    dead time.

    The models are fitted by the iteration of Steiglitz and McBride (1965): least squares of the
    equation error, filtered by the denominator that was found before, which ends where the error
    of the simulation is least.

    :param watch: called now and then; it may raise to end the search.
    """
    period = float(np.median(np.concatenate([np.diff(episode.time) for episode in episodes])))
    n_y, n_u = episodes[0].x.shape[1], episodes[0].u.shape[1]
    longest = min(_LONGEST, max(len(episode) for episode in episodes) // _SHARE)
    data = [_Sampled.of(episode, period, longest) for episode in episodes
            if len(episode) > 2 * longest + 10 * _ORDERS[-1]]
    none = (0,) * n_u
    tried: list[tuple[int, tuple[int, ...], Array]] = []
    highest = (longest,) * n_u
    for order in _ORDERS if data and longest else ():
        search = _Search(data, order, n_y)
        delays = search.best(highest, watch)
        # a larger model needs no longer dead time, but for chance
        highest = tuple(min(longest, d + 2) for d in delays)
        tried += [(order, one, errors) for one in dict.fromkeys((none, delays))
                  if (errors := search.errors(one)) is not None]
    if not tried:
        return DeadTimes(none, period, 0, np.full(n_y, np.nan), np.full(n_y, np.nan))
    best = min((errors for *_, errors in tried), key=lambda errors: search.cost_of(errors))
    order, delays, errors = next(one for one in tried if not _clearly_less(best, one[2]))
    without = min((errors for _, one, errors in tried if one == none),
                  key=lambda errors: search.cost_of(errors), default=np.full((1, n_y), np.nan))
    return DeadTimes(delays, period, order, _rms(errors), _rms(without))


def _rms(errors: Array) -> Array:
    return np.sqrt(np.mean(errors ** 2, axis=0))


def _clearly_less(errors: Array, others: Array) -> bool:
    """Return whether squared errors (N, n_y) are less than others by more than chance."""
    scale = np.mean(others ** 2, axis=0) + np.finfo(np.float64).tiny
    gain = np.array([np.mean(block) for block in np.array_split(
        (others ** 2 - errors ** 2) / scale, _BLOCKS)])
    return bool(np.mean(gain) > _SIGMAS * np.std(gain) / np.sqrt(len(gain)))


@dataclass(frozen=True)
class _Sampled:
    """An episode at equal intervals; the inputs begin earlier than the measurements."""

    y: Array  #: (N, n_y)
    u: Array  #: (longest + N, n_u) means from one sample to the next

    @classmethod
    def of(cls, episode: Episode, period: float, longest: int) -> _Sampled:
        count = int((episode.time[-1] - episode.time[0]) / period * (1.0 + 1e-9)) + 1
        time = np.minimum(episode.time[0] + period * np.arange(count), episode.time[-1])
        y = np.column_stack([np.interp(time, episode.time, column) for column in episode.x.T])
        u = np.diff(episode.input_integral(time), axis=0) / period
        return cls(y[longest:], np.vstack((u, u[-1:])))


class _Search:
    """Simulations of linear models of an order with any dead times."""

    def __init__(self, data: Sequence[_Sampled], order: int, n_y: int) -> None:
        self._data, self._order, self._n_y = data, order, n_y
        self._filters: dict[int, Array] = {}  # the last denominator of each output
        self._found: dict[tuple[int, ...], Array | None] = {}

    def best(self, highest: tuple[int, ...], watch: Callable[[], object]) -> tuple[int, ...]:
        """Return the dead times with the least error, one input after the other."""
        delays: tuple[int, ...] = (0,) * len(highest)
        for _ in range(_ROUNDS if len(highest) > 1 else 1):
            before = delays
            for j, most in enumerate(highest):
                found = []
                for d in range(most + 1):
                    watch()
                    tried = (*delays[:j], d, *delays[j + 1:])
                    errors = self.errors(tried)
                    found.append((np.inf if errors is None else self.cost_of(errors), tried))
                delays = min(found)[1]
            if delays == before:
                break
        return delays

    def cost_of(self, errors: Array) -> float:
        """Return the mean squared errors in units of the signals' variance."""
        return float(np.sum(np.mean(errors ** 2, axis=0) / self._variance))

    @cached_property
    def _variance(self) -> Array:
        return np.var(np.concatenate([one.y for one in self._data]), axis=0) + 1e-300

    def errors(self, delays: tuple[int, ...]) -> Array | None:
        """Return the errors (N, n_y) of the best simulations; None where none is stable."""
        if delays not in self._found:
            columns = [self._fitted(i, delays) for i in range(self._n_y)]
            self._found[delays] = None if any(c is None for c in columns) else np.column_stack(
                [c for c in columns if c is not None])
        return self._found[delays]

    def _fitted(self, i: int, delays: tuple[int, ...]) -> Array | None:
        known = self._filters.get(i)
        denominator = np.ones(1) if known is None else known
        best: tuple[float, Array, Array] | None = None
        for _ in range(_ITERATIONS if known is None else _FEW):
            rows = [self._equations(one, i, delays, denominator) for one in self._data]
            starts = self._order * len(rows)
            A = np.vstack([np.hstack((R, np.zeros((len(R), starts)))) for R, _, _ in rows])
            row = 0
            for k, (R, S, _) in enumerate(rows):
                first = R.shape[1] + k * self._order
                A[row:row + len(R), first:first + self._order] = S
                row += len(R)
            y = np.concatenate([own for _, _, own in rows])
            theta = lstsq(A, y, lapack_driver='gelsy')[0]
            denominator = np.concatenate((np.ones(1), theta[:self._order]))
            poles = np.roots(denominator)
            far = np.abs(poles) > _STABLE
            if np.any(far):
                # a filter must be stable; the next one may be so by itself
                denominator = np.real(np.poly(np.where(far, _STABLE ** 2 / poles.conj(), poles)))
                continue
            errors = self._errors(i, delays, denominator)
            cost = float(np.mean(errors ** 2))
            if best is not None and cost >= best[0] * (1.0 - 1e-6):
                break
            best = cost, errors, denominator
        if best is None:
            return None
        self._filters[i] = best[2]
        return best[1]

    def _equations(self, one: _Sampled, i: int, delays: tuple[int, ...], denominator: Array
                   ) -> tuple[Array, Array, Array]:
        """Return regressors, those of the start, and the output, all filtered."""
        y, past = one.y[:, i], [self._inputs(one, delays)]
        shifted = [-np.concatenate((np.zeros(k), y[:-k])) for k in range(1, self._order + 1)]
        regressors = np.column_stack((*shifted, *past, np.ones(len(y))))
        starts = np.eye(len(y), self._order)
        R, S, own = (lfilter([1.0], denominator, block, axis=0)
                     for block in (regressors, starts, y))
        return R, S, own

    def _inputs(self, one: _Sampled, delays: tuple[int, ...]) -> Array:
        """Return the inputs (N, n_u order) of the samples before, each late by its dead time."""
        N = len(one.y)
        ahead = len(one.u) - N
        columns = []
        for j, d in enumerate(delays):
            for k in range(1, self._order + 1):
                rows = np.maximum(np.arange(N) + ahead - d - k, 0)
                columns.append(one.u[rows, j])
        return np.column_stack(columns)

    def _errors(self, i: int, delays: tuple[int, ...], denominator: Array) -> Array:
        """Return the errors of the simulations by a denominator, all else by least squares."""
        rows = []
        for one in self._data:
            forced = np.column_stack((self._inputs(one, delays), np.ones(len(one.y))))
            rows.append((lfilter([1.0], denominator, forced, axis=0), lfilter(
                [1.0], denominator, np.eye(len(one.y), self._order), axis=0), one.y[:, i]))
        width = rows[0][0].shape[1]
        A = np.zeros((sum(len(y) for _, _, y in rows), width + self._order * len(rows)))
        row = 0
        for k, (F, S, y) in enumerate(rows):
            own = slice(row, row + len(y))
            A[own, :width] = F
            A[own, width + k * self._order:width + (k + 1) * self._order] = S
            row = own.stop
        y = np.concatenate([own for _, _, own in rows])
        rest: Array = y - A @ lstsq(A, y, lapack_driver='gelsy')[0]
        return rest
