# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The identification experiment without a plant: its steps, its limits, and every way it ends."""

from dataclasses import replace
import math
from typing import Any

import numpy as np
import pytest

from koopman_ros.control import experiment
from koopman_ros.control.experiment import (
    advance,
    begin,
    end,
    Experiment,
    ExperimentPhase,
    level,
    TrackingMonitor,
)
from koopman_ros.core.status import StatusFormatter
from koopman_ros.core.units import Displays
from koopman_ros.core.units import NANOSECONDS as SECOND
from support.closed_loops import say

START = 1_785_000_000 * SECOND
PLAN = Experiment(
    duration=600.0, names=('coolant',), lower=np.array([282.0]), upper=np.array([300.0]),
    rate=np.array([1.0]), home=np.array([292.0]), hold_shortest=20.0, hold_longest=50.0,
    measured=('temperature',), measured_lower=np.array([305.0]), measured_upper=np.array([327.0]),
    seed=3)
INSIDE = np.array([315.0])  # K
# a jacket and a valve, which takes 40 s from end to end; any pressure below 9e5 will do
PAIR = replace(
    PLAN, names=('coolant', 'valve'), lower=np.array([282.0, 0.1]), upper=np.array([300.0, 0.9]),
    rate=np.array([1.0, 0.02]), home=np.array([292.0, 0.3]), hold_shortest=45.0, hold_longest=80.0,
    measured=('temperature', 'pressure'), measured_lower=np.array([305.0, -math.inf]),
    measured_upper=np.array([327.0, 9e5]))
PAIR_INSIDE = np.array([315.0, 2e5])
# a set-point under control, which was none of the levels before
SETPOINT = replace(
    PLAN, names=('temperature',), lower=np.array([316.0]), upper=np.array([324.0]),
    rate=np.array([0.5]), home=np.array([314.0]), seed=7)


def run(plan: Experiment = PLAN, seconds: int = 700, measured: np.ndarray = INSIDE
        ) -> list[experiment.ExperimentProgress]:
    """Measure once a second, from the start on."""
    history = [begin(plan, START)]
    for k in range(1, seconds + 1):
        history.append(advance(plan, history[-1], measured, START + k * SECOND))
    return history


def test_steps_cover_the_duration_within_their_limits() -> None:
    plan = replace(PLAN, duration=3e5)
    (ends, levels), = plan.steps
    holds = np.diff(ends, prepend=0.0)
    assert len(ends) == len(levels) > 8000
    assert ends[-2] < plan.duration <= ends[-1]
    assert 20.0 <= holds.min() < 20.1 < 49.9 < holds.max() <= 50.0
    assert 282.0 <= levels.min() < 282.1 < 299.9 < levels.max() <= 300.0
    # uniform: mean and standard deviation, within four standard errors
    assert levels.mean() == pytest.approx(291.0, abs=4.0 * 5.2 / math.sqrt(len(levels)))
    assert levels.std() == pytest.approx(18.0 / math.sqrt(12.0), rel=0.03)
    assert holds.mean() == pytest.approx(35.0, abs=4.0 * 8.7 / math.sqrt(len(holds)))
    assert abs(np.corrcoef(levels[1:], levels[:-1])[0, 1]) < 0.05
    (ends, _), = replace(PLAN, hold_shortest=30.0, hold_longest=30.0).steps
    np.testing.assert_allclose(ends, 30.0 * np.arange(1, 21))


def test_steps_begin_at_the_present_values() -> None:
    start = np.array([281.0, 0.75])
    progress = begin(PAIR, START, start)
    np.testing.assert_array_equal(progress.command, start)
    for k in range(1, 60):
        before, progress = progress, advance(PAIR, progress, PAIR_INSIDE, START + k * SECOND)
        assert (abs(progress.command - before.command) <= PAIR.rate * (1.0 + 1e-9)).all()
    assert progress.command[0] > 281.0


@pytest.mark.parametrize(('plan', 'measured'), [
    (PLAN, INSIDE), (PAIR, PAIR_INSIDE), (SETPOINT, INSIDE)], ids=['input', 'inputs', 'setpoint'])
def test_each_level_is_reached_along_its_rate_and_home_at_the_end(
        plan: Experiment, measured: np.ndarray) -> None:
    history = run(plan, measured=measured)
    commands = np.array([progress.command for progress in history])
    for j, (ends, levels) in enumerate(plan.steps):
        # a whole range takes less time than the shortest hold
        for reached, wanted in zip(ends[:-1], levels[:-1], strict=True):
            before = history[math.ceil(reached) - 1]
            assert before.command[j] == level(plan, before)[j] == wanted
    np.testing.assert_array_equal(commands[0], plan.home)
    assert np.all(commands >= np.minimum(plan.lower, plan.home))
    assert np.all(commands <= plan.upper)
    np.testing.assert_allclose(np.abs(np.diff(commands, axis=0)).max(axis=0), plan.rate,
                               rtol=1e-9)
    assert {progress.phase for progress in history[:600]} == {ExperimentPhase.RUNNING}
    assert {progress.phase for progress in history[600:]} == {ExperimentPhase.FINISHED}
    np.testing.assert_array_equal(commands[640:], np.tile(plan.home, (61, 1)))


@pytest.mark.parametrize(('measured', 'words'), [
    ((304.99, 2e5), 'the temperature 304.99 K is outside the bounds of the experiment, 305 K to '
     '327 K'),
    ((305.0, 9e5), None),
    ((327.0, -1e9), None),
    ((327.01, 2e5), 'the temperature 327.01 K is outside the bounds'),
    ((315.0, 900001.0), 'the pressure 900001 Pa is outside the bounds of the experiment, -inf Pa '
     'to 900000 Pa'),
    ((math.nan, 2e5), 'the measured temperature is nan, not finite: check the sensor'),
    ((315.0, -math.inf), 'the measured pressure is -inf, not finite'),
])
def test_a_bad_measurement_aborts_and_rejects_a_start(
        measured: tuple[float, float], words: str | None) -> None:
    y = np.array(measured)
    write = StatusFormatter(Displays({'temperature': 'K', 'pressure': 'Pa'}))
    # a stamp heard before moves nothing, but what it carries counts
    for time_ns in (START + SECOND, START):
        after = advance(PAIR, begin(PAIR, START), y, time_ns)
        assert (PAIR.rejection(y) is None) == (words is None)
        assert after.phase is (ExperimentPhase.RUNNING if words is None
                               else ExperimentPhase.ABORTED)
        if words is not None:
            assert words in write(PAIR.rejection(y))
            assert words in write(after.reason)


@pytest.mark.parametrize(('bad', 'last'), [((400.0, 2e5), (299.5, 0.4)),
                                           ((315.0, 1e6), (291.0, 0.2))])
def test_aborted_signals_return_each_at_its_rate(
        bad: tuple[float, float], last: tuple[float, float]) -> None:
    progress = replace(run(PAIR, 300, PAIR_INSIDE)[-1], command=np.array(last))
    home, rate, start = PAIR.home, PAIR.rate, np.array(last)
    for k in range(1, 20):
        # back inside, they go home all the same
        progress = advance(PAIR, progress, np.array(bad) if k == 1 else PAIR_INSIDE,
                           START + (300 + k) * SECOND)
        left = np.maximum(np.abs(start - home) - k * rate, 0.0)
        np.testing.assert_allclose(progress.command, home + np.sign(start - home) * left,
                                   rtol=0.0, atol=1e-12)
    assert progress.phase is ExperimentPhase.ABORTED


def test_input_returns_without_measurements() -> None:
    progress = replace(run(seconds=300)[-1], command=np.array([285.0]))
    progress = end(progress, ExperimentPhase.ABORTED, 'silence')
    for k in range(100):
        progress = advance(PLAN, progress, None, START + 300 * SECOND + k * SECOND // 10)
    assert progress.command == 292.0


def test_a_repeated_stamp_moves_nothing_a_clock_set_back_aborts_and_a_gap_is_cut_short() -> None:
    progress = run(PAIR, 10, PAIR_INSIDE)[-1]
    for time_ns in (progress.time_ns, progress.time_ns - SECOND):
        assert advance(PAIR, progress, PAIR_INSIDE, time_ns) is progress
    back = progress.time_ns - SECOND - 1
    progress = advance(PAIR, progress, PAIR_INSIDE, back)
    assert progress.phase is ExperimentPhase.ABORTED
    assert 'went back' in say(progress.reason)
    # a gap counts as twice the interval before it
    after = advance(PAIR, replace(run(PAIR, 10, PAIR_INSIDE)[-1], command=np.array([282.0, 0.1]),
                                  phase=ExperimentPhase.FINISHED),
                    PAIR_INSIDE, START + 70 * SECOND)
    np.testing.assert_allclose(after.command, [284.0, 0.14], rtol=1e-12)
    # time starts afresh for the way home
    progress = advance(PAIR, replace(progress, command=np.array([299.0, 0.9])), PAIR_INSIDE,
                       back + SECOND)
    np.testing.assert_allclose(progress.command, [298.0, 0.88], rtol=1e-12)


@pytest.mark.parametrize(('change', 'words'), [
    ({'lower': np.array([282.0, 0.9])}, 'valve: lower = 0.9 must be below upper = 0.9'),
    ({'measured_upper': np.array([300.0, 9e5])},
     'temperature: lower = 305.0 must be below upper = 300.0'),
    ({'measured_upper': np.array([327.0, math.nan])},
     'measured_upper must be finite, but entry .1.'),
    ({'upper': np.array([300.0])}, r'incompatible upper: expected \(2,\), got \(1,\)'),
    ({'measured': ('temperature',)}, r'incompatible measured_lower: expected \(1,\)'),
    ({'home': np.array([292.0, math.inf])}, 'home must be finite, but entry .1. is inf'),
    ({'hold_longest': 10.0}, 'at most hold_longest = 10.0 s'),
    ({'hold_shortest': 0.0}, 'hold_shortest = 0.0 s must be above 0'),
    ({'duration': math.inf}, 'duration = inf s must be finite and above 0'),
    ({'rate': np.array([1.0, 0.0])}, 'valve: rate = 0.0 must be above 0'),
])
def test_contradicting_limits_are_rejected(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(PAIR, **change)


# What a controller commands, or which set-point it tracks, and what was asked for, in ranges of
# three sizes; and how often it deviated.
@pytest.mark.parametrize('span', [18.0, 1.8e-3, 1.8e6])
@pytest.mark.parametrize(('heard', 'asked', 'deviations'), [
    ([292.0, 292.0, 292.0], [292.0, 292.0, 292.0], 0),
    ([292.01, 291.99, 292.01], [292.0, 292.0, 292.0], 0),  # within a thousandth of the range
    ([292.1, 291.9, 292.1], [292.0, 292.0, 292.0], 2),
    ([292.0, 292.1, 292.2], [300.0, 300.0, 300.0], 0),  # at a slower rate
    ([292.0, 293.0, 294.0], [293.0, 294.0, 295.0], 0),  # a sample late
    ([290.0] * 6, [292.0] * 6, 5),
    ([295.0, 296.0, 297.0, 298.0, 299.0, 300.0], [292.0] * 6, 5),
    ([290.0 + 1e-5 * k for k in range(6)], [292.0] * 6, 5),  # settles by itself
])
def test_a_controller_that_approaches_the_setpoint_follows_it(
        heard: list[float], asked: list[float], deviations: int, span: float) -> None:
    monitor, unit = TrackingMonitor(span), span / 18.0
    for now, (command, wanted) in enumerate(zip(heard, asked, strict=True)):
        monitor = monitor.after(command * unit, wanted * unit, float(now))
    assert monitor.deviations == deviations
    if deviations:
        assert monitor.since == 1.0
        assert monitor.after(292.0, 292.0, 9.0) == TrackingMonitor(span, 292.0, 0, 9.0)
