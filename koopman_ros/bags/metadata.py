# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The bag metadata of rosbag2 (version 9, Jazzy): built as plain mappings, written as YAML."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import os
from pathlib import Path
from typing import Any

import yaml

from koopman_ros.bags.qos import qos_mappings, QosProfile
from koopman_ros.bags.schemas import MessageDefinition

METADATA_FILE = 'metadata.yaml'
# The only top-level key of metadata.yaml; the record inside the MCAP file goes without it.
METADATA_KEY = 'rosbag2_bagfile_information'

_VERSION = 9
# What rosbag2 writes as the start of a bag without messages [ns].
_NO_START_NS = 2**63 - 1


@dataclass
class RecordedTopic:
    """A topic of a bag or file being written, with the number of messages it has so far."""

    name: str
    definition: MessageDefinition
    offered_qos: tuple[QosProfile, ...]
    message_count: int = 0


@dataclass
class RecordedFile:
    """
    What a file of a bag holds so far.

    `time_range_ns` is (first, last) log time [ns], or None for a file without messages.
    """

    name: str
    topics: dict[str, RecordedTopic] = field(default_factory=dict)
    time_range_ns: tuple[int, int] | None = None

    @property
    def message_count(self) -> int:
        """The number of messages on all topics."""
        return sum(topic.message_count for topic in self.topics.values())

    def count(self, topic: str, log_time_ns: int) -> None:
        """Count one more message."""
        self.topics[topic].message_count += 1
        first, last = self.time_range_ns or (log_time_ns, log_time_ns)
        if log_time_ns < first:
            first = log_time_ns
        elif log_time_ns > last:
            last = log_time_ns
        self.time_range_ns = first, last


def bag_metadata(
    files: Sequence[RecordedFile], custom_data: Mapping[str, str]
) -> dict[str, Any]:
    """
    Return the metadata of a bag of these MCAP files, keys in the order of rosbag2.

    Chunk compression is MCAP's own affair: rosbag2's compression fields stay empty.
    """
    ranges = [file.time_range_ns for file in files if file.time_range_ns is not None]
    whole = (min(first for first, _ in ranges), max(last for _, last in ranges)
             ) if ranges else None
    return {
        'version': _VERSION,
        'storage_identifier': 'mcap',
        'duration': _duration(whole),
        'starting_time': _starting_time(whole),
        'message_count': sum(file.message_count for file in files),
        'topics_with_message_count': [_topic_mapping(topic) for topic in _all_topics(files)],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file.name for file in files],
        'files': [{
            'path': file.name,
            'starting_time': _starting_time(file.time_range_ns),
            'duration': _duration(file.time_range_ns),
            'message_count': file.message_count,
        } for file in files],
        'custom_data': dict(custom_data) or None,
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


def _all_topics(files: Sequence[RecordedFile]) -> list[RecordedTopic]:
    """Return the topics of all files in the order they appeared, with their messages summed."""
    topics: dict[str, RecordedTopic] = {}
    for file in files:
        for name, topic in file.topics.items():
            before = topics[name].message_count if name in topics else 0
            topics[name] = replace(topic, message_count=before + topic.message_count)
    return list(topics.values())


def _starting_time(range_ns: tuple[int, int] | None) -> dict[str, int]:
    return {'nanoseconds_since_epoch': _NO_START_NS if range_ns is None else range_ns[0]}


def _duration(range_ns: tuple[int, int] | None) -> dict[str, int]:
    return {'nanoseconds': 0 if range_ns is None else range_ns[1] - range_ns[0]}


def _topic_mapping(topic: RecordedTopic) -> dict[str, Any]:
    return {
        'topic_metadata': {
            'name': topic.name,
            'type': topic.definition.type_name,
            'serialization_format': 'cdr',
            'offered_qos_profiles': qos_mappings(topic.offered_qos),
            'type_description_hash': topic.definition.type_hash,
        },
        'message_count': topic.message_count,
    }
