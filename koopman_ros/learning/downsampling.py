# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Downsampling of a long record: means of samples, segments from all over its range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import itertools
import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import averaged, cut, Episode
from koopman_ros.model import Box

CELLS = 10  # along each of two signals, to count the visited share of their ranges
SEGMENT = 240  # samples of a segment, or means of samples
# Groups of samples that are tried, a power of two each, and the group by which noise is known.
_GROUPS = tuple(2 ** power for power in range(3, 13))
_NOISE_GROUP = 4
# Samples of a group are a straight line when its mean square error is larger by no more than this
# than that of lines through four of them; the group that is taken is half as long, which bends a
# quarter as much.
_STRAIGHT = 1.02
_SHORTEST = 10  # means of a segment


@dataclass
class RecordStatistics:
    """Range and pace of a record, seen episode by episode; of constant size."""

    lower: Array  #: (n,) lowest value of each state and input
    upper: Array  #: (n,) highest value
    count: int = 0  #: samples
    #: (2, groups, n_x) mean square errors of lines through groups, and through four samples each,
    #: weighed by the square of the slope: a signal at rest tells nothing of the pace
    errors: Array = field(default_factory=lambda: np.zeros((2, len(_GROUPS), 1)))

    @classmethod
    def empty(cls, n_x: int, n_u: int) -> RecordStatistics:
        """Return that of nothing."""
        return cls(np.full(n_x + n_u, np.inf), np.full(n_x + n_u, -np.inf), 0,
                   np.zeros((2, len(_GROUPS), n_x)))

    def add(self, episode: Episode) -> None:
        """Take an episode in."""
        low, high = extremes(episode)
        self.lower, self.upper = np.fmin(self.lower, low), np.fmax(self.upper, high)
        self.count += len(episode)
        x = episode.x - episode.x.mean(axis=0)
        noise = _line_errors(x, _NOISE_GROUP)[0]
        for g, size in enumerate(_GROUPS):
            if len(x) < size:
                break
            errors, slopes = _line_errors(x, size)
            own = noise[:len(errors) * size // _NOISE_GROUP].reshape(len(errors), -1, x.shape[1])
            weights = slopes ** 2
            self.errors[:, g] += [np.sum(weights * errors, axis=0),
                                  np.sum(weights * own.mean(axis=1), axis=0)]

    def merged(self, other: RecordStatistics) -> RecordStatistics:
        """Return that of both."""
        return RecordStatistics(
            np.minimum(self.lower, other.lower), np.maximum(self.upper, other.upper),
            self.count + other.count, self.errors + other.errors)

    def group(self, most: int) -> int:
        """Return how many samples are averaged so that `most` are left, or nearly; 1 for none."""
        longest = 1
        for size, (bent, straight) in zip(_GROUPS, np.swapaxes(self.errors, 0, 1), strict=True):
            if not (np.all(straight > 0.0) and np.all(bent <= _STRAIGHT * straight)):
                break
            longest = size // 2
        return min(longest, 2 ** max(0, math.ceil(math.log2(max(1, self.count) / most))))


def extremes(episode: Episode) -> tuple[Array, Array]:
    """Return the lowest and the highest value (n,) of each state and input."""
    # of the states that were measured
    return (np.concatenate((np.fmin.reduce(episode.x), episode.u.min(axis=0))),
            np.concatenate((np.fmax.reduce(episode.x), episode.u.max(axis=0))))


def _line_errors(x: Array, size: int) -> tuple[Array, Array]:
    """Fit lines to groups of samples; return mean square errors and slopes (m, n_x)."""
    m = len(x) // size
    groups = x[:m * size].reshape(m, size, x.shape[1])
    s = np.arange(size) - 0.5 * (size - 1)
    deviations = groups - groups.mean(axis=1, keepdims=True)
    slopes = np.einsum('mkj,k->mj', deviations, s) / (s @ s)
    squares = np.einsum('mkj,mkj->mj', deviations, deviations)
    return np.maximum(squares - slopes ** 2 * (s @ s), 0.0) / (size - 2), slopes


@dataclass(frozen=True)
class _Segment:
    """A segment that may be chosen."""

    place: tuple[int, int]  #: number of its bag, and of the segment in it
    key: float  #: drawn, by which segments with the same cells come first
    cells: NDArray[np.int64]  #: that it visits
    extreme: bool  #: whether a signal is nowhere lower or higher
    episode: Episode


@dataclass
class Selection:
    """
    Segments of a record that visit its range evenly, `most` samples at most; of constant size.

    Of the segments that visit a cell of two signals' ranges, drawn by lot, the first one of each
    cell is taken, then the second one, and so on. Those with the lowest and the highest value of a
    signal are always among them. Segments and draws depend on the record and the seed alone.
    """

    lower: Array  #: (n,) of the range of states and inputs
    upper: Array  #: (n,) likewise
    group: int  #: samples that are averaged
    most: int  #: samples, or means, that are kept
    length: int = SEGMENT  #: of a segment, of those
    offered: int = 0  #: segments that there were
    _held: list[_Segment] = field(default_factory=list)

    def empty(self) -> Selection:
        """Return one of the same settings to which nothing was offered."""
        return replace(self, offered=0, _held=[])

    def offer(self, bag: int, episode: Episode, rng: np.random.Generator) -> None:
        """Cut an episode into segments, and keep the best ones."""
        for part in cut([episode], self.length * self.group):
            key = float(rng.random())
            if len(part) < _SHORTEST * self.group:
                continue
            low, high = extremes(part)
            extreme = bool(np.any(low <= self.lower) or np.any(high >= self.upper))
            if self.group > 1:
                part = averaged(part, self.group)
            self._held.append(_Segment((bag, self.offered), key, self._cells(part), extreme,
                                       _copied(part)))
            self.offered += 1
        if sum(len(one.episode) for one in self._held) > 2 * self.most:
            self._held = self._best()

    def merged(self, other: Selection) -> Selection:
        """Return that of two parts of a record."""
        both = replace(self, offered=self.offered + other.offered,
                       _held=[*self._held, *other._held])
        both._held = both._best()
        return both

    def episodes(self) -> list[Episode]:
        """Return the segments that are chosen, in their order."""
        return [one.episode for one in sorted(self._best(), key=lambda one: one.place)]

    def _best(self) -> list[_Segment]:
        """Return the first segments in the order of choice, as many as may be kept."""
        names = len(self.lower)
        visits = np.zeros(CELLS ** 2 * names * (names - 1) // 2, dtype=np.int64)
        ranked = []
        for one in sorted(self._held, key=lambda one: (one.key, one.place)):
            ranked.append((not one.extreme, int(np.min(visits[one.cells])), one.key, one))
            visits[one.cells] += 1
        ranked.sort(key=lambda row: row[:3])
        sizes = np.cumsum([len(row[3].episode) for row in ranked])
        return [row[3] for row in ranked[:int(np.searchsorted(sizes, self.most, side='right'))]]

    def _cells(self, part: Episode) -> NDArray[np.int64]:
        """Return the cells of all pairs of signals that a segment visits, numbered."""
        cells = cells_of(np.hstack([part.interpolated(), part.inputs_at(part.time)]), self.lower,
                         self.upper)
        pairs = itertools.combinations(range(cells.shape[1]), 2)
        return np.unique(np.concatenate([
            CELLS ** 2 * number + CELLS * cells[:, i] + cells[:, j]
            for number, (i, j) in enumerate(pairs)]))


def _copied(part: Episode) -> Episode:
    """Return a part of an episode that does not keep all of it in memory."""
    return replace(part, time=part.time.copy(), x=part.x.copy(),
                   input_time=part.input_time.copy(), u=part.u.copy())


def cells_of(values: Array, lower: Array | float, upper: Array | float) -> NDArray[np.int64]:
    """Return in which of the cells of each signal's range values (N, n) lie: (N, n)."""
    width = np.where(np.greater(upper, lower), np.subtract(upper, lower), 1.0)
    return np.clip((CELLS * ((values - lower) / width)).astype(np.int64), 0, CELLS - 1)


def visited_cells(episodes: Sequence[Episode], box: Box) -> NDArray[np.int64]:
    """Return the cells (K, n_x + n_u) of the box that measurements and their inputs lie in."""
    lower, upper = (np.append(getattr(box.states, end), getattr(box.inputs, end))
                    for end in ('lower', 'upper'))
    return np.unique(np.concatenate([
        cells_of(np.hstack([one.interpolated(), one.inputs_at(one.time)]), lower, upper)
        for one in episodes]), axis=0)


def coverage(episodes: Sequence[Episode], box: Box) -> dict[tuple[str, str], float]:
    """
    Return the share of the cells of two signals' ranges that are visited, for all pairs.

    Not of all signals at once: an hour of samples cannot fill the cells of six.
    """
    cells = visited_cells(episodes, box)
    names = enumerate((*box.states.names, *box.inputs.names))
    return {(first, second): len(np.unique(cells[:, [i, j]], axis=0)) / CELLS ** 2
            for (i, first), (j, second) in itertools.combinations(names, 2)}
