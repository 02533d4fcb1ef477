# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The content of the bags that tests write, bags of all the kinds that are read, and damage."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
import importlib
from pathlib import Path
import random
import struct
from typing import Any

from mcap.writer import CompressionType, Writer
import yaml
import zstandard

from koopman_ros.bags import BagWriter, message_definition, MessageDefinition, QosProfile

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
    return HEAD + struct.pack('<d', value)


def text(characters: bytes) -> bytes:
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


# Values that lengths and counts are most likely to trip over.
_WORDS = [0, 1, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1]


@dataclass(frozen=True)
class Specimen:
    """A whole bag: files by name ('' for a bare file), and whether checksums guard them all."""

    files: dict[str, bytes]
    guarded: bool


def specimens(folder: Path, samples: list[Sample]) -> dict[str, Specimen]:
    found = {}
    for compression in ('none', 'zstd', 'lz4'):
        path = folder / f'{compression}.mcap'
        with BagWriter(path, compression=compression, max_chunk_bytes=1500) as writer:
            fill(writer, samples)
        found[compression] = Specimen({'': path.read_bytes()}, guarded=True)
    with BagWriter(folder / 'run', max_file_bytes=6000, max_chunk_bytes=1500) as writer:
        fill(writer, samples)
    run = {file.name: file.read_bytes() for file in (folder / 'run').iterdir()}
    assert len(run) >= 3
    found['directory'] = Specimen(run, guarded=True)
    found['files compressed by rosbag2'] = Specimen(compressed_files(run), guarded=True)
    found['messages compressed by rosbag2'] = Specimen({'': foreign(
        folder / 'messages.mcap', samples, zstandard.compress)}, guarded=False)
    found['without checksums'] = Specimen({'': foreign(
        folder / 'unguarded.mcap', samples, enable_crcs=False)}, guarded=False)
    found['without chunks'] = Specimen({'': foreign(
        folder / 'chunkless.mcap', samples, use_chunking=False)}, guarded=False)
    return found


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


def foreign(path: Path, samples: list[Sample],
            compress: Callable[[bytes], bytes] = lambda data: data,
            **options: bool) -> bytes:
    """Return an MCAP file of the samples as other programs write them."""
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=1500, compression=CompressionType.NONE, **options)
        writer.start('ros2')
        channels = {}
        for topic, type_name in TOPICS.items():
            text = message_definition(type_name).text.encode()
            schema = writer.register_schema(type_name, 'ros2msg', text)
            channels[topic] = writer.register_channel(topic, 'cdr', schema)
        for sample in samples:
            writer.add_message(channels[sample.topic], sample.log_time_ns, compress(sample.data),
                               sample.publish_time_ns)
        writer.finish()
    return path.read_bytes()


def mutate(dice: random.Random, content: bytes) -> bytes:
    for _ in range(dice.choice([1, 1, 1, 2, 3])):
        content = dice.choice(_DAMAGES)(dice, content)
    return content


def _pieces(dice: random.Random, content: bytes) -> tuple[bytes, bytes, bytes]:
    """Return what is before a place, a piece from there on, and the rest."""
    start = dice.randrange(len(content) + 1)
    end = start + int(2 ** dice.uniform(0, 12))
    return content[:start], content[start:end], content[end:]


def _flip(dice: random.Random, content: bytes) -> bytes:
    damaged = bytearray(content or b'\0')
    for _ in range(dice.choice([1, 1, 8])):
        damaged[dice.randrange(len(damaged))] ^= 1 << dice.randrange(8)
    return bytes(damaged)


def _cut(dice: random.Random, content: bytes) -> bytes:
    return content[:dice.randrange(len(content) + 1)]


def _rearrange(dice: random.Random, content: bytes) -> bytes:
    """Delete a piece, repeat it, blank it, or change its place with a later one."""
    head, piece, tail = _pieces(dice, content)
    between, later, end = _pieces(dice, tail)
    return head + dice.choice([b'', 2 * piece, bytes(len(piece)), later]) + (
        between + piece + end if dice.random() < 0.25 else tail)


def _overwrite(dice: random.Random, content: bytes) -> bytes:
    word = struct.pack('<Q', dice.choice(_WORDS))[:dice.choice([2, 4, 8])]
    head, piece, tail = _pieces(dice, content)
    return head + word + (piece + tail)[len(word):]


_DAMAGES = [_flip, _flip, _cut, _rearrange, _rearrange, _rearrange, _rearrange, _overwrite,
            _overwrite]


def fill(writer: BagWriter, samples: list[Sample]) -> None:
    for topic, type_name in TOPICS.items():
        writer.add_topic(topic, message_definition(type_name))
    for sample in samples:
        writer.write(sample.topic, sample.data, sample.log_time_ns, sample.publish_time_ns)
