# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of several files: where they are split, what is written where, and what a kill leaves."""

from pathlib import Path
import shutil
from typing import Any

from mcap.reader import make_reader
import pytest
import yaml

from koopman_ros.bags import BagReadError, BagWriter, read_messages, summary
from koopman_ros.units import NANOSECONDS as SECOND
from support.bag_samples import NUMBER, number, record, write_numbers

PERIOD = SECOND // 10


def numbers(path: Path, topic: str = '/x', *, recover: bool = False) -> list[float]:
    return [m.message.data for m in read_messages(path, [topic], recover=recover)]


def information(path: Path) -> dict[str, Any]:
    content = yaml.safe_load((path / 'metadata.yaml').read_text('utf-8'))
    found: dict[str, Any] = content['rosbag2_bagfile_information']
    return found


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
    assert (found['version'], found['relative_file_paths']) == (9, names)
    assert found['files'] == [
        {'path': name, 'starting_time': {'nanoseconds_since_epoch': 3 * k * SECOND},
         'duration': {'nanoseconds': duration * PERIOD}, 'message_count': count}
        for k, (name, duration, count) in enumerate(
            zip(names, (29, 29, 14), (30, 31, 15), strict=True))]
    assert found['starting_time'] == {'nanoseconds_since_epoch': 0}
    assert found['duration'] == {'nanoseconds': 74 * PERIOD}
    assert found['message_count'] == 76
    assert [(entry['topic_metadata']['name'], entry['message_count'])
            for entry in found['topics_with_message_count']] == [('/x', 75), ('/z', 1)]
    sequence = []
    for name, first, last, topics in zip(
            names, (0, 30, 60), (30, 60, 75), (['/x'], ['/x', '/z'], ['/x', '/z']), strict=True):
        shutil.move(path / name, alone := tmp_path / f'alone_{name}')
        assert numbers(alone) == list(range(first, last))
        with alone.open('rb') as stream:
            reader = make_reader(stream, validate_crcs=True)
            content = reader.get_summary()
            *_, own = reader.iter_metadata()
            sequence += [m.sequence for _, _, m in reader.iter_messages('/x')]
        assert content is not None
        assert [channel.topic for channel in content.channels.values()] == topics
        assert [schema.name for schema in content.schemas.values()] == ['std_msgs/msg/Float64']
        found = yaml.safe_load(own.metadata['serialized_metadata'])
        assert found['relative_file_paths'] == [name]
        assert found['topics_with_message_count'][0]['message_count'] == last - first
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
    path = record(tmp_path / 'run', [*range(1000, 1010), *range(40)], PERIOD,
                  max_file_duration_s=3.0)
    assert len(list(path.glob('*.mcap'))) == 2
    assert numbers(path) == [*range(1000, 1010), *range(40)]


@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_killed_at_any_message_it_loses_the_open_chunk_only(
        tmp_path: Path, compression: str) -> None:
    path = tmp_path / 'run'
    # as long as the writer lives, its files are what a kill would leave
    with BagWriter(path, compression=compression, max_file_duration_s=2.0,
                   max_chunk_age_s=0.5, clock=(PERIOD * 1e-9 * k for k in range(10**6)).__next__
                   ) as writer:
        for k in range(60):
            write_numbers(writer, (k,), PERIOD)
            # the metadata is renamed from a .tmp, which may vanish while it is copied
            shutil.copytree(path, left := tmp_path / f'left_{k}',
                            ignore=shutil.ignore_patterns('*.tmp'))
            found = numbers(left, recover=True)
            assert found == list(range(len(found)))
            assert len(found) > k - 6
            assert not summary(left).complete
            with pytest.raises(BagReadError, match=r'pass recover=True'):
                numbers(left)
            shutil.rmtree(left)
    assert numbers(path) == list(range(60))


def test_files_that_metadata_does_not_list(tmp_path: Path) -> None:
    path = record(tmp_path / 'run', range(120), PERIOD, max_file_duration_s=1.0)
    found = information(path)
    listed = found['relative_file_paths']
    assert len(listed) == 12
    # as left by a recorder whose disk was full when it completed the second file
    found['relative_file_paths'] = [listed[0], *listed[2:10]]
    (path / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': found}))
    (path / 'run_12.mcap').touch()
    shutil.copy(path / 'run_0.mcap', path / 'other.mcap')
    shutil.copy(path / 'run_0.mcap', path / 'other_1.mcap')
    with pytest.raises(BagReadError, match=(
            r"run_1\.mcap' is not listed in metadata\.yaml, .*: pass recover=True")):
        read_messages(path)
    assert not summary(path).complete
    assert numbers(path, recover=True) == list(range(120))


def test_failure_in_the_background_is_raised(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'run', max_file_duration_s=1.0)
    write_numbers(writer, range(5), PERIOD)
    # the metadata that the first file goes into cannot be written
    (writer.path / 'metadata.yaml.tmp').mkdir()
    with pytest.raises(IsADirectoryError):
        write_numbers(writer, range(5, 30), PERIOD)
    with pytest.raises(IsADirectoryError):
        writer.close()
    (writer.path / 'metadata.yaml.tmp').rmdir()
    assert numbers(writer.path, recover=True) == list(range(20))
