# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What is written, when, and what is rejected; the readers of mcap and rosbags; definitions."""

from collections.abc import Callable
from pathlib import Path
import sys
from typing import Any

from mcap.reader import make_reader
from mcap.summary import Summary
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2
import yaml

from koopman_ros import __version__, records
from support.bag_samples import (
    DEFAULT_QOS,
    NUMBER,
    number,
    OFFERED_QOS,
    record,
    Sample,
    TOPICS,
    write_numbers,
)


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
    with records.BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER, [DEFAULT_QOS._replace(depth=3)])
        writer.add_topic('/y', NUMBER)
        # again, which does nothing
        writer.add_topic('/x', NUMBER, [DEFAULT_QOS])
    with writer.path.open('rb') as stream:
        header = make_reader(stream).get_header()
    assert (header.profile, header.library) == ('ros2', f'koopman_ros {__version__}')
    found = content(writer.path)
    (schema,) = found.schemas.values()
    assert (schema.name, schema.encoding, schema.data) == (
        'std_msgs/msg/Float64', 'ros2msg', b'float64 data\n')
    for channel, topic, depths in zip(
            found.channels.values(), ('/x', '/y'), ([3], []), strict=True):
        assert (channel.topic, channel.schema_id, channel.message_encoding) == (
            topic, schema.id, 'cdr')
        assert channel.metadata.keys() == {'offered_qos_profiles', 'topic_type_hash'}
        assert channel.metadata['topic_type_hash'] == NUMBER.type_hash
        offers = yaml.safe_load(channel.metadata['offered_qos_profiles'])
        assert [offer['depth'] for offer in offers] == depths


def test_messages_carry_times_and_a_counter_by_topic(tmp_path: Path) -> None:
    with records.BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        writer.add_topic('/y', NUMBER)
        data = number(1.5)
        for sent_ns, (topic, buffer) in enumerate((
                ('/x', data), ('/y', bytearray(data)), ('/x', memoryview(data)))):
            writer.write(topic, buffer, np.int64(100 + sent_ns), np.uint64(sent_ns))
        # the time of sending is that of receipt by default
        writer.write('/y', data, 104)
    with writer.path.open('rb') as stream:
        found = [(channel.topic, message.sequence, message.log_time, message.publish_time)
                 for _, channel, message in make_reader(stream).iter_messages()]
    assert found == [('/x', 0, 100, 0), ('/y', 0, 101, 1), ('/x', 1, 102, 2), ('/y', 1, 104, 104)]
    assert [m.data for m in records.read_messages(writer.path)] == [data] * 4


@pytest.mark.parametrize(('environment', 'expected'), [(None, 'jazzy'), ('kilted', 'kilted')])
def test_metadata_begins_empty_and_ends_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: str | None, expected: str
) -> None:
    monkeypatch.delenv('ROS_DISTRO', raising=False)
    if environment is not None:
        monkeypatch.setenv('ROS_DISTRO', environment)
    path = record(tmp_path / 'deep' / 'er' / 'run', range(5, 8), 10)
    assert sorted(file.name for file in path.iterdir()) == ['metadata.yaml', 'run_0.mcap']
    first, last = serialized_metadata(path / 'run_0.mcap')
    assert first['message_count'] == 0
    assert first['starting_time'] == {'nanoseconds_since_epoch': 2**63 - 1}
    range_ns = {'starting_time': {'nanoseconds_since_epoch': 50},
                'duration': {'nanoseconds': 20}, 'message_count': 3}
    topic = {'name': '/x', 'type': 'std_msgs/msg/Float64', 'serialization_format': 'cdr',
             'offered_qos_profiles': [], 'type_description_hash': NUMBER.type_hash}
    assert list(last.items()) == list({
        'version': 9, 'storage_identifier': 'mcap', 'duration': range_ns['duration'],
        'starting_time': range_ns['starting_time'], 'message_count': 3,
        'topics_with_message_count': [{'topic_metadata': topic, 'message_count': 3}],
        'compression_format': '', 'compression_mode': '', 'relative_file_paths': ['run_0.mcap'],
        'files': [{'path': 'run_0.mcap', **range_ns}], 'custom_data': None,
        'ros_distro': expected}.items())
    assert yaml.safe_load((path / 'metadata.yaml').read_text('utf-8')) == {
        'rosbag2_bagfile_information': last}


def test_flushed_messages_are_in_the_file(tmp_path: Path) -> None:
    writer = records.BagWriter(tmp_path / 'run.mcap')
    write_numbers(writer, (1, 2))
    assert list(records.read_messages(writer.path, recover=True)) == []
    writer.flush()
    assert [m.log_time_ns for m in records.read_messages(writer.path, recover=True)] == [1, 2]
    size = writer.path.stat().st_size
    writer.flush()
    assert writer.path.stat().st_size == size
    writer.close()


@pytest.mark.parametrize('name', ['run', 'run.mcap'])
def test_existing_path_is_never_overwritten(tmp_path: Path, name: str) -> None:
    path = record(tmp_path / name, range(2))
    before = {file: file.read_bytes() for file in tmp_path.rglob('*') if file.is_file()}
    with pytest.raises(FileExistsError, match=(
            f'{name}.*already exists and recordings are never overwritten: choose another')):
        records.BagWriter(path)
    assert {f: f.read_bytes() for f in tmp_path.rglob('*') if f.is_file()} == before


@pytest.mark.parametrize(('arguments', 'kind'), [
    (('/y', b'', 1), KeyError), (('/x', 1.5, 1), TypeError), (('/x', b'', -1, 0), ValueError),
    (('/x', b'', 0, -7), ValueError), (('/x', b'', 2**63, 0), ValueError)])
def test_rejected_message_leaves_no_trace(
        tmp_path: Path, arguments: tuple[Any, ...], kind: type[Exception]) -> None:
    with records.BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/x', NUMBER)
        with pytest.raises(kind):
            writer.write(*arguments)
    assert list(records.read_messages(writer.path)) == []


def test_closed_writer_rejects(tmp_path: Path) -> None:
    writer = records.BagWriter(tmp_path / 'run')
    writer.add_topic('/x', NUMBER)
    # not before the bag is complete
    assert not (writer.path / 'metadata.yaml').exists()
    writer.close()
    before = (writer.path / 'run_0.mcap').read_bytes()
    for method, arguments in ((writer.write, ('/x', number(1.5), 3)),
                              (writer.add_topic, ('/y', NUMBER)), (writer.flush, ())):
        with pytest.raises(ValueError, match='is closed'):
            method(*arguments)
    writer.close()
    assert (writer.path / 'run_0.mcap').read_bytes() == before


def test_exception_inside_with_keeps_the_recording(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), records.BagWriter(tmp_path / 'run') as writer:
        write_numbers(writer, (1 // value for value in (1, 0)))
    assert [m.log_time_ns for m in records.read_messages(tmp_path / 'run')] == [1]


@pytest.mark.parametrize('options', [{'max_file_bytes': 1}, {'max_file_duration_s': 1.0}])
def test_one_file_is_not_split(tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match='cannot be split'):
        records.BagWriter(tmp_path / 'run.mcap', **options)
    assert list(tmp_path.iterdir()) == []


# The independent reader.


@pytest.mark.parametrize(('name', 'options'), [
    ('run', {'compression': 'zstd', 'max_file_bytes': 4000}), ('run.mcap', {}),
    ('run.mcap', {'compression': 'lz4'})])
def test_rosbags_reads_messages_offers_and_metadata(
    tmp_path: Path, write_bag: Callable[..., Path], samples: list[Sample], name: str,
    options: dict[str, Any]
) -> None:
    path = write_bag(tmp_path / name, **options)
    # which compares each stored type hash with one computed from the stored text
    with AnyReader([path]) as reader:
        for connection in reader.connections:
            hash_ = records.message_definition(connection.msgtype).type_hash
            assert reader.typestore.hash_rihs01(connection.msgtype) == hash_
            assert connection.digest == (hash_ if path.is_dir() else '')
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            assert tuple(connection.ext.offered_qos_profiles) == OFFERED_QOS[connection.topic]
        assert (reader.message_count, reader.start_time, reader.end_time) == (
            # rosbags counts past the last
            len(samples), samples[0].log_time_ns, samples[-1].log_time_ns + 1)
        assert {t: info.msgcount for t, info in reader.topics.items()} == dict.fromkeys(
            TOPICS, len(samples) // 4)
        found = [(c.topic, c.msgtype, time, bytes(data)) for c, time, data in reader.messages()]
    assert found == [(s.topic, TOPICS[s.topic], s.log_time_ns, s.data) for s in samples]
    # that mcap's own reader seeks by
    index = content(path if path.is_file() else path / 'run_0.mcap').chunk_indexes
    assert {one.compression for one in index} == {options.get('compression', '')}
    assert all(one.message_index_offsets for one in index)
    assert (len(list(path.glob('*.mcap'))) > 2) == ('max_file_bytes' in options)


# Message definitions.

RULE = '=' * 80
ZEROS = 'RIHS01_' + '0' * 64


@pytest.fixture
def prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have one prefix searched before the interpreter's own."""
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))


def _install(prefix: Path, type_name: str, text: str, *, description: str | None = None) -> None:
    package, name = type_name.split('/msg/')
    folder = prefix / 'share' / package / 'msg'
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f'{name}.msg').write_bytes(text.encode('utf-8'))
    (folder / f'{name}.json').write_text(description or (
        f'{{"type_hashes": [{{"type_name": "{type_name}", "hash_string": "{ZEROS}"}}]}}'))


@pytest.mark.usefixtures('prefix')
def test_dependencies_follow_depth_first_and_sorted(tmp_path: Path) -> None:
    _install(tmp_path, 'a_msgs/msg/Top', 'b_msgs/Mid mid\nLeaf[] leaves\nuint8 X=1\n')
    _install(tmp_path, 'a_msgs/msg/Leaf', 'string<=4[<=2] names\n')
    _install(tmp_path, 'b_msgs/msg/Mid', '# Leaf is no field here\na_msgs/Leaf leaf\nLow low\n')
    _install(tmp_path, 'b_msgs/msg/Low', 'float64 x  # °C\n')
    definition = records.message_definition('a_msgs/msg/Top')
    assert definition.type_hash == ZEROS
    assert definition.text == (
        'b_msgs/Mid mid\nLeaf[] leaves\nuint8 X=1\n'
        f'\n{RULE}\nMSG: a_msgs/Leaf\nstring<=4[<=2] names\n'
        f'\n{RULE}\nMSG: b_msgs/Mid\n# Leaf is no field here\na_msgs/Leaf leaf\nLow low\n'
        f'\n{RULE}\nMSG: b_msgs/Low\nfloat64 x  # °C\n')


def test_first_prefix_wins_and_line_ends_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the interpreter's own comes last
    monkeypatch.setattr(sys, 'prefix', str(tmp_path / 'python'))
    for prefix, text in (('overlay', 'float64 x\r\nfloat64 over\r\n'),
                         ('underlay', 'float64 under\n'), ('python', 'float64 own\n')):
        _install(tmp_path / prefix, 'a_msgs/msg/X', text)
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{tmp_path / "overlay"}::{tmp_path / "underlay"}')
    assert records.message_definition('a_msgs/msg/X').text == 'float64 x\r\nfloat64 over\r\n'
    monkeypatch.delenv('AMENT_PREFIX_PATH')
    assert records.message_definition('a_msgs/msg/X').text == 'float64 own\n'


@pytest.mark.parametrize(('type_name', 'words'), [
    ('my_msgs/msg/Level', r"'my_msgs/msg/Level': no Level\.msg in .*/share/my_msgs/msg, .*; "
     'install ros-jazzy-my-msgs'),
    ('a_msgs/msg/Top', r"'b_msgs/Gone': no Gone\.msg in"),
    ('a_msgs/msg/X', r'X\.json of a_msgs carries no hash'),
    ('sensor_msgs/Temperature', 'write sensor_msgs/msg/Temperature'),
    *((name, 'is not of the form package/msg/Name') for name in (
        'Temperature', 'sensor_msgs/srv/SetCameraInfo', '../../etc/msg/Passwd',
        'sensor_msgs/msg/', ''))])
@pytest.mark.usefixtures('prefix')
def test_definition_that_is_not_there(tmp_path: Path, type_name: str, words: str) -> None:
    _install(tmp_path, 'a_msgs/msg/Top', 'b_msgs/Gone gone\n')
    _install(tmp_path, 'a_msgs/msg/X', 'float64 x\n', description='{}')
    with pytest.raises(records.MessageDefinitionError, match=words):
        records.message_definition(type_name)
