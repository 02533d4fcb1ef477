# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The content of the bags that the tests write: four topics of ROS's messages, and numbers."""

from collections.abc import Iterable
from dataclasses import dataclass
import importlib
from pathlib import Path
import struct
from typing import Any

import yaml
import zstandard

from koopman_ros.bags import BagWriter, MessageDefinition, QosProfile

START_NS = 1_700_000_000_123_456_789
PERIOD_NS = 100_000_000
ROUNDS = 25

TOPICS = {
    '/temperature': 'sensor_msgs/msg/Temperature',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
    '/joint_states': 'sensor_msgs/msg/JointState',
    '/clock': 'rosgraph_msgs/msg/Clock',
}
OFFERED_QOS = {
    '/temperature': (QosProfile(),),
    '/diagnostics': (QosProfile(history='unknown', depth=0),),
    '/joint_states': (
        QosProfile(reliability='best_effort', depth=5, deadline_ns=1_500_000_000),
        QosProfile(durability='transient_local', depth=1),
    ),
    '/clock': (QosProfile(reliability='best_effort', depth=1),),
}
HASH = 'RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a'
NUMBER = MessageDefinition('std_msgs/msg/Float64', 'float64 data\n', HASH)
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


def messages(index: int, stamp_ns: int) -> dict[str, Any]:
    """Return one message a topic; all fields differ from their defaults."""
    diagnostic = importlib.import_module('diagnostic_msgs.msg')
    sensor = importlib.import_module('sensor_msgs.msg')
    rosgraph = importlib.import_module('rosgraph_msgs.msg')
    std = importlib.import_module('std_msgs.msg')
    time = importlib.import_module('builtin_interfaces.msg').Time
    stamp = time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = std.Header(stamp=stamp, frame_id='reactor')
    status = diagnostic.DiagnosticStatus(
        level=b'\x01', name='controller: loop', message='Überlauf', hardware_id='cstr',
        values=[diagnostic.KeyValue(key='round', value=str(index))])
    return {
        '/temperature': sensor.Temperature(
            header=header, temperature=51.95 + 0.1 * index, variance=0.04),
        '/diagnostics': diagnostic.DiagnosticArray(header=header, status=[status] * (index % 3)),
        # No empty sequence of doubles: rmw reserves room to align it and leaves the rest as
        # trailing bytes, which ROS and mcap ignore and rosbags refuses.
        '/joint_states': sensor.JointState(
            header=header, name=['valve', 'pump'], position=[0.5, float(index)],
            velocity=[-1e-300], effort=[float('nan')]),
        '/clock': rosgraph.Clock(clock=stamp),
    }


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
