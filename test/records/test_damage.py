# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Bags that are cut, end in other bytes, or are damaged anywhere.

Complete records before the damage are read, nothing that was not recorded is, and a rejection is
one line. `BAG_MUTANTS=5000 pytest test/records/test_damage.py` tries that many of each kind.
"""

from collections.abc import Callable
import os
from pathlib import Path
import random
import resource
import shutil
import struct
from typing import Any, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message, Schema
from mcap.writer import CompressionType, MCAP0_MAGIC, Writer
import pytest
import zstandard

from koopman_ros import records
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import NANOSECONDS as SECOND
from support.bag_samples import compressed_files, loop_episodes, NUMBER, number

MUTANTS = int(os.environ.get('BAG_MUTANTS', '25'))
MESSAGES = 60  # on each of two topics
X, U = (MessageField(topic, NUMBER.type_name, 'data', '1') for topic in ('/x', '/u'))
STATE, INPUT = records.RecordedState('x', '1', X), records.RecordedInput('u', '1', U)
SENT = [(topic, number(k), k * SECOND) for k in range(MESSAGES) for topic in ('/x', '/u')]


class Kind(NamedTuple):
    """A way to write the messages."""

    write: Callable[..., dict[str, bytes]]  #: files by name, of a path
    options: dict[str, Any]
    guarded: bool = True  #: whether checksums tell any damage of a message


def ours(path: Path, **options: Any) -> dict[str, bytes]:
    with records.BagWriter(path, max_chunk_bytes=400, **options) as writer:
        for topic in ('/x', '/u'):
            writer.add_topic(topic, NUMBER)
        for topic, data, time_ns in SENT:
            writer.write(topic, data, time_ns)
    return {file.name: file.read_bytes() for file in (
        path.iterdir() if path.is_dir() else [path])}


def foreign(path: Path, compress: Callable[[bytes], bytes] = bytes, closed: bool = True,
            **options: Any) -> dict[str, bytes]:
    with path.open('wb') as stream:
        writer = Writer(stream, **{'chunk_size': 400, 'compression': CompressionType.NONE,
                                   **options})
        writer.start('ros2')
        schema = writer.register_schema(NUMBER.type_name, 'ros2msg', NUMBER.text.encode())
        channels = {topic: writer.register_channel(topic, 'cdr', schema) for topic in ('/x', '/u')}
        for topic, data, time_ns in SENT:
            writer.add_message(channels[topic], time_ns, compress(data), time_ns)
        if closed:
            writer.finish()
        else:
            writer.flush()
    return {path.name: path.read_bytes()}


KINDS = {
    **{compression: Kind(ours, {'compression': compression})
       for compression in ('none', 'zstd', 'lz4')},
    'folder': Kind(ours, {'max_file_bytes': 4000}),
    'messages compressed by rosbag2': Kind(foreign, {'compress': zstandard.compress}, False),
    'without checksums': Kind(foreign, {'enable_crcs': False}, False),
    'without chunks': Kind(foreign, {'use_chunking': False}, False),
    'killed': Kind(foreign, {'closed': False}),
    'killed, compressed': Kind(foreign, {'closed': False, 'compression': CompressionType.ZSTD}),
    'killed, without checksums': Kind(foreign, {'closed': False, 'enable_crcs': False}, False),
    'killed, without chunks': Kind(foreign, {'closed': False, 'use_chunking': False}, False)}


def written(folder: Path, name: str) -> tuple[Path, dict[str, bytes]]:
    """Write a bag of a kind; return its path and its files."""
    kind = KINDS[name]
    path = folder / ('run' if name == 'folder' else 'run.mcap')
    return path, kind.write(path, **kind.options)


def content(path: Path, *, recover: bool) -> list[tuple[str, bytes, int]]:
    return [(m.topic, m.data, m.log_time_ns) for m in records.read_messages(path, recover=recover)]


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


@pytest.mark.parametrize('name', [name for name in KINDS if name != 'folder'])
def test_cut_file_and_random_bytes_behind_it(tmp_path: Path, name: str) -> None:
    path, files = written(tmp_path, name)
    whole = files['run.mcap']
    # a tail completes no more than a chunk, or a message, without a checksum
    more = {'without checksums': 20, 'without chunks': 1}.get(name.removeprefix('killed, '), 0)
    for seed in range(MUTANTS):
        dice = random.Random(seed)
        cut = dice.choice([len(whole), dice.randrange(len(whole) // 2, len(whole) - 1)])
        path.write_bytes(whole[:cut])
        least = len(content(path, recover=True))
        path.write_bytes(whole[:cut] + tail(dice))
        with pytest.raises(records.BagReadError, match='set recover to true'):
            content(path, recover=False)
        found = content(path, recover=True)
        assert found[:least] == SENT[:least], seed
        assert least <= len(found) <= (least + more if least < len(SENT) else least), seed
        summary = records.summary(path)
        assert (summary.message_count, summary.complete) == (len(found), False), seed
        if cut == len(whole):
            assert len(found) == len(SENT)
            _, account = loop_episodes([path], [STATE], [INPUT])
            assert account.measurements == MESSAGES
            assert any('not closed or is damaged' in note for note in account.notes)


@pytest.mark.parametrize('compression', ['', 'zstd'])
@pytest.mark.parametrize('rest', [
    b'\x05', bytes(40), b'\x05' + bytes([200, 0, 0, 0, 0, 0, 0, 0]) + b'short',
    b'\x05\x04' + bytes(11), b'\xff' * 30, b'\x03' + b'\xff' * 20],
    ids=['head', 'zeros', 'cut', 'short', 'ones', 'schema'])
def test_other_bytes_within_a_chunk(tmp_path: Path, compression: str, rest: bytes) -> None:
    path = tmp_path / 'run.mcap'
    messages = [Message(channel_id=1, sequence=k, log_time=k, publish_time=k, data=number(k))
                for k in range(21)]

    def encoded(*parts: Any) -> bytes:
        builder = RecordBuilder()
        for one in parts:
            one.write(builder)
        return builder.end()

    packed = encoded(Schema(data=NUMBER.text.encode(), encoding='ros2msg', id=1,
                            name=NUMBER.type_name),
                     Channel(id=1, topic='/x', message_encoding='cdr', metadata={}, schema_id=1),
                     *messages[:20]) + rest
    chunk = Chunk(compression=compression, message_start_time=0, message_end_time=0,
                  data=zstandard.compress(packed) if compression else packed,
                  uncompressed_crc=0, uncompressed_size=len(packed))
    path.write_bytes(MCAP0_MAGIC + encoded(Header('ros2', ''), chunk, messages[20], DataEnd(0),
                                           Footer(0, 0, 0)) + MCAP0_MAGIC)
    with pytest.raises(records.BagReadError, match='is damaged'):
        content(path, recover=False)
    before = [float(k) for k in range(20)]
    assert records.read_series(path, X, recover=True).values.tolist() == before
    assert not records.summary(path).complete


# Values that lengths and counts are most likely to trip over.
WORDS = [0, 1, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1]


def mutated(dice: random.Random, whole: bytes) -> bytes:
    """Return the bytes with one to three kinds of damage."""
    for _ in range(dice.choice([1, 1, 1, 2, 3])):
        start = dice.randrange(len(whole) + 1)
        end = start + int(2 ** dice.uniform(0, 12))
        head, piece, rest = whole[:start], whole[start:end], whole[end:]
        word = struct.pack('<Q', dice.choice(WORDS))[:dice.choice([2, 4, 8])]
        flipped = bytes(byte ^ 1 << dice.randrange(8) for byte in piece[:1]) + piece[1:]
        # flip, cut, delete, repeat, blank, put a piece elsewhere, overwrite
        whole = dice.choice([
            head + flipped + rest, head + flipped + rest, head, head + rest,
            head + 2 * piece + rest, head + bytes(len(piece)) + rest, rest + head + piece,
            head + word + (piece + rest)[len(word):]])
    return whole


def attempt(read: Callable[[], Any]) -> Any:
    """Return the result, or None for a rejection of one line."""
    try:
        return read()
    except records.BagReadError as error:
        sentence = str(error)
    assert sentence.splitlines() == [sentence] != ['']
    return None


@pytest.mark.parametrize('name', [*(name for name in KINDS if 'killed' not in name),
                                  'files compressed by rosbag2'])
@pytest.mark.filterwarnings('ignore:messages on')
def test_damaged_bag_is_read_or_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    path, files = written(tmp_path, name if name in KINDS else 'folder')
    guarded = name not in KINDS or KINDS[name].guarded
    if name not in KINDS:
        files = compressed_files(files)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(MUTANTS):
        dice = random.Random(seed)
        mutants = dict(files)
        victim = dice.choice(sorted(files))
        if seed:
            mutants[victim] = mutated(dice, files[victim])
        if len(files) > 1 and dice.random() < 0.1:
            del mutants[dice.choice(sorted(files))]
        if path.is_dir():
            shutil.rmtree(path)
            path.mkdir()
        for file, data in mutants.items():
            (path / file if path.is_dir() else path).write_bytes(data)
        try:
            strict, recovered = (attempt(lambda recover=recover: content(path, recover=recover))
                                 for recover in (False, True))
            summary = attempt(lambda: records.summary(path))
            attempt(lambda: loop_episodes([path], [STATE], [INPUT]))
            if guarded:
                assert strict is None or strict == SENT
                assert recovered is None or set(recovered) <= set(SENT)
                assert summary is None or not summary.complete or (
                    summary.message_count == len(SENT))
        except Exception as error:
            raise AssertionError(f'{name}: the mutant of seed {seed}') from error
    # whatever a damaged length declares [KiB]
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024
    assert capsys.readouterr() == ('', '')
