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

"""Parameters of the trainer node."""

from __future__ import annotations

from dataclasses import dataclass

from koopman_ros.nodes import topics
from koopman_ros.nodes.parameters import parameter, ParameterTable
from rclpy.exceptions import InvalidTopicNameException
from rclpy.validate_topic_name import validate_topic_name

LOOP_TOPICS = (topics.TEMPERATURE, topics.CONCENTRATION, topics.SETPOINT, topics.ACTIVE_SETPOINT,
               topics.COOLANT_SETPOINT, topics.MANUAL_COOLANT_SETPOINT, topics.DIAGNOSTICS)


@dataclass(frozen=True)
class TrainerParameters:
    """Snapshot of the trainer's parameters."""

    record_at_start: bool = parameter(
        True, 'start recording when the node starts, without waiting for ~/record',
        read_only=True)
    output: str = parameter(
        '', 'where to record: a file ending in .mcap, or the folder of a new bag; empty names a '
        'folder after the date and time; never overwritten')
    topics: tuple[str, ...] = parameter(
        LOOP_TOPICS, 'topics to record; those that are not part of the loop are subscribed when '
        'somebody publishes them')
    compression: str = parameter(
        'none', 'compression of the bag; none is readable even when damaged',
        choices=('none', 'zstd', 'lz4'))


def _cross_check(values: TrainerParameters) -> str:
    if not values.topics or not all(values.topics):
        return f'topics = {list(values.topics)} must hold at least one name and no empty one'
    for name in values.topics:
        try:
            validate_topic_name(name)
        except InvalidTopicNameException as error:
            return f'topics: {" ".join(str(error).split())}'
    return ''


TABLE = ParameterTable(TrainerParameters, _cross_check)
