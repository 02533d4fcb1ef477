# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Reading bags back: decoded messages and a summary, from rosbag2's bags as from our own."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
import heapq
import os
from pathlib import Path
import warnings

from mcap.records import Channel
from mcap.summary import Summary
from rosbags.interfaces import Qos

from koopman_ros.bags.bag_files import locate
from koopman_ros.bags.decoding import BagMessage, Decoders, type_name, UndecodableError
from koopman_ros.bags.mcap_file import BagReadError, opened, stored_messages, summary_section
from koopman_ros.bags.metadata import parse_offered_qos
from koopman_ros.wire import full_type_name

# A recorder that falls behind writes what waits topic by topic; longer than this it never waits.
_BEHIND_NS = 5_000_000_000


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
    offered_qos: dict[str, tuple[Qos, ...]]
    start_ns: int | None
    end_ns: int | None
    complete: bool

    @property
    def message_count(self) -> int:
        """The number of messages on all topics."""
        return sum(self.counts.values())


def read_messages(path: str | os.PathLike[str], topics: Collection[str] | None = None, *,
                  recover: bool = False) -> Iterator[BagMessage]:
    """
    Iterate over the messages of a bag in the order in which they were recorded.

    `path` is a .mcap file or a bag directory; `topics` limits the reading to these names (all
    by default; a name that the bag lacks yields nothing). With `recover`, a bag that was not
    closed or is damaged is read up to the last complete record of each file. Where all topics are
    read, messages of types that are not decoded here, such as service events, come with their
    bytes alone (`message` is None), and a warning names each of these topics once.

    Raises BagReadError: at once for a bag that is missing, empty, not MCAP or not closed, while
    iterating for a damaged record, a message that does not decode, or a topic by its name whose
    type is not decoded here. Raises TypeError for a single string as `topics`.
    """
    if isinstance(topics, str):
        raise TypeError(f'topics must be a collection of names: pass [{topics!r}]')
    files, _ = locate(path, recover=recover)
    return _decoded(files, None if topics is None else frozenset(topics), recover)


def in_log_order(messages: Iterable[BagMessage]) -> Iterator[BagMessage]:
    """
    Yield messages by their log time, as `ros2 bag play` does, within runs of one clock.

    A message goes ahead of those recorded before it when it was received earlier, by at most
    5 s. One that is earlier by more tells of a clock that was set back: all that came before it
    stays before it. Messages of one log time keep their order.
    """
    waiting: list[tuple[int, int, BagMessage]] = []
    newest_ns = 0
    for place, message in enumerate(messages):
        time_ns = message.log_time_ns
        if waiting and time_ns < newest_ns - _BEHIND_NS:
            yield from (entry for _, _, entry in sorted(waiting))
            waiting, newest_ns = [], time_ns
        newest_ns = max(newest_ns, time_ns)
        heapq.heappush(waiting, (time_ns, place, message))
        while waiting[0][0] < newest_ns - _BEHIND_NS:
            yield heapq.heappop(waiting)[2]
    yield from (entry for _, _, entry in sorted(waiting))


def summary(path: str | os.PathLike[str]) -> BagSummary:
    """
    Return what a bag holds, also for one that was not closed (`complete` is then False).

    `path` is a .mcap file or a bag directory. Raises BagReadError for a bag that is missing,
    empty or not MCAP.
    """
    files, complete = locate(path, recover=True)
    parts = [_indexed_summary(file) or _scanned_summary(file) for file in files]
    counts: Counter[str] = Counter()
    types: dict[str, str] = {}
    offered_qos: dict[str, tuple[Qos, ...]] = {}
    for part in parts:
        counts.update(part.counts)
        types.update(part.types)
        offered_qos.update(part.offered_qos)
    starts = [part.start_ns for part in parts if part.start_ns is not None]
    ends = [part.end_ns for part in parts if part.end_ns is not None]
    return BagSummary(dict(counts), types, offered_qos, min(starts, default=None),
                      max(ends, default=None),
                      complete=complete and all(part.complete for part in parts))


def _decoded(files: tuple[Path, ...], topics: frozenset[str] | None, recover: bool
             ) -> Iterator[BagMessage]:
    undecoded: set[str] = set()
    for file in files:
        # of each file by itself: identifiers of channels are a file's own
        decoders = Decoders(file)
        for stored in stored_messages(file, recover=recover, topics=topics):
            try:
                yield decoders.decode(stored)
            except UndecodableError as error:
                if topics is not None:
                    raise
                if stored.channel.topic not in undecoded:
                    undecoded.add(stored.channel.topic)
                    warnings.warn(f'messages on {stored.channel.topic!r} are given as bytes '
                                  f'alone: {error}', stacklevel=2)
                yield decoders.undecoded(stored)


def _indexed_summary(file: Path) -> BagSummary | None:
    """Return the summary at the end of a closed file, None where a part of it is left out."""
    with opened(file) as stream:
        content = summary_section(stream)
    if content is None or content.statistics is None or not _is_whole(content):
        return None
    statistics = content.statistics
    counts: Counter[str] = Counter()
    types = {}
    for channel in content.channels.values():
        schema = content.schemas.get(channel.schema_id)
        counts[channel.topic] += statistics.channel_message_counts.get(channel.id, 0)
        types[channel.topic] = full_type_name(schema.name) if schema else ''
    empty = statistics.message_count == 0
    return BagSummary(
        dict(counts), types, _offered_qos(content.channels.values()),
        None if empty else statistics.message_start_time,
        None if empty else statistics.message_end_time, complete=True)


def _is_whole(content: Summary) -> bool:
    """
    Check that a summary section has all channels with messages, their schemas and their counts.

    The MCAP specification leaves each of them to the writer; an empty map of counts means that
    they are not available.
    """
    statistics = content.statistics
    return (statistics is not None
            and statistics.channel_message_counts.keys() <= content.channels.keys()
            and sum(statistics.channel_message_counts.values()) == statistics.message_count
            and all(channel.schema_id in content.schemas or channel.schema_id == 0
                    for channel in content.channels.values()))


def _scanned_summary(file: Path) -> BagSummary:
    """Return the summary of all complete records, counted message by message."""
    counts: Counter[str] = Counter()
    types: dict[str, str] = {}
    channels: dict[str, Channel] = {}
    start_ns = end_ns = None
    complete = True
    try:
        for stored in stored_messages(file, recover=False):
            topic, time_ns = stored.channel.topic, stored.log_time_ns
            counts[topic] += 1
            types[topic] = type_name(stored)
            channels[topic] = stored.channel
            start_ns = time_ns if start_ns is None else min(start_ns, time_ns)
            end_ns = time_ns if end_ns is None else max(end_ns, time_ns)
    except BagReadError:
        complete = False
    return BagSummary(
        dict(counts), types, _offered_qos(channels.values()), start_ns, end_ns, complete)


def _offered_qos(channels: Iterable[Channel]) -> dict[str, tuple[Qos, ...]]:
    """Return the offers on each topic, as far as they were kept and can be read."""
    offers = {channel.topic: parse_offered_qos(channel.metadata.get('offered_qos_profiles', ''))
              for channel in channels}
    return {topic: offered for topic, offered in offers.items() if offered}
