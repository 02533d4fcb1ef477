# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of ours and of rosbag2 through the years, and what is no bag or none that is read."""

from collections.abc import Callable
import importlib
from pathlib import Path
import re
import shutil
from typing import Any

from mcap.writer import Writer
import pytest
from rosbags.interfaces import QosDurability, QosHistory, QosReliability, QosTime
import yaml
import zstandard

from koopman_ros import records
from koopman_ros.core import message_fields
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.records.metadata import dump_offered_qos, parse_offered_qos
from support.bag_samples import (
    compressed_files,
    DEFAULT_QOS,
    number,
    OFFERED_QOS,
    record,
    Sample,
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
            schema: bytes = b'float64 data\n', data: bytes = number(1.0),
            name: str = 'std_msgs/msg/Float64') -> Path:
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2')
        schema_id = writer.register_schema(name, schema_encoding, schema)
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
            for m in records.read_messages(path)] == [
        (s.topic, TOPICS[s.topic], s.log_time_ns, s.publish_time_ns, s.data) for s in samples]
    assert {m.topic for m in records.read_messages(path, ['/clock', '/nowhere'])} == {'/clock'}
    assert list(records.read_messages(path, [])) == []
    with pytest.raises(TypeError, match=r"of names: pass \['/x'\]"):
        records.read_messages(path, '/x')
    assert records.summary(path) == records.BagSummary(
        dict.fromkeys(TOPICS, len(samples) // 4), TOPICS, OFFERED_QOS, samples[0].log_time_ns,
        samples[-1].log_time_ns, complete=True)
    assert records.summary(path).message_count == len(samples)


def test_fields_are_decoded(tmp_path: Path, write_bag: WriteBag, samples: list[Sample]) -> None:
    for entry, sample in zip(
            records.read_messages(write_bag(tmp_path / 'run.mcap')), samples, strict=True):
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
            assert [str(one) for one in found.effort] == ['nan']
        elif entry.topic == '/diagnostics':
            assert [(bytes([one.level]), one.name, one.message,
                     [(v.key, v.value) for v in one.values]) for one in found.status] == [
                (other.level, other.name, other.message,
                 [(v.key, v.value) for v in other.values]) for other in sent.status]


def test_order_is_that_of_recording_across_a_clock_reset(tmp_path: Path) -> None:
    path = record(tmp_path / 'run.mcap', [5, 6, 7, 1, 2, 6])
    assert [m.message.data for m in records.read_messages(path)] == [5, 6, 7, 1, 2, 6]
    content = records.summary(path)
    assert (content.start_ns, content.end_ns) == (1, 7)


@FORMS
def test_bag_without_messages(tmp_path: Path, name: str) -> None:
    path = record(tmp_path / name)
    assert list(records.read_messages(path)) == []
    assert records.summary(path) == records.BagSummary(
        {'/x': 0}, {'/x': 'std_msgs/msg/Float64'}, {}, None, None, complete=True)


def test_split_bag_is_read_in_the_order_of_its_metadata(tmp_path: Path) -> None:
    path = record(tmp_path / 'run', (1, 2))
    # with another type under the same number
    foreign(path / 'run_1.mcap', schema=b'float64 other\n', data=number(9.0))
    change(path, lambda found: found.update(relative_file_paths=['run_1.mcap', 'run_0.mcap']))
    other, *rest = [m.message for m in records.read_messages(path)]
    assert (other.other, [message.data for message in rest]) == (9, [1, 2])
    content = records.summary(path)
    assert (content.counts, content.start_ns, content.end_ns) == ({'/x': 3}, 1, 2)


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
    for read in (records.read_messages, records.summary,
                 lambda path: records.read_messages(path, recover=True)):
        with pytest.raises(records.BagReadError, match=words):
            read(path)


def test_directory_that_is_no_bag_and_broken_metadata(tmp_path: Path) -> None:
    with pytest.raises(records.BagReadError,
                       match=r'has no metadata\.yaml.*: set recover to true'):
        records.read_messages(tmp_path)
    with pytest.raises(records.BagReadError, match=r'has neither metadata\.yaml nor'):
        records.read_messages(tmp_path, recover=True)
    path = record(tmp_path / 'run')
    source = path / 'metadata.yaml'
    whole = source.read_text('utf-8')
    for text in ('', 'a: [', 'rosbag2_bagfile_information: 3', '- 1', '\x00',
                 *(whole.replace('\n  - run_0.mcap', f' {names}') for names in (
                     '[]', '3', 'run_0.mcap', '[run_0.mcap, run_0.mcap]', '[[a]]'))):
        source.write_text(text, encoding='utf-8')
        assert text != whole
        with pytest.raises(records.BagReadError,
                           match=r'metadata\.yaml.*is not the metadata of a'):
            records.read_messages(path)
    for written, other, kind in (
            ('storage_identifier: mcap', 'storage_identifier: sqlite3', 'sqlite3 files'),
            ("compression_format: ''", 'compression_format: lz4', 'mcap files .* with lz4')):
        source.write_text(whole.replace(written, other), encoding='utf-8')
        with pytest.raises(records.BagReadError, match=f"holds {kind}.* with 'ros2 bag convert'"):
            records.read_messages(path)
    (path / 'run_0.db3').touch()
    source.write_text(whole, encoding='utf-8')
    change(path, lambda found: found.update(
        storage_identifier='', relative_file_paths=['run_0.db3']))
    with pytest.raises(records.BagReadError, match=r'sqlite3 files.*ros2 bag convert'):
        records.read_messages(path)
    source.write_text(whole, encoding='utf-8')
    (path / 'run_0.mcap').unlink()
    with pytest.raises(records.BagReadError, match=r"lists 'run_0\.mcap', which is missing"):
        records.read_messages(path)


@pytest.mark.parametrize(('options', 'words'), [
    ({'encoding': 'json'}, r"'/x' is encoded as .*only cdr with ros2msg"),
    ({'schema_encoding': 'ros2idl'}, r"'/x' is encoded as .*only cdr with ros2msg"),
    ({'schema': b'other_msgs/Unknown data\n'}, 'is invalid'),
    # what rosbags does not know
    ({'schema': b'wstring data\n'}, 'is invalid'),
    ({'data': number(1.0)[:4]}, "the message on '/x' at 1 ns"),
    # a sequence of 4e9 elements whose bytes are not there
    ({'schema': b'Id[] ids\n' + b'=' * 80 + b'\nMSG: std_msgs/Id\nuint8[16] id\n',
      'data': number(1.0)[:4] + b'\xff\xff\xff\xff\x01'}, "the message on '/x' at 1 ns"),
    ({'schema': b'float64[] x\n', 'data': number(1.0)[:4] + b'\xff\xff\xff\xff\x01'},
     "the message on '/x' at 1 ns"),
    # the string ends before its declared length, with nothing behind it that would notice
    ({'schema': b'string x\n', 'data': number(1.0)[:4] + b'\x09\x00\x00\x00abc'},
     "the message on '/x' at 1 ns"),
])
def test_message_that_is_not_decoded(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    path = foreign(tmp_path / 'run.mcap', **options)
    with pytest.raises(records.BagReadError, match=words):
        list(records.read_messages(path, ['/x']))
    assert list(records.read_messages(path, ['/y'])) == []


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
    assert [m.message.data for m in records.read_messages(path)] == [3, 4]
    assert records.summary(path).complete


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
    begin = [m.data for m in records.read_messages(bare)]
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
    assert [m.data for m in records.read_messages(path, recover=True)] == [s.data for s in samples]


# The order of receipt, restored from the order in the file.


@pytest.mark.parametrize(('recorded', 'order'), [
    ((), []),
    ((1, 2, 3), [1, 2, 3]),
    # a recorder that fell behind wrote what waited topic by topic
    ((1, 4, 2, 3, 5), [1, 2, 3, 4, 5]),
    ((10, 5.5, 11, 6, 20), [5.5, 6, 10, 11, 20]),
    # the clock was set back: nothing of the later run goes ahead
    ((100, 101, 3, 4, 101, 102), [100, 101, 3, 4, 101, 102]),
    ((100, 99, 98, 1, 0.5, 2), [98, 99, 100, 0.5, 1, 2]),
    # and set forward
    ((1, 2, 1000, 1001), [1, 2, 1000, 1001]),
    # one time
    ((7, 7, 7), [7, 7, 7]),
])
def test_order_of_receipt(recorded: tuple[float, ...], order: list[float]) -> None:
    messages = [records.BagMessage('/x', '', round(time * SECOND), place, None, b'')
                for place, time in enumerate(recorded)]
    found = list(records.in_log_order(messages))
    assert [m.log_time_ns / SECOND for m in found] == order
    places = [m.publish_time_ns for m in found]
    assert sorted(places) == list(range(len(recorded)))
    assert len(set(recorded)) > 1 or places == sorted(places)


def test_messages_are_passed_on_before_the_last_is_read() -> None:
    recorded = (records.BagMessage('/x', '', k * SECOND, k, None, b'') for k in range(100))
    assert next(records.in_log_order(recorded)).log_time_ns == 0
    assert next(recorded).publish_time_ns < 10


# Offers.

# As rosbag2 (Jazzy) writes a discovered publisher of the default profile.
NEVER = '\n    sec: 9223372036\n    nsec: 854775807\n'
DISCOVERED = (
    '- history: unknown\n  depth: 0\n  reliability: reliable\n  durability: volatile\n'
    f'  deadline:{NEVER}  lifespan:{NEVER}  liveliness: automatic\n'
    f'  liveliness_lease_duration:{NEVER}  avoid_ros_namespace_conventions: false')


def test_offers_as_text_of_this_version_and_of_older_ones() -> None:
    discovered = DEFAULT_QOS._replace(history=QosHistory.UNKNOWN, depth=0)
    assert dump_offered_qos([]) == '[]'
    assert dump_offered_qos([discovered]) == DISCOVERED
    # equal ones are written out each
    assert parse_offered_qos(dump_offered_qos([discovered] * 2)) == (discovered, discovered)
    assert not {'&', '*'}.intersection(dump_offered_qos([discovered] * 2))
    assert parse_offered_qos(HUMBLE_OFFER) == (discovered._replace(
        reliability=QosReliability.BEST_EFFORT, durability=QosDurability.TRANSIENT_LOCAL,
        liveliness_lease_duration=QosTime(1, 500_000_000)),)
    for text in ('', 'x', '- 3', '- history: 1', '['):
        assert parse_offered_qos(text) == ()


@pytest.mark.parametrize(('ending', 'identifier'), [
    ('', ''), ('', None), ('.zstd', ''), ('.bag', '')])
def test_metadata_without_an_identifier_of_the_storage(
        tmp_path: Path, ending: str, identifier: str | None) -> None:
    """As `ros2 bag reindex` of Humble leaves it, whatever the files are called."""
    path = record(tmp_path / 'run', range(5))
    name = f'run_0.mcap{ending}' if ending != '.bag' else 'run.bag'
    content = (path / 'run_0.mcap').read_bytes()
    (path / 'run_0.mcap').unlink()
    (path / name).write_bytes(zstandard.compress(content) if ending == '.zstd' else content)
    change(path, lambda information: information.update(
        storage_identifier=identifier, relative_file_paths=[name],
        compression_format='zstd' if ending == '.zstd' else ''))
    assert [m.message.data for m in records.read_messages(path)] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert records.summary(path).complete


@pytest.mark.parametrize('name', [
    'run_{}.mcap', '{}_run_2025_12_17-10_{:02}_00.mcap',
    '{}_run_2025_12_17-10_{:02}_00.mcap.zstd'])
def test_files_that_no_metadata_lists_are_read_by_their_numbers(tmp_path: Path, name: str) -> None:
    path = tmp_path / 'run'
    path.mkdir()
    names = [name.format(k, k) for k in range(13)]
    for k, own in enumerate(names[:12]):
        content = record(tmp_path / f'{k}.mcap', [k]).read_bytes()
        (path / own).write_bytes(zstandard.compress(content) if own.endswith('.zstd') else content)
    (path / names[12]).touch()
    numbers = [float(k) for k in range(12)]
    assert [m.message.data for m in records.read_messages(path, recover=True)] == numbers
    # of another recording, and of none
    for other in ('other_3.mcap', 'notes.mcap'):
        shutil.copy(path / names[0], path / other)
    # as left by a recorder whose disk was full when it completed the second file
    (path / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': {
        'storage_identifier': 'mcap', 'relative_file_paths': [names[0], *names[2:10]],
        'compression_format': 'zstd' if name.endswith('.zstd') else ''}}))
    with pytest.raises(records.BagReadError, match=(
            rf"{re.escape(names[1])}' is not listed in metadata\.yaml, .*: set recover to true")):
        records.read_messages(path)
    assert not records.summary(path).complete
    assert [m.message.data for m in records.read_messages(path, recover=True)] == numbers


@pytest.mark.parametrize('schema', ['std_msgs/Float64', 'std_msgs/msg/Float64'])
@pytest.mark.parametrize('named', ['std_msgs/Float64', 'std_msgs/msg/Float64'])
def test_short_and_full_names_are_one_type(tmp_path: Path, schema: str, named: str) -> None:
    path = foreign(tmp_path / 'run.mcap', name=schema)
    for place in (MessageField('/x', named, 'data', '1'),
                  message_fields.place('/x', 'x', '1', {'type': named})):
        assert records.read_series(path, place).values.tolist() == [1.0]
    assert records.summary(path).types == {'/x': 'std_msgs/msg/Float64'}
    assert next(records.read_messages(path)).type_name == 'std_msgs/msg/Float64'


def test_topics_that_are_not_decoded_come_as_bytes_in_a_whole_bag(tmp_path: Path) -> None:
    """Of a service event, rosbag2 stores the text of the .srv file."""
    path = tmp_path / 'run.mcap'
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2')
        channels = [writer.register_channel(topic, encoding, writer.register_schema(
            kind, 'ros2msg', text)) for topic, encoding, kind, text in (
                ('/x', 'cdr', 'std_msgs/msg/Float64', b'float64 data\n'),
                ('/ask/_service_event', 'cdr', 'my_srvs/srv/Ask_Event', b'bool a\n---\nbool b\n'),
                ('/json', 'json', 'std_msgs/msg/Float64', b'float64 data\n'))]
        for k in range(9):
            writer.add_message(channels[k % 3], k, number(k), k)
        writer.finish()
    with pytest.warns(UserWarning, match='are returned as raw bytes') as said:
        found = list(records.read_messages(path))
    # once for each topic
    assert ['/_service_event' in str(one.message) for one in said] == [True, False]
    assert [m.data for m in found] == [number(k) for k in range(9)]
    assert [m.message and m.message.data for m in found] == [0.0, None, None, 3.0, None, None,
                                                             6.0, None, None]
    assert found[1].type_name == 'my_srvs/srv/Ask_Event'
    assert len(list(records.read_messages(path, ['/x']))) == 3
    with pytest.raises(records.BagReadError, match='is invalid'):
        list(records.read_messages(path, ['/ask/_service_event']))


@pytest.mark.parametrize(('kind', 'field'), [
    ('Char', 'data'), ('Byte', 'data'), ('UInt8', 'data'), ('Int8', 'data'),
    ('ByteMultiArray', 'data[1]'), ('UInt8MultiArray', 'data[1]'), ('Int8MultiArray', 'data[1]')])
def test_small_integers_are_the_same_live_and_from_a_bag(
        tmp_path: Path, kind: str, field: str) -> None:
    values = range(-128, 128) if kind.startswith('Int') else range(256)
    own = getattr(importlib.import_module('std_msgs.msg'), kind)
    serialize = importlib.import_module('rclpy.serialization').serialize_message
    place = MessageField('/x', f'std_msgs/msg/{kind}', field, '1')
    place.expect(own())
    live, path = [], tmp_path / 'run.mcap'
    with records.BagWriter(path) as writer:
        writer.add_topic('/x', records.message_definition(place.type))
        for k in values:
            one = bytes([k]) if kind.startswith('Byte') else k
            message = own(data=[one, one] if 'Array' in kind else one)
            live.append(place.get(message))
            writer.write('/x', serialize(message), k + 128)
    assert live == [float(k) for k in values]
    assert records.read_series(path, place).values.tolist() == live


def test_arrays_of_char_are_of_unsigned_numbers(tmp_path: Path) -> None:
    path = foreign(tmp_path / 'run.mcap', schema=b'char[<=3] a\nchar[2] b\nchar[] c\nchar D=7\n',
                   data=number(1.0)[:4] + b'\x02\0\0\0\xc8\xc9' + b'\xca\xcb' + b'\x01\0\0\0\xcc')
    found = next(records.read_messages(path)).message
    assert [list(found.a), list(found.b), list(found.c)] == [[200, 201], [202, 203], [204]]
