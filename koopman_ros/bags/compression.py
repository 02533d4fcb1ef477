# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Decompression with bounds: of chunks, and of rosbag2's compressed files and messages.

The sizes that a damaged file declares are accepted only within limits, and what expands beyond
them is refused: a few bytes can be made to ask for all the memory there is.
"""

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import tempfile
from typing import BinaryIO
import zlib

import lz4.frame
from mcap.records import Chunk
import zstandard

from koopman_ros.bags.errors import BagReadError, DamageError
from koopman_ros.bags.limits import block_limit, Budget, check_block, file_limit

# What each zstd frame begins with; no CDR message does, its first byte is 0.
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'

_PIECE_BYTES = 2**20


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


def chunk_content(chunk: Chunk, budget: Budget) -> bytes:
    """Return the records of a chunk, of the declared length and with the declared checksum."""
    size = chunk.uncompressed_size
    check_block('a chunk', size, len(chunk.data))
    budget.take_chunk(size)
    if chunk.compression == '':
        content = chunk.data
    elif chunk.compression == 'zstd':
        content = zstd_content(chunk.data, size)
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
    if not data.startswith(ZSTD_MAGIC):
        return data
    return zstd_content(data, block_limit(len(data)))


def zstd_content(data: bytes, limit: int) -> bytes:
    """Return the content of a zstd frame of at most `limit` bytes."""
    declared = zstandard.frame_content_size(data)
    if declared > limit:
        raise DamageError(f'a zstd frame that declares {declared} bytes')
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=limit)


def _expand(stream: BinaryIO, plain: BinaryIO, file: Path) -> None:
    size = os.fstat(stream.fileno()).st_size
    limit = file_limit(size)
    # a damaged frame ends the file early, which its reader notices
    with contextlib.suppress(zstandard.ZstdError):
        reader = zstandard.ZstdDecompressor().stream_reader(stream)
        while piece := reader.read(_PIECE_BYTES):
            plain.write(piece)
            if plain.tell() > limit:
                raise BagReadError(
                    f'{str(file)!r} grows to more than {limit // size} times its size, which '
                    'no bag does: fetch it again')
