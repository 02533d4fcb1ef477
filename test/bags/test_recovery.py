# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags whose recorder was killed, and bags whose bytes were damaged."""

from collections.abc import Callable
from pathlib import Path
import shutil
import struct

from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk, StreamReader
import pytest

from koopman_ros.bags import BagReadError, read_messages, summary
from support.bag_samples import Sample

WriteBag = Callable[..., Path]

MAGIC_SIZE = 8
COMPRESSIONS = pytest.mark.parametrize('compression', ['none', 'zstd', 'lz4'])


def _records(content: bytes) -> list[tuple[int, int, int]]:
    """Return (opcode, start, end) of the top-level records, from the lengths alone."""
    found = []
    start = MAGIC_SIZE
    while start < len(content) - MAGIC_SIZE:
        opcode, length = struct.unpack_from('<BQ', content, start)
        found.append((opcode, start, start + 9 + length))
        start += 9 + length
    return found


def _messages_by_chunk_end(path: Path) -> list[tuple[int, int]]:
    """Return (end offset, messages up to there) of each chunk of a whole file."""
    ends = [end for opcode, _, end in _records(path.read_bytes()) if opcode == 0x06]
    with path.open('rb') as stream:
        chunks = [r for r in StreamReader(stream, emit_chunks=True).records
                  if isinstance(r, Chunk)]
    total, found = 0, []
    for end, chunk in zip(ends, chunks, strict=True):
        total += sum(isinstance(record, Message) for record in breakup_chunk(chunk))
        found.append((end, total))
    return found


def _cuts(content: bytes) -> list[int]:
    """Return offsets to cut at: around every record boundary, and a grid in between."""
    boundaries = [end for _, _, end in _records(content)]
    near = {edge + shift for edge in boundaries for shift in (-1, 0, 1, 5, 9)}
    grid = set(range(1, len(content), max(1, len(content) // 60)))
    return sorted(cut for cut in near | grid if 0 < cut < len(content))


@COMPRESSIONS
def test_cut_file_reads_up_to_its_last_whole_chunk(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample], compression: str
) -> None:
    whole = write_bag(tmp_path / 'whole.mcap', compression=compression, max_chunk_age_s=2.0)
    content = whole.read_bytes()
    chunks = _messages_by_chunk_end(whole)
    assert len(chunks) >= 4
    cut_file = tmp_path / 'cut.mcap'
    for cut in _cuts(content):
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
        tmp_path / 'whole.mcap', compression=compression, max_chunk_age_s=2.0).read_bytes()
    data_end = next(start for opcode, start, _ in _records(content) if opcode == 0x0F)
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
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    path = write_bag(tmp_path / 'run.mcap', max_chunk_age_s=2.0)
    (_, first), (second_end, _), *_ = _messages_by_chunk_end(path)
    content = bytearray(path.read_bytes())
    content[second_end - 1] ^= 0xFF
    path.write_bytes(content)
    reading = read_messages(path)
    for sample in samples[:first]:
        assert next(reading).data == sample.data
    with pytest.raises(BagReadError, match=r'is damaged .*wrong checksum'):
        next(reading)
    assert len(list(read_messages(path, recover=True))) == first


def test_summary_of_a_closed_file_comes_from_its_statistics(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    path = write_bag(tmp_path / 'run.mcap', max_chunk_age_s=2.0)
    content = bytearray(path.read_bytes())
    (first_end, _), *_ = _messages_by_chunk_end(path)
    content[first_end - 1] ^= 0xFF
    path.write_bytes(content)
    assert summary(path).message_count == len(samples)
    assert list(read_messages(path, recover=True)) == []


def test_damaged_summary_section_is_counted_by_scanning(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    path = write_bag(tmp_path / 'run.mcap')
    content = bytearray(path.read_bytes())
    _, start, _ = next(r for r in _records(bytes(content)) if r[0] == 0x0F)
    content[start + 13 + 1:start + 13 + 9] = b'\xff' * 8  # length of the first summary record
    path.write_bytes(content)
    assert summary(path).message_count == len(samples)
    assert len(list(read_messages(path))) == len(samples)


def test_directory_of_a_killed_recorder(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    path = write_bag(tmp_path / 'run', max_chunk_age_s=2.0)
    (path / 'metadata.yaml').unlink()
    file = path / 'run_0.mcap'
    chunks = _messages_by_chunk_end(file)
    file.write_bytes(file.read_bytes()[:chunks[-2][0]])
    with pytest.raises(BagReadError, match=r'has no metadata\.yaml.*pass recover=True'):
        read_messages(path)
    assert len(list(read_messages(path, recover=True))) == chunks[-2][1]
    left = summary(path)
    assert (left.message_count, left.complete) == (chunks[-2][1], False)


def test_files_without_metadata_are_ordered_by_number(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    path = write_bag(tmp_path / 'run')
    (path / 'metadata.yaml').unlink()
    shutil.copy(path / 'run_0.mcap', path / 'run_10.mcap')
    file = path / 'run_2.mcap'
    content = (path / 'run_0.mcap').read_bytes()
    end, count = _messages_by_chunk_end(path / 'run_0.mcap')[0]
    file.write_bytes(content[:end])
    (path / 'run_11.mcap').touch()
    found = [m.data for m in read_messages(path, recover=True)]
    sent = [s.data for s in samples]
    assert found == sent + sent[:count] + sent


def test_closed_files_without_metadata_are_not_called_complete(
    tmp_path: Path, write_bag: WriteBag
) -> None:
    path = write_bag(tmp_path / 'run')
    assert summary(path).complete
    (path / 'metadata.yaml').unlink()
    assert not summary(path).complete
    assert summary(path / 'run_0.mcap').complete


def test_lost_chunk_is_noticed_without_checksums(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    """A damaged record type makes a chunk an unknown record, which readers skip."""
    path = write_bag(tmp_path / 'run.mcap', max_chunk_age_s=2.0)
    content = bytearray(path.read_bytes())
    records = _records(bytes(content))
    _, data_end, _ = next(r for r in records if r[0] == 0x0F)
    content[data_end + 9:data_end + 13] = bytes(4)  # no checksum of the data section
    chunks = [start for opcode, start, _ in records if opcode == 0x06]
    content[chunks[1]] = 0x46
    path.write_bytes(content)
    with pytest.raises(BagReadError, match=f'of the {len(samples)} messages it should hold'):
        list(read_messages(path))
    assert 0 < len(list(read_messages(path, recover=True))) < len(samples)


def test_damaged_statistics_are_not_believed(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    path = write_bag(tmp_path / 'run.mcap')
    content = bytearray(path.read_bytes())
    (start,) = (start for opcode, start, _ in _records(bytes(content)) if opcode == 0x0B)
    content[start + 9] ^= 1  # the number of messages
    path.write_bytes(content)
    assert summary(path).message_count == len(samples)
    assert len(list(read_messages(path))) == len(samples)
