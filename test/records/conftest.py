# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Serialized messages of four types, made by ROS itself, and bags of them."""

from collections.abc import Callable, Iterable, Sequence
import importlib
from pathlib import Path
from typing import Any
import warnings

import pytest

from koopman_ros.records import BagWriter, message_definition
from support.bag_samples import (
    FLOAT,
    JOINTS,
    OFFERED_QOS,
    PRESSURE,
    Sample,
    Sent,
    TEMPERATURE,
    TOPICS,
    WALL,
)

_START_NS = 1_700_000_000_123_456_789


def _messages(index: int, stamp_ns: int) -> dict[str, Any]:
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
        # trailing bytes, which ROS and mcap ignore and rosbags rejects.
        '/joint_states': sensor.JointState(
            header=header, name=['valve', 'pump'], position=[0.5, float(index)],
            velocity=[-1e-300], effort=[float('nan')]),
        '/clock': rosgraph.Clock(clock=stamp),
    }


@pytest.fixture(scope='session')
def samples() -> list[Sample]:
    serialization = importlib.import_module('rclpy.serialization')
    with warnings.catch_warnings():
        # The type support imports its generator, whose parser imports a deprecated module.
        warnings.simplefilter('ignore', DeprecationWarning)
        for message in _messages(0, _START_NS).values():
            serialization.serialize_message(message)
    found = []
    for index in range(25):
        stamp_ns = _START_NS + index * 100_000_000
        for offset, (topic, message) in enumerate(_messages(index, stamp_ns).items()):
            found.append(Sample(
                topic=topic,
                message=message,
                data=serialization.serialize_message(message),
                log_time_ns=stamp_ns + 1_000_000 + offset,
                publish_time_ns=stamp_ns + offset,
            ))
    return found


@pytest.fixture
def write_bag(samples: list[Sample]) -> Callable[..., Path]:
    """Return a function that writes all samples to a path, so many in a chunk."""

    def write(path: Path, *, chunk: int = 10, **options: Any) -> Path:
        with BagWriter(path, **options) as writer:
            for topic in dict.fromkeys(sample.topic for sample in samples):
                writer.add_topic(topic, message_definition(TOPICS[topic]), OFFERED_QOS[topic])
            for number, sample in enumerate(samples):
                if number and number % chunk == 0:
                    writer.flush()
                writer.write(
                    sample.topic, sample.data, sample.log_time_ns, sample.publish_time_ns)
        return path

    return write


@pytest.fixture
def write_sent(samples: list[Sample], tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes messages of types that fit their values; it may not close."""
    serialize = importlib.import_module('rclpy.serialization').serialize_message
    sensor, std = (importlib.import_module(f'{name}_msgs.msg') for name in ('sensor', 'std'))

    def made(one: Sent, kind: str, start_ns: int) -> tuple[str, Any]:
        if one.stamp is None:
            return FLOAT, std.Float64(data=one.value)
        if isinstance(one.value, dict):
            kind, message = JOINTS, sensor.JointState(
                name=list(one.value), position=list(one.value.values()))
        elif kind == PRESSURE:
            message = sensor.FluidPressure(fluid_pressure=float(one.value))
        else:
            message = sensor.Temperature(temperature=float(one.value))
        stamp_ns = round(one.stamp * 10**9) + (start_ns if one.stamp else 0)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        return kind, message

    def write(messages: Iterable[Sent], name: str = 'run.mcap', *, kind: str = TEMPERATURE,
              topics: Sequence[str] = (), log_start_ns: int = 0, wall: bool = False,
              closed: bool = True) -> Path:
        writer = BagWriter(tmp_path / name)
        for topic in topics:
            writer.add_topic(topic, message_definition(kind))
        for number, one in enumerate(messages):
            own_kind, message = made(one, kind, WALL if wall else 0)
            writer.add_topic(one.topic, message_definition(own_kind))
            received = one.stamp if one.received is None else one.received
            writer.write(one.topic, serialize(message), log_start_ns + round(received * 10**9))
            if number % 20 == 19:
                writer.flush()
        before = None if closed else writer.path.read_bytes()
        writer.close()
        if before is not None:
            writer.path.write_bytes(before)
        return writer.path

    return write
