# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What the bytes of a bag may become: bounds in proportion to its size on the disk.

Compression in compression, and layouts that the readers expand, turn a kilobyte into gigabytes or
minutes. No recording does. A closed loop at rest, without noise, shrinks to a fiftieth and takes
more than four bytes of the disk for each message, because its times change; nothing that zstd
compressed once grows more than 2**15 times.
"""

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import re
import tempfile
from typing import Any, BinaryIO
import zlib

import lz4.frame
from mcap.records import Chunk
import yaml
import zstandard

_MIB = 2**20
# A chunk is written when it exceeds some megabytes, with the message that makes it exceed them.
_LARGEST_BLOCK = 256 * _MIB
_SMALL_BLOCK = 64 * _MIB
# By so much more than its bytes a block, a file or what is read of it may hold beyond the floors.
_RATIO = 1000
# All chunks of a file: passed over at the speed of memory, so that camera pictures that are the
# same throughout do not keep anyone from reading the temperatures beside them.
_CHUNKS_FLOOR = 64 * _MIB
_CHUNKS_RATIO = 2**15
# The messages that are asked for: decoded, and perhaps kept, at a hundred times their size.
_MESSAGES_FLOOR = 4 * _MIB
_RECORDS_FLOOR = 100_000
# A definition or an offer of so many bytes takes about as long to read as a message.
_BYTES_LIKE_A_RECORD = 16
# Of one definition: the largest in use have a tenth of it, and the parser compares the fields of
# a type with one another.
_LARGEST_DEFINITION = _MIB
_MOST_LINES = 5000
# What each zstd frame begins with; no CDR message does, its first byte is 0.
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
_DELIMITER = re.compile(r'={3,}|MSG:\s')
# type, name, and what follows it
_FIELD = re.compile(r'(\S+)\s+([^\s=]+)\s*(=?)')
_CHAR = re.compile(r'^char(?=\[|$)')
_MERGE = 'tag:yaml.org,2002:merge'


class BagReadError(ValueError):
    """A bag that is missing, not a bag, damaged or of a kind that is not read here."""

    def __init__(self, sentence: str) -> None:
        # foreign names and the words of other parsers may hold line ends
        super().__init__(' '.join(sentence.split()))


class BagTooLargeError(BagReadError):
    """A bag that would take more memory or time than its size warrants, or than there is."""


class DamageError(Exception):
    """Bytes that do not parse as what they should be."""


def reason(error: BaseException) -> str:
    """Return what another library says of bytes it cannot read, at a bearable length."""
    return f'{type(error).__name__} {error}'.strip()[:200]


class Budget:
    """
    What one reading of a file of this size on the disk may still come to.

    Every method raises BagTooLargeError beyond it, which `recover` does not pass over.
    """

    def __init__(self, file: Path) -> None:
        size = file.stat().st_size
        self._file = file
        self._records = _RECORDS_FLOOR + size
        self._chunk_bytes = _CHUNKS_FLOOR + _CHUNKS_RATIO * size
        self._message_bytes = _MESSAGES_FLOOR + _RATIO * size

    def take_record(self, definition_bytes: int = 0) -> None:
        """Count a record; one that defines or announces something counts by its size."""
        self._records -= 1 + definition_bytes // _BYTES_LIKE_A_RECORD
        self._check(self._records, 'records than bytes')

    def take_chunk(self, size: int) -> None:
        """Count the bytes of a chunk."""
        self._chunk_bytes -= size
        self._check(self._chunk_bytes, f'than {_CHUNKS_RATIO} times its size')

    def take_message(self, size: int) -> None:
        """Count the bytes of a message that is asked for."""
        self._message_bytes -= size
        self._check(self._message_bytes, f'than {_RATIO} times its size in messages')

    def _check(self, left: int, what: str) -> None:
        if left < 0:
            raise BagTooLargeError(
                f'{str(self._file)!r} grows to more {what}, which no recording does: fetch it '
                'again, or read fewer topics')


@contextlib.contextmanager
def enough_memory(file: Path) -> Iterator[None]:
    """Say that memory does not suffice: that is not damage, and `recover` does not help."""
    try:
        yield
    except MemoryError as error:
        raise BagTooLargeError(
            f'memory does not suffice to read {str(file)!r}: free some, or read fewer topics'
        ) from error


@contextlib.contextmanager
def opened(file: Path) -> Iterator[BinaryIO]:
    """
    Open a file of a bag; one that rosbag2 compressed as a whole is expanded to a temporary file.

    Where the compressed bytes end early or are damaged, so does the expanded file. Raises
    BagReadError for one that grows beyond reason.
    """
    with file.open('rb') as stream:
        head = stream.read(len(ZSTD_MAGIC))
        stream.seek(0)
        if head != ZSTD_MAGIC:
            yield stream
            return
        with tempfile.TemporaryFile() as plain:
            _expand(stream, plain, file)
            plain.seek(0)
            yield plain


def _expand(stream: BinaryIO, plain: BinaryIO, file: Path) -> None:
    limit = _RATIO * os.fstat(stream.fileno()).st_size
    # a damaged frame ends the file early, which its reader notices
    with contextlib.suppress(zstandard.ZstdError):
        reader = zstandard.ZstdDecompressor().stream_reader(stream)
        while piece := reader.read(_MIB):
            plain.write(piece)
            if plain.tell() > limit:
                raise BagReadError(f'{str(file)!r} grows to more than {_RATIO} times its size, '
                                   'which no bag does: fetch it again')


def chunk_content(chunk: Chunk, budget: Budget) -> bytes:
    """Return the records of a chunk, of the declared length and with the declared checksum."""
    size = chunk.uncompressed_size
    if size > _block_limit(len(chunk.data)):
        raise DamageError(f'a chunk that declares {size} bytes')
    budget.take_chunk(size)
    if chunk.compression == '':
        content = chunk.data
    elif chunk.compression == 'zstd':
        content = _zstd_content(chunk.data, size)
    elif chunk.compression == 'lz4':
        content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    else:
        raise DamageError(f'a chunk compressed with {chunk.compression!r}')
    if len(content) != size:
        raise DamageError(f'a chunk of {len(content)} bytes that declares {size}')
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise DamageError('a chunk with a wrong checksum')
    return content


def message_content(data: bytes) -> bytes:
    """Return a message that rosbag2 compressed by itself as it was sent, any other as it is."""
    return (_zstd_content(data, _block_limit(len(data))) if data.startswith(ZSTD_MAGIC)
            else data)


def _block_limit(size: int) -> int:
    """Return the bytes that a chunk or message compressed to `size` bytes may hold."""
    return min(_LARGEST_BLOCK, _SMALL_BLOCK + _RATIO * size)


def _zstd_content(data: bytes, limit: int) -> bytes:
    """Return the content of a zstd frame of at most `limit` bytes."""
    declared = zstandard.frame_content_size(data)
    if declared > limit:
        raise DamageError(f'a zstd frame that declares {declared} bytes')
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=limit)


def fields_only(definition: bytes) -> bytes:
    """
    Return a concatenated ros2msg definition without comments, constants and default values.

    Decoding needs none of them, and the definition parser takes minutes for some. What is no
    field, constant or comment stays, for the parser to refuse. A char is written as uint8, which
    it is in ROS 2; the parser takes it for int8. Raises DamageError for more than any message
    type needs.
    """
    if len(definition) > _LARGEST_DEFINITION:
        raise DamageError(f'{len(definition)} bytes')
    lines = [kept for line in definition.decode('utf-8').splitlines() if (kept := _field(line))]
    if len(lines) > _MOST_LINES:
        raise DamageError(f'{len(lines)} fields')
    return '\n'.join(lines).encode('utf-8')


def _field(line: str) -> str:
    """Return type and name of a field, other lines as they are, '' for those not needed."""
    line = line.partition('#')[0].strip()
    found = None if _DELIMITER.match(line) else _FIELD.match(line)
    if found is None:
        return line
    return '' if found[3] else f'{_CHAR.sub("uint8", found[1])} {found[2]}'


def load_plain(text: str) -> Any:
    """
    Return the content of a YAML document as rosbag2 writes it.

    It has no aliases and merges, by which a few lines name billions. Raises yaml.YAMLError and
    others for what is none.
    """
    return yaml.load(text, Loader=_PlainLoader)


class _PlainLoader(yaml.SafeLoader):
    """Refuse what refers to something said before."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError('aliases are not read in the metadata of a bag')
        return super().compose_node(parent, index)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        if any(key.tag == _MERGE for key, _ in node.value):
            raise yaml.YAMLError('merges are not read in the metadata of a bag')
        super().flatten_mapping(node)
