# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recording: serialized messages into a bag that rosbag2 and every MCAP reader can open."""

from collections.abc import Callable, Sequence
import math
import operator
import os
from pathlib import Path
import time
from typing import Self

from koopman_ros.bags.files import COMPRESSIONS, FileSequence
from koopman_ros.bags.metadata import QosProfile, RecordedTopic
from koopman_ros.bags.schemas import MessageDefinition
from koopman_ros.units import NANOSECONDS

_MAX_TIME_NS = 2**63 - 1
_BYTES = (bytes, bytearray, memoryview)


class BagWriter:
    """
    Write serialized (CDR) messages to an MCAP bag in the layout of rosbag2, Jazzy.

    `path` ending in '.mcap' makes one self-describing file; any other path makes a bag directory
    with `<name>_0.mcap` and, at `close`, `metadata.yaml`. An existing path is never overwritten.

    A bag directory is split where asked for: a message that finds `max_file_bytes` written, or
    `max_file_duration_s` [s] passed since the first log time of the file, begins the next file
    (`<name>_1.mcap`, ...; 0: never). The file before it is completed in the background, written
    through to the disk and only then listed in `metadata.yaml`.

    `compression` of the chunks is 'none', 'zstd' or 'lz4'. The default is that of rosbag2: every
    reader can open it, and there is no codec between a damaged file and its messages. With 'zstd'
    the bag of a control loop has about a third of the size. A chunk ends when it exceeds
    `max_chunk_bytes`, or with the first `write` after it has been open for `max_chunk_age_s` [s of
    `clock`] (0: after each message, infinity: never). A process that is killed loses no more than
    the open chunk; a recorder whose topics may fall silent calls `flush` from a timer. What it
    leaves is read by `read_messages` with `recover`, and by mcap's `NonSeekingReader` with
    `log_time_order=False` until that raises `EndOfFile`.

    Not thread-safe: one thread at a time may use a writer. Raises FileExistsError if `path`
    exists, ValueError for an option out of range and for a single file that is to be split.
    What goes wrong in the background is raised by the next `flush` or `close`.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        compression: str = 'none',
        max_file_bytes: int = 0,
        max_file_duration_s: float = 0.0,
        max_chunk_bytes: int = 2**20,
        max_chunk_age_s: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise ValueError(
                f'compression {compression!r} is not one of {", ".join(COMPRESSIONS)}')
        if max_chunk_bytes < 1:
            raise ValueError(f'max_chunk_bytes {max_chunk_bytes} is below 1: give a size in bytes')
        if math.isnan(max_chunk_age_s) or max_chunk_age_s < 0:
            raise ValueError(
                f'max_chunk_age_s {max_chunk_age_s} is not a time of 0 s or more: '
                'use 0 to flush each message, math.inf to flush by size alone')
        if max_file_bytes < 0:
            raise ValueError(f'max_file_bytes {max_file_bytes} is negative: use 0 for no limit')
        if not 0 <= max_file_duration_s < math.inf:
            raise ValueError(
                f'max_file_duration_s {max_file_duration_s} is not a time of 0 s or more: '
                'use 0 for no limit')
        self.path = Path(path)
        if (max_file_bytes or max_file_duration_s) and self.path.suffix == '.mcap':
            raise ValueError(
                f'{str(self.path)!r} is one file, which is not split: give the name of a folder, '
                'without .mcap')
        self._max_chunk_bytes = max_chunk_bytes
        self._max_chunk_age_s = max_chunk_age_s
        self._clock = clock
        self._topics: dict[str, RecordedTopic] = {}
        self._chunk_opened_s: float | None = None
        self._closed = False
        self._files = FileSequence(
            self.path, compression, max_file_bytes or math.inf,
            round(max_file_duration_s * NANOSECONDS) or math.inf)

    def add_topic(
        self, topic: str, definition: MessageDefinition, offered_qos: Sequence[QosProfile] = ()
    ) -> None:
        """
        Announce a topic by its absolute name; again with the same definition does nothing.

        `offered_qos` has one profile for each publisher known when the recording starts. Raises
        ValueError for a relative name, for another definition of the topic or of the type than
        before, and on a closed writer.
        """
        self._check_open('add a topic to')
        if not topic.startswith('/'):
            raise ValueError(
                f'topic {topic!r} is not an absolute name: resolve it first, '
                f'such as node.resolve_topic_name({topic!r})')
        self._check_consistent(topic, definition)
        if topic in self._topics:
            return
        self._topics[topic] = RecordedTopic(topic, definition, tuple(offered_qos))
        self._files.current.add_topic(self._topics[topic])

    def write(self, topic: str, data: bytes | bytearray | memoryview, log_time_ns: int,
              publish_time_ns: int | None = None) -> None:
        """
        Append one message, byte for byte, in CDR with its encapsulation header.

        `log_time_ns` is the time of receipt [ns], `publish_time_ns` that of sending [ns], the same
        by default. Raises ValueError for an unknown topic, for a time outside [0, 2**63) ns and on
        a closed writer, TypeError for data that is not bytes.
        """
        self._check_open('write to')
        recorded = self._topics.get(topic)
        if recorded is None:
            raise ValueError(
                f'topic {topic!r} is not in the bag {str(self.path)!r}: call add_topic first')
        if not isinstance(data, _BYTES):
            raise TypeError(
                f'data for {topic!r} must be serialized (bytes), got {type(data).__name__}: '
                'subscribe with raw=True or call rclpy.serialization.serialize_message')
        log_time_ns = _checked_time('log_time_ns', log_time_ns)
        publish_time_ns = (log_time_ns if publish_time_ns is None
                           else _checked_time('publish_time_ns', publish_time_ns))
        if self._files.is_full(log_time_ns):
            self.flush()
            self._files.split(self._topics.values())
        self._files.current.write(
            topic, bytes(data), log_time_ns, publish_time_ns, recorded.message_count)
        recorded.message_count += 1
        now_s = self._clock()
        if self._chunk_opened_s is None:
            self._chunk_opened_s = now_s
        if (self._files.current.open_chunk_bytes > self._max_chunk_bytes
                or now_s - self._chunk_opened_s >= self._max_chunk_age_s):
            self.flush()

    def flush(self) -> None:
        """
        End the open chunk; what was flushed survives the end of the process, not a loss of power.

        Raises ValueError on a closed writer.
        """
        self._check_open('flush')
        self._files.current.flush()
        self._chunk_opened_s = None
        self._files.raise_failures()

    def close(self) -> None:
        """Complete the file (and `metadata.yaml`); closing a closed writer does nothing."""
        if self._closed:
            return
        self._closed = True
        self._files.complete()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        # Also after an exception: what was recorded up to it is what one wants to look at.
        self.close()

    def _check_consistent(self, topic: str, definition: MessageDefinition) -> None:
        """Refuse a second type of one topic, and a second definition of one type."""
        for known in self._topics.values():
            same_name = known.name == topic or known.definition.type_name == definition.type_name
            if same_name and known.definition != definition:
                raise ValueError(
                    f'topic {topic!r} of type {definition.type_name} ({definition.type_hash}) '
                    f'contradicts topic {known.name!r} of type {known.definition.type_name} '
                    f'({known.definition.type_hash}): record it in a bag of its own')

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
