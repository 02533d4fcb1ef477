# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The records of one MCAP file, whole or of a killed recorder, in the order of the file."""

from array import array
from collections.abc import Callable, Collection, Iterator
import contextlib
from dataclasses import dataclass, replace
import io
import os
from pathlib import Path
import struct
from typing import BinaryIO, cast
import zlib

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Schema, Statistics
from mcap.summary import Summary
import numpy as np
from numpy.typing import NDArray
import zstandard

from koopman_ros.bags import limits

# The MCAP specification's magic, and the opcode and length that begin every record.
MAGIC = b'\x89MCAP0\r\n'
_HEAD = struct.Struct('<BQ')
_FOOTER_HEAD = _HEAD.pack(Opcode.FOOTER, 20)
# Footer: start of the summary, start of its offsets, checksum from the start up to here.
_FOOTER = struct.Struct('<QQI')
_TAIL_SIZE = len(_FOOTER_HEAD) + _FOOTER.size + len(MAGIC)
# Message: channel, sequence, log time, publish time; its data is the rest of the record.
MESSAGE_HEAD = struct.Struct('<HIQQ')
_READ_BY: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.SCHEMA: Schema.read, Opcode.CHANNEL: Channel.read, Opcode.CHUNK: Chunk.read,
    Opcode.STATISTICS: Statistics.read}
# What the data section and its chunks are read for.
_READ = (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
_PIECE_BYTES = 2**20

RECOVER = 'set recover to true to read what is whole'


@dataclass(frozen=True)
class StoredMessage:
    """A message as it was recorded, with its channel and (where there is one) its schema."""

    schema: Schema | None
    channel: Channel
    message: Message


@dataclass(frozen=True)
class ChunkRecords:
    """The n records of a chunk, one after the other."""

    content: bytes  #: with the head of each before its body
    opcodes: bytes  #: (n,)
    starts: NDArray[np.int64]  #: (n,) where the bodies begin
    rest: int = 0  #: bytes after them that are no record

    @property
    def ends(self) -> NDArray[np.int64]:
        """Where the bodies end (n,)."""
        return np.append(self.starts[1:] - _HEAD.size, len(self.content))[:len(self.starts)]

    def raise_rest(self) -> None:
        """Raise DamageError where other bytes follow the records."""
        if self.rest:
            raise limits.DamageError(f'{self.rest} bytes of a chunk that are no record')


def stored_messages(file: Path, *, recover: bool, topics: Collection[str] | None = None,
                    with_data: bool = True) -> Iterator[StoredMessage]:
    """
    Yield the messages of one MCAP file in file order, with checksums verified.

    `topics` limits them to these names. Those that rosbag2 compressed by themselves come as they
    were sent, unless it is without data. With `recover`, the messages end at the first record
    that is damaged or cut short; without, that raises BagReadError, and so do fewer or more
    messages than the file says it holds. Raises BagTooLargeError for what grows beyond reason.
    """
    count = 0
    budget = limits.Budget(file)
    with limits.enough_memory(file), limits.opened(file) as stream:
        try:
            for stored in _messages(stream, budget):
                count += 1
                if topics is not None and stored.channel.topic not in topics:
                    continue
                yield as_sent(stored, budget) if with_data else stored
            if not recover:
                _check_count(count, summary_section(stream, budget))
        except limits.DamageError as damage:
            if not recover:
                raise limits.BagReadError(
                    f'{str(file)!r} is damaged ({damage}): {RECOVER}') from damage


def summary_section(stream: BinaryIO, budget: limits.Budget) -> Summary | None:
    """Return the index at the end of a file, None where it is missing or damaged."""
    try:
        start = _start_of_summary(stream)
        return None if start is None else _summary(stream, start, budget)
    except (MemoryError, limits.BagTooLargeError):
        raise
    except Exception:
        # A cut or damaged end fails in any way, a seek out of range among them.
        return None


def is_closed(file: Path) -> bool:
    """Tell a closed file from a cut one; raise BagReadError for one that is not MCAP at all."""
    if file.stat().st_size == 0:
        raise limits.BagReadError(
            f'{str(file)!r} is empty: its recorder wrote nothing, record again')
    with limits.opened(file) as stream:
        head = stream.read(len(MAGIC))
        if not MAGIC.startswith(head):
            raise limits.BagReadError(
                f'{str(file)!r} is not an MCAP file (it starts with {head!r}): '
                'pass a .mcap file or a bag directory')
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(0, size - _TAIL_SIZE))
        tail = stream.read()
    return tail.startswith(_FOOTER_HEAD) and tail.endswith(MAGIC)


class _WholeReads:
    """
    A byte stream whose reads are complete or fail, before room is made for them.

    mcap takes whatever a short read returns for a whole record, so that the cut last message of
    a file would come out as a shorter message, and reads all there is for a negative length.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        position = stream.tell()
        self.size = stream.seek(0, os.SEEK_END)
        stream.seek(position)

    def expect(self, length: int) -> None:
        """Raise EndOfFile where fewer bytes are left."""
        if not 0 <= length <= self.size - self._stream.tell():
            raise EndOfFile

    def read(self, length: int) -> bytes:
        self.expect(length)
        return self._stream.read(length)

    def skip(self, length: int) -> None:
        self.expect(length)
        self._stream.seek(length, os.SEEK_CUR)

    def seek(self, offset: int) -> int:
        return self._stream.seek(offset)


def _messages(stream: BinaryIO, budget: limits.Budget) -> Iterator[StoredMessage]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in _records(stream, budget):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels.get(record.channel_id)
            if channel is None:
                raise limits.DamageError(f'no channel {record.channel_id} for a message')
            yield StoredMessage(schemas.get(channel.schema_id), channel, record)


def _records(stream: BinaryIO, budget: limits.Budget) -> Iterator[McapRecord]:
    """Yield the records of the data section; raise DamageError where they stop making sense."""
    with failures_are_damage():
        for record in data_section(stream, budget):
            if isinstance(record, Chunk):
                held = chunk_records(record, budget)
                for opcode, start, end in zip(held.opcodes, held.starts, held.ends, strict=True):
                    if opcode in _READ:
                        yield parsed(opcode, held.content[start:end])
                held.raise_rest()
            else:
                yield record


@contextlib.contextmanager
def failures_are_damage() -> Iterator[None]:
    """Raise DamageError for whatever foreign bytes do to a parser."""
    try:
        yield
    except (OSError, MemoryError, limits.DamageError, limits.BagTooLargeError):
        raise
    except Exception as error:
        # Arbitrary bytes meet the parser here, and the decompressor behind it: the kinds of
        # exception are theirs, the meaning is the same.
        raise limits.DamageError(limits.reason(error)) from error


def data_section(stream: BinaryIO, budget: limits.Budget) -> Iterator[McapRecord]:
    """Yield the records between the two ends of a file, chunks whole."""
    whole = _WholeReads(stream)
    data = ReadDataStream(cast('BinaryIO', whole), calculate_crc=True)
    if data.read(len(MAGIC)) != MAGIC:
        raise limits.DamageError('no MCAP file')
    while True:
        checksum = data.checksum()
        opcode, length = _HEAD.unpack(data.read(_HEAD.size))
        if opcode == Opcode.FOOTER:
            raise limits.DamageError('the end of the data is missing')
        if opcode == Opcode.DATA_END:
            expected = DataEnd.read(data).data_section_crc
            if expected and expected != checksum:
                raise limits.DamageError('wrong checksum of the data')
            return
        # damage, not a large record: random bytes may begin like one
        whole.expect(length)
        _count(opcode, length, budget)
        if opcode in _READ or opcode == Opcode.CHUNK:
            yield parsed(opcode, data.read(length))
        else:
            while length:
                length -= len(data.read(min(length, _PIECE_BYTES)))


def chunk_records(chunk: Chunk, budget: limits.Budget) -> ChunkRecords:
    """Return the records of a chunk up to the first bytes that are none, once it has arrived."""
    content = limits.chunk_content(chunk, budget)
    opcodes, starts = bytearray(), array('q')
    end, size, head = 0, len(content), _HEAD.unpack_from
    while end + _HEAD.size <= size:
        opcode, length = head(content, end)
        start = end + _HEAD.size
        # zeros are what a disk that was full leaves
        if start + length > size or opcode == 0:
            break
        end = start + length
        if opcode == Opcode.MESSAGE:
            budget.take_record()
        else:
            _count(opcode, length, budget)
        opcodes.append(opcode)
        starts.append(start)
    return ChunkRecords(content[:end], bytes(opcodes), np.array(starts, dtype=np.int64),
                        size - end)


def _count(opcode: int, length: int, budget: limits.Budget) -> None:
    if opcode == 0:
        # what a disk that was full leaves, and reserved for nothing
        raise limits.DamageError('zeros in place of a record')
    budget.take_record(length if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) else 0)


def parsed(opcode: int, body: bytes) -> McapRecord:
    """Return a record from its own bytes."""
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(body)
        return Message(channel_id=channel, sequence=sequence, log_time=log_time,
                       publish_time=publish_time, data=body[MESSAGE_HEAD.size:])
    return _READ_BY[opcode](ReadDataStream(cast('BinaryIO', _WholeReads(io.BytesIO(body)))))


def as_sent(stored: StoredMessage, budget: limits.Budget) -> StoredMessage:
    """Return a message as it was sent, also where rosbag2 compressed it by itself."""
    try:
        data = limits.message_content(stored.message.data)
    except zstandard.ZstdError as error:
        raise limits.DamageError(limits.reason(error)) from error
    budget.take_message(len(data))
    if data is stored.message.data:
        return stored
    return replace(stored, message=replace(stored.message, data=data))


def _check_count(count: int, summary: Summary | None) -> None:
    statistics = None if summary is None else summary.statistics
    if statistics is not None and statistics.message_count != count:
        raise limits.DamageError(
            f'{count} of the {statistics.message_count} messages it should hold')


def _start_of_summary(stream: BinaryIO) -> int | None:
    """Return where the summary starts, None where there is none or its checksum is wrong."""
    size = stream.seek(0, os.SEEK_END)
    footer = size - len(MAGIC) - _FOOTER.size
    stream.seek(footer)
    start, _, expected = _FOOTER.unpack(stream.read(_FOOTER.size))
    stream.seek(start)
    if expected and zlib.crc32(stream.read(max(0, footer + 16 - start))) != expected:
        return None
    return start or None


def _summary(stream: BinaryIO, start: int, budget: limits.Budget) -> Summary | None:
    """Return the schemas, channels and statistics between a place and the footer."""
    found = Summary()
    whole = _WholeReads(stream)
    whole.seek(start)
    while True:
        opcode, length = _HEAD.unpack(whole.read(_HEAD.size))
        if opcode == Opcode.FOOTER:
            return found
        whole.expect(length)
        _count(opcode, length, budget)
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            whole.skip(length)
            continue
        record = parsed(opcode, whole.read(length))
        if isinstance(record, Schema):
            found.schemas[record.id] = record
        elif isinstance(record, Channel):
            found.channels[record.id] = record
        elif isinstance(record, Statistics):
            found.statistics = record
