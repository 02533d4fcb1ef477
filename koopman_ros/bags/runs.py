# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a bag holds of some signals between two resets of time, in portions that bound memory."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.bags.columns import Column, NO_STAMP, Times
from koopman_ros.units import LATE_NANOSECONDS, NANOSECONDS
from koopman_ros.wire import Place

# Measurements of a state that are put together at a time: what is usual among them is told from
# so many, and memory is bounded by them. A bag with fewer is one portion.
MOST = 2**16
# By as many measurements, and by as much of the recorder's time, a portion lies back: what belongs
# to it has arrived by then.
_MARGIN = 1000
_MARGIN_NS = 10 * NANOSECONDS
# So many portions may wait for a state that is not measured any more.
_WAITING = 4
# Measurements of an input from before a portion that are kept for it.
_KEPT = 16
# A clock that differs from the recorder's by more is not the wall clock.
_SAME_CLOCK_NS = 5 * NANOSECONDS


@dataclass(frozen=True)
class Entries:
    """n numbers at a place, in the order of their receipt."""

    stamp_ns: Times  #: (n,) NO_STAMP for a type without one, 0 where it was left open
    log_ns: Times  #: (n,) of receipt
    values: Array  #: (n,) in the unit of the place

    def __len__(self) -> int:
        return len(self.values)

    def part(self, rows: NDArray[np.bool_] | NDArray[np.int64] | slice) -> Entries:
        """Return some of them."""
        return Entries(self.stamp_ns[rows], self.log_ns[rows], self.values[rows])

    @classmethod
    def joined(cls, parts: Sequence[Entries]) -> Entries:
        """Put some together, one after the other."""
        if not parts:
            return cls(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0))
        if len(parts) == 1:
            return parts[0]
        return cls(*(np.concatenate([getattr(part, name) for part in parts])
                     for name in ('stamp_ns', 'log_ns', 'values')))

    def first_of_each(self) -> Entries:
        """Sort by stamp; of repeated stamps the first one received stays."""
        return self.part(np.unique(self.stamp_ns, return_index=True)[1])


@dataclass(frozen=True)
class Clock:
    """How the time of receipt tells that of the stamps."""

    wall: bool  #: whether stamps are those of the recorder's clock
    logs: Times  #: (n,) times of receipt, rising
    stamps: Times  #: (n,) stamps, rising

    @classmethod
    def of(cls, entries: Entries) -> Clock:
        """Compare stamps with their receipts; without any, receipts are stamps."""
        once = entries.part(entries.stamp_ns != NO_STAMP).first_of_each()
        apart = np.abs(once.log_ns - once.stamp_ns)
        return cls(not len(once) or float(np.median(apart)) < _SAME_CLOCK_NS,
                   np.sort(once.log_ns), once.stamp_ns)

    def at(self, log_ns: Times) -> Times:
        """Return the stamps [ns] of receipts."""
        if self.wall or not len(log_ns):
            return log_ns
        return np.interp(log_ns, self.logs, self.stamps).astype(np.int64)

    def on(self, entries: Entries, open_stamp: int = NO_STAMP) -> Entries:
        """Return entries with a stamp each: that of their receipt where it was left open."""
        missing = (entries.stamp_ns == NO_STAMP) | (entries.stamp_ns == open_stamp)
        stamps = np.where(missing, self.at(entries.log_ns), entries.stamp_ns)
        return Entries(stamps, entries.log_ns, entries.values)


@dataclass
class Run:
    """The numbers of a loop between two resets of time, or a portion of them."""

    states: Sequence[Place]
    #: the last stamp [ns] that belongs to this portion, None when it is the last one
    until_ns: int | None = None
    #: by place of commands: when [ns] what began to act, as earlier portions tell; before `delay`
    acted: dict[Place, tuple[Times, Array]] = field(default_factory=dict)
    _parts: dict[Place, list[Entries]] = field(default_factory=lambda: defaultdict(list))
    _latest: dict[Place, int] = field(default_factory=dict)

    def of(self, place: Place) -> Entries:
        """Return what was received at a place."""
        parts = self._parts[place]
        self._parts[place] = [Entries.joined(parts)]
        return self._parts[place][0]

    def add(self, heard: Mapping[Place, Entries]) -> None:
        """Append what was received next."""
        for place, entries in heard.items():
            if not len(entries):
                continue
            self._parts[place].append(entries)
            if place in self.states:
                self._latest[place] = max(self._latest.get(place, NO_STAMP),
                                          int(np.max(entries.stamp_ns)))

    def set_back(self, place: Place, stamp_ns: Times) -> tuple[int, int] | None:
        """Tell which of the next stamps of a state comes first after a reset, and by how much."""
        latest = self._latest.get(place, NO_STAMP)
        before = np.maximum.accumulate(np.concatenate(([latest], stamp_ns)))[:-1]
        back = (before != NO_STAMP) & (stamp_ns < before - LATE_NANOSECONDS)
        if not np.any(back) or stamp_ns[np.argmax(back)] == NO_STAMP:
            return None
        at = int(np.argmax(back))
        return at, int(before[at] - stamp_ns[at])

    def clock(self) -> Clock:
        """Return the clock that the first state with stamps tells."""
        heard = map(self.of, self.states)
        return Clock.of(next((entries for entries in heard
                              if np.any(entries.stamp_ns != NO_STAMP)), Entries.joined(())))

    def without_stamps(self) -> bool:
        """Tell whether states were received, none of them with a stamp."""
        heard = [entries for entries in map(self.of, self.states) if len(entries)]
        return bool(heard) and all(np.all(entries.stamp_ns == NO_STAMP) for entries in heard)

    def is_ready(self, size: int) -> bool:
        """Tell whether a portion of so many measurements of a state is whole; set its end."""
        counts = {place: sum(map(len, self._parts[place])) for place in self.states}
        base = max(counts, key=lambda place: counts[place])
        if counts[base] < size + _MARGIN:
            return False
        clock = self.clock()
        entries = clock.on(self.of(base))
        until = int(np.partition(entries.stamp_ns, size - 1)[size - 1])
        arrived = int(np.max(entries.log_ns[entries.stamp_ns <= until]))
        late = int(np.max(entries.log_ns)) < arrived + _MARGIN_NS or any(
            not np.any(other.stamp_ns > until)
            for other in map(clock.on, map(self.of, self.states)))
        if late and counts[base] < _WAITING * size:
            return False
        self.until_ns = until
        return True

    def rest(self) -> Run:
        """Return what comes after this portion."""
        assert self.until_ns is not None
        following = Run(self.states, acted=self.acted, _latest=self._latest)
        clock = self.clock()
        for place in list(self._parts):
            entries = self.of(place)
            stamps = clock.on(entries, 0).stamp_ns
            after = stamps > self.until_ns
            if place not in self.states and place not in self.acted:
                before = np.flatnonzero(~after)
                after[before[np.argsort(stamps[before], kind='stable')[-_KEPT:]]] = True
            following.add({place: entries.part(after)})
        return following


def portion(total: int) -> int:
    """Return how many of some measurements are put together at a time: nearly equal portions."""
    return max(1, -(-total // max(1, -(-total // MOST))))


def accepted(column: Column, within: tuple[float, float]) -> NDArray[np.bool_]:
    """Tell which numbers there are that can be (n,)."""
    lowest, highest = within
    found: NDArray[np.bool_] = (column.present & np.isfinite(column.values)
                                & (column.values >= lowest) & (column.values <= highest))
    return found


def by_place(columns: Mapping[Place, tuple[NDArray[np.int64], Entries]], first: int, last: int
             ) -> Iterator[tuple[Place, tuple[NDArray[np.int64], Entries]]]:
    """Yield what was received in some rows of a block, at each place."""
    for place, (rows, entries) in columns.items():
        inside = slice(*np.searchsorted(rows, (first, last)))
        yield place, (rows[inside], entries.part(inside))
