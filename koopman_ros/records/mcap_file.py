# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The messages and the summary of one MCAP file, complete or cut short, by the library mcap.

The sequence of records is read here: the library gives all records of a chunk or none, where a cut
file ends within one, and takes five times as long for a message.
"""

from collections.abc import Collection, Iterator
import contextlib
import io
import os
from pathlib import Path
import struct
import tempfile
from typing import BinaryIO, cast, NamedTuple
import zlib

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, DataEnd, Schema
from mcap.stream_reader import get_chunk_data_stream, read_magic
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
import zstandard

RECOVER = 'set recover to true to read the complete records'
# The head of each record: opcode, length.
_HEAD = struct.Struct('<BQ')
# Footer: start of the summary, start of its offsets, checksum from the start up to here.
_FOOTER_HEAD = _HEAD.pack(Opcode.FOOTER, 20)
_FOOTER = struct.Struct('<QQI')
_TAIL_SIZE = len(_FOOTER_HEAD) + _FOOTER.size + len(MCAP0_MAGIC)
# Message: channel, sequence, log time, publish time; its data is the rest of the record. Times
# beyond the year 2262 are damage, and as good negative: arrays hold them so.
_MESSAGE_HEAD = struct.Struct('<HIqq')
# The first bytes of a zstd frame; no CDR message has them, its first byte is 0.
_ZSTD_MAGIC = zstandard.FRAME_HEADER
# A file that rosbag2 compressed as a whole grows to no more than so many times its size.
_MOST_GROWTH = 1000
_PIECE_BYTES = 2**20


class BagReadError(ValueError):
    """A bag that is missing, not a bag, damaged or of a kind that is not read here."""

    def __init__(self, sentence: str) -> None:
        # foreign names and the texts of other parsers may hold line ends
        super().__init__(' '.join(sentence.split()))


class StoredMessage(NamedTuple):
    """A message as it was recorded, with its channel and (where there is one) its schema."""

    schema: Schema | None
    channel: Channel
    log_time_ns: int
    publish_time_ns: int
    data: bytes


def reason(error: BaseException) -> str:
    """Return the text of another library's exception, shortened."""
    return f'{type(error).__name__} {error}'.strip()[:200]


def stored_messages(file: Path, *, recover: bool, topics: Collection[str] | None = None
                    ) -> Iterator[StoredMessage]:
    """
    Yield the messages of one MCAP file in file order, with checksums verified.

    `topics` limits them to these names. With `recover`, the messages end at the first record that
    is damaged or cut short; without, that raises BagReadError, and so does another number of
    messages than the summary counts.
    """
    count = 0
    with opened(file) as stream:
        try:
            for stored in _messages(stream, topics):
                count += 1
                if stored is not None:
                    yield (stored._replace(data=zstandard.decompress(stored.data))
                           if stored.data.startswith(_ZSTD_MAGIC) else stored)
            found = None if recover else summary_section(stream)
            if found and found.statistics and found.statistics.message_count != count:
                raise EOFError(f'{count} of the {found.statistics.message_count} expected '
                               'messages')
        except MemoryError as error:
            raise BagReadError(f'not enough memory to read {str(file)!r}: free memory, or read '
                               'fewer topics') from error
        except OSError:
            raise
        except Exception as error:
            # bytes of another program meet the library: its exceptions are of many kinds
            if not recover:
                raise BagReadError(
                    f'{str(file)!r} is damaged ({reason(error)}): {RECOVER}') from error


def summary_section(stream: BinaryIO) -> Summary | None:
    """Return the summary of a file, None where it is missing or damaged."""
    try:
        footer = stream.seek(-(len(MCAP0_MAGIC) + _FOOTER.size), os.SEEK_END)
        start, _, expected = _FOOTER.unpack(stream.read(_FOOTER.size))
        stream.seek(start)
        if expected and zlib.crc32(stream.read(footer + 16 - start)) != expected:
            return None
        stream.seek(0)
        return SeekingReader(stream).get_summary()
    except Exception:
        # a cut or damaged end fails in any way, a seek out of range among them
        return None


def is_closed(file: Path) -> bool:
    """Whether a file was closed, not truncated; raise BagReadError for one that is not MCAP."""
    if file.stat().st_size == 0:
        raise BagReadError(f'{str(file)!r} is empty: its recorder wrote nothing; record again')
    with opened(file) as stream:
        head = stream.read(len(MCAP0_MAGIC))
        if not MCAP0_MAGIC.startswith(head):
            raise BagReadError(
                f'{str(file)!r} is not an MCAP file (it starts with {head!r}): '
                'pass a .mcap file or a bag directory')
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(0, size - _TAIL_SIZE))
        tail = stream.read()
    return tail.startswith(_FOOTER_HEAD) and tail.endswith(MCAP0_MAGIC)


@contextlib.contextmanager
def opened(file: Path) -> Iterator[BinaryIO]:
    """
    Open a file of a bag; one that rosbag2 compressed as a whole is expanded to a temporary file.

    Where the compressed bytes end early or are damaged, so does the expanded file.
    """
    with file.open('rb') as stream:
        head = stream.read(len(_ZSTD_MAGIC))
        stream.seek(0)
        if head != _ZSTD_MAGIC:
            yield stream
            return
        with tempfile.TemporaryFile() as plain:
            most = _MOST_GROWTH * os.fstat(stream.fileno()).st_size
            # a damaged frame ends the file early, which its reader notices
            with contextlib.suppress(zstandard.ZstdError):
                reader = zstandard.ZstdDecompressor().stream_reader(stream)
                while piece := reader.read(_PIECE_BYTES):
                    if plain.tell() > most:
                        raise BagReadError(f'{str(file)!r} expands to more than {_MOST_GROWTH} '
                                           'times its size: copy it again')
                    plain.write(piece)
            plain.seek(0)
            yield plain


class _WholeReads:
    """A stream whose reads are complete or fail, before memory is taken for them."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._left = stream.seek(0, os.SEEK_END)
        stream.seek(0)

    def read(self, length: int) -> bytes:
        """Return a number of bytes; raise EndOfFile where there are fewer."""
        self._left -= length
        if self._left < 0:
            raise EndOfFile
        return self._stream.read(length)


def _messages(stream: BinaryIO, topics: Collection[str] | None) -> Iterator[StoredMessage | None]:
    """
    Yield the messages up to the end of the data, None for those of other topics.

    Any exception is that of a damaged record.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, tuple[Schema | None, Channel] | None] = {}
    for records in _uncompressed(stream):
        end = 0
        while end < len(records):
            opcode, length = _HEAD.unpack_from(records, end)
            start = end + _HEAD.size
            end = start + length
            # zeros are the content of a disk that was full
            if end > len(records) or opcode == 0:
                raise EOFError('bytes that are not a record')
            if opcode == Opcode.MESSAGE:
                if length < _MESSAGE_HEAD.size:
                    raise EOFError('a truncated message')
                number, _, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(records, start)
                found = channels[number]
                yield None if found is None else StoredMessage(
                    *found, log_ns, publish_ns, records[start + _MESSAGE_HEAD.size:end])
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(records[start:end]))
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(records[start:end]))
                channels[channel.id] = None if topics is not None and (
                    channel.topic not in topics) else (schemas.get(channel.schema_id), channel)


def _uncompressed(stream: BinaryIO) -> Iterator[bytes]:
    """Yield the records of the data section, those of a chunk together, checksums verified."""
    data = ReadDataStream(cast('BinaryIO', _WholeReads(stream)), calculate_crc=True)
    read_magic(data)
    while True:
        checksum = data.checksum()
        head = data.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head)
        body = data.read(length)
        if opcode == Opcode.DATA_END:
            if DataEnd.read(_stream(body)).data_section_crc not in (0, checksum):
                raise EOFError('wrong checksum of the data')
            return
        if opcode == Opcode.FOOTER:
            raise EOFError('the end of the data is missing')
        if opcode == Opcode.CHUNK:
            content, size = get_chunk_data_stream(Chunk.read(_stream(body)), validate_crc=True)
            yield content.read(size)
        # those that are not needed, as indexes, are large
        elif opcode in (0, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            yield head + body


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(cast('BinaryIO', _WholeReads(io.BytesIO(body))))
