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
Access to the records of a bag, whole or left behind by a recorder that was killed.

A file counts as closed when it ends with MCAP's footer and magic. Records are read in file
order, which is the order in which the recorder received them; sorting by time would interleave
two runs wherever the clock was set back.
"""

from collections.abc import Iterator
from dataclasses import dataclass
import os
from pathlib import Path
import re
import struct
from typing import Any, BinaryIO, cast

from koopman_ros.bags.metadata import METADATA_FILE, METADATA_KEY
from mcap.exceptions import EndOfFile
from mcap.records import Channel, DataEnd, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader
import yaml

# The MCAP specification's magic, and the opcode and length that begin its footer record.
_MAGIC = b'\x89MCAP0\r\n'
_FOOTER_HEAD = struct.pack('<BQ', 0x02, 20)
_TAIL_SIZE = len(_FOOTER_HEAD) + 20 + len(_MAGIC)

_RECOVER = 'pass recover=True to read what is whole'


class BagReadError(ValueError):
    """A bag that is missing, not a bag, damaged or of a kind that is not read here."""


@dataclass(frozen=True)
class BagFiles:
    """The MCAP files of a bag in reading order, and whether every one of them was closed."""

    files: tuple[Path, ...]
    complete: bool


@dataclass(frozen=True)
class StoredMessage:
    """A message as it lies in the file, with its channel and (where there is one) its schema."""

    schema: Schema | None
    channel: Channel
    message: Message


def locate(path: str | os.PathLike[str], *, recover: bool) -> BagFiles:
    """
    Return the files of a bag: a bare MCAP file, or a directory in the order of its metadata.

    With `recover`, files without a footer pass, and a directory without metadata.yaml is read
    in the order of its file numbers. Raises BagReadError for whatever else is wrong.
    """
    path = Path(path)
    if not path.exists():
        raise BagReadError(f'bag {str(path)!r} does not exist: check the path')
    files: tuple[Path, ...]
    if not path.is_dir():
        files, listed = (path,), True
    elif (path / METADATA_FILE).is_file():
        files, listed = _listed_files(path), True
    else:
        files, listed = _numbered_files(path, recover), False
    closed = [_is_closed(file) for file in files]
    if not all(closed) and not recover:
        unclosed = files[closed.index(False)]
        raise BagReadError(
            f'{str(unclosed)!r} is cut short, its recorder did not close it: {_RECOVER}')
    return BagFiles(files, complete=listed and all(closed))


def stored_messages(file: Path, *, recover: bool) -> Iterator[StoredMessage]:
    """
    Yield the messages of one MCAP file in file order, with checksums verified.

    With `recover`, the messages end at the first record that is damaged or cut short; without,
    that raises BagReadError.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with file.open('rb') as stream:
        try:
            for record in _records(stream, file.stat().st_size):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    channel = channels.get(record.channel_id)
                    if channel is None:
                        raise _DamageError(f'no channel {record.channel_id} for a message')
                    yield StoredMessage(schemas.get(channel.schema_id), channel, record)
        except _DamageError as damage:
            if not recover:
                raise BagReadError(
                    f'{str(file)!r} is damaged ({damage}): {_RECOVER}') from damage


class _DamageError(Exception):
    """The bytes of a file do not parse as MCAP records."""


class _WholeReads:
    """
    A byte stream whose reads are complete or fail.

    mcap's StreamReader takes whatever a short read returns for a whole record, so that the cut
    last message of a file would come out as a shorter message.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def read(self, length: int) -> bytes:
        data = self._stream.read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def _records(stream: BinaryIO, size: int) -> Iterator[McapRecord]:
    """Yield the records of the data section; raise _DamageError where they stop making sense."""
    reader = StreamReader(
        cast('BinaryIO', _WholeReads(stream)), validate_crcs=True, record_size_limit=size)
    records = iter(reader.records)
    while True:
        try:
            record = next(records)
        except OSError:
            raise
        except Exception as error:
            # Arbitrary bytes meet the parser here, and the decompressor behind it: the kinds of
            # exception are theirs, the meaning is the same.
            raise _DamageError(f'{type(error).__name__} {error}'.strip()) from error
        if isinstance(record, DataEnd):
            return
        yield record


def _is_closed(file: Path) -> bool:
    """Tell a closed file from a cut one; raise BagReadError for one that is not MCAP at all."""
    with file.open('rb') as stream:
        head = stream.read(len(_MAGIC))
        if not head:
            raise BagReadError(
                f'{str(file)!r} is empty: its recorder wrote nothing, record again')
        if not _MAGIC.startswith(head):
            raise BagReadError(
                f'{str(file)!r} is not an MCAP file (it starts with {head!r}): '
                'pass a .mcap file or a bag directory')
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(0, size - _TAIL_SIZE))
        tail = stream.read()
    return tail.startswith(_FOOTER_HEAD) and tail.endswith(_MAGIC)


def _listed_files(folder: Path) -> tuple[Path, ...]:
    """Return the files that metadata.yaml lists, in its order."""
    source = folder / METADATA_FILE
    try:
        information: dict[str, Any] = yaml.safe_load(source.read_text('utf-8'))[METADATA_KEY]
        storage = information['storage_identifier']
        compression = information.get('compression_format') or ''
        names = [str(name) for name in information['relative_file_paths']]
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, AttributeError) as error:
        raise BagReadError(
            f'{str(source)!r} is not the metadata of a bag: delete it and pass recover=True '
            'to read the files beside it') from error
    if storage != 'mcap' or compression:
        kind = f'{storage} files' + (f' compressed with {compression}' if compression else '')
        raise BagReadError(
            f'{str(folder)!r} holds {kind}, only plain mcap is read here: '
            "convert it with 'ros2 bag convert'")
    files = tuple(folder / name for name in names)
    for file in files:
        if not file.is_file():
            raise BagReadError(
                f'{str(source)!r} lists {file.name!r}, which is not there: put it back')
    return files


def _numbered_files(folder: Path, recover: bool) -> tuple[Path, ...]:
    """Return the MCAP files of a directory without metadata.yaml, by their numbers."""
    if not recover:
        raise BagReadError(
            f'{str(folder)!r} has no {METADATA_FILE}, its recorder did not close it or it is no '
            f'bag: {_RECOVER}')
    files = [file for file in folder.glob('*.mcap') if file.stat().st_size > 0]
    if not files:
        raise BagReadError(
            f'{str(folder)!r} has neither {METADATA_FILE} nor MCAP files with content: '
            'check the path')
    return tuple(sorted(files, key=_natural_order))


def _natural_order(file: Path) -> list[tuple[int, str]]:
    """Return a key that sorts 'run_2' before 'run_10'."""
    return [
        (int(part), '') if part.isdigit() else (-1, part)
        for part in re.split(r'(\d+)', file.name)
    ]
