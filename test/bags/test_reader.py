# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of ours and of rosbag2 through the years, and what is no bag or none that is read."""

from collections.abc import Callable
from pathlib import Path
import shutil
from typing import Any

from mcap.writer import Writer
import pytest
import yaml

from koopman_ros.bags import BagReadError, QosProfile, read_messages, summary
from koopman_ros.bags.metadata import parse_offered_qos
from support.bag_samples import (
    compressed_files,
    number,
    OFFERED_QOS,
    PERIOD_NS,
    record,
    ROUNDS,
    Sample,
    START_NS,
    TOPICS,
)

WriteBag = Callable[..., Path]
FORMS = pytest.mark.parametrize('name', ['run', 'run.mcap'])

# An offer as Humble writes it: the numbers of rmw, and infinity as it was spelt then.
HUMBLE_OFFER = """
- history: 3
  depth: 0
  reliability: 2
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 1, nsec: 500000000}
  avoid_ros_namespace_conventions: false
"""


def foreign(path: Path, *, encoding: str = 'cdr', schema_encoding: str = 'ros2msg',
            schema: bytes = b'float64 data\n', data: bytes = number(1.0)) -> Path:
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2')
        schema_id = writer.register_schema('std_msgs/msg/Float64', schema_encoding, schema)
        channel = writer.register_channel('/x', encoding, schema_id)
        writer.add_message(channel, 1, data, 1)
        writer.finish()
    return path


def change(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the metadata of a bag."""
    source = path / 'metadata.yaml'
    content = yaml.safe_load(source.read_text('utf-8'))
    change(content['rosbag2_bagfile_information'])
    source.write_text(yaml.safe_dump(content, sort_keys=False), 'utf-8')


@FORMS
def test_messages_and_summary_come_back_as_they_were(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], name: str
) -> None:
    path = write_bag(tmp_path / name)
    assert [(m.topic, m.type_name, m.log_time_ns, m.publish_time_ns, m.data)
            for m in read_messages(path)] == [
        (s.topic, TOPICS[s.topic], s.log_time_ns, s.publish_time_ns, s.data) for s in samples]
    assert {m.topic for m in read_messages(path, ['/clock', '/nowhere'])} == {'/clock'}
    assert list(read_messages(path, [])) == []
    with pytest.raises(TypeError, match=r"must be a collection of names: pass \['/x'\]"):
        read_messages(path, '/x')
    content = summary(path)
    assert content.counts == dict.fromkeys(TOPICS, ROUNDS)
    assert content.types == TOPICS
    assert content.offered_qos == OFFERED_QOS
    assert content.start_ns == START_NS + 1_000_000
    assert content.end_ns == START_NS + (ROUNDS - 1) * PERIOD_NS + 1_000_003
    assert content.message_count == 4 * ROUNDS
    assert content.complete


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


def test_order_is_that_of_recording_across_a_clock_reset(tmp_path: Path) -> None:
    path = record(tmp_path / 'run.mcap', [5, 6, 7, 1, 2, 6])
    assert [m.message.data for m in read_messages(path)] == [5, 6, 7, 1, 2, 6]
    content = summary(path)
    assert (content.start_ns, content.end_ns) == (1, 7)


@FORMS
def test_bag_without_messages(tmp_path: Path, name: str) -> None:
    path = record(tmp_path / name)
    assert list(read_messages(path)) == []
    content = summary(path)
    assert (content.counts, content.types) == ({'/x': 0}, {'/x': 'std_msgs/msg/Float64'})
    assert (content.start_ns, content.end_ns, content.complete) == (None, None, True)


def test_split_bag_is_read_in_the_order_of_its_metadata(tmp_path: Path) -> None:
    path = record(tmp_path / 'run', (1, 2))
    shutil.move(record(tmp_path / 'more.mcap', (3, 4)), path / 'run_1.mcap')
    change(path, lambda found: found.update(relative_file_paths=['run_1.mcap', 'run_0.mcap']))
    assert [m.message.data for m in read_messages(path)] == [3, 4, 1, 2]
    assert summary(path).counts == {'/x': 4}
    assert (summary(path).start_ns, summary(path).end_ns) == (1, 4)


def test_types_of_the_same_number_in_two_files_do_not_mix(tmp_path: Path) -> None:
    path = record(tmp_path / 'run', [7])
    foreign(path / 'run_1.mcap', schema=b'float64 other\n', data=number(9.0))
    (path / 'metadata.yaml').unlink()
    first, second = read_messages(path, recover=True)
    assert (first.message.data, second.message.other) == (7, 9)


# What is no bag, or none that is read here.


@pytest.mark.parametrize(('content', 'words'), [
    (None, r"'.*run\.mcap' does not exist: check the path"),
    (b'', 'is empty: its recorder wrote nothing'),
    *((content, r'is not an MCAP file \(it starts with')
      for content in (b'SQLite format 3\x00', b'\x89PNG', b'x'))])
def test_file_that_is_no_bag(tmp_path: Path, content: bytes | None, words: str) -> None:
    path = tmp_path / 'run.mcap'
    if content is not None:
        path.write_bytes(content)
    for read in (read_messages, summary, lambda path: read_messages(path, recover=True)):
        with pytest.raises(BagReadError, match=words):
            read(path)


def test_directory_that_is_no_bag(tmp_path: Path) -> None:
    with pytest.raises(BagReadError, match=r'has no metadata\.yaml.*: pass recover=True'):
        read_messages(tmp_path)
    with pytest.raises(BagReadError, match=r'has neither metadata\.yaml nor MCAP files'):
        read_messages(tmp_path, recover=True)


def test_broken_metadata(tmp_path: Path) -> None:
    path = record(tmp_path / 'run')
    source = path / 'metadata.yaml'
    whole = source.read_text('utf-8')
    for text in ('', 'a: [', 'rosbag2_bagfile_information: 3', '- 1', '\x00',
                 *(whole.replace('\n  - run_0.mcap', f' {names}') for names in (
                     '[]', '3', 'run_0.mcap', '[run_0.mcap, run_0.mcap]', '[[a]]'))):
        source.write_text(text, encoding='utf-8')
        assert text != whole
        with pytest.raises(BagReadError, match=r'metadata\.yaml.*is not the metadata of a bag'):
            read_messages(path)
    source.write_text(whole, encoding='utf-8')
    (path / 'run_0.mcap').unlink()
    with pytest.raises(BagReadError, match=r"lists 'run_0\.mcap', which is not there"):
        read_messages(path)


@pytest.mark.parametrize(('key', 'value', 'kind'), [
    ('storage_identifier', 'sqlite3', 'sqlite3 files'),
    ('compression_format', 'lz4', 'mcap files compressed with lz4'),
])
def test_storage_that_is_not_read_here(tmp_path: Path, key: str, value: str, kind: str) -> None:
    path = record(tmp_path / 'run')
    change(path, lambda found: found.update({key: value}))
    with pytest.raises(BagReadError, match=f"holds {kind}, .* convert it with 'ros2 bag convert'"):
        read_messages(path)


@pytest.mark.parametrize(('options', 'words'), [
    ({'encoding': 'json'}, r"'/x' is encoded as .*only cdr with ros2msg"),
    ({'schema_encoding': 'ros2idl'}, r"'/x' is encoded as .*only cdr with ros2msg"),
    ({'schema': b'other_msgs/Unknown data\n'}, "'/x' at 1 ns does not decode"),
    ({'data': number(1.0)[:4]}, "the message on '/x' at 1 ns does not decode"),
    # a sequence of 4e9 elements whose bytes are not there
    ({'schema': b'Id[] ids\n' + b'=' * 80 + b'\nMSG: std_msgs/Id\nuint8[16] id\n',
      'data': number(1.0)[:4] + b'\xff\xff\xff\xff\x01'}, "the message on '/x' at 1 ns does not"),
    ({'schema': b'float64[] x\n', 'data': number(1.0)[:4] + b'\xff\xff\xff\xff\x01'},
     "the message on '/x' at 1 ns does not decode"),
    # the string ends before its declared length, with nothing behind it that would notice
    ({'schema': b'string x\n', 'data': number(1.0)[:4] + b'\x09\x00\x00\x00abc'},
     "the message on '/x' at 1 ns does not decode"),
])
def test_message_that_is_not_decoded(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    path = foreign(tmp_path / 'run.mcap', **options)
    with pytest.raises(BagReadError, match=words):
        list(read_messages(path))
    assert list(read_messages(path, ['/y'])) == []


# Bags as rosbag2 itself has written them.


@pytest.mark.parametrize('version', [4, 5, 6, 7, 8, 9])
def test_metadata_of_every_version(tmp_path: Path, version: int) -> None:
    """As that version of rosbag2 wrote it (rosbag2_storage/yaml.hpp)."""
    def downgrade(information: dict[str, Any]) -> None:
        information['version'] = version
        for entry in information['topics_with_message_count']:
            topic = entry['topic_metadata']
            topic['offered_qos_profiles'] = HUMBLE_OFFER if version < 9 else []
            if version < 7:
                del topic['type_description_hash']
        for key, since in (('files', 5), ('custom_data', 6), ('ros_distro', 8)):
            if version < since:
                del information[key]

    path = record(tmp_path / 'run', (3, 4))
    change(path, downgrade)
    assert [m.message.data for m in read_messages(path)] == [3, 4]
    assert summary(path).complete


def test_compressed_files_of_a_killed_recorder(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    """Without metadata, and with the last file not compressed yet or half compressed."""
    path = write_bag(tmp_path / 'run', max_file_bytes=8000)
    files = {file.name: file.read_bytes() for file in path.iterdir()}
    compressed = compressed_files(files)
    # a file by itself
    bare = tmp_path / 'run_0.mcap.zstd'
    bare.write_bytes(compressed['run_0.mcap.zstd'])
    begin = [m.data for m in read_messages(bare)]
    assert begin == [s.data for s in samples[:len(begin)]] != []
    del compressed['metadata.yaml']
    assert len(compressed) >= 3
    last = max(files)
    compressed[f'{last}.zstd'] = compressed[f'{last}.zstd'][:100]
    (path / 'metadata.yaml').unlink()
    for name, content in compressed.items():
        (path / name).write_bytes(content)
        if name != f'{last}.zstd':
            (path / name.removesuffix('.zstd')).unlink()
    assert [m.data for m in read_messages(path, recover=True)] == [s.data for s in samples]


def test_offer_in_numbers() -> None:
    assert parse_offered_qos(HUMBLE_OFFER) == (QosProfile(
        history='unknown', depth=0, reliability='best_effort', durability='transient_local',
        liveliness_lease_duration_ns=1_500_000_000),)


@pytest.mark.parametrize('text', [
    '', 'x', '- 3', '- history: 1', '[', HUMBLE_OFFER.replace('reliability: 2', 'reliability: 9'),
    HUMBLE_OFFER.replace('depth: 0', 'depth: -1'),
    HUMBLE_OFFER.replace('sec: 1', 'sec: 2001-99-01'),
])
def test_offer_that_cannot_be_read_is_left_out(text: str) -> None:
    assert parse_offered_qos(text) == ()
