# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Long records, put together in portions: the same samples and inputs, in bounded memory."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
import tracemalloc

import numpy as np
import pytest

from koopman_ros import records
from koopman_ros.core.datasets import Episode
from koopman_ros.core.message_fields import MessageField
from koopman_ros.records import segments
from support.bag_samples import loop_episodes
from support.long_records import FIELD, TYPE, write

PLACES = {name: MessageField(f'/{name}', TYPE, FIELD, '1') for name in ('warm', 'cold', 'valve',
                                                                        'flow')}
STATES = [records.RecordedState(name, '1', PLACES[name]) for name in ('warm', 'cold')]
COMMANDED = records.RecordedInput('valve', '1', PLACES['valve'], None)
MEASURED = replace(COMMANDED, measured=PLACES['flow'])
PERIOD = 0.05


@pytest.fixture(autouse=True)
def small_portions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segments, 'MOST', 2000)


def record(path: Path, count: int) -> Path:
    """Write a slow motion, whose values tell the time, and an input behind a lag."""
    rng = np.random.default_rng(0)
    time = PERIOD * np.arange(count)
    command = np.repeat(rng.uniform(0.0, 1.0, count // 40 + 1), 40)[:count]
    flow = np.empty(count)
    flow[0] = command[0]
    for k in range(count - 1):
        flow[k + 1] = flow[k] + 0.2 * (command[k] - flow[k])
    return write(path, [f'/{name}' for name in PLACES], np.column_stack(
        [time, -time, command, flow]), PERIOD)


def whole(path: Path, signal: records.RecordedInput, monkeypatch: pytest.MonkeyPatch) -> Episode:
    with monkeypatch.context() as patch:
        patch.setattr(segments, 'MOST', 10 ** 9)
        (episode,), _ = loop_episodes([path], STATES, [signal])
    return episode


@pytest.fixture(scope='module')
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp('long') / 'long.mcap', 9000)


@pytest.mark.parametrize('signal', [
    pytest.param(COMMANDED, id='commanded'), pytest.param(MEASURED, id='measured'),
    pytest.param(replace(COMMANDED, delay=7.0), id='dead time')])
def test_portions_together_equal_the_whole_record(
    long: Path, monkeypatch: pytest.MonkeyPatch, signal: records.RecordedInput) -> None:
    expected = whole(long, signal, monkeypatch)
    episodes, account = loop_episodes([long], STATES, [signal])
    # nearly equal ones
    assert len(episodes) == 5
    assert max(map(len, episodes)) <= 1800
    assert account.used == 2 * len(expected)
    np.testing.assert_array_equal(np.concatenate([one.x for one in episodes]), expected.x)
    for one in episodes:
        first = np.searchsorted(expected.time, one.x[0, 0] - expected.x[0, 0] - 1e-6)
        rows = slice(first, first + len(one))
        np.testing.assert_allclose(one.time, expected.time[rows] - expected.time[first], atol=1e-8)
        # what acted does not know of portions
        np.testing.assert_allclose(one.inputs_at(one.time[:-1] + 0.01), expected.inputs_at(
            expected.time[rows][:-1] + 0.01), rtol=1e-7)
        area = expected.input_integral(expected.time[rows])
        np.testing.assert_allclose(one.input_integral(one.time), area - area[0], atol=1e-7)


def test_command_of_an_earlier_portion_is_held(tmp_path: Path) -> None:
    time = np.arange(7000) * PERIOD
    path = write(tmp_path / 'long.mcap', ['/warm', '/cold'], np.column_stack([time, time]), PERIOD)
    # one command for all of it, in a bag that rosbag2 would have split
    both = tmp_path / 'both'
    both.mkdir()
    write(both / 'both_0.mcap', ['/valve'], np.array([[3.0]]), PERIOD)
    path.rename(both / 'both_1.mcap')
    episodes, account = loop_episodes([both], STATES, [COMMANDED])
    assert (len(episodes), account.used) == (4, 14_000)
    for one in episodes:
        assert one.u[:, 0].tolist() == [3.0]


def test_state_that_falls_silent_does_not_hold_up_the_others(tmp_path: Path) -> None:
    time = np.arange(20_000) * PERIOD
    both = tmp_path / 'both'
    both.mkdir()
    write(both / 'both_0.mcap', ['/valve', '/cold'], np.ones((30, 2)), PERIOD)
    write(both / 'both_1.mcap', ['/warm'], time[:, None], PERIOD)
    _, account = loop_episodes([both], STATES, [COMMANDED])
    assert account.used == 60
    assert account.dropped == {'measurement without cold': 20_000 - 30}


def test_memory_does_not_grow_with_the_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(segments, 'MOST', 500)
    monkeypatch.setattr(segments, '_MARGIN', 200)

    def peak(count: int) -> int:
        path = record(tmp_path / f'{count}.mcap', count)
        account = records.ImportReport()
        stream: Iterator[Episode] = records.stream_episodes([path], STATES, [MEASURED], account)
        tracemalloc.start()
        try:
            assert sum(map(len, stream)) == count
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(1000)
    assert peak(4500) < 1.1 * peak(1500)
