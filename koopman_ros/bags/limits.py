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
from pathlib import Path

from koopman_ros.bags.errors import BagTooLargeError, DamageError

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
# Of one definition; the largest in use have a tenth of it.
LARGEST_DEFINITION = _MIB


def block_limit(size: int) -> int:
    """Return the bytes that a chunk or message compressed to `size` bytes may hold."""
    return min(_LARGEST_BLOCK, _SMALL_BLOCK + _RATIO * size)


def file_limit(size: int) -> int:
    """Return the bytes that a file compressed to `size` bytes may hold."""
    return _RATIO * size


class Budget:
    """
    What one reading of a file may still come to.

    Every method raises BagTooLargeError beyond it, which `recover` does not pass over.

    :param file: that is read; its size on the disk counts.
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
        if self._records < 0:
            raise self._refusal('records than bytes')

    def take_chunk(self, size: int) -> None:
        """Count the bytes of a chunk."""
        self._chunk_bytes -= size
        if self._chunk_bytes < 0:
            raise self._refusal(f'than {_CHUNKS_RATIO} times its size')

    def take_message(self, size: int) -> None:
        """Count the bytes of a message that is asked for."""
        self._message_bytes -= size
        if self._message_bytes < 0:
            raise self._refusal(f'than {_RATIO} times its size in messages')

    def _refusal(self, what: str) -> BagTooLargeError:
        return BagTooLargeError(
            f'{str(self._file)!r} grows to more {what}, which no recording does: fetch it again, '
            'or read fewer topics')


def check_block(what: str, declared: int, compressed: int) -> None:
    """Raise DamageError where a block declares more bytes than it may hold."""
    if declared > block_limit(compressed):
        raise DamageError(f'{what} that declares {declared} bytes')


@contextlib.contextmanager
def enough_memory(file: Path) -> Iterator[None]:
    """Say that memory does not suffice: that is not damage, and `recover` does not help."""
    try:
        yield
    except MemoryError as error:
        raise BagTooLargeError(
            f'memory does not suffice to read {str(file)!r}: free some, or read fewer topics'
        ) from error
