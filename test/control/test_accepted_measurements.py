# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Which measurements are accepted, and what the loop does with the others."""

from dataclasses import replace
import math

import numpy as np
import pytest

from koopman_ros.control import Silence, State
from koopman_ros.estimation import SensorLimits
from support.closed_loops import SETPOINT, shipped, START
from support.sampled_loops import (
    controller,
    EPOCH,
    largest_step,
    levels,
    Reactor,
    say,
    SECOND,
    settled,
)

NAN = math.nan


@pytest.mark.parametrize(('value', 'words'), [
    (NAN, 'the measured temperature is nan, not finite: check the sensor'),
    (math.inf, 'is inf, not finite'),
    (1e300, 'outside the range of the sensor, 253.15 K to 423.15 K: check it'),
    (-0.0, 'the measured temperature -0 K is outside the range of the sensor'),
    (START + 30.0, 'to 354.475 K in 1 s, at most 2 K and 2 K/s are possible: check the sensor'),
])
def test_one_bad_measurement_holds_the_command(value, words):
    loop = Reactor(controller())
    loop.run(10)
    loop.ask(SETPOINT)
    before = loop.run(20)[-1].command
    bad = loop.run(1, lambda _: value)[0]
    assert (bad.command, bad.report.level) == (before, 'hold')
    assert words in say(bad.report.reason)
    assert bad.report.command.law.form == ''
    np.testing.assert_array_equal(bad.report.target.setpoint, [SETPOINT])
    # and the next good one is used
    after = loop.run(1)
    assert (after[0].report.level, after[0].report.reason) == ('sdre', None)


def test_every_other_measurement_is_enough():
    loop = Reactor(controller())
    loop.run(10)
    loop.ask(SETPOINT)
    count = 0

    def flickering(kelvin: float) -> float:
        nonlocal count
        count += 1
        return kelvin if count % 2 else NAN

    samples = loop.run(300, flickering)
    assert settled(samples, SETPOINT, 1e-3) < 250
    assert 'safe' not in levels(samples)


@pytest.mark.parametrize(('by', 'seconds'), [(-3.0, 0), (-9.0, 3)])
def test_a_jump_that_stays_is_accepted_when_the_plant_could_have_got_there(by, seconds):
    loop = Reactor(controller())
    loop.run(10)
    loop.change(x=np.array([loop.kelvin + by]))
    samples = loop.run(300)
    assert [s.report.level for s in samples[:seconds + 1]] == (
        ['hold'] * seconds + ['sdre'])
    if seconds:
        # it is no disturbance
        assert abs(float(samples[seconds].report.estimate.disturbance[0])) < 0.01
    assert settled(samples, START, 1e-3) < 280


def test_a_sensor_that_freezes_under_way_is_found_out():
    loop = Reactor(controller())
    loop.run(10)
    loop.ask(SETPOINT)
    loop.run(10)
    value = loop.kelvin
    frozen = loop.run(40, lambda _: value)
    assert levels(frozen) == ['sdre', 'hold']
    first = next(s for s in frozen if s.report.level == 'hold')
    assert first.second - frozen[0].second == 21
    assert 'for longer than 20 s while the model moved' in say(first.report.reason)
    # what the observer made of it is forgotten
    assert abs(float(first.report.estimate.disturbance[0])) < 0.05


def test_a_plant_at_rest_is_not_frozen():
    loop = Reactor(controller())
    samples = loop.run(100, lambda _: START)
    assert levels(samples) == ['sdre']


def test_a_frozen_sensor_is_not_looked_for_when_switched_off():
    loop = Reactor(controller(sensor={'frozen_timeout': math.inf}))
    loop.run(10)
    loop.ask(SETPOINT)
    assert levels(loop.run(60, lambda _: START)) == ['sdre']


def test_steps_of_the_sensor_are_no_fault():
    loop = Reactor(controller(), noise=0.02)
    loop.run(10)
    loop.ask(SETPOINT)
    samples = loop.run(400, lambda kelvin: 0.1 * round(kelvin / 0.1))
    assert levels(samples) == ['sdre']
    assert max(abs(s.temperature - SETPOINT) for s in samples[-60:]) < 0.1


def test_rare_measurements_are_not_taken_for_a_gap():
    model = shipped('reactor_nz4')
    loop = controller(model)
    state = loop.initialise(State(), np.array([300.0]))
    for k in range(30):
        state, command, report = loop.step(
            state, np.array([START + 1e-9 * k]), EPOCH + 60 * k * SECOND)
        assert report.measurement.missed == 0
        assert report.level == 'sdre'
    assert command[0] == pytest.approx(300.0, abs=1e-3)


def test_missed_measurements_are_counted():
    loop = controller()
    state, missed = State(), []
    for second in (0, 1, 2, 3, 7, 8):
        state, _, report = loop.step(state, np.array([START]), EPOCH + second * SECOND)
        missed.append(report.measurement.missed)
    assert missed == [0, 0, 0, 0, 3, 0]


def test_nobody_watches_before_the_first_measurement():
    loop = controller()
    state, command, report = loop.hold(State(), EPOCH)
    assert (state.command, command, report.reason) == (None, None, None)


@pytest.mark.parametrize('ahead', [15, 3600])
def test_stamps_that_stood_still_while_it_was_watched_do_not_stop_the_law(ahead):
    """The plant was halted, or its clock was an hour ahead for a moment."""
    loop = Reactor(controller())
    loop.run(10)
    loop.ask(START - 2.0)
    loop.do(Silence(EPOCH + (9 + ahead) * SECOND))
    samples = loop.run(300)
    assert levels(samples) == ['sdre']
    assert abs(samples[9].command - samples[0].command) > 0.5
    assert largest_step(samples) <= 1.0 + 1e-9
    assert abs(samples[-1].temperature - (START - 2.0)) < 0.01


def test_manual_commands_go_on_without_measurements():
    loop = Reactor(controller())
    loop.run(10)
    loop.manual(296.0)
    samples = loop.run(20, lambda _: None)
    assert samples[-1].command == 296.0
    assert 'no measurement' in say(samples[-1].report.reason)


@pytest.mark.parametrize(('change', 'message'), [
    ({'lower': np.array([400.0]), 'upper': np.array([300.0])},
     r'sensor limits must be lower < upper, got \[400\.0\] and \[300'),
    ({'rate': np.zeros(1)}, r'rate must be above 0, got \[0\.0\]'),
    ({'jump': np.array([NAN])}, r'jump must be above 0, got \[nan\]'),
    ({'frozen_timeout': -1.0}, r'frozen_timeout must be above 0, got -1\.0'),
])
def test_limits_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(SensorLimits.none(1), **change)
