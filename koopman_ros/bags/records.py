# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The records of one MCAP file, whole or left behind by a recorder that was killed.

Records are read in file order, which is the order in which the recorder received them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
import io
import os
from pathlib import Path
import struct
from typing import BinaryIO, cast
import zlib

from koopman_ros.bags.compression import chunk_content, opened, zstd_content, ZSTD_MAGIC
from koopman_ros.bags.errors import BagReadError, DamageError, reason
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary

# The MCAP specification's magic, and the opcode and length that begin every record.
MAGIC = b'\x89MCAP0\r\n'
_HEAD = struct.Struct('<BQ')
_FOOTER_HEAD = _HEAD.pack(Opcode.FOOTER, 20)
# Footer: start of the summary, start of its offsets, checksum from the start up to here.
_FOOTER = struct.Struct('<QQI')
_TAIL_SIZE = len(_FOOTER_HEAD) + _FOOTER.size + len(MAGIC)

RECOVER = 'pass recover=True to read what is whole'


@dataclass(frozen=True)
class StoredMessage:
    """A message as it was recorded, with its channel and (where there is one) its schema."""

    schema: Schema | None
    channel: Channel
    message: Message


def stored_messages(file: Path, *, recover: bool) -> Iterator[StoredMessage]:
    """
    Yield the messages of one MCAP file in file order, with checksums verified.

    With `recover`, the messages end at the first record that is damaged or cut short; without,
    that raises BagReadError, and so do fewer or more messages than the file says it holds.
    """
    count = 0
    with opened(file) as stream:
        try:
            for message in _messages(stream):
                count += 1
                yield message
            if not recover:
                _check_count(count, summary_section(stream))
        except DamageError as damage:
            if not recover:
                raise BagReadError(f'{str(file)!r} is damaged ({damage}): {RECOVER}') from damage


def summary_section(stream: BinaryIO) -> Summary | None:
    """Return the index at the end of a file, None where it is missing or damaged."""
    try:
        if not _summary_is_sound(stream):
            return None
        whole = _WholeReads(stream)
        stream.seek(0)
        return SeekingReader(cast('BinaryIO', whole), record_size_limit=whole.size).get_summary()
    except Exception:
        # A cut or damaged end fails in any way, a seek out of range among them.
        return None


def is_closed(file: Path) -> bool:
    """Tell a closed file from a cut one; raise BagReadError for one that is not MCAP at all."""
    if file.stat().st_size == 0:
        raise BagReadError(f'{str(file)!r} is empty: its recorder wrote nothing, record again')
    with opened(file) as stream:
        head = stream.read(len(MAGIC))
        if not MAGIC.startswith(head):
            raise BagReadError(
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

    def read(self, length: int) -> bytes:
        if not 0 <= length <= self.size - self._stream.tell():
            raise EndOfFile
        return self._stream.read(length)

    def seek(self, offset: int, origin: int = os.SEEK_SET) -> int:
        return self._stream.seek(offset, origin)


def _messages(stream: BinaryIO) -> Iterator[StoredMessage]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in _records(stream):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels.get(record.channel_id)
            if channel is None:
                raise DamageError(f'no channel {record.channel_id} for a message')
            yield StoredMessage(schemas.get(channel.schema_id), channel, record)


def _records(stream: BinaryIO) -> Iterator[McapRecord]:
    """Yield the records of the data section; raise DamageError where they stop making sense."""
    whole = _WholeReads(stream)
    records = iter(StreamReader(cast('BinaryIO', whole), emit_chunks=True, validate_crcs=True,
                                record_size_limit=whole.size).records)
    while True:
        try:
            record = next(records)
            found = _chunk_records(record) if isinstance(record, Chunk) else [_plain(record)]
        except (OSError, DamageError):
            raise
        except Exception as error:
            # Arbitrary bytes meet the parser here, and the decompressor behind it: the kinds of
            # exception are theirs, the meaning is the same.
            raise DamageError(reason(error)) from error
        if isinstance(record, DataEnd):
            return
        yield from found


def _chunk_records(chunk: Chunk) -> list[McapRecord]:
    """Return the schemas, channels and messages of a chunk, each within its own length."""
    content = chunk_content(chunk)
    found: list[McapRecord] = []
    end = 0
    while end < len(content):
        opcode, length = _HEAD.unpack_from(content, end)
        start, end = end + _HEAD.size, end + _HEAD.size + length
        if end > len(content):
            raise EndOfFile
        body = ReadDataStream(cast('BinaryIO', _WholeReads(io.BytesIO(content[start:end]))))
        if opcode == Opcode.MESSAGE:
            found.append(_plain(Message.read(body, length)))
        elif opcode == Opcode.CHANNEL:
            found.append(Channel.read(body))
        elif opcode == Opcode.SCHEMA:
            found.append(Schema.read(body))
    return found


def _plain(record: McapRecord) -> McapRecord:
    """Return a message that rosbag2 compressed by itself as it was sent."""
    if isinstance(record, Message) and record.data.startswith(ZSTD_MAGIC):
        return replace(record, data=zstd_content(record.data))
    return record


def _check_count(count: int, summary: Summary | None) -> None:
    statistics = None if summary is None else summary.statistics
    if statistics is not None and statistics.message_count != count:
        raise DamageError(f'{count} of the {statistics.message_count} messages it should hold')


def _summary_is_sound(stream: BinaryIO) -> bool:
    """Verify the checksum of the summary where there is one."""
    size = stream.seek(0, os.SEEK_END)
    footer = size - len(MAGIC) - _FOOTER.size
    stream.seek(footer)
    start, _, expected = _FOOTER.unpack(stream.read(_FOOTER.size))
    stream.seek(start)
    return not expected or zlib.crc32(stream.read(max(0, footer + 16 - start))) == expected
