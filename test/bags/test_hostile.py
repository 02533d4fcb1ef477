# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of some kilobytes that would take gigabytes or minutes, and large ones that do not."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import subprocess
import sys
import tracemalloc

import lz4.frame
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, Schema
import pytest
import yaml
import zstandard

from koopman_ros.bags import BagReadError, BagWriter, read_messages, summary
from koopman_ros.bags.limits import fields_only
from koopman_ros.bags.metadata import parse_offered_qos
from support.bag_samples import HEAD, Sample, TEXT, text

MIB = 2**20
MAGIC = b'\x89MCAP0\r\n'
# a string and nothing else
SCHEMA = Schema(id=1, name='std_msgs/msg/String', encoding='ros2msg', data=b'string data')
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
    return declaring('zstd', zstandard.compress(content), len(content))


def bag(path: Path, *data: bytes | McapRecord) -> Path:
    """Write a closed file of these records, without a summary."""
    body = b''.join(part if isinstance(part, bytes) else encoded(part) for part in data)
    path.write_bytes(MAGIC + encoded(Header('ros2', '')) + body + encoded(
        DataEnd(data_section_crc=0), Footer(0, 0, 0)) + MAGIC)
    return path


def refused(path: Path, words: str, recovers: bool) -> None:
    """Check that a bag is refused, and whether recovery passes over what is wrong with it."""
    with pytest.raises(BagReadError, match=words):
        list(read_messages(path, ['/x']))
    if recovers:
        assert list(read_messages(path, ['/x'], recover=True)) == []
    else:
        with pytest.raises(BagReadError, match=words):
            list(read_messages(path, ['/x'], recover=True))


def peak(call: Callable[[], object]) -> float:
    """Return the memory that a call takes, in MiB."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1] / MIB
    finally:
        tracemalloc.stop()


def zstd_stream(mebibytes: int, head: bytes = b'', declared: bool = True) -> bytes:
    """Return so many mebibytes in a frame: a beginning, and zeros."""
    compressor = zstandard.ZstdCompressor().compressobj(size=mebibytes * MIB if declared else -1)
    return b''.join([compressor.compress(head + bytes(MIB - len(head))), *(
        compressor.compress(bytes(MIB)) for _ in range(mebibytes - 1)), compressor.flush()])


def large(mebibytes: int) -> bytes:
    """Return a message of one string of zeros, compressed as rosbag2 does it."""
    return zstd_stream(mebibytes, HEAD + (mebibytes * MIB - 8).to_bytes(4, 'little'))


def declaring(compression: str, data: bytes, size: int) -> Chunk:
    return Chunk(compression=compression, data=data, message_start_time=0, message_end_time=0,
                 uncompressed_crc=0, uncompressed_size=size)


@pytest.mark.parametrize(('chunk', 'words'), [
    (declaring('', b'', 2**60), 'declares 1152921504606846976 bytes'),
    (declaring('', b'abc', 4), 'a chunk of 3 bytes that declares 4'),
    (declaring('zstd', zstd_stream(100), 1000), 'a zstd frame that declares'),
    (declaring('zstd', zstd_stream(100, declared=False), 1000), 'ZstdError'),
    (declaring('zstd', zstandard.compress(b'abc')[:-1], 3), 'ZstdError'),
    (declaring('lz4', lz4.frame.compress(bytes(20 * MIB)), 1000), 'a chunk of 1001 bytes'),
    (declaring('lz4', lz4.frame.compress(b'abc')[:-8], 3), 'a chunk of 0 bytes'),
    (declaring('lz4', b'\x04"M\x18' + bytes(20), 1000), 'RuntimeError'),
    (declaring('snappy', b'abc', 3), "compressed with 'snappy'"),
])
def test_chunk_that_is_not_what_it_declares(tmp_path: Path, chunk: Chunk, words: str) -> None:
    path = tmp_path / 'run.mcap'

    def read() -> None:
        path.write_bytes(MAGIC + encoded(chunk))
        assert list(read_messages(path, recover=True)) == []
        assert not summary(path).complete
        with path.open('ab') as stream:
            stream.write(encoded(Footer(0, 0, 0)) + MAGIC)
        with pytest.raises(BagReadError, match=f'is damaged .*{words}'):
            list(read_messages(path))

    assert peak(read) < 10


def test_compressed_file_that_grows_beyond_reason(tmp_path: Path) -> None:
    path = tmp_path / 'run.mcap.zstd'
    path.write_bytes(zstd_stream(100))
    for function in (read_messages, summary):
        with pytest.raises(BagReadError, match='grows to more than 1000 times its size'):
            function(path)


def test_compressed_file_that_is_cut_reads_up_to_there(
    tmp_path: Path, write_bag: Callable[..., Path], samples: list[Sample]
) -> None:
    content = write_bag(tmp_path / 'run.mcap', max_chunk_bytes=1000).read_bytes()
    # blocks of their own, as rosbag2 writes them
    compressor = zstandard.ZstdCompressor().compressobj()
    pieces = [compressor.compress(content[start:start + 1000])
              + compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
              for start in range(0, len(content), 1000)]
    path = tmp_path / 'cut.mcap.zstd'
    path.write_bytes(b''.join(pieces[:len(pieces) // 2]))
    with pytest.raises(BagReadError, match='is cut short'):
        read_messages(path)
    found = [m.data for m in read_messages(path, recover=True)]
    assert 10 < len(found) < len(samples)
    assert found == [s.data for s in samples[:len(found)]]


@pytest.mark.parametrize('inside', [True, False])
@pytest.mark.parametrize(('size', 'recovers', 'words'), [
    (256, True, 'is damaged .a zstd frame that declares 268435456 bytes'),
    (3, False, 'grows to more than 1000 times its size in messages, which no recording does'),
])
def test_compressed_messages_that_grow(
        tmp_path: Path, inside: bool, size: int, recovers: bool, words: str) -> None:
    content = encoded(SCHEMA, CHANNEL) + encoded(message(large(size))) * 100
    path = bag(tmp_path / 'run.mcap', chunk(content) if inside else content)

    def read() -> None:
        refused(path, words, recovers)
        # nobody asks what the messages are, and those of other topics are passed over
        assert summary(path).counts == {'/x': 100}
        assert list(read_messages(path, ['/y'])) == []

    assert peak(read) < 50


@pytest.mark.parametrize(('count', 'recovers', 'words'), [
    # 31 bytes each
    (8_600_000, True, 'is damaged .a chunk that declares 266600000 bytes'),
    (400_000, False, 'grows to more records than bytes, which no recording does'),
])
def test_millions_of_empty_messages(
        tmp_path: Path, count: int, recovers: bool, words: str) -> None:
    path = bag(tmp_path / 'run.mcap', SCHEMA, CHANNEL, chunk(encoded(message(b'')) * count))
    assert path.stat().st_size < 2**15
    # before the first of them
    assert peak(lambda: refused(path, words, recovers)) < 30
    if not recovers:
        with pytest.raises(BagReadError, match=words):
            summary(path)


def test_zeros_in_place_of_records(tmp_path: Path) -> None:
    path = bag(tmp_path / 'run.mcap', chunk(bytes(60 * MIB)))
    refused(path, 'is damaged .62914560 bytes of a chunk that are no record', recovers=True)
    assert not summary(path).complete


def test_aliases_and_merges_in_the_metadata_and_the_offers(tmp_path: Path) -> None:
    for lines in (LAUGHS, MERGES):
        (tmp_path / 'metadata.yaml').write_text('\n'.join(
            [*lines, f'x: *{lines[-1].partition(":")[0]}', 'rosbag2_bagfile_information:',
             '  relative_file_paths: [run_0.mcap]']))
        for function in (summary, read_messages):
            with pytest.raises(BagReadError, match='aliases are not read in the metadata of a'):
                function(tmp_path)
    for offers in ('\n'.join([*LAUGHS, '- *a29']), '- {<<: {history: keep_last}}', '- &a [*a]'):
        assert parse_offered_qos(offers) == ()


def test_offers_are_read_up_to_a_limit(tmp_path: Path) -> None:
    offer = '- ' + yaml.safe_dump({f'key_{k}': 'x' for k in range(3000)}).replace('\n', '\n  ')
    channels = [Channel(id=k, topic=f'/{k}', message_encoding='cdr', schema_id=1, metadata={
        'offered_qos_profiles': f'{offer}# {k}'}) for k in range(40)]
    messages = [Message(channel_id=k, sequence=0, log_time=1, publish_time=1, data=b'')
                for k in range(40)]
    path = bag(tmp_path / 'run.mcap', chunk(encoded(SCHEMA, *channels, *messages)))
    tried: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('koopman_ros.bags.reader.parse_offered_qos',
                      lambda text: tried.append(text) or ())
        assert len(summary(path).counts) == 40
    assert 0 < sum(len(text) for text in tried) <= 2**18


def test_one_file_under_many_names(tmp_path: Path) -> None:
    bag(tmp_path / 'run_0.mcap', SCHEMA, CHANNEL, message(text(b'')))
    (tmp_path / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': {
        'storage_identifier': 'mcap', 'relative_file_paths': [
            './' * k + 'run_0.mcap' for k in range(50)]}}))
    with pytest.raises(BagReadError, match='lists one file under two names'):
        read_messages(tmp_path)


@pytest.mark.parametrize(('definition', 'words'), [
    # what the definition parser looks for in each goes on for ever
    (f'uint8 {"A" * 60}!=1\nstring data', ''),
    (f'#{" " * 100_000}x\nstring data', ''),
    ('string data # ' + 'x' * 1000, ''),
    ('string data "' + "\\'" * 50_000 + '"', ''),
    ('uint8 KIND=1\nstring MARK = "# # ="\n\n# [m]\n  # [s]\nstring data', ''),
    (' ' * 2 * MIB, 'does not parse .DamageError 2097152 bytes'),
    ('\n'.join(f'uint8 a{k}' for k in range(20_000)), 'does not parse .DamageError 20000 fields'),
])
def test_definitions_without_end_and_with_what_no_message_needs(
        tmp_path: Path, definition: str, words: str) -> None:
    path = tmp_path / 'run.mcap'
    with BagWriter(path, compression='zstd') as writer:
        writer.add_topic('/x', replace(TEXT, text=definition))
        writer.write('/x', text(b'abc'), 1)
    if words:
        refused(path, words, recovers=False)
    else:
        assert fields_only(definition.encode()) == b'string data'
        assert [entry.message.data for entry in read_messages(path)] == ['abc']


def test_many_definitions(tmp_path: Path) -> None:
    # eight bytes for each pair of empty strings
    metadata = (40 * MIB).to_bytes(4, 'little') + bytes(40 * MIB)
    body = b'\x01\x00\x01\x00' + b'\x02\x00\x00\x00/x' + b'\x03\x00\x00\x00cdr' + metadata
    record = b'\x04' + len(body).to_bytes(8, 'little') + body
    path = bag(tmp_path / 'run.mcap', SCHEMA, chunk(record))
    refused(path, 'grows to more records than bytes', recovers=False)


def test_chunk_in_the_summary(tmp_path: Path) -> None:
    """The library expands whatever stands there, declared at any size."""
    path = tmp_path / 'run.mcap'
    bomb = declaring('zstd', large(200), 200 * MIB)
    start = MAGIC + encoded(Header('ros2', ''), SCHEMA, CHANNEL, DataEnd(data_section_crc=0))
    path.write_bytes(start + encoded(bomb, Footer(len(start), 0, 0)) + MAGIC)
    assert peak(lambda: (summary(path), list(read_messages(path)))) < 10


# What is large and honest.


def test_topics_beside_pictures_that_are_all_the_same(tmp_path: Path) -> None:
    """A simulated camera in an empty world shrinks ten thousandfold."""
    path = tmp_path / 'run.mcap'
    picture = text(bytes(2 * MIB))
    with BagWriter(path, compression='zstd') as writer:
        for topic in ('/picture', '/text'):
            writer.add_topic(topic, TEXT)
        for k in range(60):
            writer.write('/picture', picture, k)
            writer.write('/text', text(b'a'), k)
    assert path.stat().st_size < 2**15
    assert [entry.message.data for entry in read_messages(path, ['/text'])] == ['a'] * 60
    assert summary(path).counts == {'/picture': 60, '/text': 60}


def test_long_bag_that_shrinks_as_far_as_one_can(tmp_path: Path) -> None:
    """At rest, without noise, at a round rate: nothing but the times changes."""
    path = tmp_path / 'run.mcap'
    entry = text(b'x' * 1000)
    with BagWriter(path, compression='zstd', max_chunk_bytes=64 * MIB) as writer:
        writer.add_topic('/x', TEXT)
        for k in range(12_000):
            writer.write('/x', entry, k * 2**24)
    size = path.stat().st_size
    assert 12_000 * len(entry) > 40 * size
    assert sum(1 for _ in read_messages(path)) == 12_000


def test_memory_that_does_not_suffice_is_no_damage(tmp_path: Path) -> None:
    path = tmp_path / 'run.mcap'
    with BagWriter(path) as writer:
        writer.add_topic('/x', TEXT)
        writer.write('/x', text(b'x' * 20 * MIB), 1)
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
