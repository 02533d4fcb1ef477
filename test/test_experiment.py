# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The identification experiment without a plant: its steps, its limits, and every way it ends."""

from dataclasses import replace
import math

import numpy as np
import pytest

from koopman_ros import experiment
from koopman_ros.experiment import advance, begin, end, Experiment, Following, level, Phase
from koopman_ros.units import NANOSECONDS as SECOND
from support.closed_loops import say

START = 1_785_000_000 * SECOND
PLAN = Experiment(
    duration=600.0, input_lower=282.0, input_upper=300.0, hold_shortest=20.0, hold_longest=50.0,
    rate=1.0, state_lower=305.0, state_upper=327.0, safe_input=292.0, seed=3,
    state='temperature')
INSIDE = 315.0  # K


def run(plan: Experiment = PLAN, seconds: int = 700) -> list[experiment.Progress]:
    """Measure once a second, from the start on."""
    history = [begin(plan, START)]
    for k in range(1, seconds + 1):
        history.append(advance(plan, history[-1], INSIDE, START + k * SECOND))
    return history


def test_steps_cover_the_duration_within_their_limits() -> None:
    plan = replace(PLAN, duration=3e5)
    ends, levels = plan.steps
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
    ends, _ = replace(PLAN, hold_shortest=30.0, hold_longest=30.0).steps
    np.testing.assert_allclose(ends, 30.0 * np.arange(1, 21))


def test_a_seed_gives_the_same_steps_and_another_seed_others() -> None:
    again, other = replace(PLAN), replace(PLAN, seed=4)
    np.testing.assert_array_equal(PLAN.steps, again.steps)
    assert not np.array_equal(PLAN.steps[1][:5], other.steps[1][:5])
    assert run() == run(again)


def test_each_level_is_reached_along_the_rate_limit_and_the_safe_input_at_the_end() -> None:
    history = run()
    ends, levels = PLAN.steps
    # a level of at least 20 s is reached, at 1 K/s over 18 K at most
    for reached, wanted in zip(ends[:-1], levels[:-1], strict=True):
        before = history[math.ceil(reached) - 1]
        assert before.command == level(PLAN, before) == wanted
    commands = np.array([progress.command for progress in history])
    assert commands[0] == 292.0
    assert 282.0 <= commands.min() <= commands.max() <= 300.0
    assert np.abs(np.diff(commands)).max() == pytest.approx(1.0, abs=1e-12)
    assert {progress.phase for progress in history[:600]} == {Phase.RUNNING}
    assert {progress.phase for progress in history[600:]} == {Phase.FINISHED}
    assert set(commands[620:]) == {292.0}


@pytest.mark.parametrize(('measured', 'words'), [
    (304.99, 'the temperature 304.99 K is outside the bounds of the experiment, 305 K to 327 K'),
    (305.0, None),
    (327.0, None),
    (327.01, 'the temperature 327.01 K is outside the bounds'),
    (math.nan, 'the measured temperature is nan, not finite: check the sensor'),
    (-math.inf, 'not finite'),
])
def test_a_bad_measurement_aborts_and_refuses_a_start(measured: float, words: str | None) -> None:
    after = advance(PLAN, begin(PLAN, START), measured, START + SECOND)
    assert (PLAN.refusal(measured) is None) == (words is None)
    assert after.phase is (Phase.RUNNING if words is None else Phase.ABORTED)
    if words is not None:
        assert words in say(PLAN.refusal(measured))
        assert words in say(after.reason)


def test_aborted_input_returns_along_the_rate_limit_and_stays() -> None:
    progress = replace(run(seconds=300)[-1], command=299.5)
    commands = []
    for k in range(301, 330):
        # back inside, it goes on to the safe input all the same
        progress = advance(PLAN, progress, 328.0 if k == 301 else INSIDE, START + k * SECOND)
        commands.append(progress.command)
    assert commands[:8] == [298.5, 297.5, 296.5, 295.5, 294.5, 293.5, 292.5, 292.0]
    assert set(commands[8:]) == {292.0}
    assert progress.phase is Phase.ABORTED


def test_ended_input_returns_and_the_first_end_counts() -> None:
    progress = end(run(seconds=300)[-1], Phase.ENDED)
    progress = end(progress, Phase.ABORTED, 'too late')
    assert (progress.phase, progress.reason) == (Phase.ENDED, None)
    assert level(PLAN, progress) == 292.0
    for k in range(301, 320):
        progress = advance(PLAN, progress, 400.0, START + k * SECOND)
    assert (progress.phase, progress.command) == (Phase.ENDED, 292.0)


def test_input_returns_without_measurements() -> None:
    progress = end(replace(run(seconds=300)[-1], command=285.0), Phase.ABORTED, 'silence')
    for k in range(100):
        progress = advance(PLAN, progress, None, START + 300 * SECOND + k * SECOND // 10)
    assert progress.command == 292.0


def test_a_stamp_that_is_not_later_moves_nothing_and_time_that_goes_back_aborts() -> None:
    progress = run(seconds=10)[-1]
    for time_ns in (progress.time_ns, progress.time_ns - SECOND):
        assert advance(PLAN, progress, INSIDE, time_ns) == progress
    progress = advance(PLAN, progress, INSIDE, START)
    assert progress.phase is Phase.ABORTED
    assert 'went back' in say(progress.reason)
    # time starts afresh for the way to the safe input
    progress = advance(PLAN, replace(progress, command=299.0), INSIDE, START + SECOND)
    assert progress.command == 298.0


def test_a_gap_counts_as_twice_the_interval_before() -> None:
    before = replace(run(seconds=10)[-1], command=282.0, phase=Phase.FINISHED)
    after = advance(PLAN, before, INSIDE, before.time_ns + 60 * SECOND)
    assert after.command == 284.0


@pytest.mark.parametrize(('change', 'words'), [
    ({'input_lower': 300.0}, 'input_lower = 300.0 must be below input_upper = 300.0'),
    ({'state_upper': 300.0}, 'state_lower = 305.0 must be below state_upper = 300.0'),
    ({'state_upper': math.nan}, 'must be below'),
    ({'hold_longest': 10.0}, 'not above hold_longest = 10.0 s'),
    ({'hold_shortest': 0.0}, 'hold_shortest = 0.0 s must be above 0'),
    ({'duration': math.inf}, 'duration = inf must be finite and above 0'),
    ({'rate': 0.0}, 'rate = 0.0 must be finite and above 0'),
])
def test_contradicting_limits_are_refused(change: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(PLAN, **change)


# What a controller in manual mode commands, what was asked for, and how often it went astray.
@pytest.mark.parametrize(('heard', 'asked', 'astray'), [
    ([292.0, 292.0, 292.0], [292.0, 292.0, 292.0], 0),
    ([292.0, 292.1, 292.2], [300.0, 300.0, 300.0], 0),  # at a slower rate
    ([292.0, 293.0, 294.0], [293.0, 294.0, 295.0], 0),  # a sample late
    ([290.0] * 6, [292.0] * 6, 5),
    ([295.0, 296.0, 297.0, 298.0, 299.0, 300.0], [292.0] * 6, 5),
    ([290.0 + 1e-5 * k for k in range(6)], [292.0] * 6, 5),  # settles by itself
])
def test_controller_that_comes_nearer_follows(
        heard: list[float], asked: list[float], astray: int) -> None:
    following = Following()
    for now, (command, wanted) in enumerate(zip(heard, asked, strict=True)):
        following = following.after(command, wanted, float(now))
    assert following.astray == astray
    if astray:
        assert following.since == 1.0
        assert following.after(292.0, 292.0, 9.0) == Following(292.0, 0, 9.0)
