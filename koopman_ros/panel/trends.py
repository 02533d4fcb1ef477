# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""History of values over time, and its decimation, which keeps each extreme."""

from bisect import bisect_left, bisect_right, insort
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import math
import threading

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.panel.files import sanitize_text

MAX_BUCKETS = 10_000
MAX_MARKS = 2_000  #: of each kind: many of one kind leave the others
MAX_TEXT = 200  # characters of a mark
_SAID = 3  # last events of a group that are written out

_FIRST_ROOM = 1024  # values
_OF_A_BUCKET = 4  # values of a bucket: first, last, lowest and highest
_Places = np.ndarray[tuple[int], np.dtype[np.intp]]


@dataclass(frozen=True)
class TrendMark:
    """An event in the trends."""

    time: float
    kind: str
    text: str


@dataclass(frozen=True)
class MarkGroup:
    """Events that are near in time, as one mark."""

    time: float  #: of the first
    label: str  #: kinds, with their numbers
    text: str
    alarm: bool  #: whether an alarm is one of them


def grouped(marks: Sequence[TrendMark], width: float) -> list[MarkGroup]:
    """Return events in order as marks, each of the events within a width of its first one."""
    groups: list[list[TrendMark]] = []
    for mark in marks:
        if not groups or mark.time > groups[-1][0].time + width:
            groups.append([])
        groups[-1].append(mark)
    return [MarkGroup(group[0].time, ', '.join(
        f'{kind} ×{count}' if count > 1 else kind
        for kind, count in Counter(mark.kind for mark in group).items()), '; '.join((
            *((f'{len(group) - _SAID} earlier',) if len(group) > _SAID else ()),
            *(f'{mark.kind}: {mark.text}' for mark in group[-_SAID:]))),
        any(mark.kind == 'alarm' for mark in group)) for group in groups]


class _RecordedPen:
    """Rising times with a value at each, in arrays with room at their end."""

    def __init__(self, span: float, points: int) -> None:
        self._span, self._points = span, points
        self._times, self._values = np.empty(_FIRST_ROOM), np.empty(_FIRST_ROOM)
        self._begin = self._end = 0

    @property
    def times(self) -> Array:
        return self._times[self._begin:self._end]

    @property
    def values(self) -> Array:
        return self._values[self._begin:self._end]

    @property
    def last(self) -> float:
        """The last time; -inf for none."""
        return float(self._times[self._end - 1]) if self._end > self._begin else -math.inf

    def add(self, time: float, value: float) -> None:
        if time <= self.last:
            self.cut(time)
        if self._end == len(self._times):
            # double the room, and drop the values that are too old
            kept = int(np.searchsorted(self.times, self.last - self._span))
            room = min(2 * (len(self.times) - kept), self._points + self._points // 4)
            times, values = self.times[kept:], self.values[kept:]
            size = max(room, len(times) + _FIRST_ROOM)
            self._times, self._values = np.empty(size), np.empty(size)
            self._times[:len(times)], self._values[:len(values)] = times, values
            self._begin, self._end = 0, len(times)
        self._times[self._end], self._values[self._end] = time, value
        self._end += 1
        self._begin = max(self._begin, self._end - self._points)

    def cut(self, time: float) -> None:
        """Drop the values at a time and later."""
        self._end = self._begin + int(np.searchsorted(self.times, time))


class Trends:
    """
    History of pens, and events; several threads may use it.

    Values that are not finite are gaps, returned as NaN. The times of a pen rise: when time jumps
    back, as after a reset of a simulation, later values are dropped, and a second value at a time
    replaces the first.

    >>> trends = Trends()
    >>> for second in range(4):
    ...     trends.add('level', second, 2.0 * second)
    >>> trends.window(['level'], 1.5, 2.5)['level'][1].tolist()
    [2.0, 4.0, 6.0]

    :param span: s that are kept at least, within the bound.
    :param points: bound of the values of each pen.
    """

    def __init__(self, span: float = 8 * 3600.0, points: int = 600_000) -> None:
        self._span, self._points = span, points
        self._pens: dict[str, _RecordedPen] = {}
        self._marks: dict[str, list[TrendMark]] = {}
        self._lock = threading.Lock()

    def add(self, pen: str, time: float, value: float) -> None:
        """Append a value to a pen."""
        with self._lock:
            self._pen(pen).add(time, value if math.isfinite(value) else math.nan)

    def mark(self, time: float, kind: str, text: str) -> None:
        """Add an event; too many of a kind drop its oldest."""
        with self._lock:
            marks = self._marks.setdefault(kind, [])
            insort(marks, TrendMark(time, kind, sanitize_text(text, MAX_TEXT)), key=_time)
            if len(marks) > MAX_MARKS:
                del marks[0]

    def rewind(self, time: float) -> None:
        """Drop all later values and events, after a simulation was reset."""
        with self._lock:
            for pen in self._pens.values():
                pen.cut(math.nextafter(time, math.inf))
            for marks in self._marks.values():
                del marks[bisect_right(marks, time, key=_time):]

    def interrupt(self, pens: Iterable[str] | None = None) -> None:
        """Add a gap after the last value of pens, by default of all."""
        with self._lock:
            for pen in [self._pens[name] for name in (self._pens if pens is None else pens)
                        if name in self._pens]:
                if math.isfinite(pen.last):
                    pen.add(math.nextafter(pen.last, math.inf), math.nan)

    @property
    def pens(self) -> tuple[str, ...]:
        """Names of all pens."""
        with self._lock:
            return tuple(self._pens)

    def window(self, pens: Iterable[str], begin: float, end: float, buckets: int = 600
               ) -> dict[str, tuple[Array, Array]]:
        """
        Return times and values of pens from one time to another.

        Each of many buckets has its first, lowest, highest and last value at their own times, and
        one NaN for a gap. The values before and after the window are added, so that lines extend
        to its edges. A pen without values is empty.

        :param buckets: at most :data:`MAX_BUCKETS`, about the number of pixels.
        """
        buckets = min(max(buckets, 1), MAX_BUCKETS)
        found = {}
        with self._lock:
            for name in pens:
                pen = self._pen(name)
                chosen = _decimated(pen.times, pen.values, begin, end, buckets)
                found[name] = pen.times[chosen], pen.values[chosen]
        return found

    def marks(self, begin: float, end: float) -> tuple[TrendMark, ...]:
        """Return the events from one time to another, in order."""
        with self._lock:
            found = [mark for marks in self._marks.values() for mark in
                     marks[bisect_left(marks, begin, key=_time):bisect_right(
                         marks, end, key=_time)]]
        return tuple(sorted(found, key=_time))

    @property
    def latest(self) -> float | None:
        """The time of the last value of all pens."""
        with self._lock:
            last = max((pen.last for pen in self._pens.values()), default=-math.inf)
        return last if math.isfinite(last) else None

    def _pen(self, name: str) -> _RecordedPen:
        return self._pens.setdefault(name, _RecordedPen(self._span, self._points))


def _time(mark: TrendMark) -> float:
    return mark.time


def _decimated(times: Array, values: Array, begin: float, end: float, buckets: int) -> _Places:
    """Return the places of the values of a window."""
    first, behind = int(np.searchsorted(times, begin)), int(np.searchsorted(times, end, 'right'))
    if behind - first <= _OF_A_BUCKET * buckets:
        return np.arange(max(first - 1, 0), min(max(behind, first) + 1, len(times)))
    inside = _chosen(times[first:behind], values[first:behind], buckets) + first
    return np.concatenate((np.arange(max(first - 1, 0), first), inside,
                           np.arange(behind, min(behind + 1, len(times)))))


def _chosen(times: Array, values: Array, buckets: int) -> _Places:
    """Return the places of first, lowest, highest and last value and of a gap in each bucket."""
    edges = np.linspace(times[0], times[-1], buckets, endpoint=False)
    starts = np.unique(np.searchsorted(times, edges))
    ends = np.append(starts[1:], len(times))
    places = [starts, ends - 1]
    lowest, highest = (np.repeat(extreme.reduceat(values, starts), ends - starts)
                       for extreme in (np.fmin, np.fmax))
    for found in (np.flatnonzero(values == lowest), np.flatnonzero(values == highest),
                  np.flatnonzero(np.isnan(values))):
        # the first in each bucket that has one
        after = np.searchsorted(found, starts)
        has = after < len(found)
        place = found[after[has]]
        places.append(place[place < ends[has]])
    return np.unique(np.concatenate(places))
