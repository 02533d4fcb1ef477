# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Summaries of MCAP files whose writers left out what the format leaves to them."""

from collections import Counter
import itertools
from pathlib import Path
from typing import Any

from mcap.reader import NonSeekingReader
from mcap.records import Statistics
from mcap.writer import CompressionType, IndexType, Writer
import pytest

from koopman_ros import records
from koopman_ros.core.message_fields import MessageField
from support.bag_samples import NUMBER, number, TEXT, text

MESSAGES = 120
FLAGS = ('use_chunking', 'repeat_channels', 'repeat_schemas', 'use_statistics',
         'use_summary_offsets')


def keep_counts(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """Write statistics that count so many channels; none means that counts are not available."""
    write = Statistics.write

    def with_some(self: Statistics, builder: Any) -> None:
        counts = self.channel_message_counts
        self.channel_message_counts = dict(itertools.islice(counts.items(), most))
        write(self, builder)
        self.channel_message_counts = counts

    monkeypatch.setattr(Statistics, 'write', with_some)


def write(path: Path, *, schemaless: bool = False, **options: Any) -> Path:
    """Write messages on three channels, two of one topic, the last one late in the file."""
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=900, **options)
        writer.start('ros2')
        ids = [0 if schemaless else writer.register_schema(
            one.type_name, 'ros2msg', one.text.encode()) for one in (NUMBER, TEXT)]
        channels = [writer.register_channel('/x', 'cdr', ids[0]),
                    writer.register_channel('/words', 'cdr', ids[1])]
        for k in range(MESSAGES):
            if k == MESSAGES // 2:
                channels.append(writer.register_channel('/x', 'cdr', ids[0], {'again': 'yes'}))
            which = k % len(channels)
            writer.add_message(channels[which], 10 + k, text(b'word') if which == 1 else number(k),
                               10 + k)
        writer.finish()
    return path


def read_one_by_one(path: Path) -> tuple[dict[str, int], dict[str, str], int, int]:
    """Count messages as MCAP's own sequential reader gives them."""
    counts: Counter[str] = Counter()
    types, times = {}, []
    with path.open('rb') as stream:
        for schema, channel, message in NonSeekingReader(stream).iter_messages():
            counts[channel.topic] += 1
            types[channel.topic] = schema.name if schema else ''
            times.append(message.log_time)
    return dict(counts), types, min(times), max(times)


@pytest.mark.parametrize('counted', [0, 1, 3])
@pytest.mark.parametrize('index', [IndexType.ALL, IndexType.NONE])
@pytest.mark.parametrize('schemaless', [False, True])
def test_summary_is_that_of_a_sequential_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, index: IndexType, schemaless: bool,
    counted: int
) -> None:
    keep_counts(monkeypatch, counted)
    # all flags, none, and all but one
    for off in ((), FLAGS, *((flag,) for flag in FLAGS)):
        path = write(tmp_path / 'run.mcap', schemaless=schemaless, index_types=index,
                     compression=CompressionType.NONE, **{flag: flag not in off for flag in FLAGS})
        found = records.summary(path)
        assert (found.counts, found.types, found.start_ns, found.end_ns) == read_one_by_one(
            path), off
        assert found.complete, off
        if not schemaless:
            assert len(list(records.read_messages(path))) == MESSAGES, off
            series = records.read_series(path, MessageField('/x', NUMBER.type_name, 'data', '1'))
            assert len(series.values) == found.counts['/x'], off
