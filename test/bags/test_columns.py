# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers of a bag as arrays: those that decoding message by message gives, bit by bit."""

from collections.abc import Callable, Iterable
import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from koopman_ros import bags
from koopman_ros.bags.columns import columns, NO_STAMP
from koopman_ros.bags.decoding import Decoders
from koopman_ros.bags.series import stamped_number
from koopman_ros.wire import Place
from support.bag_samples import Sample

SECOND = 10 ** 9


def message(package: str, kind: str, stamp_ns: int | None = None, /, **fields: Any) -> Any:
    made = getattr(importlib.import_module(f'{package}.msg'), kind)(**fields)
    if stamp_ns is not None:
        made.header.stamp.sec, made.header.stamp.nanosec = divmod(stamp_ns, SECOND)
    return made


def type_name(made: Any) -> str:
    return f'{type(made).__module__.partition(".")[0]}/msg/{type(made).__name__}'


@pytest.fixture
def write(samples: list[Sample], tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes messages, one topic a type, a hundredth of a second apart."""
    serialize = importlib.import_module('rclpy.serialization').serialize_message

    def write(messages: Iterable[Any], compress: bool = False, **options: Any) -> Path:
        with bags.BagWriter(tmp_path / 'run', **options) as writer:
            for number, made in enumerate(messages):
                topic = f'/{type(made).__name__.lower()}'
                writer.add_topic(topic, bags.message_definition(type_name(made)))
                data = serialize(made)
                writer.write(topic, zstandard.compress(data) if compress and number % 3 else data,
                             SECOND + number * SECOND // 100)
        return writer.path

    return write


def one_by_one(path: Path, places: list[Place]) -> dict[Place, list[tuple[Any, ...]]]:
    found: dict[Place, list[tuple[Any, ...]]] = {place: [] for place in places}
    for entry in bags.read_messages(path, {place.topic for place in places}, recover=True):
        for place in places:
            if place.topic == entry.topic:
                stamp, value = stamped_number(path, entry, place)
                found[place].append((NO_STAMP if stamp is None else stamp, entry.log_time_ns,
                                     value is not None, math.nan if value is None else value))
    return found


def as_arrays(path: Path, places: list[Place]) -> dict[Place, list[tuple[Any, ...]]]:
    found: dict[Place, list[tuple[Any, ...]]] = {place: [] for place in places}
    for block in columns(path, places):
        for place, column in block.items():
            found[place] += zip(column.stamp_ns.tolist(), column.log_ns.tolist(),
                                column.present.tolist(), column.values.tolist(), strict=True)
    return found


def same(path: Path, places: list[Place]) -> None:
    """Compare both; NaN is as good as NaN."""
    expected, found = one_by_one(path, places), as_arrays(path, places)
    assert any(expected.values())
    for place in places:
        np.testing.assert_array_equal(np.array(found[place]), np.array(expected[place]))


def temperatures(rng: np.random.Generator) -> list[Any]:
    # nan first, so that there is nothing to learn from; frames of several lengths
    values = [math.nan, math.inf, -0.0, 5e-324, *rng.standard_normal(60)]
    frames = rng.choice(['', 'a', 'tank', 'überlauf'], len(values))
    made = [message('sensor_msgs', 'Temperature', int(rng.integers(0, 2 ** 31 * SECOND)),
                    temperature=float(value), variance=float(rng.random())) for value in values]
    for one, frame in zip(made, frames.tolist(), strict=True):
        one.header.frame_id = frame
    return made


def joints(rng: np.random.Generator) -> list[Any]:
    made = []
    for k in range(60):
        names = [['low', 'high'], ['high', 'low'], ['low'], ['other', 'low', 'high']][k % 4]
        made.append(message('sensor_msgs', 'JointState', k * SECOND, name=names,
                            position=rng.standard_normal(len(names)).tolist(),
                            velocity=rng.standard_normal(k % 2 * len(names)).tolist()))
    return made


def numbers(rng: np.random.Generator) -> list[Any]:
    return [one for k in range(40) for one in (
        message('sensor_msgs', 'Range', k * SECOND, range=float(np.float32(rng.random()))),
        message('std_msgs', 'Int32', data=int(rng.integers(-2 ** 31, 2 ** 31))),
        message('std_msgs', 'UInt8', data=int(rng.integers(0, 256))),
        message('std_msgs', 'Bool', data=bool(rng.integers(0, 2))),
        message('std_msgs', 'Int64', data=int(rng.integers(-2 ** 53, 2 ** 53))),
        message('std_msgs', 'Float64MultiArray', data=rng.random(1 + k % 3).tolist()))]


KINDS = {
    temperatures: [('/temperature', 'sensor_msgs/msg/Temperature', 'temperature'),
                   ('/temperature', 'sensor_msgs/msg/Temperature', 'variance')],
    joints: [('/jointstate', 'sensor_msgs/msg/JointState', f'{array}[{name}]')
             for array in ('position', 'velocity') for name in ('low', 'high')],
    numbers: [('/range', 'sensor_msgs/msg/Range', 'range'),
              *((f'/{name.lower()}', f'std_msgs/msg/{name}', 'data')
                for name in ('Int32', 'UInt8', 'Bool', 'Int64')),
              *(('/float64multiarray', 'std_msgs/msg/Float64MultiArray', f'data[{k}]')
                for k in range(3))],
}


@pytest.mark.parametrize('options', [
    {}, {'max_chunk_bytes': 300}, {'compression': 'zstd', 'max_file_bytes': 4000},
    {'compress': True}], ids=['one chunk', 'small chunks', 'several files', 'compressed messages'])
@pytest.mark.parametrize('kind', KINDS, ids=lambda kind: kind.__name__)
def test_arrays_hold_what_decoding_gives(
    write: Callable[..., Path], kind: Callable[..., list[Any]], options: dict[str, Any]
) -> None:
    path = write(kind(np.random.default_rng(0)), **options)
    same(path, [Place(*where, '1') for where in KINDS[kind]])


@pytest.mark.parametrize('cut', [1, 40, 700, 2000])
def test_bag_that_was_not_closed_is_read_as_far(write: Callable[..., Path], cut: int) -> None:
    file = write(temperatures(np.random.default_rng(1)), max_chunk_bytes=400) / 'run_0.mcap'
    file.write_bytes(file.read_bytes()[:-cut])
    same(file, [Place(*where, '1') for where in KINDS[temperatures]])


def test_few_messages_are_decoded_one_by_one(
    write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write([message('sensor_msgs', 'Temperature', k, temperature=float(k))
                  for k in range(500)])
    decoded = []
    original = Decoders.decode
    monkeypatch.setattr(Decoders, 'decode', lambda self, stored: (
        decoded.append(stored), original(self, stored))[1])
    place = Place('/temperature', 'sensor_msgs/msg/Temperature', 'temperature', 'degC')
    assert [row[3] for row in as_arrays(path, [place])[place]] == list(range(500))
    assert len(decoded) == 1


def test_message_that_does_not_decode_is_refused(write: Callable[..., Path], tmp_path: Path
                                                 ) -> None:
    path = write([message('std_msgs', 'Float64', data=1.0)] * 3)
    definition = bags.message_definition('std_msgs/msg/Float64')
    with bags.BagWriter(tmp_path / 'short.mcap') as writer:
        writer.add_topic('/float64', definition)
        for entry in bags.read_messages(path):
            writer.write('/float64', entry.data, 1)
        writer.write('/float64', entry.data[:-1], 2)
    place = Place('/float64', 'std_msgs/msg/Float64', 'data', '1')
    with pytest.raises(bags.BagReadError, match="message on '/float64' at 2 ns does not decode"):
        as_arrays(writer.path, [place])
