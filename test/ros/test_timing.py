# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Silence, age and countable time of measurements, by a clock that the test turns."""

import math
from types import SimpleNamespace

import pytest

from koopman_ros.core.time_base import Advance
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.ros import timing
from koopman_ros.ros.timing import Timing

EPOCH = 1_785_000_000  # s
WINDOW = 10.0  # s


class Clocks:
    """The steady clock, the system's and /clock, in s; and a node that reads them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, simulated: bool) -> None:
        self.steady, self.simulated = 100.0, 0.0
        monkeypatch.setattr(timing, 'time', SimpleNamespace(
            monotonic=lambda: self.steady,
            time_ns=lambda: round((EPOCH + self.steady) * SECOND)))
        self.node = SimpleNamespace(
            get_parameter=lambda _: SimpleNamespace(value=simulated),
            get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(
                nanoseconds=round(self.simulated * SECOND))))

    def pass_by(self, seconds: float, simulated: float = 0.0) -> None:
        self.steady += seconds
        self.simulated += simulated


def measured(timing: Timing, stamp: float) -> Advance:
    at, stamp_ns = timing.now(), round(stamp * SECOND)
    found = timing.arrive(stamp_ns, at, WINDOW)
    if found in (Advance.NEW, Advance.RESTARTED):
        timing.note(stamp_ns, at)
    return found


@pytest.mark.parametrize('stamps', [
    (7.0,), (6.1, 6.3, 6.5, 6.7, 6.9)], ids=['stands', 'cycles'])
def test_stamps_that_do_not_advance_end_no_silence(
        monkeypatch: pytest.MonkeyPatch, stamps: tuple[float, ...]) -> None:
    clocks = Clocks(monkeypatch, simulated=False)
    timing = Timing(clocks.node)
    measured(timing, 7.0)
    for k in range(100):
        clocks.pass_by(0.2)
        assert measured(timing, stamps[k % len(stamps)]) is Advance.OLD
    assert timing.silence == pytest.approx(20.0)
    assert timing.silence_cause(10.0) is Advance.OLD
    clocks.pass_by(11.0)
    # then nothing arrives at all
    assert timing.silence_cause(10.0) is None
    assert measured(timing, 7.2) is Advance.NEW
    assert (timing.silence, timing.silence_cause(10.0)) == (0.0, None)


def test_seconds_count_as_far_as_they_have_passed_and_one_more(
        monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks(monkeypatch, simulated=False)
    timing = Timing(clocks.node)

    def counted(passed: float, seconds: float, age: float = 0.0) -> float | None:
        clocks.pass_by(passed)
        at = timing.now()
        return timing.countable(seconds, at[2] - round(age * SECOND), at)

    assert counted(1.0, 1.0) == 1.0
    # a little early and late
    assert [counted(passed, 1.0) for passed in (0.7, 1.3, 0.6, 1.4, 1.0)] == [1.0] * 5
    # stamps ten times too fast
    assert sum(counted(0.1, 1.0) for _ in range(100)) == pytest.approx(10.0 + 1.0)
    # of another time than the clock's
    assert counted(0.1, 1.0, age=7200.0) is None
    assert counted(0.0, 100.0) == pytest.approx(0.0, abs=1e-6)
    # of the time that commands in a silence have counted nothing is left
    clocks.pass_by(20.0)
    timing.commanded()
    assert counted(0.25, 100.0) == pytest.approx(0.25)


def test_paused_simulation_is_no_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks(monkeypatch, simulated=True)
    timing = Timing(clocks.node)
    for _ in range(3):
        clocks.pass_by(20.0, 1.0)
        measured(timing, clocks.simulated)
        assert not timing.paused
    clocks.pass_by(50.0)
    assert (timing.silence, timing.paused) == (0.0, False)
    clocks.pass_by(15.0)
    # as long as three samples of this slow simulation took
    assert (timing.silence, timing.paused) == (0.0, True)
    assert timing.wall_silence == 65.0
    clocks.pass_by(1.0, 12.0)
    assert (timing.silence, timing.paused) == (12.0, False)
    assert math.isfinite(timing.age)


def test_seconds_count_once_on_a_simulated_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks(monkeypatch, simulated=True)
    timing = Timing(clocks.node)
    clocks.pass_by(0.1, 1000.0)

    def counted(stamp: float, seconds: float) -> float | None:
        return timing.countable(seconds, round(stamp * SECOND), timing.now())

    assert counted(1000.0, 1.0) == 1.0
    # before /clock, which is published every ten seconds
    assert [counted(1000.0 + k, 1.0) for k in range(1, 11)] == [1.0] * 10
    clocks.pass_by(0.1, 10.0)
    assert counted(1011.0, 1.0) == 1.0
    # the watchdog has commanded until 1020 s, then all that was under way comes at once
    clocks.pass_by(0.1, 10.0)
    timing.commanded()
    late = [counted(1011.0 + k, 1.0) for k in range(1, 10)]
    assert sum(late) == pytest.approx(1.0)
    # a simulation that begins again
    clocks.pass_by(0.1, -1000.0)
    assert counted(20.5, 1.0) is not None
    clocks.pass_by(0.1, 1.0)
    assert counted(21.5, 1.0) == 1.0
