# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The files of a bag being written, each complete in itself, and the metadata that lists them."""

from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
import contextlib
import os
from pathlib import Path

from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from koopman_ros import __version__
from koopman_ros.bags import metadata
from koopman_ros.bags.schemas import MessageDefinition

COMPRESSIONS = {
    'none': CompressionType.NONE,
    'zstd': CompressionType.ZSTD,
    'lz4': CompressionType.LZ4,
}
_SEQUENCE_MODULUS = 2**32
# What a message takes in a chunk beside its data: opcode, length, channel, sequence, two times.
_MESSAGE_HEAD_BYTES = 31
# Chunks end where we say so, and then go to the operating system at once: mcap's own limit would
# leave the end of a chunk in a buffer.
_NO_LIMIT = 2**62


class FileSequence:
    """
    A file, or the directory of files `<name>_0.mcap`, `<name>_1.mcap`, ... with metadata.yaml.

    A file that has reached `max_bytes`, or `max_ns` [ns] of log time, is full. `metadata.yaml`
    lists the files that are complete and on the disk: whatever happens later, those can be read.
    Raises FileExistsError for a path that exists.
    """

    def __init__(self, path: Path, compression: str, max_bytes: float, max_ns: float) -> None:
        self._path = path
        self._is_directory = path.suffix != '.mcap'
        self._compression = compression
        self._max_bytes = max_bytes
        self._max_ns = max_ns
        self._completed: list[metadata.RecordedFile] = []
        # A thread of its own: to write a large file through to the disk takes longer than
        # messages can wait.
        self._background = ThreadPoolExecutor(max_workers=1, thread_name_prefix='bag')
        self._completion: Future[None] | None = None
        self.current = self._create()
        self._count = 1

    def is_full(self, log_time_ns: int) -> bool:
        """Tell whether a message at this time [ns] belongs into the next file."""
        range_ns = self.current.content.time_range_ns
        return range_ns is not None and (
            self.current.size_bytes >= self._max_bytes
            or log_time_ns - range_ns[0] >= self._max_ns)

    def split(self, topics: Iterable[metadata.RecordedTopic]) -> None:
        """Go on in the next file, and complete the present one meanwhile."""
        if self._completion is not None:
            # long done, unless files fill up faster than the disk takes them
            self._completion.result()
        following = self._open(self._count)
        for topic in topics:
            following.add_topic(topic)
        full, self.current = self.current, following
        self._count += 1
        self._completion = self._background.submit(self._complete, full)

    def raise_failures(self) -> None:
        """Raise what went wrong with a file that was completed in the background."""
        if self._completion is not None and self._completion.done():
            self._completion.result()

    def complete(self) -> None:
        """Complete all files."""
        self._background.shutdown()
        try:
            self.raise_failures()
        finally:
            self._complete(self.current)

    def _create(self) -> 'McapFile':
        """Create the first file, and its directory; both calls fail on whatever exists."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            if self._is_directory:
                self._path.mkdir()
            return self._open(0)
        except FileExistsError as error:
            raise FileExistsError(
                f'{str(error.filename)!r} exists already and recordings are never overwritten: '
                'choose another name, or move the old one away') from error

    def _open(self, number: int) -> 'McapFile':
        return McapFile(
            self._path / f'{self._path.name}_{number}.mcap' if self._is_directory else self._path,
            self._compression)

    def _complete(self, file: 'McapFile') -> None:
        """Complete a file, and list it in the metadata of a bag directory."""
        file.close()
        self._completed.append(file.content)
        if self._is_directory:
            metadata.write_metadata_file(self._path, metadata.bag_metadata(self._completed))
        else:
            metadata.sync_folder(self._path.parent)


class McapFile:
    """
    Write the messages of one file, chunk by chunk; nothing is checked here.

    `content` is what the file holds so far. A chunk ends with :meth:`flush`. Raises
    FileExistsError for a path that exists.
    """

    def __init__(self, path: Path, compression: str) -> None:
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
                            compression=COMPRESSIONS[compression])
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
        self._channels[topic.name] = self._mcap.register_channel(
            topic=topic.name, message_encoding=MessageEncoding.CDR,
            schema_id=self._schema_id(definition),
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
            raise OSError(f'{str(self.path)!r} ends where it could not be written before')
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

    def _schema_id(self, definition: MessageDefinition) -> int:
        """Return the id of a type's schema, written once and shared by all its topics."""
        name = definition.type_name
        if name not in self._schemas:
            self._schemas[name] = self._mcap.register_schema(
                name=name, encoding=SchemaEncoding.ROS2, data=definition.text.encode('utf-8'))
        return self._schemas[name]

    def _add_metadata_record(self) -> None:
        text = metadata.dump_metadata(metadata.bag_metadata([self.content]))
        self._mcap.add_metadata('rosbag2', {'serialized_metadata': text})
