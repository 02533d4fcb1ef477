# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Inputs under way: each acts on the plant a dead time of its own after it was applied."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.core.arrays import Array, read_only
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.tuning import largest_bandwidth

# Stamp of an input that was applied before all others.
_ALWAYS = -(1 << 62)


@dataclass(frozen=True, slots=True)
class AppliedInputs:
    """
    Inputs (n_u,) in input units, each applied from its time until that of the next one.

    The first one was applied at all times before, too. A dead time is an integer of nanoseconds
    for each input.
    """

    times_ns: tuple[int, ...] = ()  #: rising
    values: tuple[Array, ...] = ()  #: (n_u,) each

    def followed_by(self, time_ns: int, u: Array, dead_ns: tuple[int, ...]) -> AppliedInputs:
        """Append an input in place of those from its time on; drop those that no longer act."""
        end = bisect_left(self.times_ns, time_ns)
        times, values = (*self.times_ns[:end], time_ns), (*self.values[:end], u)
        begin = max(0, bisect_right(times, time_ns - max(dead_ns, default=0)) - 1)
        return AppliedInputs(times[begin:], values[begin:])

    def corrected(self, u: Array) -> AppliedInputs:
        """Replace the last input by the measured one (n_u,)."""
        return AppliedInputs(self.times_ns or (_ALWAYS,), (*self.values[:-1], read_only(u)))

    def shifted(self, by_ns: int) -> AppliedInputs:
        """Move all times, as a clock was set."""
        return AppliedInputs(tuple(time + by_ns for time in self.times_ns), self.values)

    def acting(self, time_ns: int, dead_ns: tuple[int, ...]) -> Array:
        """Return the input (n_u,) that acts on the plant from a time on."""
        if len(self.values) == 1:
            return self.values[0]
        rows = [max(0, bisect_right(self.times_ns, time_ns - dead) - 1) for dead in dead_ns]
        return self.values[rows[0]] if len(set(rows)) == 1 else np.array(
            [self.values[row][i] for i, row in enumerate(rows)])

    def assumed(self, time_ns: int, dead_ns: tuple[int, ...]) -> float:
        """Return the time in s for which inputs from before the first known one still act."""
        first = next((time for time in self.times_ns if time > _ALWAYS // 2), time_ns)
        return max(0, first + max(dead_ns, default=0) - time_ns) / NANOSECONDS

    def pieces(self, start_ns: int, end_ns: int, dead_ns: tuple[int, ...]
               ) -> list[tuple[float, Array]]:
        """Return the durations in s and the inputs (n_u,) that act from one time to another."""
        edges = {start_ns, end_ns}
        for dead in set(dead_ns):
            first = bisect_right(self.times_ns, start_ns - dead, 1)
            for time in self.times_ns[first:bisect_left(self.times_ns, end_ns - dead, first)]:
                edges.add(time + dead)
        return [((end - begin) / NANOSECONDS, self.acting(begin, dead_ns))
                for begin, end in itertools.pairwise(sorted(edges))]


class PendingInputs(NamedTuple):
    """The inputs that were applied before a time, of which some act after it."""

    applied: AppliedInputs
    time_ns: int  #: that of the estimate
    dead_ns: tuple[int, ...]  #: (n_u,) dead time of each input

    def between(self, start_ns: int, end_ns: int) -> list[tuple[float, Array]]:
        """Return :meth:`AppliedInputs.pieces` between two times after that of the estimate."""
        return self.applied.pieces(self.time_ns + start_ns, self.time_ns + end_ns, self.dead_ns)


def held_means(edges: Array, values: Array, times: Array) -> Array:
    """
    Return the means (N - 1, n) of held values between times (N,).

    :param edges: (K + 1,) from which one value is held until the next one, the last its end.
    :param values: (K, n).
    """
    integral = np.vstack((np.zeros((1, values.shape[1])), np.cumsum(
        values * np.diff(edges)[:, None], axis=0)))
    return np.diff(np.column_stack([np.interp(times, edges, one) for one in integral.T]),
                   axis=0) / np.diff(times)[:, None]


def default_bandwidth(modes: ArrayLike, dead_time: float) -> float:
    """
    Return the bandwidth in 1/s whose delay margin a filter keeps unless it is tuned.

    That is the fastest mode, or, behind a dead time, half of :func:`largest_bandwidth`: a filter
    corrects the state as well, and overshoots where the dead time is a tenth longer than known.

    :param modes: eigenvalues of the model in 1/s.
    :param dead_time: the longest of the inputs, in s.
    :return: infinity for an unstable plant without dead time, which cannot wait.
    """
    sizes = np.abs(modes)
    if dead_time > 0.0:
        return 0.5 * largest_bandwidth(dead_time, float(np.min(sizes)))
    return float(np.max(sizes)) if np.all(np.real(modes) < 0.0) else math.inf
