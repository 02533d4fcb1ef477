# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""One MCAP file of a bag being written: complete in itself, with schemas, topics and metadata."""

from collections.abc import Mapping
import contextlib
import os
from pathlib import Path

from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from koopman_ros import __version__
from koopman_ros.bags.metadata import bag_metadata, dump_metadata, RecordedFile, RecordedTopic
from koopman_ros.bags.qos import dump_offered_qos
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


class McapFile:
    """
    Write the messages of one file, chunk by chunk; nothing is checked here.

    `content` is what the file holds so far. A chunk ends with :meth:`flush`. Raises
    FileExistsError for a path that exists.
    """

    def __init__(self, path: Path, compression: str, custom_data: Mapping[str, str]) -> None:
        self.path = path
        self.content = RecordedFile(path.name)
        self.open_chunk_bytes = 0
        self._whole_chunk_bytes = 0
        # After a failed write, mcap's writer and the file no longer agree.
        self._is_broken = False
        self._custom_data = custom_data
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._stream = path.open('xb')
        self._mcap = Writer(
            self._stream,
            chunk_size=_NO_LIMIT,
            compression=COMPRESSIONS[compression],
            # Chunk checksums alone leave the bytes between chunks unchecked: a damaged record
            # type there would make a reader skip a whole chunk without a word.
            enable_data_crcs=True,
        )
        try:
            self._mcap.start(profile=Profile.ROS2, library=f'koopman_ros {__version__}')
            # rosbag2 too writes the record at both ends. The last one counts; the first one lets
            # a file whose recorder was killed keep its format version and custom data.
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

    def add_topic(self, topic: RecordedTopic) -> None:
        """Announce a topic, once; its own count of messages begins at 0."""
        definition = topic.definition
        self._channels[topic.name] = self._mcap.register_channel(
            topic=topic.name,
            message_encoding=MessageEncoding.CDR,
            schema_id=self._schema_id(definition),
            metadata={
                'offered_qos_profiles': dump_offered_qos(topic.offered_qos),
                'topic_type_hash': definition.type_hash,
            },
        )
        self.content.topics[topic.name] = RecordedTopic(
            topic.name, definition, topic.offered_qos)

    def write(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int, sequence: int
              ) -> None:
        """Append one message to the open chunk."""
        self._mcap.add_message(
            channel_id=self._channels[topic],
            log_time=log_time_ns,
            data=data,
            publish_time=publish_time_ns,
            sequence=sequence % _SEQUENCE_MODULUS,
        )
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
        """
        Complete the file and wait until it is on the disk.

        Raises OSError where that fails; the file then ends with its last whole chunk, as that of
        a recorder that was killed.
        """
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
        text = dump_metadata(bag_metadata([self.content], self._custom_data))
        self._mcap.add_metadata('rosbag2', {'serialized_metadata': text})
