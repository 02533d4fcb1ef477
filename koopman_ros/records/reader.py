# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Reading bags back: decoded messages and a summary, from rosbag2's bags as from our own."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
import heapq
import os
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Schema
from rosbags.interfaces import Qos

from koopman_ros.core.message_fields import full_type_name
from koopman_ros.records.bag_files import locate
from koopman_ros.records.decoding import BagMessage, decoded_messages
from koopman_ros.records.mcap_file import BagReadError, opened, stored_messages, summary_section
from koopman_ros.records.metadata import parse_offered_qos

# A late recorder writes its queue topic by topic; no message waits longer than this.
_BEHIND_NS = 5_000_000_000


@dataclass(frozen=True)
class BagSummary:
    """
    The content of a bag: messages, type and publishers' offers by topic, log times [ns].

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
        raise TypeError(f'topics must be a list of names: pass [{topics!r}]')
    files, _ = locate(path, recover=recover)
    return decoded_messages(files, None if topics is None else frozenset(topics), recover)


def in_log_order(messages: Iterable[BagMessage]) -> Iterator[BagMessage]:
    """
    Yield messages by their log time, as `ros2 bag play` does, within runs of one clock.

    A message goes ahead of those recorded before it when it was received earlier, by at most 5 s.
    One that is earlier by more means that a clock was set back: all earlier messages stay before
    it. Messages of one log time keep their order.
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
    Return the content of a bag, also for one that was not closed (`complete` is then False).

    `path` is a .mcap file or a bag directory. Raises BagReadError for a bag that is missing,
    empty or not MCAP.
    """
    files, complete = locate(path, recover=True)
    counts: Counter[str] = Counter()
    types: dict[str, str] = {}
    offers: dict[str, tuple[Qos, ...]] = {}
    times_ns: list[int] = []
    for file in files:
        content = _indexed(file) or _scanned(file)
        complete = complete and content.complete
        times_ns += content.times_ns
        for channel, schema, count in content.channels:
            counts[channel.topic] += count
            types[channel.topic] = full_type_name(schema.name) if schema else ''
            if offered := parse_offered_qos(channel.metadata.get('offered_qos_profiles', '')):
                offers[channel.topic] = offered
    return BagSummary(dict(counts), types, offers, min(times_ns, default=None),
                      max(times_ns, default=None), complete)


class _Content(NamedTuple):
    """Channels with their number of messages, first and last log time [ns], of one file."""

    channels: list[tuple[Channel, Schema | None, int]]
    times_ns: list[int]
    complete: bool


def _indexed(file: Path) -> _Content | None:
    """
    Return the content by the summary at the end of a closed file, None where that is incomplete.

    The MCAP specification leaves channels, schemas and counts to the writer; an empty map of
    counts means that they are not available.
    """
    with opened(file) as stream:
        found = summary_section(stream)
    if found is None or (statistics := found.statistics) is None:
        return None
    counts, schemas = statistics.channel_message_counts, {0: None, **found.schemas}
    if (not counts.keys() <= found.channels.keys()
            or sum(counts.values()) != statistics.message_count
            or any(channel.schema_id not in schemas for channel in found.channels.values())):
        return None
    return _Content(
        [(channel, schemas[channel.schema_id], counts.get(channel.id, 0))
         for channel in found.channels.values()],
        [statistics.message_start_time, statistics.message_end_time]
        if statistics.message_count else [], complete=True)


def _scanned(file: Path) -> _Content:
    """Return the content by all complete records, counted message by message."""
    channels: dict[int, tuple[Channel, Schema | None]] = {}
    counts: Counter[int] = Counter()
    first = last = None
    complete = True
    try:
        for schema, channel, time_ns, _, _ in stored_messages(file, recover=False):
            channels[channel.id] = channel, schema
            counts[channel.id] += 1
            first = time_ns if first is None else min(first, time_ns)
            last = time_ns if last is None else max(last, time_ns)
    except BagReadError:
        complete = False
    return _Content([(*found, counts[number]) for number, found in channels.items()],
                    [] if first is None or last is None else [first, last], complete)
