# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What nodes share in a process of many: timers, failures, the file that names the loops."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy

from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.ros import hosted, topics
from koopman_ros.ros.host import read_loops
from koopman_ros.ros.hosted import HostableNode, Hosting, Schedule
from koopman_ros.ros.process import answer
from koopman_ros.testing import isolated_domain


class Steady:
    """A clock that stands where it is put."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 10.0
        monkeypatch.setattr(hosted.time, 'monotonic', lambda: self.now)


def test_timers_are_called_when_they_are_due_and_skip_what_they_missed(
        monkeypatch: pytest.MonkeyPatch) -> None:
    clock, schedule, called = Steady(monkeypatch), Schedule(), []
    schedule.timer(0.5, lambda: called.append('half'))
    schedule.timer(0.2, lambda: called.append('fifth'))
    assert schedule.turn() == pytest.approx(0.2)
    assert called == []
    clock.now = 10.25
    assert schedule.turn() == pytest.approx(0.15)
    assert called == ['fifth']
    # 10.4, 10.6 and 10.8 have passed: called once, and next at 11.0
    clock.now = 10.9
    assert schedule.turn() == 0.0
    assert schedule.turn() == pytest.approx(0.1)
    assert called == ['fifth', 'fifth', 'half']


def test_timer_that_is_cancelled_is_due_no_more_until_it_is_reset(
        monkeypatch: pytest.MonkeyPatch) -> None:
    clock, schedule, called = Steady(monkeypatch), Schedule(), []
    timer = schedule.timer(0.5, lambda: called.append(clock.now))
    timer.cancel()
    clock.now = 10.7
    schedule.turn()
    assert called == []
    timer.reset()
    clock.now = 11.1
    schedule.turn()
    clock.now = 11.2
    timer.reset()
    schedule.turn()
    assert called == []
    clock.now = 11.7
    schedule.turn()
    assert called == [11.7]


def test_timer_that_cancels_itself_stays_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, schedule, called = Steady(monkeypatch), Schedule(), []

    def once() -> None:
        called.append(clock.now)
        timer.cancel()

    timer = schedule.timer(0.5, once)
    for clock.now in (10.5, 11.0, 11.5):
        schedule.turn()
    assert called == [10.5]


@pytest.mark.parametrize('error', [KeyError('a'), SystemExit(3), GeneratorExit()], ids=repr)
def test_error_of_a_callback_goes_to_the_hosting(error: BaseException) -> None:
    failed: list[BaseException] = []

    def act(value: int) -> int:
        if value < 0:
            raise error
        return value

    guarded = Hosting(Schedule(), 1, failed.append).guarded(act)
    assert guarded(3) == 3
    assert guarded(-3) is None
    assert failed == [error]


@pytest.mark.parametrize('fails', [False, True], ids=['answers', 'fails'])
def test_asynchronous_callback_is_awaited(monkeypatch: pytest.MonkeyPatch, fails: bool) -> None:
    clock, schedule = Steady(monkeypatch), Schedule()
    failed: list[BaseException] = []
    sent: list[Any] = []

    class Twice:
        def __await__(self) -> Any:
            yield
            yield

    async def work() -> str:
        await Twice()
        if fails:
            raise RuntimeError('no')
        return 'done'

    Hosting(schedule, 1, failed.append).answering(lambda *given: sent.append(given))(work(), 7)
    for k in range(5):
        assert bool(sent or failed) == (k > 2)
        clock.now += 0.02
        schedule.turn()
    assert sent == ([] if fails else [('done', 7)])
    assert [str(error) for error in failed] == (['no'] if fails else [])


def test_file_of_loops(tmp_path: Path) -> None:
    file = tmp_path / 'loops.txt'
    file.write_text('# the old hall\nline_1/reactor_1\n\n/line_1/reactor_2   # rebuilt\n')
    assert read_loops(file) == ('/line_1/reactor_1', '/line_1/reactor_2')


@pytest.mark.parametrize(('text', 'words'), [
    ('a\nb//c\n', "line 2: 'b//c' is no namespace"),
    ('a\n2b\n', "line 2: '2b' is no namespace"),
    ('a\nb\n/a\n', 'line 3: /a is in line 1, too'),
    ('# none yet\n', 'names no loop: write one namespace a line'),
])
def test_file_of_loops_that_cannot_be(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / 'loops.txt'
    file.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        read_loops(file)
    assert words in str(caught.value)


def test_loops_are_taken_by_the_nodes_that_can_be_many(capsys: pytest.CaptureFixture[str]) -> None:
    given = ['program', '--loops', 'loops.txt', '--ros-args', '-p', 'system:=reactor']
    assert answer('controller', given, hosts=True) is None
    assert answer('trainer', given) == 2
    assert answer('controller', ['program', '--loops'], hosts=True) == 2
    assert capsys.readouterr().err.count("unknown argument '--loops'") == 2


@pytest.mark.parametrize(('loops', 'turns'), [
    # the whole look of 0.04 s in one turn
    (1, [[0, 1, 2], [0, 1, 2]]),
    # one topic of 0.02 s in each, and 40 s between them
    (100, [[0], [1], [2], [], [0]]),
])
def test_looks_of_all_loops_take_a_twentieth_of_a_core_a_topic_at_a_time(
        monkeypatch: pytest.MonkeyPatch, loops: int, turns: list[list[int]]) -> None:
    clock, schedule = Steady(monkeypatch), Schedule()
    spent = 0.0
    monkeypatch.setattr(topics.time, 'thread_time', lambda: spent)
    looked: dict[float, list[int]] = {}  # topics by the time of a turn

    def look(_: topics.Matching) -> Iterator[None]:
        nonlocal spent
        for topic in range(3):
            spent += 0.02
            looked.setdefault(clock.now, []).append(topic)
            yield
        looked.setdefault(clock.now, [])
        spent += 0.02

    monkeypatch.setattr(topics.Matching, '_look', look)
    with isolated_domain():
        rclpy.init()
        try:
            node = HostableNode('one', Hosting(schedule, loops, _raised))
            topics.Matching(node, lambda: None)
            while len(looked) < len(turns):
                clock.now += 0.5
                schedule.turn()
            node.destroy_node()
        finally:
            rclpy.shutdown()
    assert list(looked.values())[:len(turns)] == turns
    first, second = list(looked)[:2]
    assert second - first == pytest.approx(1.6 if loops == 1 else 40.0, abs=0.5)


def _raised(error: BaseException) -> None:
    raise error
