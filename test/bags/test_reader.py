# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

from collections.abc import Callable
from pathlib import Path
import shutil

from mcap.writer import Writer
import pytest
import yaml

from koopman_ros.bags import (
    BagReadError,
    BagWriter,
    MessageDefinition,
    read_messages,
    summary,
)
from support.bag_samples import PERIOD_NS, ROUNDS, Sample, START_NS, TOPICS

WriteBag = Callable[..., Path]

NUMBER = MessageDefinition('std_msgs/msg/UInt8', 'uint8 data\n', 'RIHS01_' + 'a' * 64)


def _number(value: int) -> bytes:
    return b'\x00\x01\x00\x00' + bytes([value])


def _numbers(path: Path, *values: int) -> Path:
    with BagWriter(path) as writer:
        writer.add_topic('/x', NUMBER)
        for value in values:
            writer.write('/x', _number(value), value)
    return path


def _foreign(path: Path, *, encoding: str = 'cdr', schema_encoding: str = 'ros2msg',
             schema: bytes = b'uint8 data\n', data: bytes = _number(1)) -> Path:
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2')
        schema_id = writer.register_schema('std_msgs/msg/UInt8', schema_encoding, schema)
        channel = writer.register_channel('/x', encoding, schema_id)
        writer.add_message(channel, 1, data, 1)
        writer.finish()
    return path


@pytest.mark.parametrize('name', ['run', 'run.mcap'])
def test_messages_come_back_as_they_were(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], name: str
) -> None:
    found = list(read_messages(write_bag(tmp_path / name)))
    assert [m.data for m in found] == [s.data for s in samples]
    assert [m.topic for m in found] == [s.topic for s in samples]
    assert [m.type_name for m in found] == [TOPICS[s.topic] for s in samples]
    assert [m.log_time_ns for m in found] == [s.log_time_ns for s in samples]
    assert [m.publish_time_ns for m in found] == [s.publish_time_ns for s in samples]


def test_fields_are_decoded(tmp_path: Path, write_bag: WriteBag, samples: list[Sample]) -> None:
    for entry, sample in zip(
            read_messages(write_bag(tmp_path / 'run.mcap')), samples, strict=True):
        found, sent = entry.message, sample.message
        stamps = [getattr(m, 'clock', None) or m.header.stamp for m in (found, sent)]
        assert (stamps[0].sec, stamps[0].nanosec) == (stamps[1].sec, stamps[1].nanosec)
        if entry.topic == '/temperature':
            assert found.header.frame_id == 'reactor'
            assert (found.temperature, found.variance) == (sent.temperature, sent.variance)
        elif entry.topic == '/joint_states':
            assert found.name == sent.name
            assert list(found.position) == list(sent.position)
            assert list(found.velocity) == [-1e-300]
            assert str(list(found.effort)) == '[nan]'
        elif entry.topic == '/diagnostics':
            assert len(found.status) == len(sent.status)
            for one, other in zip(found.status, sent.status, strict=True):
                assert bytes([one.level]) == other.level
                assert (one.name, one.message) == (other.name, other.message)
                assert [(v.key, v.value) for v in one.values] == [
                    (v.key, v.value) for v in other.values]


def test_topics_limit_the_reading(tmp_path: Path, write_bag: WriteBag) -> None:
    path = write_bag(tmp_path / 'run.mcap')
    assert {m.topic for m in read_messages(path, ['/clock', '/nowhere'])} == {'/clock'}
    assert list(read_messages(path, [])) == []


def test_single_string_as_topics_is_refused(tmp_path: Path) -> None:
    path = _numbers(tmp_path / 'run.mcap', 1)
    with pytest.raises(TypeError, match=r"must be a collection of names: pass \['/x'\]"):
        read_messages(path, '/x')


def test_order_is_that_of_recording_across_a_clock_reset(tmp_path: Path) -> None:
    path = _numbers(tmp_path / 'run.mcap', 5, 6, 7, 1, 2, 6)
    assert [m.message.data for m in read_messages(path)] == [5, 6, 7, 1, 2, 6]
    content = summary(path)
    assert (content.start_ns, content.end_ns) == (1, 7)


@pytest.mark.parametrize('name', ['run', 'run.mcap'])
def test_summary(tmp_path: Path, write_bag: WriteBag, name: str) -> None:
    content = summary(write_bag(tmp_path / name))
    assert content.counts == dict.fromkeys(TOPICS, ROUNDS)
    assert content.types == TOPICS
    assert content.start_ns == START_NS + 1_000_000
    assert content.end_ns == START_NS + (ROUNDS - 1) * PERIOD_NS + 1_000_003
    assert content.message_count == 4 * ROUNDS
    assert content.complete


@pytest.mark.parametrize('name', ['run', 'run.mcap'])
def test_bag_without_messages(tmp_path: Path, name: str) -> None:
    path = _numbers(tmp_path / name)
    assert list(read_messages(path)) == []
    content = summary(path)
    assert (content.counts, content.types) == ({'/x': 0}, {'/x': 'std_msgs/msg/UInt8'})
    assert (content.start_ns, content.end_ns, content.complete) == (None, None, True)


def test_split_bag_is_read_in_the_order_of_its_metadata(tmp_path: Path) -> None:
    path = _numbers(tmp_path / 'run', 1, 2)
    shutil.move(_numbers(tmp_path / 'more.mcap', 3, 4), path / 'run_1.mcap')
    source = path / 'metadata.yaml'
    content = yaml.safe_load(source.read_text('utf-8'))
    content['rosbag2_bagfile_information']['relative_file_paths'] = ['run_1.mcap', 'run_0.mcap']
    source.write_text(yaml.safe_dump(content), encoding='utf-8')
    assert [m.message.data for m in read_messages(path)] == [3, 4, 1, 2]
    assert summary(path).counts == {'/x': 4}
    assert (summary(path).start_ns, summary(path).end_ns) == (1, 4)


def test_types_of_the_same_number_in_two_files_do_not_mix(tmp_path: Path) -> None:
    path = _numbers(tmp_path / 'run', 7)
    _foreign(path / 'run_1.mcap', schema=b'uint8 other\n', data=_number(9))
    (path / 'metadata.yaml').unlink()
    first, second = read_messages(path, recover=True)
    assert (first.message.data, second.message.other) == (7, 9)


def test_missing_bag(tmp_path: Path) -> None:
    for function in (read_messages, summary):
        with pytest.raises(BagReadError, match=r"'.*none\.mcap' does not exist: check the path"):
            function(tmp_path / 'none.mcap')


@pytest.mark.parametrize('recover', [False, True])
def test_empty_file(tmp_path: Path, recover: bool) -> None:
    path = tmp_path / 'run.mcap'
    path.touch()
    with pytest.raises(BagReadError, match='is empty: its recorder wrote nothing'):
        read_messages(path, recover=recover)


@pytest.mark.parametrize('content', [b'SQLite format 3\x00', b'\x89PNG', b'x'])
def test_file_that_is_not_mcap(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / 'run.mcap'
    path.write_bytes(content)
    for function in (read_messages, summary):
        with pytest.raises(BagReadError, match=r'is not an MCAP file \(it starts with'):
            function(path)


def test_directory_that_is_no_bag(tmp_path: Path) -> None:
    with pytest.raises(BagReadError, match=r'has no metadata\.yaml.*: pass recover=True'):
        read_messages(tmp_path)
    with pytest.raises(BagReadError, match=r'has neither metadata\.yaml nor MCAP files'):
        read_messages(tmp_path, recover=True)


@pytest.mark.parametrize('text', ['', 'a: [', 'rosbag2_bagfile_information: 3', '- 1', '\x00'])
def test_broken_metadata(tmp_path: Path, text: str) -> None:
    path = _numbers(tmp_path / 'run', 1)
    (path / 'metadata.yaml').write_text(text, encoding='utf-8')
    with pytest.raises(BagReadError, match=r'metadata\.yaml.*is not the metadata of a bag'):
        read_messages(path)


def test_listed_file_that_is_missing(tmp_path: Path) -> None:
    path = _numbers(tmp_path / 'run', 1)
    (path / 'run_0.mcap').unlink()
    with pytest.raises(BagReadError, match=r"lists 'run_0\.mcap', which is not there"):
        read_messages(path)


@pytest.mark.parametrize(('key', 'value', 'kind'), [
    ('storage_identifier', 'sqlite3', 'sqlite3 files'),
    ('compression_format', 'lz4', 'mcap files compressed with lz4'),
])
def test_storage_that_is_not_read_here(tmp_path: Path, key: str, value: str, kind: str) -> None:
    path = _numbers(tmp_path / 'run', 1)
    source = path / 'metadata.yaml'
    content = yaml.safe_load(source.read_text('utf-8'))
    content['rosbag2_bagfile_information'][key] = value
    source.write_text(yaml.safe_dump(content), encoding='utf-8')
    with pytest.raises(BagReadError, match=f"holds {kind}, .* convert it with 'ros2 bag convert'"):
        read_messages(path)


@pytest.mark.parametrize('options', [{'encoding': 'json'}, {'schema_encoding': 'ros2idl'}])
def test_encoding_that_is_not_decoded_here(tmp_path: Path, options: dict[str, str]) -> None:
    path = _foreign(tmp_path / 'run.mcap', **options)
    with pytest.raises(BagReadError, match=r"'/x' is encoded as .*only cdr with ros2msg"):
        list(read_messages(path))
    assert list(read_messages(path, ['/y'])) == []


def test_definition_that_does_not_parse(tmp_path: Path) -> None:
    path = _foreign(tmp_path / 'run.mcap', schema=b'other_msgs/Unknown data\n')
    with pytest.raises(BagReadError, match="'/x' at 1 ns does not decode"):
        list(read_messages(path))


def test_message_that_is_too_short(tmp_path: Path) -> None:
    path = _foreign(tmp_path / 'run.mcap', data=b'\x00\x01\x00\x00')
    with pytest.raises(BagReadError, match="the message on '/x' at 1 ns does not decode"):
        list(read_messages(path))
