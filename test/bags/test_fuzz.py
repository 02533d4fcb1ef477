# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Bags with random damage: they give a result or one clear sentence, and never what was not recorded.

`BAG_MUTANTS=5000 pytest test/bags/test_fuzz.py` tries that many of each kind instead of a few.
"""

from collections.abc import Callable
from dataclasses import dataclass
import os
from pathlib import Path
import random
import resource
import shutil
import struct
from typing import Any
import warnings

from mcap.writer import CompressionType, Writer
import pytest
import zstandard

from koopman_ros import bags
from support.bag_samples import compressed_files, Sample, TOPICS

MUTANTS = int(os.environ.get('BAG_MUTANTS', '40'))
ROUNDS = 8
KINDS = ['none', 'zstd', 'lz4', 'directory', 'files compressed by rosbag2',
         'messages compressed by rosbag2', 'without checksums', 'without chunks']
# What a process may grow by however many bytes a damaged length declares [KiB].
MEMORY = 200 * 1024
# Values that lengths and counts are most likely to trip over.
_WORDS = [0, 1, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1]


@dataclass(frozen=True)
class Specimen:
    """A whole bag: files by name ('' for a bare file), and whether checksums guard them all."""

    files: dict[str, bytes]
    guarded: bool


def specimens(folder: Path, samples: list[Sample]) -> dict[str, Specimen]:
    """Return whole bags that hold the same messages."""
    fill(folder / 'run', samples, max_file_bytes=6000)
    run = {file.name: file.read_bytes() for file in (folder / 'run').iterdir()}
    assert len(run) >= 3
    ours = {compression: fill(folder / f'{compression}.mcap', samples, compression=compression)
            for compression in ('none', 'zstd', 'lz4')}
    others = {
        'messages compressed by rosbag2': foreign(folder / '1', samples, zstandard.compress),
        'without checksums': foreign(folder / '2', samples, enable_crcs=False),
        'without chunks': foreign(folder / '3', samples, use_chunking=False)}
    return {
        **{kind: Specimen({'': path.read_bytes()}, guarded=True) for kind, path in ours.items()},
        **{kind: Specimen({'': content}, guarded=False) for kind, content in others.items()},
        'directory': Specimen(run, guarded=True),
        'files compressed by rosbag2': Specimen(compressed_files(run), guarded=True)}


def foreign(path: Path, samples: list[Sample],
            compress: Callable[[bytes], bytes] = lambda data: data,
            **options: bool) -> bytes:
    """Return an MCAP file of the samples as other programs write them."""
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=1500, compression=CompressionType.NONE, **options)
        writer.start('ros2')
        channels = {}
        for topic, type_name in TOPICS.items():
            text = bags.message_definition(type_name).text.encode()
            schema = writer.register_schema(type_name, 'ros2msg', text)
            channels[topic] = writer.register_channel(topic, 'cdr', schema)
        for sample in samples:
            writer.add_message(channels[sample.topic], sample.log_time_ns, compress(sample.data),
                               sample.publish_time_ns)
        writer.finish()
    return path.read_bytes()


def mutate(dice: random.Random, content: bytes) -> bytes:
    """Return the content with one to three kinds of damage."""
    for _ in range(dice.choice([1, 1, 1, 2, 3])):
        content = dice.choice(_DAMAGES)(dice, content)
    return content


def _pieces(dice: random.Random, content: bytes) -> tuple[bytes, bytes, bytes]:
    """Return what is before a place, a piece from there on, and the rest."""
    start = dice.randrange(len(content) + 1)
    end = start + int(2 ** dice.uniform(0, 12))
    return content[:start], content[start:end], content[end:]


def _flip(dice: random.Random, content: bytes) -> bytes:
    damaged = bytearray(content or b'\0')
    for _ in range(dice.choice([1, 1, 8])):
        damaged[dice.randrange(len(damaged))] ^= 1 << dice.randrange(8)
    return bytes(damaged)


def _cut(dice: random.Random, content: bytes) -> bytes:
    return content[:dice.randrange(len(content) + 1)]


def _rearrange(dice: random.Random, content: bytes) -> bytes:
    """Delete a piece, repeat it, blank it, or change its place with a later one."""
    head, piece, tail = _pieces(dice, content)
    between, later, end = _pieces(dice, tail)
    return head + dice.choice([b'', 2 * piece, bytes(len(piece)), later]) + (
        between + piece + end if dice.random() < 0.25 else tail)


def _overwrite(dice: random.Random, content: bytes) -> bytes:
    word = struct.pack('<Q', dice.choice(_WORDS))[:dice.choice([2, 4, 8])]
    head, piece, tail = _pieces(dice, content)
    return head + word + (piece + tail)[len(word):]


_DAMAGES = [_flip, _flip, _cut, _rearrange, _rearrange, _rearrange, _rearrange, _overwrite,
            _overwrite]


def fill(path: Path, samples: list[Sample], **options: Any) -> Path:
    """Write a bag of the samples."""
    with bags.BagWriter(path, max_chunk_bytes=1500, **options) as writer:
        for topic, type_name in TOPICS.items():
            writer.add_topic(topic, bags.message_definition(type_name))
        for sample in samples:
            writer.write(sample.topic, sample.data, sample.log_time_ns, sample.publish_time_ns)
    return path


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory, samples: list[Sample]) -> dict[str, Specimen]:
    return specimens(tmp_path_factory.mktemp('specimens'), samples[:ROUNDS * len(TOPICS)])


def _write(path: Path, files: dict[str, bytes]) -> Path:
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    for name, content in files.items():
        (path / (name or 'run.mcap')).write_bytes(content)
    return path / 'run.mcap' if '' in files else path


def _content(messages: list[bags.BagMessage]) -> list[tuple[str, bytes, int, int]]:
    return [(m.topic, m.data, m.log_time_ns, m.publish_time_ns) for m in messages]


def _attempt(read: Callable[[], object]) -> object:
    """Return what was read, or None for an error of one line."""
    try:
        return read()
    except bags.BagReadError as error:
        sentence = str(error)
    assert sentence
    assert sentence.splitlines() == [sentence]
    return None


def _check(path: Path, sent: list[tuple[str, bytes, int, int]], guarded: bool) -> None:
    strict = _attempt(lambda: _content(list(bags.read_messages(path))))
    recovered = _attempt(lambda: _content(list(bags.read_messages(path, recover=True))))
    if guarded:
        assert strict is None or strict == sent
        assert recovered is None or set(recovered) <= set(sent)
        content = _attempt(lambda: bags.summary(path))
        assert (not isinstance(content, bags.BagSummary) or not content.complete
                or content.message_count == len(sent))
    _attempt(lambda: bags.summary(path))
    _attempt(lambda: bags.read_series(path, '/temperature'))
    _attempt(lambda: bags.read_series(path, '/temperature', recover=True))


@pytest.mark.parametrize('kind', KINDS)
def test_bag_is_read_and_a_damaged_one_read_or_refused_in_one_line(
    tmp_path: Path, whole: dict[str, Specimen], samples: list[Sample],
    capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    sent = [(s.topic, s.data, s.log_time_ns, s.publish_time_ns)
            for s in samples[:ROUNDS * len(TOPICS)]]
    path = _write(tmp_path / 'bag', whole[kind].files)
    for recover in (False, True):
        assert _content(list(bags.read_messages(path, recover=recover))) == sent
    content = bags.summary(path)
    assert (content.counts, content.types, content.complete) == (
        dict.fromkeys(TOPICS, ROUNDS), TOPICS, True)
    assert len(bags.read_series(path, '/temperature').values) == ROUNDS
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(MUTANTS):
        dice = random.Random(seed)
        files = dict(whole[kind].files)
        victim = dice.choice(sorted(files))
        files[victim] = mutate(dice, files[victim])
        if len(files) > 1 and dice.random() < 0.1:
            del files[dice.choice(sorted(files))]
        path = _write(tmp_path / 'bag', files)
        try:
            with warnings.catch_warnings():
                # of a definition that is damaged
                warnings.simplefilter('ignore', UserWarning)
                _check(path, sent, whole[kind].guarded)
        except Exception as error:
            raise AssertionError(f'{kind}: the mutant of seed {seed}') from error
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY
    assert capsys.readouterr() == ('', '')
