# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""One file, or a directory of one: what is written, when, and what is refused."""

from collections.abc import Callable
import math
from pathlib import Path
import subprocess
import sys
from typing import Any

from mcap.reader import make_reader
from mcap.summary import Summary
import numpy as np
import pytest
import yaml

from koopman_ros import __version__
from koopman_ros.bags import BagWriter, MessageDefinition, QosProfile, read_messages
from support.bag_samples import HASH, NUMBER, number, record, write_numbers


def content(path: Path) -> Summary:
    with path.open('rb') as stream:
        found = make_reader(stream).get_summary()
    assert found is not None
    assert found.statistics is not None
    return found


def serialized_metadata(path: Path) -> list[dict[str, Any]]:
    with path.open('rb') as stream:
        records = list(make_reader(stream).iter_metadata())
    assert {record.name for record in records} == {'rosbag2'}
    return [yaml.safe_load(record.metadata['serialized_metadata']) for record in records]


def test_header_schemas_and_channels_are_those_of_rosbag2(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER, [QosProfile(depth=3)])
        writer.add_topic('/y', NUMBER)
        # again, which does nothing
        writer.add_topic('/x', NUMBER, [QosProfile()])
    with writer.mcap_path.open('rb') as stream:
        header = make_reader(stream).get_header()
    assert (header.profile, header.library) == ('ros2', f'koopman_ros {__version__}')
    found = content(writer.mcap_path)
    (schema,) = found.schemas.values()
    assert (schema.name, schema.encoding) == ('std_msgs/msg/Float64', 'ros2msg')
    assert schema.data == b'float64 data\n'
    x, y = found.channels.values()
    assert (x.topic, y.topic) == ('/x', '/y')
    assert x.schema_id == y.schema_id == schema.id
    assert x.message_encoding == y.message_encoding == 'cdr'
    assert x.metadata.keys() == {'offered_qos_profiles', 'topic_type_hash'}
    assert x.metadata['topic_type_hash'] == HASH
    assert yaml.safe_load(x.metadata['offered_qos_profiles'])[0]['depth'] == 3
    assert yaml.safe_load(y.metadata['offered_qos_profiles']) == []


def test_messages_carry_times_and_a_counter_by_topic(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        writer.add_topic('/y', NUMBER)
        for time_ns, topic in enumerate(('/x', '/y', '/x', '/x')):
            writer.write(topic, number(1.5), 100 + time_ns, time_ns)
        # the time of sending is that of receipt by default
        writer.write('/y', number(1.5), 104)
    with writer.mcap_path.open('rb') as stream:
        found = [
            (channel.topic, message.sequence, message.log_time, message.publish_time)
            for _, channel, message in make_reader(stream).iter_messages()
        ]
    assert found == [
        ('/x', 0, 100, 0), ('/y', 0, 101, 1), ('/x', 1, 102, 2), ('/x', 2, 103, 3),
        ('/y', 1, 104, 104)]


def test_buffers_and_numpy_integers_are_taken_as_they_are(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        for data in (number(1.5), bytearray(number(1.5)), memoryview(number(1.5))):
            writer.write('/x', data, np.int64(5), np.uint64(4))
    found = list(read_messages(writer.path))
    assert [(m.data, m.log_time_ns, m.publish_time_ns) for m in found] == [
        (number(1.5), 5, 4)] * 3


@pytest.mark.parametrize('compression', ['none', 'zstd', 'lz4'])
def test_statistics_indexes_and_compression(tmp_path: Path, compression: str) -> None:
    path = record(tmp_path / 'run.mcap', range(100, 120), max_chunk_bytes=200,
                  compression=compression)
    found = content(path)
    assert found.statistics.message_count == 20
    assert found.statistics.channel_message_counts == {1: 20}
    assert found.statistics.message_start_time == 100
    assert found.statistics.message_end_time == 119
    assert len(found.chunk_indexes) == found.statistics.chunk_count > 1
    assert all(index.message_index_offsets for index in found.chunk_indexes)
    assert {index.compression for index in found.chunk_indexes} == {
        '' if compression == 'none' else compression}
    assert len(found.metadata_indexes) == 2
    assert [m.message.data for m in read_messages(path)] == list(range(100, 120))


def test_metadata_begins_empty_and_ends_complete(tmp_path: Path) -> None:
    path = record(tmp_path / 'deep' / 'er' / 'run', range(5, 8), 10)
    assert sorted(file.name for file in path.iterdir()) == ['metadata.yaml', 'run_0.mcap']
    first, last = serialized_metadata(path / 'run_0.mcap')
    assert first['message_count'] == 0
    assert first['starting_time'] == {'nanoseconds_since_epoch': 2**63 - 1}
    range_ns = {'starting_time': {'nanoseconds_since_epoch': 50},
                'duration': {'nanoseconds': 20}, 'message_count': 3}
    topic = {'name': '/x', 'type': 'std_msgs/msg/Float64', 'serialization_format': 'cdr',
             'offered_qos_profiles': [], 'type_description_hash': HASH}
    assert list(last.items()) == list({
        'version': 9, 'storage_identifier': 'mcap', 'duration': range_ns['duration'],
        'starting_time': range_ns['starting_time'], 'message_count': 3,
        'topics_with_message_count': [{'topic_metadata': topic, 'message_count': 3}],
        'compression_format': '', 'compression_mode': '', 'relative_file_paths': ['run_0.mcap'],
        'files': [{'path': 'run_0.mcap', **range_ns}], 'custom_data': None,
        'ros_distro': last['ros_distro']}.items())
    assert yaml.safe_load((path / 'metadata.yaml').read_text('utf-8')) == {
        'rosbag2_bagfile_information': last}


@pytest.mark.parametrize(('environment', 'expected'), [(None, 'jazzy'), ('kilted', 'kilted')])
def test_distribution_is_the_sourced_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: str | None, expected: str
) -> None:
    monkeypatch.delenv('ROS_DISTRO', raising=False)
    if environment is not None:
        monkeypatch.setenv('ROS_DISTRO', environment)
    path = record(tmp_path / 'run.mcap')
    assert serialized_metadata(path)[1]['ros_distro'] == expected


@pytest.mark.parametrize(('age_s', 'chunks'), [(0.0, 12), (1.0, 4), (math.inf, 1)])
def test_chunk_ends_with_its_age(tmp_path: Path, age_s: float, chunks: int) -> None:
    # Half a second a message: a chunk of 1 s holds the messages at 0, 0.5 and 1 s.
    now_s = iter(np.arange(12) * 0.5)
    path = record(tmp_path / 'run.mcap', range(12), max_chunk_age_s=age_s,
                  clock=lambda: float(next(now_s)))
    assert content(path).statistics.chunk_count == chunks


def test_flushed_messages_are_in_the_file(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'run.mcap', max_chunk_age_s=math.inf)
    write_numbers(writer, (1, 2))
    assert list(read_messages(writer.path, recover=True)) == []
    writer.flush()
    assert [m.log_time_ns for m in read_messages(writer.path, recover=True)] == [1, 2]
    size = writer.path.stat().st_size
    writer.flush()
    assert writer.path.stat().st_size == size
    writer.close()


@pytest.mark.parametrize(('age', 'survivors'), [('0.0', 7), ('math.inf', 0)])
def test_process_that_dies_loses_the_open_chunk_only(
    tmp_path: Path, age: str, survivors: int
) -> None:
    path = tmp_path / 'run.mcap'
    program = (
        'import math, os\n'
        'from koopman_ros.bags import BagWriter, MessageDefinition\n'
        f'writer = BagWriter({str(path)!r}, max_chunk_age_s={age})\n'
        f'writer.add_topic("/x", {NUMBER!r})\n'
        'for time_ns in range(7):\n'
        f'    writer.write("/x", {number(1.5)!r}, time_ns)\n'
        'os._exit(9)\n')
    assert subprocess.run([sys.executable, '-c', program], check=False).returncode == 9
    assert [m.log_time_ns for m in read_messages(path, recover=True)] == list(range(survivors))


@pytest.mark.parametrize('name', ['run', 'run.mcap'])
def test_existing_path_is_never_overwritten(tmp_path: Path, name: str) -> None:
    path = record(tmp_path / name, range(2))
    before = {file: file.read_bytes() for file in tmp_path.rglob('*') if file.is_file()}
    with pytest.raises(FileExistsError, match=(
            f'{name}.* exists already and recordings are never overwritten: choose another')):
        BagWriter(path)
    assert {f: f.read_bytes() for f in tmp_path.rglob('*') if f.is_file()} == before


INTEGER = MessageDefinition('std_msgs/msg/Int64', 'int64 data\n', HASH)
CHANGED = MessageDefinition('std_msgs/msg/Float64', 'float32 data\n', HASH)


@pytest.mark.parametrize(('action', 'kind', 'words'), [
    (lambda writer: writer.add_topic('/x', INTEGER), ValueError,
     r"'/x' of type std_msgs/msg/Int64 .* contradicts topic '/x' of type std_msgs/msg/Float64"),
    (lambda writer: writer.add_topic('/y', CHANGED), ValueError,
     r"contradicts topic '/x' .* in a bag of its own"),
    (lambda writer: writer.add_topic('x', NUMBER), ValueError,
     r"'x' is not an absolute name.*resolve_topic_name\('x'\)"),
    (lambda writer: writer.write('/y', b'', 1), ValueError,
     r"'/y' is not in the bag '.*run\.mcap': call add_topic"),
    (lambda writer: writer.write('/x', 1.5, 1), TypeError,
     r"'/x' must be serialized .* got float: subscribe"),
    (lambda writer: writer.write('/x', b'', -1, 0), ValueError,
     r'log_time_ns -1 is outside \[0, 9223372036854775807\] ns'),
    (lambda writer: writer.write('/x', b'', 0, -7), ValueError, 'publish_time_ns -7 is outside'),
    (lambda writer: writer.write('/x', b'', 2**63, 0), ValueError,
     'log_time_ns 9223372036854775808 is outside'),
    (lambda writer: writer.write('/x', b'', 1.5), TypeError, 'float'),
])
def test_what_is_refused_leaves_no_trace(
    tmp_path: Path, action: Callable[[BagWriter], None], kind: type[Exception], words: str
) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        with pytest.raises(kind, match=words):
            action(writer)
    assert list(read_messages(writer.path)) == []
    assert len(content(writer.path).channels) == 1


@pytest.mark.parametrize(('action', 'verb'), [
    (lambda writer: writer.write('/x', number(1.5), 3), 'write to'),
    (lambda writer: writer.add_topic('/y', NUMBER), 'add a topic to'),
    (lambda writer: writer.flush(), 'flush'),
])
def test_closed_writer_refuses(
    tmp_path: Path, action: Callable[[BagWriter], None], verb: str
) -> None:
    writer = BagWriter(tmp_path / 'run')
    writer.add_topic('/x', NUMBER)
    # not before the bag is whole
    assert not (writer.path / 'metadata.yaml').exists()
    writer.close()
    before = writer.mcap_path.read_bytes()
    with pytest.raises(ValueError, match=rf"cannot {verb} the bag '.*run': it is closed"):
        action(writer)
    writer.close()
    assert writer.mcap_path.read_bytes() == before


def test_exception_inside_with_keeps_the_recording(tmp_path: Path) -> None:
    def record_and_fail() -> None:
        with BagWriter(tmp_path / 'run') as writer:
            write_numbers(writer, (1,))
            raise RuntimeError('plant')

    with pytest.raises(RuntimeError, match='plant'):
        record_and_fail()
    assert [m.log_time_ns for m in read_messages(tmp_path / 'run')] == [1]


@pytest.mark.parametrize(('name', 'options', 'sentence'), [
    ('run.mcap', {'compression': 'zip'}, "compression 'zip' is not one of none, zstd, lz4"),
    ('run.mcap', {'max_chunk_bytes': 0}, 'max_chunk_bytes 0 is below 1'),
    ('run.mcap', {'max_chunk_age_s': -1.0}, r'max_chunk_age_s -1\.0 is not a time of 0 s or more'),
    ('run.mcap', {'max_chunk_age_s': math.nan}, 'max_chunk_age_s nan is not a time'),
    ('run.mcap', {'max_file_bytes': 1}, r"run\.mcap' is one file, which is not split: give the"),
    ('run.mcap', {'max_file_duration_s': 1.0}, 'is one file'),
    ('run', {'max_file_bytes': -1}, 'max_file_bytes -1 is negative: use 0 for no limit'),
    ('run', {'max_file_duration_s': -1.0}, r'max_file_duration_s -1\.0 is not a time'),
    ('run', {'max_file_duration_s': math.nan}, 'max_file_duration_s nan is not a time'),
])
def test_bad_options_make_no_file(
    tmp_path: Path, name: str, options: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        BagWriter(tmp_path / name, **options)
    assert list(tmp_path.iterdir()) == []


def test_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    one, two = (record(tmp_path / folder / 'run.mcap', range(100), max_chunk_age_s=math.inf)
                for folder in ('one', 'two'))
    assert one.read_bytes() == two.read_bytes()


def test_import_brings_neither_ros_nor_torch() -> None:
    program = (
        'import sys, koopman_ros.bags\n'
        'print([name for name in ("rclpy", "rosidl_runtime_py", "sensor_msgs", "torch")'
        ' if name in sys.modules])')
    done = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[]'
