# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of a simulated plant whose messages have no stamps: which time their receipts are."""

from collections.abc import Callable
from pathlib import Path
import struct

import pytest

from koopman_ros import records
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import NANOSECONDS as SECOND
from support.bag_samples import HEAD, loop_episodes, NUMBER, number

STATE = records.RecordedState('x', '1', MessageField('/x', NUMBER.type_name, 'data', '1'))
INPUT = records.RecordedInput('u', '1', MessageField('/u', NUMBER.type_name, 'data', '1'))
CLOCK = records.MessageDefinition(
    'rosgraph_msgs/msg/Clock', 'builtin_interfaces/Time clock\n' + '=' * 80
    + '\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n', 'RIHS01_' + 'b' * 64)
WALL = 1_700_000_000
Clock = Callable[[float], float]


def write(path: Path, receipt_time: Clock, clock_time: Clock,
          clock: bool = True) -> Path:
    """Write 100 s of the wall clock: times of receipt [s], and times on /clock [s]."""
    with records.BagWriter(path) as writer:
        for topic, definition in (('/x', NUMBER), ('/u', NUMBER), ('/clock', CLOCK)):
            writer.add_topic(topic, definition)
        for k in range(200):
            now = round(clock_time(0.5 * k) * SECOND)
            log_ns = round(receipt_time(0.5 * k) * SECOND)
            if clock:
                writer.write('/clock', HEAD + struct.pack('<iI', *divmod(now, SECOND)), log_ns)
            writer.write('/x', number(k), log_ns)
            writer.write('/u', number(k // 20), log_ns)
    return path


@pytest.mark.parametrize(('receipt_time', 'clock_time', 'seconds'), [
    (lambda t: WALL + t, lambda t: 5.0 + t, 99.5),  # in real time
    (lambda t: 20.0 * t, lambda t: 20.0 * t, 1990.0),  # recorded with use_sim_time
    (lambda t: 20.0 * (t % 50.0), lambda t: 20.0 * (t % 50.0), 990.0),  # and started again
])
def test_receipts_in_plant_time_count(
        tmp_path: Path, receipt_time: Clock, clock_time: Clock,
        seconds: float) -> None:
    path = write(tmp_path / 'run.mcap', receipt_time, clock_time)
    episodes, _ = loop_episodes([path], [STATE], [INPUT])
    assert max(episode.time[-1] for episode in episodes) == pytest.approx(seconds)


@pytest.mark.parametrize(('clock_time', 'words'), [
    (lambda t: 20.0 * t, r'x has no stamps.*1990 s on /clock in 99.5 s'),
    (lambda t: 0.1 * t, r'9.95 s on /clock in 99.5 s'),
    (lambda t: min(t, 60.0), r'60 s on /clock in 99.5 s'),  # a pause
    (lambda t: 20.0 * (t % 50.0), r'1980 s on /clock in 99 s'),  # started again
])
def test_receipts_in_another_time_are_rejected(
        tmp_path: Path, clock_time: Clock, words: str) -> None:
    path = write(tmp_path / 'run.mcap', lambda t: WALL + t, clock_time)
    with pytest.raises(records.BagReadError, match=f'{words}.*use_sim_time'):
        loop_episodes([path], [STATE], [INPUT])


def test_receipts_without_a_clock_are_noted(tmp_path: Path) -> None:
    path = write(tmp_path / 'run.mcap', lambda t: WALL + t, lambda t: t, clock=False)
    _, account = loop_episodes([path], [STATE], [INPUT])
    assert any('have no stamp: the time of receipt' in note for note in account.notes)
