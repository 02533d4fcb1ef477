# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""History of the values that are shown as pens, and its decimation, which keeps each extreme."""

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import math
import threading

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.arrays import Array
from koopman_ros.panel.texts import plain

MAX_PENS = 256
MAX_BUCKETS = 10_000
MAX_KINDS = 32
MAX_MARKS = 2_000  #: of each kind, so that many of one leave the others
MAX_TEXT = 200  # characters of a mark

_FIRST_ROOM = 1024  # values
# A window is decimated from here on: a bucket gives its first, its last and two extremes.
_OF_A_BUCKET = 4
_NONE = np.empty(0)


@dataclass(frozen=True)
class Mark:
    """An event in the trends."""

    time: float
    kind: str
    text: str


class _Pen:
    """
    Times that rise, and a value at each; at most so many.

    Values are appended to arrays with room at their end. When they are full, what is kept moves to
    new ones, so that what :meth:`view` gave stays as it was.
    """

    def __init__(self, span: float, points: int) -> None:
        self._span, self._points = span, points
        self._times, self._values = np.empty(_FIRST_ROOM), np.empty(_FIRST_ROOM)
        self._begin = self._end = 0
        # whether somebody may look at the arrays
        self._viewed = False
        #: time of the first value that was added, not filled in
        self.live = math.inf

    @property
    def last(self) -> float:
        """Time of the last value; -inf where there is none."""
        return float(self._times[self._end - 1]) if self._end > self._begin else -math.inf

    def view(self) -> tuple[Array, Array]:
        """Return times and values; they do not change any more."""
        self._viewed = True
        return self._times[self._begin:self._end], self._values[self._begin:self._end]

    def add(self, time: float, value: float) -> None:
        if time <= self.last:
            held = self._values[self._end - 1]
            if time == self.last and (value == held or (value != value and held != held)):
                return
            self.cut(time)
        if self._end == len(self._times):
            self._move()
        self._times[self._end], self._values[self._end] = time, value
        self._end += 1
        self._begin = max(self._begin, self._end - self._points)
        self.live = min(self.live, time)

    def cut(self, time: float) -> None:
        """Drop what is at a time or later."""
        end = self._begin + int(np.searchsorted(self._times[self._begin:self._end], time))
        if end < self._end and self._viewed:
            # what follows would be written where somebody looks
            self._put(self._times[self._begin:end], self._values[self._begin:end],
                      len(self._times))
        else:
            self._end = end
        if time <= self.live:
            self.live = math.inf

    def fill(self, times: Array, values: Array) -> None:
        """Put in what was before the live values; at a time that is held it is replaced."""
        new = times < self.live
        held, old = self.view()
        live = int(np.searchsorted(held, self.live))
        times = np.concatenate((held[:live], times[new]))
        values = np.concatenate((old[:live], values[new]))
        order = np.argsort(times, kind='stable')
        times, values = times[order], values[order]
        last = np.append(times[1:] != times[:-1], True)[:len(times)]
        times = np.concatenate((times[last], held[live:]))[-self._points:]
        values = np.concatenate((values[last], old[live:]))[-self._points:]
        self._put(times, values, len(times) + _FIRST_ROOM)

    def _move(self) -> None:
        """Make room at the end, twice as much up to the bound; forget what is too old."""
        times = self._times[self._begin:self._end]
        start = int(np.searchsorted(times, times[-1] - self._span))
        # beyond the bound, there is room for a quarter until the next move
        room = min(max(_FIRST_ROOM, 2 * (len(times) - start)),
                   self._points + self._points // 4 + 1)
        self._put(times[start:], self._values[self._begin + start:self._end], room)

    def _put(self, times: Array, values: Array, room: int) -> None:
        self._begin, self._end, self._viewed = 0, len(times), False
        self._times, self._values = np.empty(room), np.empty(room)
        self._times[:self._end], self._values[:self._end] = times, values


class Trends:
    """
    The past of pens, and events; several threads may use it.

    Values that are not finite are gaps, held and returned as NaN. The times of a pen rise: where
    one jumps back, as after a plant was reset, what is later is dropped, and a second value of a
    time replaces the first.

    :param span: s that are kept at least, where the bound allows it.
    :param points: values of each pen at most.
    :raises ValueError: for a span or a bound that is not positive.
    """

    def __init__(self, span: float = 8 * 3600.0, points: int = 600_000) -> None:
        if not span > 0.0 or points < 1:
            raise ValueError(f'span and points must be positive, got {span} s and {points}')
        self._span, self._points = span, points
        self._pens: dict[str, _Pen] = {}
        self._marks: dict[str, list[Mark]] = {}
        self._lock = threading.Lock()

    def add(self, pen: str, time: float, value: float) -> None:
        """
        Append a value to a pen; one at no finite time is left out.

        :raises ValueError: for too many pens.
        """
        if math.isfinite(time):
            with self._lock:
                self._pen(pen).add(time, value if math.isfinite(value) else math.nan)

    def extend(self, pen: str, times: ArrayLike, values: ArrayLike) -> None:
        """
        Fill in the past of a pen, e.g. from a bag: what is before the first value that was added.

        In parts and in any order; within one call, what follows a jump back counts.

        :param times: shape (k,).
        :param values: shape (k,).
        :raises ValueError: for shapes that do not fit, and for too many pens.
        """
        t, v = np.asarray(times, dtype=np.float64), np.asarray(values, dtype=np.float64)
        if t.ndim != 1 or t.shape != v.shape:
            raise ValueError(f'incompatible times and values: {t.shape} and {v.shape}; both must '
                             'be of one and the same length')
        t, v = t[np.isfinite(t)], v[np.isfinite(t)]
        if len(t) == 0:
            return
        # as add() does it: a value stays where all that follow are later
        ahead = np.append(np.minimum.accumulate(t[::-1])[::-1][1:], math.inf)
        t, v = t[t < ahead], v[t < ahead]
        v = np.where(np.isfinite(v), v, math.nan)
        with self._lock:
            self._pen(pen).fill(t, v)

    def mark(self, time: float, kind: str, text: str) -> None:
        """
        Add an event, in any order; of a kind that has too many the oldest goes.

        :raises ValueError: for too many kinds.
        """
        if not math.isfinite(time):
            return
        with self._lock:
            marks = self._marks.setdefault(kind, [])
            if len(self._marks) > MAX_KINDS:
                del self._marks[kind]
                raise ValueError(f'there are {MAX_KINDS} kinds of marks, no more may be: {kind!r}')
            insort(marks, Mark(time, kind, plain(text, MAX_TEXT)), key=_time)
            if len(marks) > MAX_MARKS:
                del marks[0]

    def rewind(self, time: float) -> None:
        """Drop values and events that are later, of all pens; after a plant was reset."""
        if math.isnan(time):
            return
        with self._lock:
            for pen in self._pens.values():
                pen.cut(math.nextafter(time, math.inf))
            for marks in self._marks.values():
                del marks[bisect_right(marks, time, key=_time):]

    def window(self, pens: Iterable[str], begin: float, end: float, buckets: int = 600
               ) -> dict[str, tuple[Array, Array]]:
        """
        Return times and values of pens from one time to another, in order.

        Where there are many, each bucket gives its first, lowest, highest and last value at their
        own times, and one NaN where there is a gap. The value before the window and the one after
        it come with them, so that lines run to the edges. A pen without values is empty.

        :param buckets: at most :data:`MAX_BUCKETS`, about as many as pixels.
        """
        buckets = min(max(int(buckets), 1), MAX_BUCKETS)
        return {pen: _decimated(*held, begin, end, buckets)
                for pen, held in self._views(pens).items()}

    def marks(self, begin: float, end: float) -> tuple[Mark, ...]:
        """Return the events from one time to another, in order."""
        if not begin <= end:
            return ()
        with self._lock:
            found = [mark for marks in self._marks.values() for mark in
                     marks[bisect_left(marks, begin, key=_time):bisect_right(
                         marks, end, key=_time)]]
        return tuple(sorted(found, key=_time))

    def at(self, pens: Iterable[str], time: float) -> dict[str, float]:
        """Return the last value at a time or before, NaN in a gap; no pen without one."""
        found = {}
        for pen, (times, values) in self._views(pens).items():
            place = int(np.searchsorted(times, time, side='right'))
            # NaN is sorted to the end
            if place and not math.isnan(time):
                found[pen] = float(values[place - 1])
        return found

    @property
    def latest(self) -> float | None:
        """The time of the last value of all pens."""
        with self._lock:
            last = max((pen.last for pen in self._pens.values()), default=-math.inf)
        return last if math.isfinite(last) else None

    def _views(self, pens: Iterable[str]) -> Mapping[str, tuple[Array, Array]]:
        # the lock is held for this alone, not while somebody reads
        with self._lock:
            return {name: self._pens[name].view() if name in self._pens else (_NONE, _NONE)
                    for name in pens}

    def _pen(self, name: str) -> _Pen:
        pen = self._pens.get(name)
        if pen is None:
            if len(self._pens) >= MAX_PENS:
                raise ValueError(f'there are {MAX_PENS} pens, no more may be: {name!r}')
            pen = self._pens[name] = _Pen(self._span, self._points)
        return pen


def _time(mark: Mark) -> float:
    return mark.time


def _decimated(times: Array, values: Array, begin: float, end: float, buckets: int
               ) -> tuple[Array, Array]:
    """Return what :meth:`Trends.window` says, of one pen."""
    if not begin <= end:
        return _NONE.copy(), _NONE.copy()
    first = int(np.searchsorted(times, begin))
    behind = int(np.searchsorted(times, end, side='right'))
    if behind - first <= _OF_A_BUCKET * buckets:
        chosen = np.arange(max(first - 1, 0), min(behind + 1, len(times)))
    else:
        inside = _chosen(times[first:behind], values[first:behind], begin, end, buckets) + first
        chosen = np.concatenate((np.arange(max(first - 1, 0), first), inside,
                                 np.arange(behind, min(behind + 1, len(times)))))
    return times[chosen], values[chosen]


def _chosen(times: Array, values: Array, begin: float, end: float, buckets: int
            ) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the places of what the buckets give, in order."""
    edges = np.linspace(max(begin, times[0]), min(end, times[-1]), buckets, endpoint=False)
    starts = np.unique(np.append(0, np.searchsorted(times, edges[1:])))
    starts = starts[starts < len(times)]
    ends = np.append(starts[1:], len(times))
    places = [starts, ends - 1]
    for found in (_equal_to(values, np.fmin.reduceat(values, starts), ends - starts),
                  _equal_to(values, np.fmax.reduceat(values, starts), ends - starts),
                  np.flatnonzero(np.isnan(values))):
        # the first in each bucket that has one
        after = np.searchsorted(found, starts)
        has = after < len(found)
        place = found[after[has]]
        places.append(place[place < ends[has]])
    return np.unique(np.concatenate(places))


def _equal_to(values: Array, extremes: Array, counts: np.ndarray[tuple[int], np.dtype[np.intp]]
              ) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the places of the extreme of each bucket."""
    return np.flatnonzero(values == np.repeat(extremes, counts))
