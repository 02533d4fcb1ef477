# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Bags that end in other bytes: all messages before are read, with a note, or the bag is refused.

`BAG_TAILS=2000 pytest test/bags/test_tails.py` tries that many of each kind instead of a few.
"""

import os
from pathlib import Path
import random
import struct
import zlib

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message, Schema
from mcap.writer import CompressionType, Writer
import pytest
import zstandard

from koopman_ros import bags
from koopman_ros.wire import Place
from support.bag_samples import NUMBER, number

TAILS = int(os.environ.get('BAG_TAILS', '40'))
MESSAGES = 60
SECOND = 10**9
X = Place('/x', NUMBER.type_name, 'data', '1')
U = Place('/u', NUMBER.type_name, 'data', '1')
STATE, INPUT = bags.RecordedState('x', '1', X), bags.RecordedInput('u', '1', U)
KINDS = {
    'closed': (True, {}), 'killed': (False, {}),
    'killed, compressed': (False, {'compression': CompressionType.ZSTD}),
    'killed, without checksums': (False, {'enable_crcs': False}),
    'killed, without chunks': (False, {'use_chunking': False})}


def written(path: Path, closed: bool, **options: object) -> bytes:
    """Write two numbers a second, and return the bytes of the file."""
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=400, **{'compression': CompressionType.NONE, **options})
        writer.start('ros2')
        schema = writer.register_schema(NUMBER.type_name, 'ros2msg', NUMBER.text.encode())
        channels = [writer.register_channel(topic, 'cdr', schema) for topic in ('/x', '/u')]
        for k in range(MESSAGES):
            for channel in channels:
                writer.add_message(channel, k * SECOND, number(k), k * SECOND)
        if closed:
            writer.finish()
        else:
            writer.flush()
    return path.read_bytes()


def tail(dice: random.Random) -> bytes:
    """Return bytes that a disk may hold after a recording."""
    return dice.choice([
        lambda: dice.randbytes(dice.choice([1, 8, 9, 30, 500, 5000])),
        lambda: bytes(dice.randrange(1, 5000)),
        lambda: b'No space left on device\n' * dice.randrange(1, 50),
        # as a record may begin: any kind, any length
        lambda: struct.pack('<BQ', dice.randrange(0, 256), dice.choice(
            [0, 1, 4, 22, 60, 2**31, 2**63])) + dice.randbytes(dice.randrange(0, 200)),
        lambda: struct.pack('<BQ', dice.choice([Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK]),
                            dice.randrange(2**64)) + dice.randbytes(dice.randrange(0, 200)),
    ])()


def checked(path: Path, least: int, most: int) -> None:
    """Check that some messages at least are read, in order, with a note; most are whole."""
    with pytest.raises(bags.BagReadError):
        list(bags.read_messages(path))
    found = [(m.topic, m.log_time_ns, m.data) for m in bags.read_messages(path, recover=True)]
    sent = [(topic, k * SECOND, number(k)) for k in range(MESSAGES) for topic in ('/x', '/u')]
    assert found[:least] == sent[:least]
    assert least <= len(found) <= most
    content = bags.summary(path)
    assert not content.complete
    assert content.message_count == len(found)
    if least < 50:
        return
    _, account = bags.loop_episodes([path], [STATE], [INPUT])
    assert account.measurements == content.counts['/x']
    assert any('not closed or is damaged' in note for note in account.notes)


@pytest.mark.parametrize('kind', KINDS)
def test_random_bytes_after_the_messages(tmp_path: Path, kind: str) -> None:
    path = tmp_path / 'run.mcap'
    closed, options = KINDS[kind]
    whole = written(path, closed, **options)
    for seed in range(TAILS):
        dice = random.Random(seed)
        path.write_bytes(whole + tail(dice))
        try:
            checked(path, 2 * MESSAGES, 2 * MESSAGES)
        except Exception as error:
            raise AssertionError(f'{kind}: the tail of seed {seed}') from error


@pytest.mark.parametrize('kind', KINDS)
def test_random_bytes_after_a_file_that_was_cut(tmp_path: Path, kind: str) -> None:
    path = tmp_path / 'run.mcap'
    closed, options = KINDS[kind]
    whole = written(path, closed, **options)
    for seed in range(TAILS):
        dice = random.Random(seed)
        cut = whole[:dice.randrange(len(whole) // 2, len(whole) - 1)]
        path.write_bytes(cut)
        before = sum(1 for _ in bags.read_messages(path, recover=True))
        path.write_bytes(cut + tail(dice))
        # what the tail completes is no more than a chunk, or a message without a checksum
        more = {'killed, without checksums': 20, 'killed, without chunks': 1}.get(kind, 0)
        try:
            checked(path, before, before + more)
        except Exception as error:
            raise AssertionError(f'{kind}: the tail of seed {seed}') from error


def encoded(*records: object) -> bytes:
    builder = RecordBuilder()
    for one in records:
        one.write(builder)  # type: ignore[attr-defined]
    return builder.end()


@pytest.mark.parametrize('compression', ['', 'zstd'])
@pytest.mark.parametrize('checksum', [True, False])
@pytest.mark.parametrize('rest', [
    b'\x05', bytes(40), b'\x05' + bytes([200, 0, 0, 0, 0, 0, 0, 0]) + b'short',
    b'\xff' * 30, b'\x03' + b'\xff' * 20], ids=['head', 'zeros', 'short', 'ones', 'schema'])
def test_other_bytes_within_a_chunk(tmp_path: Path, compression: str, checksum: bool, rest: bytes
                                    ) -> None:
    path = tmp_path / 'run.mcap'
    messages = [Message(channel_id=1, sequence=k, log_time=k * SECOND, publish_time=k * SECOND,
                        data=number(k)) for k in range(21)]
    content = encoded(Schema(data=NUMBER.text.encode(), encoding='ros2msg', id=1,
                             name=NUMBER.type_name),
                      Channel(id=1, topic='/x', message_encoding='cdr', metadata={}, schema_id=1),
                      *messages[:20]) + rest
    data = zstandard.compress(content) if compression else content
    whole = Chunk(compression=compression, data=data, message_start_time=0, message_end_time=0,
                  uncompressed_crc=zlib.crc32(content) if checksum else 0,
                  uncompressed_size=len(content))
    last = encoded(messages[20])
    path.write_bytes(b'\x89MCAP0\r\n' + encoded(Header('ros2', ''), whole) + last + encoded(
        DataEnd(0), Footer(0, 0, 0)) + b'\x89MCAP0\r\n')
    with pytest.raises(bags.BagReadError, match='is damaged'):
        list(bags.read_messages(path))
    before = [float(k) for k in range(20)]
    assert [m.message.data for m in bags.read_messages(path, recover=True)] == before
    assert bags.read_series(path, X, recover=True).values.tolist() == before
    assert not bags.summary(path).complete
