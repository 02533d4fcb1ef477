# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The content of the bags that the tests write: four topics of ROS's messages, and numbers."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
import struct
from typing import Any

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
import yaml
import zstandard

from koopman_ros.core.datasets import Episode
from koopman_ros.records import (
    BagWriter,
    ImportReport,
    MessageDefinition,
    RecordedInput,
    RecordedState,
    stream_episodes,
)

TOPICS = {
    '/temperature': 'sensor_msgs/msg/Temperature',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
    '/joint_states': 'sensor_msgs/msg/JointState',
    '/clock': 'rosgraph_msgs/msg/Clock',
}
TEMPERATURE, PRESSURE, JOINTS, FLOAT = (
    'sensor_msgs/msg/Temperature', 'sensor_msgs/msg/FluidPressure', 'sensor_msgs/msg/JointState',
    'std_msgs/msg/Float64')
WALL = 1_700_000_000 * 10**9  # time of the wall clock [ns] at which bags with stamps of it begin
# RMW_DURATION_INFINITE
NEVER = QosTime(9223372036, 854775807)
DEFAULT_QOS = Qos(QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.VOLATILE, NEVER,
                  NEVER, QosLiveliness.AUTOMATIC, NEVER, avoid_ros_namespace_conventions=False)
OFFERED_QOS = {
    '/temperature': (DEFAULT_QOS,),
    '/diagnostics': (DEFAULT_QOS._replace(history=QosHistory.UNKNOWN, depth=0),),
    '/joint_states': (
        DEFAULT_QOS._replace(reliability=QosReliability.BEST_EFFORT, depth=5,
                             deadline=QosTime(1, 500_000_000)),
        DEFAULT_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL, depth=1),
    ),
    '/clock': (DEFAULT_QOS._replace(reliability=QosReliability.BEST_EFFORT, depth=1),),
}
_HASH = 'RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a'
NUMBER = MessageDefinition('std_msgs/msg/Float64', 'float64 data\n', _HASH)
TEXT = MessageDefinition('std_msgs/msg/String', 'string data', 'RIHS01_' + 'a' * 64)
HEAD = b'\x00\x01\x00\x00'  # of each message in CDR


def number(value: float) -> bytes:
    """Return a message of the type NUMBER."""
    return HEAD + struct.pack('<d', value)


def text(characters: bytes) -> bytes:
    """Return a message of the type TEXT."""
    return HEAD + struct.pack('<I', len(characters) + 1) + characters + b'\0'


def write_numbers(writer: BagWriter, values: Iterable[int], period_ns: int = 1) -> None:
    """Write numbers on /x, each at a log time of so many periods."""
    writer.add_topic('/x', NUMBER)
    for value in values:
        writer.write('/x', number(value), value * period_ns)


def record(path: Path, values: Iterable[int] = (), period_ns: int = 1, **options: Any) -> Path:
    """Record a bag of numbers, with the writer's options."""
    with BagWriter(path, **options) as writer:
        write_numbers(writer, values, period_ns)
    return path


@dataclass(frozen=True)
class Sample:
    """A message as ROS made it, its CDR bytes, and when it was sent and received."""

    topic: str
    message: Any
    data: bytes
    log_time_ns: int
    publish_time_ns: int


@dataclass(frozen=True)
class Sent:
    """A message: topic, stamp [s] or None, value, time of receipt [s], by default the stamp."""

    topic: str
    stamp: float | None
    value: float | dict[str, float]
    received: float | None = None


def loop_episodes(bags: Sequence[Path | str], states: Sequence[RecordedState],
                  inputs: Sequence[RecordedInput], **options: Any
                  ) -> tuple[list[Episode], ImportReport]:
    """Return all episodes of some bags, and the account of the import."""
    account = ImportReport()
    return list(stream_episodes(bags, states, inputs, account, **options)), account


def noted(account: ImportReport, *words: str) -> bool:
    """Tell whether an import has one note, which holds some words."""
    return len(account.notes) == 1 and all(word in account.notes[0] for word in words)


def compressed_files(files: dict[str, bytes]) -> dict[str, bytes]:
    """Return a bag directory as rosbag2 leaves it with the compression mode 'file'."""
    text = files['metadata.yaml'].decode()
    metadata = yaml.safe_load(text)
    information = metadata['rosbag2_bagfile_information']
    information |= {'compression_format': 'zstd', 'compression_mode': 'FILE'}
    names = information['relative_file_paths']
    information['relative_file_paths'] = [f'{name}.zstd' for name in names]
    # in a stream, as rosbag2 does it: the frame does not tell its size
    compressor = zstandard.ZstdCompressor(write_content_size=False)
    return {'metadata.yaml': yaml.safe_dump(metadata, sort_keys=False).encode(),
            **{f'{name}.zstd': compressor.compress(files[name]) for name in names}}
