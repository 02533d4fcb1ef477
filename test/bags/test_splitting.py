# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""Bags of several files: where they are split, what is written where, and what a kill leaves."""

from __future__ import annotations

from pathlib import Path
import shutil
from typing import Any

from mcap.reader import make_reader
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
import yaml

from koopman_ros.bags import (
    BagReadError,
    BagWriter,
    MessageDefinition,
    QosProfile,
    read_messages,
    summary,
)

HASH = 'RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a'
NUMBER = MessageDefinition('std_msgs/msg/Float64', 'float64 data\n', HASH)
SECOND = 1_000_000_000
PERIOD = SECOND // 10


def _cdr(number: float) -> bytes:
    return b'\x00\x01\x00\x00' + np.float64(number).tobytes()


def _write(writer: BagWriter, first: int, last: int) -> None:
    """Write the numbers [first, last) on /x, ten a second, and every fifth on /y as well."""
    for k in range(first, last):
        writer.write('/x', _cdr(k), k * PERIOD)
        if k % 5 == 0:
            writer.write('/y', _cdr(k), k * PERIOD + 1)


def _open(path: Path, **options: Any) -> BagWriter:
    writer = BagWriter(path, **options)
    writer.add_topic('/x', NUMBER, [QosProfile(depth=3)])
    writer.add_topic('/y', NUMBER)
    return writer


def _record(path: Path, count: int = 100, **options: Any) -> Path:
    with _open(path, **options) as writer:
        _write(writer, 0, count)
    return path


def _numbers(path: Path, topic: str = '/x', *, recover: bool = False) -> list[float]:
    return [m.message.data for m in read_messages(path, [topic], recover=recover)]


def _information(path: Path) -> dict[str, Any]:
    content = yaml.safe_load((path / 'metadata.yaml').read_text('utf-8'))
    found: dict[str, Any] = content['rosbag2_bagfile_information']
    return found


def test_splits_by_duration(tmp_path: Path) -> None:
    path = _record(tmp_path / 'run', max_file_duration_s=3.0)
    files = [path / f'run_{k}.mcap' for k in range(4)]
    assert sorted(path.iterdir()) == [path / 'metadata.yaml', *files]
    assert [_numbers(file) for file in files] == [
        list(range(0, 30)), list(range(30, 60)), list(range(60, 90)), list(range(90, 100))]
    assert _numbers(path) == list(range(100))
    assert _numbers(path, '/y') == list(range(0, 100, 5))
    found = summary(path)
    assert (found.counts, found.complete) == ({'/x': 100, '/y': 20}, True)


def test_splits_by_size(tmp_path: Path) -> None:
    path = _record(tmp_path / 'run', 2000, max_file_bytes=20_000, max_chunk_bytes=1000)
    files = sorted(path.glob('*.mcap'), key=lambda file: int(file.stem.split('_')[1]))
    assert len(files) > 5
    # at the end of a file come its indexes, which grow with its messages
    sizes = [file.stat().st_size for file in files]
    assert all(20_000 <= size < 32_000 for size in sizes[:-1]), sizes
    assert _numbers(path) == list(range(2000))


def test_no_limit_means_one_file(tmp_path: Path) -> None:
    path = _record(tmp_path / 'run', 2000, max_chunk_bytes=1000)
    assert [file.name for file in path.glob('*.mcap')] == ['run_0.mcap']


def test_metadata_lists_every_file(tmp_path: Path) -> None:
    path = _record(tmp_path / 'run', 75, max_file_duration_s=3.0, custom_data={'seed': '3'})
    found = _information(path)
    assert found['version'] == 9
    assert found['relative_file_paths'] == ['run_0.mcap', 'run_1.mcap', 'run_2.mcap']
    assert found['files'] == [
        {'path': f'run_{k}.mcap',
         'starting_time': {'nanoseconds_since_epoch': 3 * k * SECOND},
         'duration': {'nanoseconds': duration},
         'message_count': count}
        for k, (duration, count) in enumerate([
            (29 * PERIOD, 36), (29 * PERIOD, 36), (14 * PERIOD, 18)])]
    assert found['starting_time'] == {'nanoseconds_since_epoch': 0}
    assert found['duration'] == {'nanoseconds': 74 * PERIOD}
    assert found['message_count'] == 90
    assert found['custom_data'] == {'seed': '3'}
    assert {entry['topic_metadata']['name']: entry['message_count']
            for entry in found['topics_with_message_count']} == {'/x': 75, '/y': 15}


def test_every_file_is_complete_in_itself(tmp_path: Path) -> None:
    path = _record(tmp_path / 'run', 75, max_file_duration_s=3.0, custom_data={'seed': '3'})
    sequence = []
    for k, count in enumerate([30, 30, 15]):
        shutil.move(path / f'run_{k}.mcap', alone := tmp_path / f'alone_{k}.mcap')
        assert len(_numbers(alone)) == count
        with alone.open('rb') as stream:
            reader = make_reader(stream)
            content = reader.get_summary()
            *_, record = reader.iter_metadata()
            sequence += [m.sequence for _, _, m in reader.iter_messages('/x')]
        assert content is not None
        assert [channel.topic for channel in content.channels.values()] == ['/x', '/y']
        assert [schema.name for schema in content.schemas.values()] == ['std_msgs/msg/Float64']
        information = yaml.safe_load(record.metadata['serialized_metadata'])
        assert information['relative_file_paths'] == [f'run_{k}.mcap']
        assert information['topics_with_message_count'][0]['message_count'] == count
        assert information['custom_data'] == {'seed': '3'}
    assert sequence == list(range(75))


def test_topics_announced_later_are_in_the_files_from_then_on(tmp_path: Path) -> None:
    with _open(tmp_path / 'run', max_file_duration_s=3.0) as writer:
        _write(writer, 0, 40)
        writer.add_topic('/z', NUMBER)
        writer.write('/z', _cdr(7.0), 40 * PERIOD)
        _write(writer, 41, 70)
    assert _numbers(writer.path, '/z') == [7.0]
    assert [entry['topic_metadata']['name'] for entry in _information(writer.path)[
        'topics_with_message_count']] == ['/x', '/y', '/z']


@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_other_readers_read_a_split_bag(tmp_path: Path, compression: str) -> None:
    path = _record(tmp_path / 'run', max_file_duration_s=3.0, compression=compression)
    with AnyReader([path]) as reader:
        found = [reader.deserialize(data, connection.msgtype).data
                 for connection, _, data in reader.messages()
                 if connection.topic == '/x']
    assert found == list(range(100))
    with Reader(path) as bag:
        assert (bag.message_count, bag.start_time) == (120, 0)
    heard = 0
    for file in path.glob('*.mcap'):
        with file.open('rb') as stream:
            heard += sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())
    assert heard == 120


def test_clock_that_is_set_back_does_not_stop_the_splitting(tmp_path: Path) -> None:
    with _open(tmp_path / 'run', max_file_duration_s=3.0) as writer:
        _write(writer, 1000, 1010)
        _write(writer, 0, 40)
    assert len(list(writer.path.glob('*.mcap'))) == 2
    assert _numbers(writer.path) == [*range(1000, 1010), *range(40)]


@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_killed_at_any_message_it_loses_the_open_chunk_only(
        tmp_path: Path, compression: str) -> None:
    path = tmp_path / 'run'
    # as long as the writer lives, its files are what a kill would leave
    with _open(path, compression=compression, max_file_duration_s=2.0,
               max_chunk_age_s=0.5, clock=(PERIOD * 1e-9 * k for k in range(10**6)).__next__
               ) as writer:
        for k in range(60):
            _write(writer, k, k + 1)
            # the metadata is renamed from a .tmp, which may vanish while it is copied
            shutil.copytree(path, left := tmp_path / f'left_{k}',
                            ignore=shutil.ignore_patterns('*.tmp'))
            found = _numbers(left, recover=True)
            assert found == list(range(len(found)))
            assert len(found) > k - 6
            assert not summary(left).complete
            with pytest.raises(BagReadError, match=r'pass recover=True'):
                _numbers(left)
            shutil.rmtree(left)
    assert _numbers(path) == list(range(60))


def test_files_that_metadata_does_not_list(tmp_path: Path) -> None:
    path = _record(tmp_path / 'run', 120, max_file_duration_s=1.0)
    information = _information(path)
    listed = information['relative_file_paths']
    assert len(listed) == 12
    # as left by a recorder whose disk was full when it completed the second file
    information['relative_file_paths'] = [listed[0], *listed[2:10]]
    (path / 'metadata.yaml').write_text(
        yaml.safe_dump({'rosbag2_bagfile_information': information}))
    (path / 'run_12.mcap').touch()
    shutil.copy(path / 'run_0.mcap', path / 'other.mcap')
    shutil.copy(path / 'run_0.mcap', path / 'other_1.mcap')
    with pytest.raises(BagReadError, match=(
            r"run_1\.mcap' is not listed in metadata\.yaml, .*: pass recover=True")):
        read_messages(path)
    assert not summary(path).complete
    assert _numbers(path, recover=True) == list(range(120))


def test_failure_in_the_background_is_raised(tmp_path: Path) -> None:
    writer = _open(tmp_path / 'run', max_file_duration_s=1.0)
    _write(writer, 0, 5)
    # the metadata that the first file goes into cannot be written
    (writer.path / 'metadata.yaml.tmp').mkdir()
    with pytest.raises(IsADirectoryError):
        _write(writer, 5, 30)
    with pytest.raises(IsADirectoryError):
        writer.close()
    (writer.path / 'metadata.yaml.tmp').rmdir()
    assert _numbers(writer.path, recover=True) == list(range(20))


@pytest.mark.parametrize(('name', 'options', 'sentence'), [
    ('run.mcap', {'max_file_bytes': 1}, r"run\.mcap' is one file, which is not split: give the"),
    ('run.mcap', {'max_file_duration_s': 1.0}, 'is one file'),
    ('run', {'max_file_bytes': -1}, 'max_file_bytes -1 is negative: use 0 for no limit'),
    ('run', {'max_file_duration_s': -1.0}, r'max_file_duration_s -1\.0 is not a time'),
    ('run', {'max_file_duration_s': float('nan')}, 'max_file_duration_s nan is not a time'),
])
def test_limits_that_make_no_sense_make_no_file(
        tmp_path: Path, name: str, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        BagWriter(tmp_path / name, **options)
    assert list(tmp_path.iterdir()) == []
