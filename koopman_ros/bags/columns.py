# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The numbers of a bag at some places, block by block, as arrays."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.bags import limits
from koopman_ros.bags.blocks import Block, message_blocks
from koopman_ros.bags.decoding import Decoders
from koopman_ros.bags.layout import Layout, layout_of
from koopman_ros.bags.series import stamped_number
from koopman_ros.bags.storage import locate
from koopman_ros.units import NANOSECONDS
from koopman_ros.wire import Place

NO_STAMP = np.iinfo(np.int64).min  # of a type without one
# Shapes of messages that are looked for, in one file and topic.
_MOST_LAYOUTS = 8

Times = NDArray[np.int64]


@dataclass(frozen=True)
class Column:
    """The numbers at one place, of n messages in the order of their receipt."""

    row: NDArray[np.int64]  #: (n,) of each message among those of all places in the block
    stamp_ns: Times  #: (n,) of the header, NO_STAMP where the type has none
    log_ns: Times  #: (n,) of receipt
    values: Array  #: (n,) in the unit of the place
    present: NDArray[np.bool_]  #: (n,) whether a message has the number; an array may lack it


def columns(path: str | os.PathLike[str], places: Sequence[Place]
            ) -> Iterator[dict[Place, Column]]:
    """
    Yield the numbers of a bag at some places, a block of messages at a time.

    They are those that :func:`read_messages` with `recover` and :func:`stamped_number` give one
    by one, which is what a new kind of message is decoded by; the next ones like it are taken
    from the same bytes.

    :raises BagReadError: as these do.
    """
    by_topic: dict[str, list[Place]] = defaultdict(list)
    for place in places:
        by_topic[place.topic].append(place)
    for file in locate(path, recover=True)[0]:
        readers: dict[int, _Reader] = {}
        decoders = Decoders(file)
        for block in message_blocks(file, by_topic):
            found: dict[Place, list[Column]] = defaultdict(list)
            with limits.enough_memory(file):
                for number in np.unique(block.channel).tolist():
                    rows = np.flatnonzero(block.channel == number)
                    here = by_topic[block.channels[number].topic]
                    if number not in readers:
                        readers[number] = _Reader(path, file, decoders, here)
                    for place, column in zip(here, readers[number].read(block, rows),
                                             strict=True):
                        found[place].append(column)
            yield {place: _merged(parts) for place, parts in found.items()}


def _merged(parts: Sequence[Column]) -> Column:
    """Put columns of one block together, of a topic with several channels."""
    if len(parts) == 1:
        return parts[0]
    row = np.concatenate([part.row for part in parts])
    order = np.argsort(row)
    return Column(row[order], *(np.concatenate([getattr(part, name) for part in parts])[order]
                                for name in ('stamp_ns', 'log_ns', 'values', 'present')))


class _Reader:
    """Reads the numbers of one channel; knows the shapes of messages that it has seen."""

    def __init__(self, bag: str | os.PathLike[str], file: Path, decoders: Decoders,
                 places: Sequence[Place]) -> None:
        self._bag, self._file, self._places = bag, file, places
        self._decoders = decoders
        self._layouts: list[Layout] = []
        self._left = _MOST_LAYOUTS

    def read(self, block: Block, rows: NDArray[np.int64]) -> list[Column]:
        """Return a column for each place."""
        part = block.part(rows)
        n, p = len(rows), len(self._places)
        stamps, values = np.full(n, NO_STAMP), np.full((n, p), np.nan)
        present = np.zeros((n, p), dtype=bool)
        left = np.ones(n, dtype=bool)
        for layout in self._layouts:
            _take(layout, part, left, stamps, values, present)
        while np.any(left):
            row = int(np.argmax(left))
            entry = self._decoders.decode(part.stored(row))
            found = [stamped_number(self._bag, entry, place) for place in self._places]
            if (learned := self._learned(part, row, found)) is not None:
                self._layouts.append(learned)
                _take(learned, part, left, stamps, values, present)
                continue
            left[row] = False
            stamps[row] = NO_STAMP if found[0][0] is None else found[0][0]
            values[row] = [np.nan if value is None else value for _, value in found]
            present[row] = [value is not None for _, value in found]
        return [Column(rows, stamps, part.log_ns, values[:, k], present[:, k]) for k in range(p)]

    def _learned(self, part: Block, row: int, found: Sequence[tuple[int | None, float | None]]
                 ) -> Layout | None:
        """Return the layout of a message, when it gives what its decoder does."""
        if self._left <= 0:
            return None
        self._left -= 1
        stored = part.stored(row)
        layout = layout_of(stored.message.data,
                           lambda data: self._decoders.fields(stored, data), self._numbers)
        if layout is None:
            return None
        one = part.part(slice(row, row + 1))
        left, stamps = np.ones(1, dtype=bool), np.full(1, NO_STAMP)
        values, present = np.full((1, len(found)), np.nan), np.zeros((1, len(found)), dtype=bool)
        _take(layout, one, left, stamps, values, present)
        same = not left[0] and all(
            (None if stamps[0] == NO_STAMP else stamps[0]) == stamp and (
                has == (value is not None)) and (not has or value == got or got != got)
            for (stamp, value), got, has in zip(found, values[0], present[0], strict=True))
        return layout if same else None

    def _numbers(self, message: Any) -> list[float | int | None]:
        """Return the two numbers of a stamp, None without one, and those at the places."""
        header = getattr(message, 'header', None)
        stamp = [None, None] if header is None else [header.stamp.sec, header.stamp.nanosec]
        values: list[float | None] = []
        for place in self._places:
            try:
                values.append(place.get(message))
            except LookupError:
                values.append(None)
        return [*stamp, *values]


def _take(layout: Layout, part: Block, left: NDArray[np.bool_], stamps: Times, values: Array,
          present: NDArray[np.bool_]) -> None:
    """Fill in what messages with a layout hold, and cross them off those that are left."""
    rows = np.flatnonzero(left & (part.ends - part.starts == layout.length))
    if not len(rows):
        return
    data = np.frombuffer(part.content, dtype=np.uint8)[
        part.starts[rows, None] + np.arange(layout.length)]
    fits = layout.fits(data)
    rows, data = rows[fits], data[fits]
    left[rows] = False
    seconds, rest = layout.column(data, 0), layout.column(data, 1)
    if seconds is not None and rest is not None:
        stamps[rows] = NANOSECONDS * seconds.astype(np.int64) + rest.astype(np.int64)
    for k in range(values.shape[1]):
        if (column := layout.column(data, 2 + k)) is not None:
            values[rows, k], present[rows, k] = column, True
