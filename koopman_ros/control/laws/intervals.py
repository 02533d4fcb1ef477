# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The intervals of a horizon, their limits, and how a plan over some is taken over to others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array, frozen


@dataclass(frozen=True, slots=True)
class _Shift:
    """Where the inputs and nodes of a plan come from in the one before."""

    held: NDArray[np.int64]  #: (N,) the input of an interval
    left: NDArray[np.int64]  #: (N + 1,) the nodes before each, and `right` after it
    right: NDArray[np.int64]
    share: Array  #: (N + 1, 1) of the latter


@dataclass(frozen=True)
class Intervals:
    """Intervals of a horizon from the present on, each with one input that is held."""

    lengths: Array  #: (N,) in the model's time unit, the first that of a sample

    @classmethod
    def reaching(cls, horizon: float, first: float, count: int, longest: float) -> Intervals:
        """Let so many grow by a factor until they reach a horizon; none is longer than allowed."""
        lengths = first * _growth(count, horizon / first) ** np.arange(count)
        return cls(frozen(np.minimum(lengths, longest), 'intervals', (count,)))

    @cached_property
    def times(self) -> Array:
        """The nodes (N + 1,) between them, from 0."""
        return np.concatenate(([0.0], np.cumsum(self.lengths)))

    @cached_property
    def before(self) -> Array:
        """What passes until each input from the one before it, (N, 1)."""
        return np.concatenate((self.lengths[:1], self.lengths[:-1]))[:, None]

    def shifted(self, u: Array, x: Array, lengths: Array) -> tuple[Array, Array]:
        """
        Take over the plan of the sample before.

        :param u: (M, n_u) its inputs.
        :param x: (M + 1, n_x) its nodes.
        :param lengths: (M,) its intervals.
        :return: the inputs (N, n_u) that held in the middle of each interval, and nodes
            (N + 1, n_x) on the straight ways between; beyond its end, the last.
        """
        shift = self._shift(lengths.tobytes())
        left = x.take(shift.left, axis=0)
        return (u.take(shift.held, axis=0),
                left + shift.share * (x.take(shift.right, axis=0) - left))

    @cached_property
    def _shift(self) -> Any:
        @lru_cache(maxsize=4)
        def of(lengths: bytes) -> _Shift:
            old = np.concatenate(([0.0], np.cumsum(np.frombuffer(lengths))))
            new = self.lengths[0] + self.times
            last = len(old) - 2
            held = np.searchsorted(old[1:], 0.5 * (new[1:] + new[:-1]))
            left = np.minimum(np.searchsorted(old, new, 'right') - 1, last)
            share = np.minimum((new - old[left]) / (old[left + 1] - old[left]), 1.0)
            return _Shift(np.minimum(held, last), left, left + 1, share[:, None])

        return of


@dataclass(frozen=True)
class Reach:
    """What limits the inputs (n_u,) of a plan, in scaled deviations."""

    lower: Array  #: lower end of their range, to `upper`
    upper: Array
    #: (N, n_u) what each may change from one interval to the next: the first since the command
    #: before
    change: Array

    def differences(self, first: bool) -> tuple[Array, NDArray[np.intp]]:
        """
        Return rows of the change of each limited input from the interval before, and its place.

        :param first: whether nothing is before the first interval.
        :return: (rows, N n_u) and (rows,) of N n_u.
        """
        return self._first if first else self._further

    @cached_property
    def _further(self) -> tuple[Array, NDArray[np.intp]]:
        (N, n_u), places = self.change.shape, np.flatnonzero(np.isfinite(self.change))
        return (np.eye(N * n_u) - np.eye(N * n_u, k=-n_u))[places], places

    @cached_property
    def _first(self) -> tuple[Array, NDArray[np.intp]]:
        rows, places = self._further
        later = places >= self.change.shape[1]
        return rows[later], places[later]


def _growth(count: int, total: float) -> float:
    """Return g >= 1 with 1 + g + ... + g^(count - 1) = total; 1 where that is less than count."""
    # beside 1 nothing is left of g - 1
    if total <= count * (1.0 + 1e-9) or count < 2:
        return 1.0
    low, high = 1.0, 2.0
    while (high ** count - 1.0) / (high - 1.0) < total:
        high *= 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if (middle ** count - 1.0) / (middle - 1.0) < total:
            low = middle
        else:
            high = middle
    return high
