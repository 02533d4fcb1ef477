# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of several files, bags whose recorder was killed, and bags whose bytes were damaged."""

from collections.abc import Callable
from pathlib import Path
import shutil
import struct
from typing import Any

from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk, StreamReader
import pytest
import yaml

from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.records import BagReadError, BagWriter, read_messages, summary
from support.bag_samples import NUMBER, number, record, Sample, write_numbers

WriteBag = Callable[..., Path]

MAGIC_SIZE = 8
PERIOD = SECOND // 10


@pytest.fixture(scope='module')
def samples(samples: list[Sample]) -> list[Sample]:
    """Return those of two topics: bags are read in hundreds here."""
    return [sample for sample in samples if sample.topic in ('/temperature', '/clock')][:32]


@pytest.fixture
def path(tmp_path: Path, write_bag: WriteBag) -> Path:
    """Return a bag of four chunks in a folder, and where its file is."""
    return write_bag(tmp_path / 'run') / 'run_0.mcap'


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
    counts = [sum(isinstance(record, Message) for record in breakup_chunk(chunk))
              for chunk in chunks]
    return [(end, sum(counts[:k + 1])) for k, end in enumerate(ends)]


def changed(path: Path, place: int, content: bytes | None = None) -> None:
    """Put other bytes at a place, or flip those of one."""
    whole = path.read_bytes()
    content = bytes([whole[place] ^ 0xFF]) if content is None else content
    path.write_bytes(whole[:place] + content + whole[place + len(content):])


def numbers(path: Path, topic: str = '/x', *, recover: bool = False) -> list[float]:
    return [m.message.data for m in read_messages(path, [topic], recover=recover)]


def information(path: Path) -> dict[str, Any]:
    return yaml.safe_load((path / 'metadata.yaml').read_text())['rosbag2_bagfile_information']


# Damage.


def test_cut_file_reads_up_to_its_last_whole_chunk(
    tmp_path: Path, write_bag: WriteBag, samples: list[Sample]
) -> None:
    whole = write_bag(tmp_path / 'whole.mcap', compression='zstd')
    content = whole.read_bytes()
    chunks = messages_by_chunk_end(whole)
    assert len(chunks) >= 4
    cut_file = tmp_path / 'cut.mcap'
    # around every record boundary, and a grid in between
    cuts = {end + shift for _, end in records(content) for shift in (-1, 0, 1, 9)}
    cuts |= set(range(1, len(content), max(1, len(content) // 40)))
    for cut in sorted(cut for cut in cuts if 0 < cut < len(content)):
        cut_file.write_bytes(content[:cut])
        expected = max((total for end, total in chunks if end <= cut), default=0)
        with pytest.raises(BagReadError, match='set recover to true'):
            read_messages(cut_file)
        found = [m.data for m in read_messages(cut_file, recover=True)]
        assert found == [s.data for s in samples[:expected]], cut
        left = summary(cut_file)
        assert (left.message_count, left.complete) == (expected, False), cut
        assert left.end_ns == (samples[expected - 1].log_time_ns if expected else None)


def test_damage_after_the_first_chunk_keeps_the_first_chunk(
    path: Path, samples: list[Sample]
) -> None:
    (_, first), (second_end, _), *_ = messages_by_chunk_end(path)
    changed(path, second_end - 1)
    reading = read_messages(path)
    assert [next(reading).data for _ in range(first)] == [s.data for s in samples[:first]]
    with pytest.raises(BagReadError, match=r'is damaged .*crc'):
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
    with pytest.raises(BagReadError, match=f'of the {len(samples)} expected messages'):
        list(read_messages(path))
    assert 0 < len(list(read_messages(path, recover=True))) < len(samples)


# Killed recorders.


def test_directory_of_a_killed_recorder(path: Path, samples: list[Sample]) -> None:
    folder = path.parent
    assert summary(folder).complete
    (folder / 'metadata.yaml').unlink()
    assert (summary(folder).complete, summary(path).complete) == (False, True)
    (end, count), *_ = messages_by_chunk_end(path)
    # read by their numbers
    shutil.copy(path, folder / 'run_10.mcap')
    (folder / 'run_2.mcap').write_bytes(path.read_bytes()[:end])
    (folder / 'run_11.mcap').touch()
    with pytest.raises(BagReadError, match=r'has no metadata\.yaml.*set recover to true'):
        read_messages(folder)
    sent = [s.data for s in samples]
    assert [m.data for m in read_messages(folder, recover=True)] == sent + sent[:count] + sent
    left = summary(folder)
    assert (left.message_count, left.complete) == (2 * len(sent) + count, False)


def test_killed_at_any_message_it_loses_the_open_chunk_only(tmp_path: Path) -> None:
    path = tmp_path / 'run'
    # as long as the writer lives, its files are what a kill would leave
    with BagWriter(path, max_file_duration_s=2.0) as writer:
        for k in range(60):
            write_numbers(writer, (k,), PERIOD)
            if k % 5 == 4:
                writer.flush()
            # the metadata is written in a folder *.tmp, which may vanish while it is copied
            shutil.copytree(path, left := tmp_path / f'left_{k}',
                            ignore=shutil.ignore_patterns('*.tmp'))
            found = numbers(left, recover=True)
            assert found == list(range(len(found)))
            assert len(found) > k - 6
            assert not summary(left).complete
            with pytest.raises(BagReadError, match=r'set recover to true'):
                numbers(left)
            shutil.rmtree(left)
    assert numbers(path) == list(range(60))


def test_failure_in_the_background_is_raised(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'run', max_file_duration_s=1.0)
    write_numbers(writer, range(5), PERIOD)
    # the metadata that the first file goes into cannot be written
    (writer.path / 'metadata.yaml').mkdir()
    with pytest.raises(IsADirectoryError):
        write_numbers(writer, range(5, 30), PERIOD)
    with pytest.raises(IsADirectoryError):
        writer.close()
    (writer.path / 'metadata.yaml').rmdir()
    assert numbers(writer.path, recover=True) == list(range(20))


# Several files.


def test_splits_by_duration_into_files_complete_in_themselves(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run', max_file_duration_s=3.0) as writer:
        write_numbers(writer, range(40), PERIOD)
        # in the files from then on
        writer.add_topic('/z', NUMBER)
        writer.write('/z', number(7.0), 39 * PERIOD)
        write_numbers(writer, range(40, 75), PERIOD)
    path = writer.path
    names = [f'run_{k}.mcap' for k in range(3)]
    assert sorted(file.name for file in path.iterdir()) == ['metadata.yaml', *names]
    assert numbers(path) == list(range(75))
    assert numbers(path, '/z') == [7.0]
    assert (summary(path).counts, summary(path).complete) == ({'/x': 75, '/z': 1}, True)
    found = information(path)
    assert (found['relative_file_paths'], found['message_count']) == (names, 76)
    assert [(one['starting_time']['nanoseconds_since_epoch'], one['duration']['nanoseconds'],
             one['message_count']) for one in found['files']] == [
        (0, 29 * PERIOD, 30), (3 * SECOND, 29 * PERIOD, 31), (6 * SECOND, 14 * PERIOD, 15)]
    assert [(entry['topic_metadata']['name'], entry['message_count'])
            for entry in found['topics_with_message_count']] == [('/x', 75), ('/z', 1)]
    sequence = []
    for name, first, last, topics in zip(
            names, (0, 30, 60), (30, 60, 75), (['/x'], ['/x', '/z'], ['/x', '/z']), strict=True):
        shutil.move(path / name, alone := tmp_path / f'alone_{name}')
        assert numbers(alone) == list(range(first, last))
        with alone.open('rb') as stream:
            reader = make_reader(stream, validate_crcs=True)
            channels = reader.get_summary().channels.values()
            *_, own = reader.iter_metadata()
            sequence += [m.sequence for _, _, m in reader.iter_messages('/x')]
        assert [channel.topic for channel in channels] == topics
        found = yaml.safe_load(own.metadata['serialized_metadata'])
        assert found['relative_file_paths'] == [name]
    assert sequence == list(range(75))


def test_splits_by_size(tmp_path: Path) -> None:
    path = record(tmp_path / 'run', range(2000), max_file_bytes=20_000, max_chunk_bytes=1000)
    files = sorted(path.glob('*.mcap'), key=lambda file: int(file.stem.split('_')[1]))
    assert len(files) > 5
    # at the end of a file come its indexes, which grow with its messages
    sizes = [file.stat().st_size for file in files]
    assert all(20_000 <= size < 32_000 for size in sizes[:-1]), sizes
    assert numbers(path) == list(range(2000))
    path = record(tmp_path / 'whole', range(2000), max_chunk_bytes=1000)
    assert [file.name for file in path.glob('*.mcap')] == ['whole_0.mcap']


def test_clock_that_is_set_back_does_not_stop_the_splitting(tmp_path: Path) -> None:
    sent = [*range(1000, 1010), *range(40)]
    path = record(tmp_path / 'run', sent, PERIOD, max_file_duration_s=3.0)
    assert len(list(path.glob('*.mcap'))) == 2
    assert numbers(path) == sent
