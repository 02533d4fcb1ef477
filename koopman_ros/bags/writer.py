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

"""Recording: serialized messages into a bag that rosbag2 and every MCAP reader can open."""

from collections.abc import Callable, Mapping, Sequence
import math
import operator
import os
from pathlib import Path
import time
from types import TracebackType
from typing import BinaryIO, Self

from koopman_ros import __version__
from koopman_ros.bags.metadata import (
    bag_metadata,
    dump_metadata,
    RecordedTopic,
    write_metadata_file,
)
from koopman_ros.bags.qos import dump_offered_qos, QosProfile
from koopman_ros.bags.schemas import MessageDefinition
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

_COMPRESSIONS = {
    'none': CompressionType.NONE,
    'zstd': CompressionType.ZSTD,
    'lz4': CompressionType.LZ4,
}
_MAX_TIME_NS = 2**63 - 1
_SEQUENCE_MODULUS = 2**32


class BagWriter:
    """
    Write serialized (CDR) messages to an MCAP bag in the layout of rosbag2, Jazzy.

    `path` ending in '.mcap' makes one self-describing file; any other path makes a bag
    directory with `<name>_0.mcap` and, at `close`, `metadata.yaml`. Missing parent folders are
    made. An existing path is never overwritten.

    `compression` of the chunks is 'none', 'zstd' or 'lz4'. The default is 'none', as in
    rosbag2: every reader can open it, and there is no codec between a damaged file and its
    messages. With 'zstd' the bag of a control loop has about a third of the size.
    A chunk ends when it exceeds `max_chunk_bytes`, or with the first `write` after it has been
    open for `max_chunk_age_s` [s of `clock`] (0: after each message, infinity: never). A
    process that is killed loses no more than the open chunk; a recorder whose topics may fall
    silent calls `flush` from a timer.
    `custom_data` is made of pairs of strings, kept in the bag's metadata.

    Not thread-safe: one thread at a time may use a writer. Raises FileExistsError if `path`
    exists, ValueError for an option out of range.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        compression: str = 'none',
        max_chunk_bytes: int = 2**20,
        max_chunk_age_s: float = 1.0,
        custom_data: Mapping[str, str] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if compression not in _COMPRESSIONS:
            raise ValueError(
                f'compression {compression!r} is not one of {", ".join(_COMPRESSIONS)}')
        if max_chunk_bytes < 1:
            raise ValueError(f'max_chunk_bytes {max_chunk_bytes} is below 1: give a size in bytes')
        if math.isnan(max_chunk_age_s) or max_chunk_age_s < 0:
            raise ValueError(
                f'max_chunk_age_s {max_chunk_age_s} is not a time of 0 s or more: '
                'use 0 to flush each message, math.inf to flush by size alone')
        self.path = Path(path)
        self._is_directory = self.path.suffix != '.mcap'
        self._max_chunk_age_s = max_chunk_age_s
        self._custom_data = _string_pairs(custom_data or {})
        self._clock = clock
        self._topics: dict[str, RecordedTopic] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._time_range_ns: tuple[int, int] | None = None
        self._chunk_opened_s: float | None = None
        self._closed = False
        self._stream = self._create()
        self._mcap = Writer(
            self._stream,
            chunk_size=max_chunk_bytes,
            compression=_COMPRESSIONS[compression],
            # Chunk checksums alone leave the bytes between chunks unchecked: a damaged record
            # type there would make a reader skip a whole chunk without a word.
            enable_data_crcs=True,
        )
        self._mcap.start(profile=Profile.ROS2, library=f'koopman_ros {__version__}')
        # rosbag2 too writes the record at both ends. The last one counts; the first one lets a
        # file whose recorder was killed keep its format version and custom data.
        self._add_metadata_record()
        self._mcap.flush()

    @property
    def mcap_path(self) -> Path:
        """The MCAP file that receives the messages."""
        return self.path / f'{self.path.name}_0.mcap' if self._is_directory else self.path

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._closed

    @property
    def message_count(self) -> int:
        """The number of messages written so far, on all topics."""
        return sum(topic.message_count for topic in self._topics.values())

    def add_topic(
        self, topic: str, definition: MessageDefinition, offered_qos: Sequence[QosProfile] = ()
    ) -> None:
        """
        Announce a topic; announcing it again with the same definition does nothing.

        `topic` is the resolved name ('/temperature'), `definition` that of its type (see
        `message_definition`), `offered_qos` one profile for each publisher known when the
        recording starts. Raises ValueError for a relative name, for another definition of the
        topic or of the type than before, and on a closed writer.
        """
        self._check_open('add a topic to')
        if not topic.startswith('/'):
            raise ValueError(
                f'topic {topic!r} is not an absolute name: resolve it first, '
                f'such as node.resolve_topic_name({topic!r})')
        self._check_consistent(topic, definition)
        if topic in self._topics:
            return
        recorded = RecordedTopic(topic, definition, tuple(offered_qos))
        self._channels[topic] = self._mcap.register_channel(
            topic=topic,
            message_encoding=MessageEncoding.CDR,
            schema_id=self._schema_id(definition),
            metadata={
                'offered_qos_profiles': dump_offered_qos(recorded.offered_qos),
                'topic_type_hash': definition.type_hash,
            },
        )
        self._topics[topic] = recorded

    def write(
        self,
        topic: str,
        data: bytes | bytearray | memoryview,
        log_time_ns: int,
        publish_time_ns: int | None = None,
    ) -> None:
        """
        Append one serialized message, byte for byte.

        `data` is CDR with its encapsulation header, as a subscription with `raw=True` or
        `rclpy.serialization.serialize_message` gives it. `log_time_ns` is the time of receipt
        [ns], `publish_time_ns` that of sending [ns], the same by default. Raises ValueError for
        an unknown topic, for a time outside [0, 2**63) ns and on a closed writer, TypeError for
        data that is not bytes.
        """
        self._check_open('write to')
        recorded = self._topics.get(topic)
        if recorded is None:
            raise ValueError(
                f'topic {topic!r} is not in the bag {str(self.path)!r}: call add_topic first')
        if not isinstance(data, bytes | bytearray | memoryview):
            raise TypeError(
                f'data for {topic!r} must be serialized (bytes), got {type(data).__name__}: '
                'subscribe with raw=True or call rclpy.serialization.serialize_message')
        log_time_ns = _checked_time('log_time_ns', log_time_ns)
        if publish_time_ns is None:
            publish_time_ns = log_time_ns
        self._mcap.add_message(
            channel_id=self._channels[topic],
            log_time=log_time_ns,
            data=bytes(data),
            publish_time=_checked_time('publish_time_ns', publish_time_ns),
            sequence=recorded.message_count % _SEQUENCE_MODULUS,
        )
        recorded.message_count += 1
        first, last = self._time_range_ns or (log_time_ns, log_time_ns)
        self._time_range_ns = (min(first, log_time_ns), max(last, log_time_ns))
        self._flush_old_chunk()

    def flush(self) -> None:
        """
        End the open chunk and hand everything to the operating system.

        What was flushed survives the end of the process, not the loss of power. Raises
        ValueError on a closed writer.
        """
        self._check_open('flush')
        self._mcap.flush()
        self._chunk_opened_s = None

    def close(self) -> None:
        """Complete the file (and `metadata.yaml`); closing a closed writer does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self._mcap.flush()
            self._add_metadata_record()
            self._mcap.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
        finally:
            self._stream.close()
        if self._is_directory:
            write_metadata_file(self.path, self._metadata())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        # Also after an exception: what was recorded up to it is what one wants to look at.
        self.close()

    def _create(self) -> BinaryIO:
        """Create the file, and its directory; both calls fail on whatever exists."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self._is_directory:
                self.path.mkdir()
            return self.mcap_path.open('xb')
        except FileExistsError as error:
            raise FileExistsError(
                f'{str(error.filename)!r} exists already and recordings are never overwritten: '
                'choose another name, or move the old one away') from error

    def _check_consistent(self, topic: str, definition: MessageDefinition) -> None:
        """Refuse a second type of one topic, and a second definition of one type."""
        for known in self._topics.values():
            same_name = known.name == topic or known.definition.type_name == definition.type_name
            if same_name and known.definition != definition:
                raise ValueError(
                    f'topic {topic!r} of type {definition.type_name} ({definition.type_hash}) '
                    f'contradicts topic {known.name!r} of type {known.definition.type_name} '
                    f'({known.definition.type_hash}): record it in a bag of its own')

    def _schema_id(self, definition: MessageDefinition) -> int:
        """Return the id of a type's schema, written once and shared by all its topics."""
        name = definition.type_name
        if name not in self._schemas:
            self._schemas[name] = self._mcap.register_schema(
                name=name, encoding=SchemaEncoding.ROS2, data=definition.text.encode('utf-8'))
        return self._schemas[name]

    def _flush_old_chunk(self) -> None:
        now_s = self._clock()
        if self._chunk_opened_s is None:
            self._chunk_opened_s = now_s
        if now_s - self._chunk_opened_s >= self._max_chunk_age_s:
            self.flush()

    def _metadata(self) -> dict[str, object]:
        return bag_metadata(
            self.mcap_path.name,
            tuple(self._topics.values()),
            self._time_range_ns,
            self._custom_data,
        )

    def _add_metadata_record(self) -> None:
        text = dump_metadata(self._metadata())
        self._mcap.add_metadata('rosbag2', {'serialized_metadata': text})

    def _check_open(self, action: str) -> None:
        if self._closed:
            raise ValueError(
                f'cannot {action} the bag {str(self.path)!r}: it is closed; start another one')


def _checked_time(name: str, time_ns: int) -> int:
    time_ns = operator.index(time_ns)
    if not 0 <= time_ns <= _MAX_TIME_NS:
        raise ValueError(f'{name} {time_ns} is outside [0, {_MAX_TIME_NS}] ns: '
                         'give nanoseconds since the epoch of the clock in use')
    return time_ns


def _string_pairs(pairs: Mapping[str, str]) -> dict[str, str]:
    for key, value in pairs.items():
        if not (isinstance(key, str) and isinstance(value, str)):
            raise ValueError(
                f'custom_data {key!r}: {value!r} is not a pair of strings: '
                'convert both with str()')
    return dict(pairs)
