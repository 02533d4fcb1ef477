# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags whose recorder was killed, and bags whose bytes were damaged."""

from collections.abc import Callable
from pathlib import Path
import shutil
import struct

from mcap.opcode import Opcode
from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk, StreamReader
import pytest

from koopman_ros.bags import BagReadError, read_messages, summary
from support.bag_samples import Sample

WriteBag = Callable[..., Path]

MAGIC_SIZE = 8
COMPRESSIONS = pytest.mark.parametrize('compression', ['none', 'zstd', 'lz4'])


@pytest.fixture(scope='module')
def samples(samples: list[Sample]) -> list[Sample]:
    """Return those of two topics: bags are read in hundreds here."""
    return [sample for sample in samples if sample.topic in ('/temperature', '/clock')][:32]


@pytest.fixture
def path(tmp_path: Path, write_bag: WriteBag) -> Path:
    """Return a bag of four chunks in a folder, and where its file is."""
    return write_bag(tmp_path / 'run', max_chunk_age_s=0.85) / 'run_0.mcap'


def records(content: bytes, opcode: int | None = None) -> list[tuple[int, int]]:
    """Return (start, end) of the top-level records, from the lengths alone."""
    found = []
    start = MAGIC_SIZE
    while start < len(content) - MAGIC_SIZE:
        kind, length = struct.unpack_from('<BQ', content, start)
        if opcode in (None, kind):
            found.append((start, start + 9 + length))
        start += 9 + length
    return found


def messages_by_chunk_end(path: Path) -> list[tuple[int, int]]:
    """Return (end offset, messages up to there) of each chunk of a whole file."""
    ends = [end for _, end in records(path.read_bytes(), Opcode.CHUNK)]
    with path.open('rb') as stream:
        chunks = [r for r in StreamReader(stream, emit_chunks=True).records
                  if isinstance(r, Chunk)]
    total, found = 0, []
    for end, chunk in zip(ends, chunks, strict=True):
        total += sum(isinstance(record, Message) for record in breakup_chunk(chunk))
        found.append((end, total))
    return found


def changed(path: Path, place: int, content: bytes | None = None) -> None:
    """Put other bytes at a place, or flip those of one."""
    whole = path.read_bytes()
    content = bytes([whole[place] ^ 0xFF]) if content is None else content
    path.write_bytes(whole[:place] + content + whole[place + len(content):])


def cuts(content: bytes) -> list[int]:
    """Return offsets to cut at: around every record boundary, and a grid in between."""
    boundaries = [end for _, end in records(content)]
    near = {edge + shift for edge in boundaries for shift in (-1, 0, 1, 9)}
    grid = set(range(1, len(content), max(1, len(content) // 40)))
    return sorted(cut for cut in near | grid if 0 < cut < len(content))


@COMPRESSIONS
def test_cut_file_reads_up_to_its_last_whole_chunk(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], compression: str
) -> None:
    whole = write_bag(tmp_path / 'whole.mcap', compression=compression, max_chunk_age_s=0.85)
    content = whole.read_bytes()
    chunks = messages_by_chunk_end(whole)
    assert len(chunks) >= 4
    cut_file = tmp_path / 'cut.mcap'
    for cut in cuts(content):
        cut_file.write_bytes(content[:cut])
        expected = max((total for end, total in chunks if end <= cut), default=0)
        with pytest.raises(BagReadError, match=r'is cut short.*: pass recover=True'):
            read_messages(cut_file)
        found = [m.data for m in read_messages(cut_file, recover=True)]
        assert found == [s.data for s in samples[:expected]], cut
        left = summary(cut_file)
        assert (left.message_count, left.complete) == (expected, False), cut
        assert left.end_ns == (samples[expected - 1].log_time_ns if expected else None)


@COMPRESSIONS
def test_flipped_byte_is_noticed_and_survived(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], compression: str
) -> None:
    content = write_bag(
        tmp_path / 'whole.mcap', compression=compression, max_chunk_age_s=0.85).read_bytes()
    (data_end, _), = records(content, Opcode.DATA_END)
    sent = [s.data for s in samples]
    damaged = tmp_path / 'damaged.mcap'
    for place in range(MAGIC_SIZE, data_end, 97):
        damaged.write_bytes(
            content[:place] + bytes([content[place] ^ 0x40]) + content[place + 1:])
        with pytest.raises(BagReadError, match=r'is damaged .*: pass recover=True'):
            list(read_messages(damaged))
        found = [m.data for m in read_messages(damaged, recover=True)]
        remaining = iter(sent)
        assert all(data in remaining for data in found), place  # in order, none invented


def test_damage_after_the_first_chunk_keeps_the_first_chunk(
    path: Path, samples: list[Sample]
) -> None:
    (_, first), (second_end, _), *_ = messages_by_chunk_end(path)
    changed(path, second_end - 1)
    reading = read_messages(path)
    for sample in samples[:first]:
        assert next(reading).data == sample.data
    with pytest.raises(BagReadError, match=r'is damaged .*wrong checksum'):
        next(reading)
    assert len(list(read_messages(path, recover=True))) == first
    # the summary of a closed file is that of its statistics
    assert summary(path).message_count == len(samples)


def test_damaged_end_is_counted_by_scanning(path: Path, samples: list[Sample]) -> None:
    content = path.read_bytes()
    (_, summary_start), = records(content, Opcode.DATA_END)
    (statistics, _), = records(content, Opcode.STATISTICS)
    # the length of the first record of the summary, and the number of messages
    for place, damage in ((summary_start + 1, b'\xff' * 8), (statistics + 9, b'\xff')):
        path.write_bytes(content)
        changed(path, place, damage)
        assert summary(path).message_count == len(samples)
        assert len(list(read_messages(path))) == len(samples)


def test_lost_chunk_is_noticed_without_checksums(path: Path, samples: list[Sample]) -> None:
    """A damaged record type makes a chunk an unknown record, which readers skip."""
    content = path.read_bytes()
    (data_end, _), = records(content, Opcode.DATA_END)
    changed(path, data_end + 9, bytes(4))  # no checksum of the data section
    changed(path, records(content, Opcode.CHUNK)[1][0], b'\x46')
    with pytest.raises(BagReadError, match=f'of the {len(samples)} messages it should hold'):
        list(read_messages(path))
    assert 0 < len(list(read_messages(path, recover=True))) < len(samples)


def test_directory_of_a_killed_recorder(path: Path) -> None:
    folder = path.parent
    assert summary(folder).complete
    (folder / 'metadata.yaml').unlink()
    assert not summary(folder).complete
    assert summary(path).complete
    *_, (end, count), _ = messages_by_chunk_end(path)
    path.write_bytes(path.read_bytes()[:end])
    with pytest.raises(BagReadError, match=r'has no metadata\.yaml.*pass recover=True'):
        read_messages(folder)
    assert len(list(read_messages(folder, recover=True))) == count
    left = summary(folder)
    assert (left.message_count, left.complete) == (count, False)


def test_files_without_metadata_are_ordered_by_number(path: Path, samples: list[Sample]) -> None:
    folder = path.parent
    (folder / 'metadata.yaml').unlink()
    shutil.copy(path, folder / 'run_10.mcap')
    end, count = messages_by_chunk_end(path)[0]
    (folder / 'run_2.mcap').write_bytes(path.read_bytes()[:end])
    (folder / 'run_11.mcap').touch()
    found = [m.data for m in read_messages(folder, recover=True)]
    sent = [s.data for s in samples]
    assert found == sent + sent[:count] + sent
