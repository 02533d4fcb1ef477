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

"""The bag metadata of rosbag2 (version 9, Jazzy): built as plain mappings, written as YAML."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any

from koopman_ros.bags.qos import qos_mappings, QosProfile
from koopman_ros.bags.schemas import MessageDefinition
import yaml

METADATA_FILE = 'metadata.yaml'
# The only top-level key of metadata.yaml; the record inside the MCAP file goes without it.
METADATA_KEY = 'rosbag2_bagfile_information'

_VERSION = 9
# What rosbag2 writes as the start of a bag without messages [ns].
_NO_START_NS = 2**63 - 1


@dataclass
class RecordedTopic:
    """A topic of a bag being written, with the number of messages it has so far."""

    name: str
    definition: MessageDefinition
    offered_qos: tuple[QosProfile, ...]
    message_count: int = 0


def bag_metadata(
    file_name: str,
    topics: Sequence[RecordedTopic],
    time_range_ns: tuple[int, int] | None,
    custom_data: Mapping[str, str],
) -> dict[str, Any]:
    """
    Return the metadata of a bag of one MCAP file, keys in the order of rosbag2.

    `time_range_ns` is (first, last) log time [ns], or None for a bag without messages. Chunk
    compression is MCAP's own affair: rosbag2's compression fields stay empty.
    """
    start_ns, end_ns = time_range_ns or (_NO_START_NS, _NO_START_NS)
    count = sum(topic.message_count for topic in topics)
    return {
        'version': _VERSION,
        'storage_identifier': 'mcap',
        'duration': {'nanoseconds': end_ns - start_ns},
        'starting_time': {'nanoseconds_since_epoch': start_ns},
        'message_count': count,
        'topics_with_message_count': [_topic_mapping(topic) for topic in topics],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file_name],
        'files': [{
            'path': file_name,
            'starting_time': {'nanoseconds_since_epoch': start_ns},
            'duration': {'nanoseconds': end_ns - start_ns},
            'message_count': count,
        }],
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
