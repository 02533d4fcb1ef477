# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The messages of one MCAP file in blocks of some thousand, as arrays of where they are."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
import itertools
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags import limits
from koopman_ros.bags.records import (
    as_sent,
    chunk_records,
    data_section,
    failures_are_damage,
    MESSAGE_HEAD,
    parsed,
    StoredMessage,
)

# Small chunks, which a recorder ends once a second, are put together up to this size.
_BLOCK_BYTES = 2**18
_HEAD = np.dtype([('channel', '<u2'), ('sequence', '<u4'), ('log', '<u8'), ('publish', '<u8')])
_COMPRESSED = limits.ZSTD_MAGIC[0]

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Block:
    """Messages that follow each other in a file, n of them."""

    content: bytes  #: where their data are
    starts: Rows  #: (n,) begin of the data of each
    ends: Rows  #: (n,) and their end
    channel: Rows  #: (n,) identifiers of their channels
    log_ns: Rows  #: (n,) times of receipt
    channels: dict[int, Channel]  #: by identifier
    schemas: dict[int, Schema]  #: likewise

    def part(self, rows: Rows | slice) -> 'Block':
        """Return some of the messages."""
        return replace(self, starts=self.starts[rows], ends=self.ends[rows],
                       channel=self.channel[rows], log_ns=self.log_ns[rows])

    def stored(self, row: int) -> StoredMessage:
        """Return one message by itself."""
        channel = self.channels[int(self.channel[row])]
        log_ns = int(self.log_ns[row])
        return StoredMessage(self.schemas.get(channel.schema_id), channel, Message(
            channel_id=channel.id, sequence=0, log_time=log_ns, publish_time=log_ns,
            data=self.content[self.starts[row]:self.ends[row]]))


def message_blocks(file: Path, topics: Collection[str]) -> Iterator[Block]:
    """
    Yield the messages on some topics of one MCAP file, in file order, with checksums verified.

    They end at the first record that is damaged or cut short. Raises BagTooLargeError for what
    grows beyond reason.
    """
    budget = limits.Budget(file)
    with limits.enough_memory(file), limits.opened(file) as stream:
        gathered = _Gathered(topics, budget)
        try:
            for piece in _pieces(stream, budget):
                if isinstance(piece, _Piece):
                    gathered.add(piece)
                    if gathered.size < _BLOCK_BYTES:
                        continue
                yield from gathered.blocks()
                if isinstance(piece, Schema):
                    gathered.schemas[piece.id] = piece
                elif isinstance(piece, Channel):
                    gathered.channels[piece.id] = piece
            yield from gathered.blocks()
        except limits.DamageError:
            # what was whole before counts; it may be what is damaged itself
            try:
                yield from gathered.blocks()
            except limits.DamageError:
                return


@dataclass(frozen=True)
class _Piece:
    """Messages in one chunk: its content, begin and end of their records."""

    content: bytes
    starts: Rows
    ends: Rows


def _pieces(stream: BinaryIO, budget: limits.Budget) -> Iterator[_Piece | Schema | Channel]:
    """Yield messages side by side, and what announces others between them."""
    with failures_are_damage():
        for record in data_section(stream, budget):
            if isinstance(record, Chunk):
                held = chunk_records(record, budget)
                opcodes, ends = np.frombuffer(held.opcodes, dtype=np.uint8), held.ends
                others = np.flatnonzero((opcodes == Opcode.SCHEMA) | (opcodes == Opcode.CHANNEL))
                for first, last in itertools.pairwise([-1, *others.tolist(), len(opcodes)]):
                    rows = first + 1 + np.flatnonzero(opcodes[first + 1:last] == Opcode.MESSAGE)
                    yield _Piece(held.content, held.starts[rows], ends[rows])
                    if last < len(opcodes):
                        yield _announcement(opcodes[last], held.content[
                            held.starts[last]:ends[last]])
                held.raise_rest()
            elif isinstance(record, Message):
                content = MESSAGE_HEAD.pack(record.channel_id, record.sequence, record.log_time,
                                            record.publish_time) + record.data
                yield _Piece(content, np.array([0]), np.array([len(content)]))
            elif isinstance(record, (Schema, Channel)):
                yield record


def _announcement(opcode: int, body: bytes) -> Schema | Channel:
    found = parsed(opcode, body)
    assert isinstance(found, (Schema, Channel))
    return found


@dataclass
class _Gathered:
    """Pieces that are still to become a block."""

    topics: Collection[str]
    budget: limits.Budget
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    size: int = 0
    _pieces: list[_Piece] = field(default_factory=list)

    def add(self, piece: _Piece) -> None:
        """Take a piece in."""
        if len(piece.starts):
            self._pieces.append(piece)
            self.size += len(piece.content)

    def blocks(self) -> Iterator[Block]:
        """Give what was taken in; DamageError after what is whole of it."""
        if not self._pieces:
            return
        pieces, self._pieces, self.size = self._pieces, [], 0
        offsets = np.cumsum([0, *(len(piece.content) for piece in pieces)])[:-1]
        content = b''.join(piece.content for piece in pieces)
        starts, ends = (np.concatenate([getattr(piece, edge) + offset for piece, offset in zip(
            pieces, offsets, strict=True)]) for edge in ('starts', 'ends'))
        long_enough = ends - starts >= MESSAGE_HEAD.size
        whole = len(starts) if long_enough.all() else int(np.argmin(long_enough))
        heads = _gathered(content, starts[:whole], MESSAGE_HEAD.size).view(_HEAD)[:, 0]
        channel = heads['channel'].astype(np.int64)
        known = np.isin(channel, list(self.channels))
        whole = whole if known.all() else int(np.argmin(known))
        wanted = [number for number, one in self.channels.items() if one.topic in self.topics]
        asked = np.flatnonzero(np.isin(channel[:whole], wanted))
        block = Block(content, starts[asked] + MESSAGE_HEAD.size, ends[asked], channel[asked],
                      heads['log'][asked].astype(np.int64), dict(self.channels),
                      dict(self.schemas))
        yield from self._as_sent(block)
        if whole < len(starts):
            raise limits.DamageError('a message that is cut short, or without a channel')

    def _as_sent(self, block: Block) -> Iterator[Block]:
        """Give messages as they were sent, also where rosbag2 compressed them one by one."""
        filled = np.flatnonzero(block.ends > block.starts)
        first = np.frombuffer(block.content, dtype=np.uint8)[block.starts[filled]]
        if not np.any(first == _COMPRESSED):
            self.budget.take_message(int(np.sum(block.ends - block.starts)))
            yield block
            return
        data: list[bytes] = []
        damage = None
        for row in range(len(block.starts)):
            try:
                data.append(as_sent(block.stored(row), self.budget).message.data)
            except limits.DamageError as error:
                damage = error
                break
        ends = np.cumsum([0, *map(len, data)])
        yield replace(block.part(slice(len(data))), content=b''.join(data), starts=ends[:-1],
                      ends=ends[1:])
        if damage is not None:
            raise damage


def _gathered(content: bytes, starts: Rows, size: int) -> NDArray[np.uint8]:
    """Return so many bytes (n, size) from each of some places (n,) on."""
    found: NDArray[np.uint8] = np.frombuffer(content, dtype=np.uint8)[
        starts[:, None] + np.arange(size)]
    return found
