# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

from collections import Counter
from collections.abc import Callable
import math
from pathlib import Path
import subprocess
import sys
from typing import Any

from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
import numpy as np
import pytest
import yaml

from koopman_ros import __version__
from koopman_ros.bags import BagWriter, MessageDefinition, QosProfile, read_messages

HASH = 'RIHS01_' + 'a' * 64
NUMBER = MessageDefinition('std_msgs/msg/Float64', 'float64 data\n', HASH)
CDR = b'\x00\x01\x00\x00' + np.float64(1.5).tobytes()


def _write_numbers(path: Path, count: int, **options: Any) -> Path:
    with BagWriter(path, **options) as writer:
        writer.add_topic('/x', NUMBER)
        for index in range(count):
            writer.write('/x', CDR, 1000 + 10 * index, 500 + 10 * index)
    return path


def _chunk_count(path: Path) -> int:
    with path.open('rb') as stream:
        records = StreamReader(stream, emit_chunks=True).records
        return sum(isinstance(record, Chunk) for record in records)


def _serialized_metadata(path: Path) -> list[dict[str, Any]]:
    with path.open('rb') as stream:
        records = list(make_reader(stream).iter_metadata())
    assert {record.name for record in records} == {'rosbag2'}
    return [yaml.safe_load(record.metadata['serialized_metadata']) for record in records]


def test_header_names_profile_and_version(tmp_path: Path) -> None:
    path = _write_numbers(tmp_path / 'run.mcap', 1)
    with path.open('rb') as stream:
        header = make_reader(stream).get_header()
    assert (header.profile, header.library) == ('ros2', f'koopman_ros {__version__}')


def test_channel_and_schema_are_those_of_rosbag2(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER, [QosProfile(depth=3)])
        writer.add_topic('/y', NUMBER)
    with writer.mcap_path.open('rb') as stream:
        content = make_reader(stream).get_summary()
    assert content is not None
    (schema,) = content.schemas.values()
    assert (schema.name, schema.encoding) == ('std_msgs/msg/Float64', 'ros2msg')
    assert schema.data == b'float64 data\n'
    x, y = content.channels.values()
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
        for time_ns, topic in enumerate(('/x', '/y', '/x', '/x', '/y')):
            writer.write(topic, CDR, 100 + time_ns, time_ns)
    with writer.mcap_path.open('rb') as stream:
        found = [
            (channel.topic, message.sequence, message.log_time, message.publish_time)
            for _, channel, message in make_reader(stream).iter_messages()
        ]
    assert found == [
        ('/x', 0, 100, 0), ('/y', 0, 101, 1), ('/x', 1, 102, 2), ('/x', 2, 103, 3),
        ('/y', 1, 104, 4)]


def test_publish_time_is_the_log_time_by_default(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        writer.write('/x', CDR, 77)
    assert [m.publish_time_ns for m in read_messages(writer.path)] == [77]


def test_buffers_and_numpy_integers_are_taken_as_they_are(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        for data in (CDR, bytearray(CDR), memoryview(CDR)):
            writer.write('/x', data, np.int64(5), np.uint64(4))
    found = list(read_messages(writer.path))
    assert [(m.data, m.log_time_ns, m.publish_time_ns) for m in found] == [(CDR, 5, 4)] * 3


def test_statistics_and_indexes(tmp_path: Path) -> None:
    path = _write_numbers(tmp_path / 'run.mcap', 20, max_chunk_bytes=200)
    with path.open('rb') as stream:
        content = make_reader(stream).get_summary()
    assert content is not None
    assert content.statistics is not None
    assert content.statistics.message_count == 20
    assert content.statistics.channel_message_counts == {1: 20}
    assert content.statistics.message_start_time == 1000
    assert content.statistics.message_end_time == 1190
    assert len(content.chunk_indexes) == content.statistics.chunk_count > 1
    assert all(index.message_index_offsets for index in content.chunk_indexes)
    assert len(content.metadata_indexes) == 2


def test_metadata_record_begins_empty_and_ends_complete(tmp_path: Path) -> None:
    path = _write_numbers(tmp_path / 'run.mcap', 3, custom_data={'seed': '1e-3'})
    first, last = _serialized_metadata(path)
    assert first['message_count'] == 0
    assert first['starting_time'] == {'nanoseconds_since_epoch': 2**63 - 1}
    assert first['custom_data'] == last['custom_data'] == {'seed': '1e-3'}
    assert list(last) == [
        'version', 'storage_identifier', 'duration', 'starting_time', 'message_count',
        'topics_with_message_count', 'compression_format', 'compression_mode',
        'relative_file_paths', 'files', 'custom_data', 'ros_distro']
    assert last['version'] == 9
    assert last['storage_identifier'] == 'mcap'
    assert last['starting_time'] == {'nanoseconds_since_epoch': 1000}
    assert last['duration'] == {'nanoseconds': 20}
    assert last['message_count'] == 3
    assert last['relative_file_paths'] == ['run.mcap']
    assert last['files'] == [{
        'path': 'run.mcap',
        'starting_time': {'nanoseconds_since_epoch': 1000},
        'duration': {'nanoseconds': 20},
        'message_count': 3,
    }]
    assert last['topics_with_message_count'] == [{
        'topic_metadata': {
            'name': '/x',
            'type': 'std_msgs/msg/Float64',
            'serialization_format': 'cdr',
            'offered_qos_profiles': [],
            'type_description_hash': HASH,
        },
        'message_count': 3,
    }]


@pytest.mark.parametrize(('environment', 'expected'), [(None, 'jazzy'), ('kilted', 'kilted')])
def test_distribution_is_the_sourced_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: str | None, expected: str
) -> None:
    monkeypatch.delenv('ROS_DISTRO', raising=False)
    if environment is not None:
        monkeypatch.setenv('ROS_DISTRO', environment)
    path = _write_numbers(tmp_path / 'run.mcap', 1)
    assert _serialized_metadata(path)[1]['ros_distro'] == expected


def test_directory_has_numbered_file_and_metadata(tmp_path: Path) -> None:
    path = _write_numbers(tmp_path / 'deep' / 'er' / 'run', 3)
    assert sorted(file.name for file in path.iterdir()) == ['metadata.yaml', 'run_0.mcap']
    content = yaml.safe_load((path / 'metadata.yaml').read_text('utf-8'))
    assert list(content) == ['rosbag2_bagfile_information']
    assert content['rosbag2_bagfile_information'] == _serialized_metadata(path / 'run_0.mcap')[1]
    assert content['rosbag2_bagfile_information']['relative_file_paths'] == ['run_0.mcap']


def test_metadata_appears_at_close_only(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'run')
    assert not (writer.path / 'metadata.yaml').exists()
    writer.close()
    assert (writer.path / 'metadata.yaml').exists()


def test_unicode_and_long_custom_data_stay_on_one_line(tmp_path: Path) -> None:
    note = 'Kühlmittel: ' + 'wort ' * 100
    path = _write_numbers(tmp_path / 'run', 1, custom_data={'note': note})
    text = (path / 'metadata.yaml').read_text('utf-8')
    assert f"note: '{note}'" in text
    assert yaml.safe_load(text)['rosbag2_bagfile_information']['custom_data'] == {'note': note}


@pytest.mark.parametrize('compression', ['none', 'zstd', 'lz4'])
def test_compressions_read_back_alike(tmp_path: Path, compression: str) -> None:
    path = _write_numbers(tmp_path / 'run.mcap', 50, compression=compression)
    with path.open('rb') as stream:
        content = make_reader(stream).get_summary()
    assert content is not None
    name = '' if compression == 'none' else compression
    assert {index.compression for index in content.chunk_indexes} == {name}
    assert [m.message.data for m in read_messages(path)] == [1.5] * 50


@pytest.mark.parametrize(('age_s', 'chunks'), [(0.0, 12), (1.0, 4), (math.inf, 1)])
def test_chunk_ends_with_its_age(tmp_path: Path, age_s: float, chunks: int) -> None:
    # Half a second a message: a chunk of 1 s holds the messages at 0, 0.5 and 1 s.
    now_s = iter(np.arange(12) * 0.5)
    path = _write_numbers(
        tmp_path / 'run.mcap', 12, max_chunk_age_s=age_s, clock=lambda: float(next(now_s)))
    assert _chunk_count(path) == chunks


def test_flushed_messages_are_in_the_file(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'run.mcap', max_chunk_age_s=math.inf)
    writer.add_topic('/x', NUMBER)
    writer.write('/x', CDR, 1)
    writer.write('/x', CDR, 2)
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
        f'    writer.write("/x", {CDR!r}, time_ns)\n'
        'os._exit(9)\n')
    assert subprocess.run([sys.executable, '-c', program], check=False).returncode == 9
    assert [m.log_time_ns for m in read_messages(path, recover=True)] == list(range(survivors))


@pytest.mark.parametrize('name', ['run', 'run.mcap'])
def test_existing_path_is_never_overwritten(tmp_path: Path, name: str) -> None:
    path = _write_numbers(tmp_path / name, 2)
    before = {file: file.read_bytes() for file in tmp_path.rglob('*') if file.is_file()}
    with pytest.raises(FileExistsError, match=(
            f'{name}.* exists already and recordings are never overwritten: choose another')):
        BagWriter(path)
    assert {f: f.read_bytes() for f in tmp_path.rglob('*') if f.is_file()} == before


def test_adding_a_topic_again_does_nothing(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        writer.write('/x', CDR, 1)
        writer.add_topic('/x', NUMBER, [QosProfile()])
        writer.write('/x', CDR, 2)
    with writer.path.open('rb') as stream:
        content = make_reader(stream).get_summary()
    assert content is not None
    assert len(content.channels) == len(content.schemas) == 1
    assert Counter(m.topic for m in read_messages(writer.path)) == {'/x': 2}


def test_contradicting_definitions_are_refused(tmp_path: Path) -> None:
    integer = MessageDefinition('std_msgs/msg/Int64', 'int64 data\n', HASH)
    changed = MessageDefinition('std_msgs/msg/Float64', 'float32 data\n', HASH)
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        with pytest.raises(ValueError, match=(
                r"'/x' of type std_msgs/msg/Int64 .* contradicts topic '/x' of type "
                'std_msgs/msg/Float64')):
            writer.add_topic('/x', integer)
        with pytest.raises(ValueError, match=r"contradicts topic '/x' .* in a bag of its own"):
            writer.add_topic('/y', changed)


def test_relative_topic_is_refused(tmp_path: Path) -> None:
    with (
        BagWriter(tmp_path / 'run.mcap') as writer,
        pytest.raises(ValueError, match=r"'x' is not an absolute name.*resolve_topic_name\('x'\)"),
    ):
        writer.add_topic('x', NUMBER)


def test_unknown_topic_is_refused(tmp_path: Path) -> None:
    with (
        BagWriter(tmp_path / 'run.mcap') as writer,
        pytest.raises(ValueError, match=r"'/x' is not in the bag '.*run\.mcap': call add_topic"),
    ):
        writer.write('/x', CDR, 1)


def test_message_that_is_not_bytes_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        with pytest.raises(TypeError, match=r"'/x' must be serialized .* got float: subscribe"):
            writer.write('/x', 1.5, 1)  # type: ignore[arg-type]


@pytest.mark.parametrize(('times', 'sentence'), [
    ((-1, 0), r'log_time_ns -1 is outside \[0, 9223372036854775807\] ns'),
    ((0, -7), 'publish_time_ns -7 is outside'),
    ((2**63, 0), 'log_time_ns 9223372036854775808 is outside'),
])
def test_time_out_of_range_leaves_no_trace(
    tmp_path: Path, times: tuple[int, int], sentence: str
) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        with pytest.raises(ValueError, match=sentence):
            writer.write('/x', CDR, *times)
        assert writer.message_count == 0
    assert list(read_messages(writer.path)) == []


def test_time_in_seconds_is_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        with pytest.raises(TypeError, match='float'):
            writer.write('/x', CDR, 1.5)  # type: ignore[arg-type]


@pytest.mark.parametrize(('action', 'verb'), [
    (lambda writer: writer.write('/x', CDR, 3), 'write to'),
    (lambda writer: writer.add_topic('/y', NUMBER), 'add a topic to'),
    (lambda writer: writer.flush(), 'flush'),
])
def test_closed_writer_refuses(
    tmp_path: Path, action: Callable[[BagWriter], None], verb: str
) -> None:
    with BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
    assert writer.closed
    with pytest.raises(ValueError, match=rf"cannot {verb} the bag '.*run\.mcap': it is closed"):
        action(writer)


def test_closing_twice_does_nothing(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'run')
    writer.close()
    before = writer.mcap_path.read_bytes()
    writer.close()
    assert writer.mcap_path.read_bytes() == before


def test_exception_inside_with_keeps_the_recording(tmp_path: Path) -> None:
    def record_and_fail() -> None:
        with BagWriter(tmp_path / 'run') as writer:
            writer.add_topic('/x', NUMBER)
            writer.write('/x', CDR, 1)
            raise RuntimeError('plant')

    with pytest.raises(RuntimeError, match='plant'):
        record_and_fail()
    assert [m.log_time_ns for m in read_messages(tmp_path / 'run')] == [1]


@pytest.mark.parametrize(('options', 'sentence'), [
    ({'compression': 'zip'}, "compression 'zip' is not one of none, zstd, lz4"),
    ({'max_chunk_bytes': 0}, 'max_chunk_bytes 0 is below 1'),
    ({'max_chunk_age_s': -1.0}, r'max_chunk_age_s -1\.0 is not a time of 0 s or more'),
    ({'max_chunk_age_s': math.nan}, 'max_chunk_age_s nan is not a time'),
    ({'custom_data': {'seed': 7}}, "custom_data 'seed': 7 is not a pair of strings"),
])
def test_bad_options_make_no_file(
    tmp_path: Path, options: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        BagWriter(tmp_path / 'run.mcap', **options)
    assert list(tmp_path.iterdir()) == []


def test_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    options = {'max_chunk_age_s': math.inf}
    one = _write_numbers(tmp_path / 'one' / 'run.mcap', 100, **options)
    two = _write_numbers(tmp_path / 'two' / 'run.mcap', 100, **options)
    assert one.read_bytes() == two.read_bytes()


def test_import_brings_neither_ros_nor_torch() -> None:
    program = (
        'import sys, koopman_ros.bags\n'
        'print([name for name in ("rclpy", "rosidl_runtime_py", "sensor_msgs", "torch")'
        ' if name in sys.modules])')
    done = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[]'
