# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The metadata of a rosbag2 bag (version 9, Jazzy), and the QoS that publishers offered."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
import os
from pathlib import Path
from typing import Any

from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos
import yaml

from koopman_ros.core.paths import write_atomically
from koopman_ros.core.yaml_text import load_yaml
from koopman_ros.records.message_definitions import MessageDefinition

METADATA_FILE = 'metadata.yaml'
# The only top-level key of metadata.yaml; the record inside the MCAP file goes without it.
METADATA_KEY = 'rosbag2_bagfile_information'

_VERSION = 9
# Start that rosbag2 writes for a bag without messages [ns].
_NO_START_NS = 2**63 - 1


def dump_offered_qos(profiles: Sequence[Qos]) -> str:
    """Return the text of the channel metadata `offered_qos_profiles`: a YAML sequence."""
    return yaml.safe_dump(dump_qos_v9(list(profiles)), sort_keys=False).rstrip('\n')


@cache
def parse_offered_qos(text: str) -> tuple[Qos, ...]:
    """Return the profiles of a channel, of any version of rosbag2, or none if unreadable."""
    try:
        load_yaml(text)
        return tuple(parse_qos(text))
    except Exception:
        # text of another recorder: it can be wrong in any way, and nothing depends on it
        return ()


@dataclass
class RecordedTopic:
    """A topic of a bag or file being written, with the number of messages so far."""

    name: str
    definition: MessageDefinition
    offered_qos: tuple[Qos, ...]
    message_count: int = 0


@dataclass
class RecordedFile:
    """The content of a file so far."""

    name: str
    topics: dict[str, RecordedTopic] = field(default_factory=dict)
    #: (first, last) log time [ns], or None without messages
    time_range_ns: tuple[int, int] | None = None

    def count(self, topic: str, log_time_ns: int) -> None:
        """Count one more message."""
        self.topics[topic].message_count += 1
        first, last = self.time_range_ns or (log_time_ns, log_time_ns)
        self.time_range_ns = min(first, log_time_ns), max(last, log_time_ns)

    def as_metadata(self) -> dict[str, Any]:
        """Return the entry of `files`."""
        return {'path': self.name, **_time_range(self.time_range_ns),
                'message_count': sum(topic.message_count for topic in self.topics.values())}


def bag_metadata(files: Sequence[RecordedFile]) -> dict[str, Any]:
    """Return the metadata of a bag of these MCAP files, keys in the order of rosbag2."""
    ranges = [file.time_range_ns for file in files if file.time_range_ns is not None]
    total = _time_range((min(first for first, _ in ranges), max(last for _, last in ranges))
                        if ranges else None)
    entries = [file.as_metadata() for file in files]
    topics = {name: topic for file in files for name, topic in file.topics.items()}
    return {
        'version': _VERSION,
        'storage_identifier': 'mcap',
        'duration': total['duration'],
        'starting_time': total['starting_time'],
        'message_count': sum(entry['message_count'] for entry in entries),
        'topics_with_message_count': [{
            'topic_metadata': {
                'name': name,
                'type': topic.definition.type_name,
                'serialization_format': 'cdr',
                'offered_qos_profiles': dump_qos_v9(list(topic.offered_qos)),
                'type_description_hash': topic.definition.type_hash,
            },
            'message_count': sum(
                file.topics[name].message_count for file in files if name in file.topics),
        } for name, topic in topics.items()],
        # chunks may be compressed all the same: that is MCAP's own affair
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file.name for file in files],
        'files': entries,
        'custom_data': None,
        'ros_distro': os.environ.get('ROS_DISTRO') or 'jazzy',
    }


def dump_metadata(metadata: Mapping[str, Any]) -> str:
    """Return the metadata as YAML, one entry a line, never folded."""
    return yaml.safe_dump(
        dict(metadata), sort_keys=False, allow_unicode=True, width=2**31).rstrip('\n')


def write_metadata_file(folder: Path, metadata: Mapping[str, Any]) -> None:
    """Write metadata.yaml of a bag directory; it appears complete or not at all."""
    text = dump_metadata({METADATA_KEY: dict(metadata)}) + '\n'
    write_atomically(folder / METADATA_FILE, text.encode())


def _time_range(range_ns: tuple[int, int] | None) -> dict[str, Any]:
    first, last = range_ns or (_NO_START_NS, _NO_START_NS)
    return {'starting_time': {'nanoseconds_since_epoch': first},
            'duration': {'nanoseconds': last - first}}
