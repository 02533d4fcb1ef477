# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The numbers of some signals between two resets of time, in portions of bounded memory."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import LATE_NANOSECONDS, NANOSECONDS

Times = NDArray[np.int64]

NO_STAMP = np.iinfo(np.int64).min  # of a type without one

# Measurements of a state in one portion: usual changes are estimated from so many, and memory is
# bounded by them. A bag with fewer is one portion.
MOST = 2**16
# A portion is complete once so many further measurements, and so much of the recorder's time,
# have followed: by then late messages have arrived.
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

    def part(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Entries:
        """Return some of them."""
        return Entries(self.stamp_ns[rows], self.log_ns[rows], self.values[rows])

    def first_of_each(self) -> Entries:
        """Sort by stamp; of repeated stamps the first one received stays."""
        return self.part(np.unique(self.stamp_ns, return_index=True)[1])


@dataclass(frozen=True)
class Clock:
    """The stamp that belongs to a time of receipt."""

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

    def on(self, entries: Entries, open_stamp: int = NO_STAMP) -> Entries:
        """Return entries with a stamp each: that of their receipt where it was left open."""
        received = entries.log_ns
        if not self.wall and len(received):
            received = np.interp(received, self.logs, self.stamps).astype(np.int64)
        missing = (entries.stamp_ns == NO_STAMP) | (entries.stamp_ns == open_stamp)
        return Entries(np.where(missing, received, entries.stamp_ns), entries.log_ns,
                       entries.values)


class Segment:
    """The numbers at some places between two resets of time, or a portion of them."""

    def __init__(self, places: Sequence[MessageField], n_x: int) -> None:
        #: the last stamp [ns] that belongs to this portion, None when it is the last one
        self.until_ns: int | None = None
        #: by place of commands: times [ns] at which commands of earlier portions began to act,
        #: and their values; without dead time
        self.applied: dict[MessageField, tuple[Times, Array]] = {}
        self._places = places
        self._states = places[:n_x]
        self._latest_ns = [NO_STAMP] * n_x
        self._columns = [(array('q'), array('q'), array('d')) for _ in places]

    def add(self, number: int, stamp_ns: int, log_ns: int, value: float) -> None:
        """Append a number of the place so numbered, in the order of receipt."""
        stamps, logs, values = self._columns[number]
        stamps.append(stamp_ns)
        logs.append(log_ns)
        values.append(value)
        if number < len(self._latest_ns) and stamp_ns > self._latest_ns[number]:
            self._latest_ns[number] = stamp_ns

    def set_back(self, number: int, stamp_ns: int) -> int:
        """Return by how much [ns] the next stamp of a state lies before the latest, else 0."""
        if number >= len(self._latest_ns) or stamp_ns == NO_STAMP:
            return 0
        back_ns = self._latest_ns[number] - stamp_ns
        return back_ns if back_ns > LATE_NANOSECONDS else 0

    def of(self, place: MessageField) -> Entries:
        """Return the numbers at a place."""
        return Entries(*map(np.array, self._columns[self._places.index(place)]))

    def clock(self) -> Clock:
        """Return the clock of the first state with stamps."""
        received = [self.of(place) for place in self._states]
        return Clock.of(next((entries for entries in received
                              if np.any(entries.stamp_ns != NO_STAMP)), received[0]))

    def without_stamps(self) -> bool:
        """Whether states were received, none of them with a stamp."""
        stamps = np.concatenate([self.of(place).stamp_ns for place in self._states])
        return bool(len(stamps) and np.all(stamps == NO_STAMP))

    def is_complete(self, size: int) -> bool:
        """Whether a portion of measurements of a state is complete; set its end."""
        counts = [len(stamps) for stamps, _, _ in self._columns[:len(self._states)]]
        if (count := max(counts)) < size + _MARGIN:
            return False
        clock = self.clock()
        entries = clock.on(self.of(self._states[counts.index(count)]))
        until_ns = int(np.partition(entries.stamp_ns, size - 1)[size - 1])
        arrived_ns = np.max(entries.log_ns[entries.stamp_ns <= until_ns])
        late = np.max(entries.log_ns) < arrived_ns + _MARGIN_NS or any(
            not np.any(clock.on(self.of(place)).stamp_ns > until_ns) for place in self._states)
        if late and count < _WAITING * size:
            return False
        self.until_ns = until_ns
        return True

    def following(self) -> Segment:
        """Return the numbers after this portion."""
        assert self.until_ns is not None
        found = Segment(self._places, len(self._states))
        found.applied, found._latest_ns = self.applied, self._latest_ns
        clock = self.clock()
        for number, place in enumerate(self._places):
            entries = self.of(place)
            stamps = clock.on(entries, 0).stamp_ns
            after = stamps > self.until_ns
            if place not in self._states and place not in self.applied:
                before = np.flatnonzero(~after)
                after[before[np.argsort(stamps[before], kind='stable')[-_KEPT:]]] = True
            rest = entries.part(after)
            found._columns[number] = (
                array('q', rest.stamp_ns.tobytes()), array('q', rest.log_ns.tobytes()),
                array('d', rest.values.tobytes()))
        return found


def portion(total: int) -> int:
    """Return the size of nearly equal portions of some measurements."""
    return max(1, -(-total // max(1, -(-total // MOST))))
