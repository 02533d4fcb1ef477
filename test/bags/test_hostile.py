# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of some kilobytes that ask for gigabytes or minutes, and large ones that do not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
import subprocess
import sys
import tracemalloc

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, Schema
import pytest
import yaml
import zstandard

from koopman_ros.bags import BagReadError, BagWriter, MessageDefinition, read_messages, summary
from koopman_ros.bags.fields import fields_only
from koopman_ros.bags.qos import parse_offered_qos

MIB = 2**20
MAGIC = b'\x89MCAP0\r\n'
# a string and nothing else
TEXT = Schema(id=1, name='std_msgs/msg/String', encoding='ros2msg', data=b'string data')
CHANNEL = Channel(id=1, topic='/x', message_encoding='cdr', metadata={}, schema_id=1)
# each line names the one before ten times: thirty of them name more than there are atoms
LAUGHS = ['a0: &a0 [ha]'] + [f'a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 10)}]'
                             for k in range(1, 30)]
MERGES = ['m0: &m0 {a: 1}'] + [f'm{k}: &m{k} {{<<: [{", ".join([f"*m{k - 1}"] * 10)}]}}'
                               for k in range(1, 30)]


def encoded(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def message(data: bytes) -> Message:
    return Message(channel_id=1, sequence=0, log_time=1, publish_time=1, data=data)


def chunk(content: bytes) -> Chunk:
    return Chunk(compression='zstd', data=zstandard.compress(content), message_start_time=0,
                 message_end_time=0, uncompressed_crc=0, uncompressed_size=len(content))


def bag(path: Path, *data: bytes | McapRecord) -> Path:
    """Write a closed file of these records, without a summary."""
    body = b''.join(part if isinstance(part, bytes) else encoded(part) for part in data)
    path.write_bytes(MAGIC + encoded(Header('ros2', '')) + body + encoded(
        DataEnd(data_section_crc=0), Footer(0, 0, 0)) + MAGIC)
    return path


def peak(call: Callable[[], object]) -> float:
    """Return the memory that a call takes, in MiB."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1] / MIB
    finally:
        tracemalloc.stop()


def large(mebibytes: int) -> bytes:
    """Return a message of one string of zeros, compressed as rosbag2 does it."""
    size = mebibytes * MIB
    head = b'\x00\x01\x00\x00' + (size - 8).to_bytes(4, 'little')
    compressor = zstandard.ZstdCompressor().compressobj(size=size)
    return b''.join([compressor.compress(head + bytes(MIB - 8)), *(
        compressor.compress(bytes(MIB)) for _ in range(mebibytes - 1)), compressor.flush()])


@pytest.mark.parametrize('inside', [True, False])
@pytest.mark.parametrize(('size', 'recovers', 'words'), [
    (256, True, 'is damaged .a zstd frame that declares 268435456 bytes'),
    (3, False, 'grows to more than 1000 times its size in messages, which no recording does'),
])
def test_compressed_messages_that_grow(
        tmp_path: Path, inside: bool, size: int, recovers: bool, words: str) -> None:
    content = encoded(TEXT, CHANNEL) + encoded(message(large(size))) * 100
    path = bag(tmp_path / 'run.mcap', chunk(content) if inside else content)

    def read() -> None:
        with pytest.raises(BagReadError, match=words):
            list(read_messages(path))
        if recovers:
            assert list(read_messages(path, recover=True)) == []
        else:
            with pytest.raises(BagReadError, match=words):
                list(read_messages(path, recover=True))
        # nobody asks what the messages are, and those of other topics are passed over
        assert summary(path).counts == {'/x': 100}
        assert list(read_messages(path, ['/y'])) == []

    assert peak(read) < 50


@pytest.mark.parametrize(('count', 'words'), [
    # 31 bytes each
    (8_600_000, 'is damaged .a chunk that declares 266600000 bytes'),
    (2_000_000, 'grows to more records than bytes, which no recording does'),
])
def test_millions_of_empty_messages(tmp_path: Path, count: int, words: str) -> None:
    one = encoded(message(b''))
    path = bag(tmp_path / 'run.mcap', TEXT, CHANNEL, chunk(one * count))
    assert path.stat().st_size < 2**15
    if count > 5_000_000:
        with pytest.raises(BagReadError, match=words):
            list(read_messages(path))
        assert peak(lambda: list(read_messages(path, recover=True))) < 10
        return
    for recover in (False, True):
        messages = read_messages(path, recover=recover)
        # before the first of them
        with pytest.raises(BagReadError, match=words):
            next(messages)
    with pytest.raises(BagReadError, match=words):
        summary(path)


def test_zeros_in_place_of_records(tmp_path: Path) -> None:
    path = bag(tmp_path / 'run.mcap', chunk(bytes(60 * MIB)))
    with pytest.raises(BagReadError, match=r'is damaged .zeros in place of a record'):
        list(read_messages(path))
    assert list(read_messages(path, recover=True)) == []
    assert not summary(path).complete


@pytest.mark.parametrize('lines', [LAUGHS, MERGES])
def test_aliases_in_the_metadata(tmp_path: Path, lines: Sequence[str]) -> None:
    (folder := tmp_path / 'run').mkdir()
    last = f'x: *{lines[-1].partition(":")[0]}'
    (folder / 'metadata.yaml').write_text('\n'.join(
        [*lines, last, 'rosbag2_bagfile_information:', '  relative_file_paths: [run_0.mcap]']))
    for function in (summary, read_messages):
        with pytest.raises(BagReadError, match='aliases are not read in the metadata of a bag'):
            function(folder)


def test_merges_and_aliases_in_the_offers_of_a_topic() -> None:
    for text in ('\n'.join([*LAUGHS, '- *a29']), '- {<<: {history: keep_last}}', '- &a [*a]'):
        assert parse_offered_qos(text) == ()


def test_offers_are_read_up_to_a_limit(tmp_path: Path) -> None:
    text = '- ' + yaml.safe_dump({f'key_{k}': 'x' for k in range(3000)}).replace('\n', '\n  ')
    channels = [Channel(id=k, topic=f'/{k}', message_encoding='cdr', schema_id=1, metadata={
        'offered_qos_profiles': f'{text}# {k}'}) for k in range(40)]
    messages = [Message(channel_id=k, sequence=0, log_time=1, publish_time=1, data=b'')
                for k in range(40)]
    path = bag(tmp_path / 'run.mcap', chunk(encoded(TEXT, *channels, *messages)))
    tried: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('koopman_ros.bags.reader.parse_offered_qos',
                      lambda text: tried.append(text) or ())
        assert len(summary(path).counts) == 40
    assert 0 < sum(len(text) for text in tried) <= 2**18


def test_one_file_under_many_names(tmp_path: Path) -> None:
    (folder := tmp_path / 'run').mkdir()
    bag(folder / 'run_0.mcap', TEXT, CHANNEL, message(b'\x00\x01\x00\x00\x00\x00\x00\x00'))
    (folder / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': {
        'storage_identifier': 'mcap', 'relative_file_paths': [
            './' * k + 'run_0.mcap' for k in range(50)]}}))
    with pytest.raises(BagReadError, match='lists one file under two names'):
        read_messages(folder)


@pytest.mark.parametrize('text', [
    # what the definition parser looks for in each goes on for ever
    f'uint8 {"A" * 60}!=1\nstring data',
    f'#{" " * 100_000}x\nstring data',
    'string data # ' + 'x' * 1000,
    'string data "' + "\\'" * 50_000 + '"',
    'uint8 KIND=1\nstring MARK = "# # ="\n\n# [m]\n  # [s]\nstring data',
])
def test_definitions_are_read_without_what_no_message_needs(tmp_path: Path, text: str) -> None:
    assert fields_only(text.encode()) == b'string data'
    path = tmp_path / 'run.mcap'
    with BagWriter(path, compression='zstd') as writer:
        writer.add_topic('/x', MessageDefinition('std_msgs/msg/X', text, 'RIHS01_' + 'a' * 64))
        writer.write('/x', b'\x00\x01\x00\x00\x04\x00\x00\x00abc\0', 1)
    assert [entry.message.data for entry in read_messages(path)] == ['abc']


@pytest.mark.parametrize(('text', 'words'), [
    (' ' * 2 * MIB, 'does not parse .DamageError 2097152 bytes'),
    ('\n'.join(f'uint8 a{k}' for k in range(20_000)), 'does not parse .DamageError 20000 fields'),
])
def test_definitions_without_end(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / 'run.mcap'
    with BagWriter(path, compression='zstd') as writer:
        writer.add_topic('/x', MessageDefinition('std_msgs/msg/X', text, 'RIHS01_' + 'a' * 64))
        writer.write('/x', b'\x00\x01\x00\x00', 1)
    with pytest.raises(BagReadError, match=words):
        list(read_messages(path))


def test_many_definitions(tmp_path: Path) -> None:
    # eight bytes for each pair of empty strings
    metadata = (40 * MIB).to_bytes(4, 'little') + bytes(40 * MIB)
    body = b'\x01\x00\x01\x00' + b'\x02\x00\x00\x00/x' + b'\x03\x00\x00\x00cdr' + metadata
    record = b'\x04' + len(body).to_bytes(8, 'little') + body
    path = bag(tmp_path / 'run.mcap', TEXT, chunk(record))
    with pytest.raises(BagReadError, match='grows to more records than bytes'):
        list(read_messages(path, recover=True))


def test_chunk_in_the_summary(tmp_path: Path) -> None:
    """The library expands whatever stands there, declared at any size."""
    path = tmp_path / 'run.mcap'
    bomb = Chunk(compression='zstd', data=large(200), message_start_time=0, message_end_time=0,
                 uncompressed_crc=0, uncompressed_size=200 * MIB)
    start = MAGIC + encoded(Header('ros2', ''), TEXT, CHANNEL, DataEnd(data_section_crc=0))
    path.write_bytes(start + encoded(bomb, Footer(len(start), 0, 0)) + MAGIC)
    assert peak(lambda: (summary(path), list(read_messages(path)))) < 10


# What is large and honest.


def test_topics_beside_pictures_that_are_all_the_same(tmp_path: Path) -> None:
    """A simulated camera in an empty world shrinks ten thousandfold."""
    definition = MessageDefinition('std_msgs/msg/String', 'string data', 'RIHS01_' + 'a' * 64)
    path = tmp_path / 'run.mcap'
    picture = b'\x00\x01\x00\x00' + (2 * MIB - 8).to_bytes(4, 'little') + bytes(2 * MIB - 8)
    with BagWriter(path, compression='zstd') as writer:
        for topic in ('/picture', '/text'):
            writer.add_topic(topic, definition)
        for k in range(60):
            writer.write('/picture', picture, k)
            writer.write('/text', b'\x00\x01\x00\x00\x02\x00\x00\x00a\0', k)
    assert path.stat().st_size < 2**15
    assert [entry.message.data for entry in read_messages(path, ['/text'])] == ['a'] * 60
    assert summary(path).counts == {'/picture': 60, '/text': 60}


def test_long_bag_that_shrinks_as_far_as_one_can(tmp_path: Path) -> None:
    """At rest, without noise, at a round rate: nothing but the times changes."""
    definition = MessageDefinition('std_msgs/msg/String', 'string data', 'RIHS01_' + 'a' * 64)
    path = tmp_path / 'run.mcap'
    text = b'\x00\x01\x00\x00\xe9\x03\x00\x00' + b'x' * 1000 + b'\0'
    with BagWriter(path, compression='zstd', max_chunk_bytes=64 * MIB) as writer:
        writer.add_topic('/x', definition)
        for k in range(30_000):
            writer.write('/x', text, k * 2**24)
    size = path.stat().st_size
    assert 30_000 * len(text) > 40 * size
    assert sum(1 for _ in read_messages(path)) == 30_000


def test_memory_that_does_not_suffice_is_no_damage(tmp_path: Path) -> None:
    definition = MessageDefinition('std_msgs/msg/String', 'string data', 'RIHS01_' + 'a' * 64)
    path = tmp_path / 'run.mcap'
    with BagWriter(path) as writer:
        writer.add_topic('/x', definition)
        writer.write('/x', b'\x00\x01\x00\x00' + (20 * MIB).to_bytes(4, 'little')
                     + b'x' * 20 * MIB, 1)
    program = """
import resource, sys
from koopman_ros.bags import BagReadError, read_messages
pages = int(open('/proc/self/statm').read().split()[0])
limit = pages * resource.getpagesize() + 30 * 2**20
for allowed in (limit, resource.RLIM_INFINITY):
    resource.setrlimit(resource.RLIMIT_AS, (allowed, resource.RLIM_INFINITY))
    for recover in (False, True):
        try:
            print(len(list(read_messages(sys.argv[1], recover=recover))))
        except BagReadError as error:
            print(error)
"""
    ended = subprocess.run([sys.executable, '-c', program, str(path)],
                           capture_output=True, text=True, timeout=60, check=False)
    refusal = f"memory does not suffice to read '{path}': free some, or read fewer topics"
    assert (ended.stdout.splitlines(), ended.stderr) == ([refusal, refusal, '1', '1'], '')
