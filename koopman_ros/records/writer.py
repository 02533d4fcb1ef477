# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Crash-safe recording: serialized messages into a bag that rosbag2 and MCAP readers open."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
import contextlib
import math
import operator
import os
from pathlib import Path
from typing import Self

from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Qos

from koopman_ros import __version__
from koopman_ros.core.paths import sync_folder
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.records import metadata
from koopman_ros.records.message_definitions import MessageDefinition

_SEQUENCE_MODULUS = 2**32
# A message in a chunk without its data: opcode, length, channel, sequence, two times.
_MESSAGE_HEAD_BYTES = 31
# Chunks end by flush() and then go to the operating system at once: mcap's own limit would leave
# the end of a chunk in a buffer.
_NO_LIMIT = 2**62


class BagWriter:
    """
    Write serialized (CDR) messages to an MCAP bag in the layout of rosbag2, Jazzy.

    `path` ending in '.mcap' makes one self-describing file; any other path makes a bag directory
    with `<name>_0.mcap` and, at `close`, `metadata.yaml`. An existing path is never overwritten.

    A bag directory can be split: a message that finds `max_file_bytes` written, or
    `max_file_duration_s` [s] passed since the first log time of the file, begins the next file
    (`<name>_1.mcap`, ...; 0: never). The file before it is completed in the background, written
    through to the disk and only then listed in `metadata.yaml`: files listed there stay readable
    after any later failure.

    `compression` of the chunks is 'none', 'zstd' or 'lz4'. The default is that of rosbag2: every
    reader can open it, and there is no codec between a damaged file and its messages. With 'zstd'
    the bag of a control loop has about a third of the size. A process that is killed loses no more
    than the open chunk, which ends with :meth:`flush`, or beyond `max_chunk_bytes`. A cut file is
    read by `read_messages` with `recover`, and by mcap's `NonSeekingReader` with
    `log_time_order=False` until that raises `EndOfFile`.

    Not thread-safe: one thread at a time may use a writer. Raises FileExistsError if `path`
    exists, ValueError for a single file that is to be split. An error in the background is raised
    by the next `flush` or `close`.
    """

    def __init__(self, path: str | os.PathLike[str], *, compression: str = 'none',
                 max_file_bytes: int = 0, max_file_duration_s: float = 0.0,
                 max_chunk_bytes: int = 2**20) -> None:
        self.path = Path(path)
        self._is_directory = self.path.suffix != '.mcap'
        if (max_file_bytes or max_file_duration_s) and not self._is_directory:
            raise ValueError(
                f'{str(self.path)!r} is a single file, which cannot be split: name a folder, '
                'without .mcap')
        self._compression = CompressionType[compression.upper()]
        self._max_file_bytes = max_file_bytes or math.inf
        self._max_file_ns = round(max_file_duration_s * NANOSECONDS) or math.inf
        self._max_chunk_bytes = max_chunk_bytes
        self._topics: dict[str, metadata.RecordedTopic] = {}
        self._closed = False
        self._completed: list[metadata.RecordedFile] = []
        # In a thread: to write a large file through to the disk takes longer than messages can
        # wait.
        self._background = ThreadPoolExecutor(max_workers=1, thread_name_prefix='bag')
        self._completion: Future[None] | None = None
        self._file_count = 0
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self._is_directory:
                self.path.mkdir()
            self._file = self._next_file()
        except FileExistsError as error:
            raise FileExistsError(
                f'{str(error.filename)!r} already exists and recordings are never overwritten: '
                'choose another name, or move the old one') from error

    def add_topic(self, topic: str, definition: MessageDefinition,
                  offered_qos: Sequence[Qos] = ()) -> None:
        """
        Announce a topic by its absolute name, with the offers of its publishers; once.

        Raises ValueError on a closed writer.
        """
        self._check_open()
        if topic not in self._topics:
            self._topics[topic] = metadata.RecordedTopic(topic, definition, tuple(offered_qos))
            self._file.add_topic(self._topics[topic])

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int | None = None
              ) -> None:
        """
        Append one message, byte for byte, in CDR with its encapsulation header.

        `log_time_ns` is the time of receipt [ns], `publish_time_ns` that of sending [ns], the same
        by default. Raises KeyError for a topic that was not announced, ValueError for a time
        outside [0, 2**63) ns and on a closed writer.
        """
        self._check_open()
        log_time_ns, publish_time_ns = map(operator.index, (
            log_time_ns, log_time_ns if publish_time_ns is None else publish_time_ns))
        for time_ns in (log_time_ns, publish_time_ns):
            if not 0 <= time_ns < 2**63:
                raise ValueError(f'message on {topic!r}: the time {time_ns} ns is outside '
                                 '[0, 2**63) ns')
        recorded = self._topics[topic]
        if self._is_full(log_time_ns):
            self._split()
        self._file.write(
            topic, bytes(data), log_time_ns, publish_time_ns, recorded.message_count)
        recorded.message_count += 1
        if self._file.open_chunk_bytes > self._max_chunk_bytes:
            self.flush()

    def flush(self) -> None:
        """
        End the open chunk; flushed messages survive the end of the process, not a loss of power.

        Raises ValueError on a closed writer.
        """
        self._check_open()
        self._file.flush()
        self._raise_background_error()

    def close(self) -> None:
        """Complete the file (and `metadata.yaml`); closing a closed writer does nothing."""
        if self._closed:
            return
        self._closed = True
        self._background.shutdown()
        try:
            self._raise_background_error()
        finally:
            self._complete(self._file)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        # After an exception, too: the record up to it explains the failure.
        self.close()

    def _is_full(self, log_time_ns: int) -> bool:
        range_ns = self._file.content.time_range_ns
        return range_ns is not None and (
            self._file.size_bytes >= self._max_file_bytes
            or log_time_ns - range_ns[0] >= self._max_file_ns)

    def _split(self) -> None:
        """Go on in the next file, and complete the present one meanwhile."""
        self.flush()
        if self._completion is not None:
            # long done, unless files fill up faster than the disk takes them
            self._completion.result()
        full, self._file = self._file, self._next_file()
        for topic in self._topics.values():
            self._file.add_topic(topic)
        self._completion = self._background.submit(self._complete, full)

    def _next_file(self) -> '_McapFile':
        name = f'{self.path.name}_{self._file_count}.mcap'
        file = _McapFile(self.path / name if self._is_directory else self.path, self._compression)
        self._file_count += 1
        return file

    def _complete(self, file: '_McapFile') -> None:
        """Complete a file, and list it in the metadata of a bag directory."""
        file.close()
        self._completed.append(file.content)
        if self._is_directory:
            metadata.write_metadata_file(self.path, metadata.bag_metadata(self._completed))
        else:
            sync_folder(self.path.parent)

    def _raise_background_error(self) -> None:
        if self._completion is not None and self._completion.done():
            self._completion.result()

    def _check_open(self) -> None:
        if self._closed:
            raise ValueError(f'the bag {str(self.path)!r} is closed: start another one')


class _McapFile:
    """One file that is being written, chunk by chunk; `content` describes it so far."""

    def __init__(self, path: Path, compression: CompressionType) -> None:
        self.path = path
        self.content = metadata.RecordedFile(path.name)
        self.open_chunk_bytes = 0
        self._whole_chunk_bytes = 0
        # After a failed write, mcap's writer and the file no longer agree.
        self._is_broken = False
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._stream = path.open('xb')
        # Chunk checksums alone leave the bytes between chunks unchecked: a damaged record type
        # there would make a reader skip a whole chunk without a word.
        self._mcap = Writer(self._stream, chunk_size=_NO_LIMIT, enable_data_crcs=True,
                            compression=compression)
        try:
            self._mcap.start(profile=Profile.ROS2, library=f'koopman_ros {__version__}')
            # rosbag2 too writes the record at both ends. The last one counts; the first one lets
            # a file whose recorder was killed keep its format version.
            self._add_metadata_record()
            self.flush()
        except OSError:
            with contextlib.suppress(OSError):
                self._stream.close()
            path.unlink()
            raise

    @property
    def size_bytes(self) -> int:
        """The size so far, with the open chunk as if it was not compressed."""
        return self._whole_chunk_bytes + self.open_chunk_bytes

    def add_topic(self, topic: metadata.RecordedTopic) -> None:
        """Announce a topic, once; its own count of messages begins at 0."""
        definition = topic.definition
        if definition.type_name not in self._schemas:
            self._schemas[definition.type_name] = self._mcap.register_schema(
                name=definition.type_name, encoding=SchemaEncoding.ROS2,
                data=definition.text.encode('utf-8'))
        self._channels[topic.name] = self._mcap.register_channel(
            topic=topic.name, message_encoding=MessageEncoding.CDR,
            schema_id=self._schemas[definition.type_name],
            metadata={'offered_qos_profiles': metadata.dump_offered_qos(topic.offered_qos),
                      'topic_type_hash': definition.type_hash})
        self.content.topics[topic.name] = metadata.RecordedTopic(
            topic.name, definition, topic.offered_qos)

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int, sequence: int
              ) -> None:
        """Append one message to the open chunk."""
        self._mcap.add_message(
            channel_id=self._channels[topic], log_time=log_time_ns, data=data,
            publish_time=publish_time_ns, sequence=sequence % _SEQUENCE_MODULUS)
        self.open_chunk_bytes += len(data) + _MESSAGE_HEAD_BYTES
        self.content.count(topic, log_time_ns)

    def flush(self) -> None:
        """End the open chunk and hand everything to the operating system."""
        if self._is_broken:
            raise OSError(f'{str(self.path)!r} ends at an earlier write error')
        try:
            self._mcap.flush()
        except OSError:
            self._is_broken = True
            raise
        self._whole_chunk_bytes = self._stream.tell()
        self.open_chunk_bytes = 0

    def close(self) -> None:
        """Complete the file on the disk; after an OSError it ends with its last whole chunk."""
        try:
            self.flush()
            self._add_metadata_record()
            self._mcap.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
        except OSError:
            with contextlib.suppress(OSError):
                self._stream.close()
            os.truncate(self.path, self._whole_chunk_bytes)
            raise
        self._stream.close()

    def _add_metadata_record(self) -> None:
        text = metadata.dump_metadata(metadata.bag_metadata([self.content]))
        self._mcap.add_metadata('rosbag2', {'serialized_metadata': text})
