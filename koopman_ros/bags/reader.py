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

"""Reading bags back: decoded messages and a summary, from rosbag2's bags as from our own."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
import contextlib
from dataclasses import dataclass
import io
import os
from pathlib import Path
from typing import Any

from koopman_ros.bags.compression import opened
from koopman_ros.bags.errors import BagReadError, reason
from koopman_ros.bags.qos import parse_offered_qos, QosProfile
from koopman_ros.bags.records import stored_messages, StoredMessage, summary_section
from koopman_ros.bags.storage import locate
from mcap.exceptions import EndOfFile
from mcap.records import Channel
from mcap_ros2.decoder import DecoderFactory


@dataclass(frozen=True, slots=True)
class BagMessage:
    """
    One message of a bag: times of receipt and of sending [ns], decoded fields, original bytes.

    `message` has the fields of the ROS message as attributes (`message.header.stamp.sec`).
    """

    topic: str
    type_name: str
    log_time_ns: int
    publish_time_ns: int
    message: Any
    data: bytes


@dataclass(frozen=True)
class BagSummary:
    """
    What a bag holds: messages, type and publishers' offers by topic, first and last log time [ns].

    The times are None for a bag without messages. `complete` is False when the recorder did not
    close the bag: the counts are then those of the part that can be read. `offered_qos` has no
    entry for a topic whose recorder kept none.
    """

    counts: dict[str, int]
    types: dict[str, str]
    offered_qos: dict[str, tuple[QosProfile, ...]]
    start_ns: int | None
    end_ns: int | None
    complete: bool

    @property
    def message_count(self) -> int:
        """The number of messages on all topics."""
        return sum(self.counts.values())


def read_messages(
    path: str | os.PathLike[str],
    topics: Collection[str] | None = None,
    *,
    recover: bool = False,
) -> Iterator[BagMessage]:
    """
    Iterate over the messages of a bag in the order in which they were recorded.

    `path` is a .mcap file or a bag directory; `topics` limits the reading to these names (all
    by default; a name that the bag lacks yields nothing). With `recover`, a bag that was not
    closed or is damaged is read up to the last complete record of each file.

    Raises BagReadError: at once for a bag that is missing, empty, not MCAP or not closed, while
    iterating for a damaged record or a message that does not decode. Raises TypeError for a
    single string as `topics`.
    """
    if isinstance(topics, str):
        raise TypeError(f'topics must be a collection of names: pass [{topics!r}]')
    bag = locate(path, recover=recover)
    wanted = None if topics is None else frozenset(topics)
    return _decoded(bag.files, wanted, recover)


def summary(path: str | os.PathLike[str]) -> BagSummary:
    """
    Return what a bag holds, also for one that was not closed (`complete` is then False).

    `path` is a .mcap file or a bag directory. Raises BagReadError for a bag that is missing,
    empty or not MCAP.
    """
    bag = locate(path, recover=True)
    parts = [_file_summary(file) for file in bag.files]
    counts: Counter[str] = Counter()
    types: dict[str, str] = {}
    offered_qos: dict[str, tuple[QosProfile, ...]] = {}
    for part in parts:
        counts.update(part.counts)
        types.update(part.types)
        offered_qos.update(part.offered_qos)
    starts = [part.start_ns for part in parts if part.start_ns is not None]
    ends = [part.end_ns for part in parts if part.end_ns is not None]
    return BagSummary(
        counts=dict(counts),
        types=types,
        offered_qos=offered_qos,
        start_ns=min(starts, default=None),
        end_ns=max(ends, default=None),
        complete=bag.complete and all(part.complete for part in parts),
    )


def _decoded(
    files: tuple[Path, ...], topics: frozenset[str] | None, recover: bool
) -> Iterator[BagMessage]:
    for file in files:
        # One factory for each file: it keeps decoders by schema id, and ids are a file's own.
        factory = DecoderFactory()
        for stored in stored_messages(file, recover=recover):
            if topics is None or stored.channel.topic in topics:
                yield _decode(stored, factory, file)


def _decode(stored: StoredMessage, factory: DecoderFactory, file: Path) -> BagMessage:
    topic = stored.channel.topic
    decoder = _decoder(stored, factory, file)
    try:
        message = decoder(_WholeSlices(stored.message.data))
    except Exception as error:
        # The decoder walks over foreign bytes and fails in as many ways as they can be wrong.
        raise BagReadError(
            f'{str(file)!r}: the message on {topic!r} at {stored.message.log_time} ns does not '
            f'decode ({reason(error)}): read the other topics by name') from error
    return BagMessage(
        topic=topic,
        type_name=stored.schema.name if stored.schema else '',
        log_time_ns=stored.message.log_time,
        publish_time_ns=stored.message.publish_time,
        message=message,
        data=stored.message.data,
    )


class _WholeSlices(bytes):
    """
    Bytes whose slices are complete or fail.

    The decoder takes whatever a slice returns for a string or a field of bytes: one cut short
    would pass for a shorter one, and a damaged length for that many empty ones.
    """

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice) and key.stop > len(self):
            raise EndOfFile
        return super().__getitem__(key)


def _decoder(
    stored: StoredMessage, factory: DecoderFactory, file: Path
) -> Callable[[bytes], Any]:
    encoding = stored.channel.message_encoding
    schema_encoding = stored.schema.encoding if stored.schema else 'no schema'
    try:
        # the definition parser prints what it also raises
        with contextlib.redirect_stderr(io.StringIO()):
            decoder = factory.decoder_for(encoding, stored.schema)
    except Exception as error:
        # Another recorder's schema text meets the definition parser here.
        raise BagReadError(
            f'{str(file)!r}: the definition stored for {stored.channel.topic!r} does not parse '
            f'({reason(error)}): read the other topics by name') from error
    if decoder is None:
        raise BagReadError(
            f'{str(file)!r}: topic {stored.channel.topic!r} is encoded as {encoding!r} with '
            f'{schema_encoding!r}, only cdr with ros2msg is decoded here: read the other topics '
            'by name')
    return decoder


def _file_summary(file: Path) -> BagSummary:
    indexed = _indexed_summary(file)
    return _scanned_summary(file) if indexed is None else indexed


def _indexed_summary(file: Path) -> BagSummary | None:
    """Return the summary from the statistics at the end of a closed file, None without them."""
    with opened(file) as stream:
        content = summary_section(stream)
    if content is None or content.statistics is None:
        return None
    statistics = content.statistics
    counts: Counter[str] = Counter()
    types = {}
    for channel in content.channels.values():
        schema = content.schemas.get(channel.schema_id)
        counts[channel.topic] += statistics.channel_message_counts.get(channel.id, 0)
        types[channel.topic] = schema.name if schema else ''
    empty = statistics.message_count == 0
    return BagSummary(
        counts=dict(counts),
        types=types,
        offered_qos=_offered_qos(content.channels.values()),
        start_ns=None if empty else statistics.message_start_time,
        end_ns=None if empty else statistics.message_end_time,
        complete=True,
    )


def _scanned_summary(file: Path) -> BagSummary:
    """Return the summary of whatever can be read, counted message by message."""
    counts: Counter[str] = Counter()
    types: dict[str, str] = {}
    channels: dict[str, Channel] = {}
    start_ns = end_ns = None
    complete = True
    try:
        for stored in stored_messages(file, recover=False):
            topic, time_ns = stored.channel.topic, stored.message.log_time
            counts[topic] += 1
            types[topic] = stored.schema.name if stored.schema else ''
            channels[topic] = stored.channel
            start_ns = time_ns if start_ns is None else min(start_ns, time_ns)
            end_ns = time_ns if end_ns is None else max(end_ns, time_ns)
    except BagReadError:
        complete = False
    return BagSummary(
        dict(counts), types, _offered_qos(channels.values()), start_ns, end_ns, complete)


def _offered_qos(channels: Iterable[Channel]) -> dict[str, tuple[QosProfile, ...]]:
    """Return what was offered on each topic, as far as it was kept and can be read."""
    offers = {channel.topic: parse_offered_qos(channel.metadata.get('offered_qos_profiles', ''))
              for channel in channels}
    return {topic: offered for topic, offered in offers.items() if offered}
