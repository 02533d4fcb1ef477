# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The bag metadata of rosbag2 (version 9, Jazzy), and the offers that it stores with a topic."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
import os
from pathlib import Path
from typing import Any

import yaml

from koopman_ros.bags.limits import load_plain
from koopman_ros.bags.schemas import MessageDefinition
from koopman_ros.units import NANOSECONDS

METADATA_FILE = 'metadata.yaml'
# The only top-level key of metadata.yaml; the record inside the MCAP file goes without it.
METADATA_KEY = 'rosbag2_bagfile_information'
# An unlimited duration [ns]: RMW_DURATION_INFINITE, 9223372036 s and 854775807 ns.
INFINITE_NS = 2**63 - 1

_VERSION = 9
# What rosbag2 writes as the start of a bag without messages [ns].
_NO_START_NS = 2**63 - 1
# The spellings of rmw/qos_string_conversions.h in the order of rmw/types.h, by whose numbers
# rosbag2 wrote them before version 9 (Jazzy); 'unknown' is what discovery reports when a
# publisher's history is not on the wire. None is a word that is no longer in use.
_POLICIES = {
    'history': ('system_default', 'keep_last', 'keep_all', 'unknown'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': ('system_default', 'automatic', None, 'manual_by_topic', 'unknown',
                   'best_available'),
}
_DURATIONS = ('deadline_ns', 'lifespan_ns', 'liveliness_lease_duration_ns')


@dataclass(frozen=True)
class QosProfile:
    """
    One publisher's offer, as plain values (durations in ns, `INFINITE_NS` for no limit).

    The policies are rmw's own words, which rclpy gives as `policy.short_key`. Raises ValueError
    for a word that rmw does not know, a negative depth and a duration outside
    [0, INFINITE_NS] ns.
    """

    # in the order of rosbag2
    history: str = 'keep_last'
    depth: int = 10
    reliability: str = 'reliable'
    durability: str = 'volatile'
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = 'automatic'
    liveliness_lease_duration_ns: int = INFINITE_NS
    avoid_ros_namespace_conventions: bool = False

    def __post_init__(self) -> None:
        for policy, numbered in _POLICIES.items():
            words = [word for word in numbered if word is not None]
            if getattr(self, policy) not in words:
                raise ValueError(
                    f'{policy} {getattr(self, policy)!r} is not one of {", ".join(words)}')
        if self.depth < 0:
            raise ValueError(f'depth {self.depth} is negative: give a queue length of 0 or more')
        for name in _DURATIONS:
            if not 0 <= getattr(self, name) <= INFINITE_NS:
                raise ValueError(
                    f'{name} {getattr(self, name)} is outside [0, {INFINITE_NS}] ns: '
                    'use INFINITE_NS for no limit')


def qos_mappings(profiles: Sequence[QosProfile]) -> list[dict[str, Any]]:
    """Return the profiles as rosbag2's metadata.yaml (version 9) lists them."""
    return [{name.removesuffix('_ns'): _seconds(value) if name in _DURATIONS else value
             for name, value in asdict(profile).items()} for profile in profiles]


def dump_offered_qos(profiles: Sequence[QosProfile]) -> str:
    """Return the text of the channel metadata `offered_qos_profiles`: a YAML sequence."""
    return yaml.safe_dump(qos_mappings(profiles), sort_keys=False).rstrip('\n')


def parse_offered_qos(text: str) -> tuple[QosProfile, ...]:
    """Return the profiles of a channel, of any version of rosbag2, or none if unreadable."""
    try:
        return tuple(_profile(mapping) for mapping in load_plain(text) or ())
    except (yaml.YAMLError, ValueError, KeyError, TypeError, IndexError, AttributeError,
            RecursionError):
        return ()


def _profile(mapping: Mapping[str, Any]) -> QosProfile:
    values: dict[str, Any] = {
        policy: _POLICIES[policy][word] if isinstance(word := mapping[policy], int) else word
        for policy in _POLICIES}
    values |= {name: _nanoseconds(mapping[name.removesuffix('_ns')]) for name in _DURATIONS}
    return QosProfile(
        **values, depth=int(mapping['depth']),
        avoid_ros_namespace_conventions=bool(mapping['avoid_ros_namespace_conventions']))


def _nanoseconds(duration: Mapping[str, int]) -> int:
    return min(int(duration['sec']) * NANOSECONDS + int(duration['nsec']), INFINITE_NS)


def _seconds(nanoseconds: int) -> dict[str, int]:
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return {'sec': seconds, 'nsec': rest}


@dataclass
class RecordedTopic:
    """A topic of a bag or file being written, with the number of messages it has so far."""

    name: str
    definition: MessageDefinition
    offered_qos: tuple[QosProfile, ...]
    message_count: int = 0


@dataclass
class RecordedFile:
    """What a file of a bag holds so far."""

    name: str
    topics: dict[str, RecordedTopic] = field(default_factory=dict)
    #: (first, last) log time [ns], or None without messages
    time_range_ns: tuple[int, int] | None = None

    @property
    def message_count(self) -> int:
        """The number of messages on all topics."""
        return sum(topic.message_count for topic in self.topics.values())

    def count(self, topic: str, log_time_ns: int) -> None:
        """Count one more message."""
        self.topics[topic].message_count += 1
        first, last = self.time_range_ns or (log_time_ns, log_time_ns)
        self.time_range_ns = min(first, log_time_ns), max(last, log_time_ns)


def bag_metadata(files: Sequence[RecordedFile]) -> dict[str, Any]:
    """Return the metadata of a bag of these MCAP files, keys in the order of rosbag2."""
    ranges = [file.time_range_ns for file in files if file.time_range_ns is not None]
    whole = (min(first for first, _ in ranges), max(last for _, last in ranges)
             ) if ranges else None
    topics = {name: topic for file in files for name, topic in file.topics.items()}
    return {
        'version': _VERSION,
        'storage_identifier': 'mcap',
        'duration': _duration(whole),
        'starting_time': _starting_time(whole),
        'message_count': sum(file.message_count for file in files),
        'topics_with_message_count': [{
            'topic_metadata': {
                'name': name,
                'type': topic.definition.type_name,
                'serialization_format': 'cdr',
                'offered_qos_profiles': qos_mappings(topic.offered_qos),
                'type_description_hash': topic.definition.type_hash,
            },
            'message_count': sum(
                file.topics[name].message_count for file in files if name in file.topics),
        } for name, topic in topics.items()],
        # that of chunks is MCAP's own affair
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file.name for file in files],
        'files': [{
            'path': file.name,
            'starting_time': _starting_time(file.time_range_ns),
            'duration': _duration(file.time_range_ns),
            'message_count': file.message_count,
        } for file in files],
        'custom_data': None,
        'ros_distro': os.environ.get('ROS_DISTRO') or 'jazzy',
    }


def dump_metadata(metadata: Mapping[str, Any]) -> str:
    """Return the metadata as YAML, one entry a line, never folded."""
    return yaml.safe_dump(
        dict(metadata), sort_keys=False, allow_unicode=True, width=2**31).rstrip('\n')


def write_metadata_file(folder: Path, metadata: Mapping[str, Any]) -> None:
    """Write metadata.yaml of a bag directory; it appears complete or not at all."""
    temporary = folder / f'{METADATA_FILE}.tmp'
    with temporary.open('w', encoding='utf-8') as stream:
        stream.write(dump_metadata({METADATA_KEY: dict(metadata)}) + '\n')
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(temporary, folder / METADATA_FILE)
    sync_folder(folder)


def sync_folder(folder: Path) -> None:
    """Wait until the names of the files in a folder are on the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _starting_time(range_ns: tuple[int, int] | None) -> dict[str, int]:
    return {'nanoseconds_since_epoch': _NO_START_NS if range_ns is None else range_ns[0]}


def _duration(range_ns: tuple[int, int] | None) -> dict[str, int]:
    return {'nanoseconds': 0 if range_ns is None else range_ns[1] - range_ns[0]}
