# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control step: pure, always within limits, and a loop that reaches its set-point."""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from enum import Enum
import math
from typing import Any

import numpy as np
import pytest

from koopman_ros.control import (
    Arrival,
    at,
    Controller,
    Form,
    InputLimits,
    Mode,
    SetpointRequest,
    Settings,
    simulate,
    State,
)
from koopman_ros.lifting import Coordinates, LiftedModel, NetworkObservables, Provenance
from koopman_ros.plants import Process
from support.closed_loops import COOLANT, REACTOR, SETPOINT, shipped, START, two_state_model
from support.sampled_loops import say

SECOND = 1_000_000_000
NOW = 1_785_000_000 * SECOND
LOWER, UPPER, RATE = 280.0, 304.0, 0.8
LARGEST = float(np.finfo(np.float64).max)


def controller(name='reactor_nz4', *, input_weight=1.0, rate=RATE, setpoint_ramp=np.inf,
               **settings):
    return Controller(shipped(name), Settings.for_model(
        shipped(name), state_weight=np.array([1.0]), input_weight=np.array([input_weight]),
        limits=InputLimits(np.array([LOWER]), np.array([UPPER]), np.array([rate])),
        setpoint_ramp=np.array([setpoint_ramp]), **settings))


def plain(model, limits, **settings):
    """Return a controller of any model with weights of one."""
    return Controller(model, Settings.for_model(
        model, state_weight=np.ones(model.n_x), input_weight=np.ones(model.n_u), limits=limits,
        **settings))


def started(loop=None, kelvin=START):
    """Return a state that has seen one measurement."""
    return (loop or controller()).step(State(), np.array([kelvin]), NOW)[0]


def content(value: Any) -> Any:
    """Turn a dataclass with arrays into something that compares bit for bit."""
    if is_dataclass(value):
        return tuple(content(getattr(value, item.name)) for item in fields(value))
    if isinstance(value, tuple):
        return tuple(content(item) for item in value)
    if isinstance(value, Mapping):
        return tuple((key, content(item)) for key, item in value.items())
    if isinstance(value, np.ndarray):
        return (value.shape, value.tobytes())
    if isinstance(value, float):
        return np.float64(value).tobytes()
    assert value is None or isinstance(value, (bool, int, str, Enum))
    return value


# One step.

def test_at_its_setpoint_the_loop_rests():
    state, command, report = controller().step(State(), np.array([START]), NOW)
    np.testing.assert_allclose(command, [300.0], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(report.target.setpoint, [START])
    assert report.command.law.form == Form.RECENTRED.value
    assert report.mode is Mode.AUTOMATIC
    assert (report.reason, report.measurement.outside) == (None, 0.0)
    assert 0.0 <= report.command.law.residual <= 1e-6
    assert 0.0 < report.command.law.gain <= 1e3
    assert (report.command.at_range, report.command.at_rate) == (False, False)
    assert not report.measurement.clock_went_back
    assert state.time_ns == NOW
    assert state.command is not None


def test_a_start_elsewhere_holds_what_it_finds():
    _, command, report = controller().step(State(), np.array([SETPOINT]), NOW)
    np.testing.assert_array_equal(report.target.setpoint, [SETPOINT])
    np.testing.assert_allclose(command, [COOLANT], rtol=0, atol=1e-3)


def test_a_law_with_unstable_modes_is_reported_as_projected():
    loop = plain(two_state_model(), InputLimits(
        np.array([-50.0]), np.array([50.0]), np.array([np.inf])))
    state = loop.step(State(), np.array([1.0, 2.0]), NOW)[0]
    state, refused = loop.request_setpoint(state, np.zeros(2))
    assert refused is None
    report = loop.step(state, np.array([1.0, 2.0]), NOW + SECOND)[2]
    assert (report.command.law.form, report.reason) == (Form.PROJECTED.value, None)


@pytest.mark.parametrize('measurement', [312.0, 327.5, math.nan, 1e300])
@pytest.mark.parametrize('later', [SECOND, 0, -SECOND])
def test_a_step_is_pure(measurement, later):
    loop = controller(setpoint_ramp=0.1)
    before = loop.request_setpoint(started(loop), np.array([311.0]))[0]
    before = loop.request_setpoint(before, np.array([313.0]), NOW + 9 * SECOND)[0]
    kept, value = content(before), np.array([measurement])
    results = [loop.step(before, value, NOW + later) for _ in range(2)]
    # a loop built afresh has nothing cached
    results.append(controller(setpoint_ramp=0.1).step(before, value.copy(), NOW + later))
    assert content(before) == kept
    np.testing.assert_array_equal(value, [measurement])
    assert len({content(result) for result in results}) == 1


def measurements() -> Iterator[tuple[int, float]]:
    """Yield stamps and temperatures of a rough day: gaps, repeats, glitches, a clock set back."""
    rng = np.random.default_rng(11)
    glitches = (math.nan, math.inf, -math.inf, 1e300, -1e300, LARGEST, -LARGEST, 0.0, -0.0,
                5e-324, 1e20, 305.0, 331.0)
    time_ns = NOW
    for _ in range(400):
        time_ns += int(rng.choice([0, 1, SECOND, 7 * SECOND, 3600 * SECOND, -50 * SECOND]))
        glitch = rng.random() < 0.4
        yield time_ns, float(rng.choice(glitches) if glitch else rng.uniform(303.0, 330.0))


@pytest.mark.parametrize('name', ['reactor_nz3', 'reactor_nz4', 'reactor_linear'])
@pytest.mark.parametrize('mode', list(Mode))
def test_commands_are_finite_and_within_limits_whatever_is_measured(name, mode):
    loop = controller(name, setpoint_ramp=0.2)
    state = loop.set_mode(started(loop), mode)
    state = loop.request_manual_input(state, np.array([299.0]))[0]
    state = loop.request_setpoint(state, np.array([312.0]))[0]
    for time_ns, value in measurements():
        previous, last_ns = state.command, state.time_ns
        state, command, report = loop.step(state, np.array([value]), time_ns)
        assert LOWER <= command[0] <= UPPER
        elapsed = max(0.0, (time_ns - last_ns) / SECOND)
        # rounded at the size of the command
        assert abs(command[0] - previous[0]) <= RATE * elapsed + 1e-12
        assert report.measurement.clock_went_back is (time_ns < last_ns - SECOND)
        arrival = report.measurement.arrival
        assert (arrival is Arrival.LATE) is (last_ns - SECOND <= time_ns < last_ns)
        assert (arrival is Arrival.REPEATED) is (time_ns == last_ns)
        repeated = arrival in (Arrival.LATE, Arrival.REPEATED)
        if not repeated:
            believed = math.isfinite(value)
            assert (report.estimate is not None) or not believed
            assert (report.reason is not None) or believed or mode is Mode.MANUAL
        if repeated:
            np.testing.assert_array_equal(command, previous)


def test_a_day_replays_bit_for_bit():
    def replay():
        loop, state = controller(setpoint_ramp=0.2), State()
        for time_ns, value in measurements():
            state, command, report = loop.step(state, np.array([value]), time_ns)
            yield content(state), content(command), content(report)

    assert list(replay()) == list(replay())


def change_of_variable(scale: float) -> LiftedModel:
    """Return the free lift tanh(x) of one state."""
    c = Coordinates(('x',), ('1',), np.zeros(1), np.array([scale]), -np.ones(1), np.ones(1))
    itself = NetworkObservables(((np.eye(1), np.zeros(1)),), np.eye(1), identity=False)
    return LiftedModel(itself, -np.eye(1), np.eye(1), c, c, 's', Provenance('change of variable'))


@pytest.mark.parametrize('first', [math.nan, LARGEST, -LARGEST, 1e300, 0.0])
@pytest.mark.parametrize('second', [math.inf, LARGEST, -LARGEST, -1e300, -0.0])
def test_scaling_beyond_what_numbers_hold(first, second):
    model = two_state_model()
    fine = replace(model, states=replace(model.states, scale=np.array([1e-3, 0.1])))
    bounds = InputLimits(np.array([-2.0]), np.array([1.0]), np.array([np.inf]))
    for loop, measurement in (
            (plain(fine, bounds), [first, second]),
            (plain(change_of_variable(1e-3), bounds), [first]),
            (plain(change_of_variable(1e3), bounds), [second])):
        state = loop.step(State(), np.zeros(len(measurement)), NOW)[0]
        command = loop.step(state, np.array(measurement), NOW + SECOND)[1]
        assert -2.0 <= command[0] <= 1.0


# Sensor failures.

def test_a_sensor_that_fails_from_the_start_gives_the_nominal_input():
    state, command, report = controller().step(State(), np.array([math.nan]), NOW)
    np.testing.assert_array_equal(command, [300.0])
    assert report.target is None
    assert 'not finite' in say(report.reason)
    # the first valid measurement is what is held
    report = controller().step(state, np.array([315.0]), NOW + SECOND)[2]
    np.testing.assert_array_equal(report.target.setpoint, [315.0])


def test_a_nominal_input_out_of_range_is_limited():
    loop = controller()
    loop = replace(loop, settings=replace(loop.settings, limits=InputLimits(
        np.array([280.0]), np.array([295.0]), np.array([RATE]))))
    _, command, report = loop.step(State(), np.array([math.nan]), NOW)
    np.testing.assert_array_equal(command, [295.0])
    assert report.command.at_range


def test_outside_the_box_the_distance_is_reported():
    model = shipped('reactor_nz4')
    half = 0.5 * (model.states.upper - model.states.lower)
    report = controller().step(started(), model.states.upper + 0.05 * half, NOW + SECOND)[2]
    assert report.measurement.outside == pytest.approx(0.05, rel=1e-9)
    assert report.level == 'sdre'
    assert report.command.law.form == Form.RECENTRED.value


# Time.

def test_a_repeated_stamp_repeats_the_command():
    loop = controller(rate=np.inf)
    state, command, _ = loop.step(started(loop), np.array([320.0]), NOW + SECOND)
    for value in (320.0, 310.0, math.nan):
        again, repeated, report = loop.step(state, np.array([value]), NOW + SECOND)
        np.testing.assert_array_equal(repeated, command)
        assert again.time_ns == NOW + SECOND
        assert (report.measurement.arrival is Arrival.REPEATED)
        assert not report.measurement.clock_went_back


def test_a_range_that_was_tightened_is_reached_at_the_rate():
    loop = controller()
    state = loop.step(started(loop), np.array([START]), NOW + SECOND)[0]
    lower = replace(loop, settings=replace(loop.settings, limits=InputLimits(
        np.array([LOWER]), np.array([290.0]), np.array([RATE]))))
    for second in range(2, 20):
        before = state.command[0]
        state, command, report = lower.step(state, np.array([START]), NOW + second * SECOND)
        assert command[0] == pytest.approx(max(before - RATE, 290.0), abs=1e-9)
    assert report.command.at_range


@pytest.mark.parametrize('late', [1, SECOND // 2, SECOND])
def test_a_measurement_out_of_order_changes_nothing(late):
    loop = controller()
    state = loop.request_setpoint(started(loop), np.array([306.0]))[0]
    state, command, _ = loop.step(state, np.array([START]), NOW + 10 * SECOND)
    state = loop.request_setpoint(state, np.array([310.0]), NOW + 60 * SECOND)[0]
    again, repeated, report = loop.step(state, np.array([START]), NOW + 10 * SECOND - late)
    assert (report.measurement.arrival is Arrival.LATE)
    assert content(again) == content(state)
    np.testing.assert_array_equal(repeated, command)


def test_an_earlier_stamp_starts_time_afresh():
    loop = controller()
    state, command, _ = loop.step(started(loop), np.array([323.5]), NOW + 100 * SECOND)
    state, held, report = loop.step(state, np.array([323.5]), NOW)
    assert report.measurement.clock_went_back
    np.testing.assert_array_equal(held, command)
    assert state.time_ns == NOW
    state = loop.request_setpoint(state, np.array([306.0]))[0]
    _, moved, report = loop.step(state, np.array([323.5]), NOW + SECOND)
    assert not report.measurement.clock_went_back
    assert moved[0] == pytest.approx(held[0] - RATE, rel=1e-12)


def test_an_earlier_stamp_stops_the_ramp_for_one_step():
    loop = controller(setpoint_ramp=0.1)
    state = loop.request_setpoint(started(loop), np.array([310.0]))[0]
    state = loop.step(state, np.array([START]), NOW + 20 * SECOND)[0]
    active = []
    for seconds in (0, 1, 11):
        state, _, report = loop.step(state, np.array([START]), NOW + seconds * SECOND)
        active.append(report.target.setpoint[0])
    np.testing.assert_allclose(active, [START - 2.0, START - 2.1, START - 3.1], rtol=1e-12)


@pytest.mark.parametrize(('ramp', 'read', 'per_second'), [
    (np.inf, lambda command, report: command[0], RATE),
    (0.1, lambda command, report: report.target.setpoint[0], 0.1),
], ids=['rate limit', 'ramp'])
def test_a_gap_in_the_measurements_is_no_licence_to_jump(ramp, read, per_second):
    loop = controller(setpoint_ramp=ramp)
    state = loop.request_setpoint(started(loop), np.array([306.0]))[0]
    values = []
    # an hour without measurements counts as two of the usual intervals
    for second in (1, 2, 3, 3600, 3601):
        state, *outcome = loop.step(state, np.array([START]), NOW + second * SECOND)
        values.append(read(*outcome))
    np.testing.assert_allclose(
        np.diff(values), -per_second * np.array([1.0, 1.0, 2.0, 1.0]), rtol=1e-9)


def test_a_burst_of_measurements_does_not_slow_the_next_ones():
    loop = controller()
    state = loop.request_setpoint(started(loop), np.array([306.0]))[0]
    for milliseconds in (1000, 2000, 2001, 3000):
        before = state.command[0]
        state, command, _ = loop.step(
            state, np.array([START]), NOW + milliseconds * SECOND // 1000)
    assert command[0] == pytest.approx(before - 0.999 * RATE, rel=1e-12)


def test_the_rate_limit_counts_elapsed_time():
    loop = controller()
    state = loop.request_setpoint(started(loop), np.array([306.0]))[0]
    expected = float(state.command[0])
    time_ns = NOW
    for milliseconds in (1000, 250, 1000, 1):
        time_ns += milliseconds * SECOND // 1000
        state, command, report = loop.step(state, np.array([START]), time_ns)
        expected -= RATE * milliseconds / 1000.0
        assert command[0] == pytest.approx(expected, rel=1e-12)
        assert report.command.at_rate
    # with time enough it ends at the range
    for second in range(1, 60):
        state, command, report = loop.step(state, np.array([START]), time_ns + second * SECOND)
    assert command[0] == LOWER
    assert report.command.at_range
    assert not report.command.at_rate


def test_a_scheduled_setpoint_takes_effect_at_its_stamp():
    loop = controller()
    state, refused = loop.request_setpoint(started(loop), np.array([316.0]), NOW + 3 * SECOND)
    assert refused is None
    active = []
    for second in range(1, 6):
        state, _, report = loop.step(state, np.array([START]), NOW + second * SECOND)
        active.append(float(report.target.setpoint[0]))
    assert active == [START, START, 316.0, 316.0, 316.0]


def test_a_refused_setpoint_changes_nothing():
    loop = controller()
    state = loop.request_setpoint(started(loop), np.array([316.0]))[0]
    for value in (math.nan, 200.0, 400.0):
        same, reason = loop.request_setpoint(state, np.array([value]))
        assert same is state
        assert 'the old one is kept' in say(reason)


# Manual mode.

def test_manual_mode_starts_from_the_last_command():
    loop = controller()
    state = loop.request_setpoint(started(loop), np.array([316.0]))[0]
    state, command, _ = loop.step(state, np.array([320.0]), NOW + SECOND)
    state = loop.set_mode(state, Mode.MANUAL)
    for second in range(2, 5):
        state, manual, report = loop.step(state, np.array([310.0]), NOW + second * SECOND)
        np.testing.assert_array_equal(manual, command)
        assert (report.mode, report.level, report.reason) == (Mode.MANUAL, 'manual', None)
        assert report.measurement.outside == 0.0


def test_manual_mode_before_the_first_command_gives_the_nominal_input():
    loop = controller()
    _, command, _ = loop.step(loop.set_mode(State(), Mode.MANUAL), np.array([320.0]), NOW)
    np.testing.assert_array_equal(command, [300.0])


def test_manual_commands_are_followed_within_the_limits():
    loop = controller()
    state = loop.set_mode(started(loop), Mode.MANUAL)
    state, refused = loop.request_manual_input(state, np.array([500.0]))
    assert refused is None
    state, command, report = loop.step(state, np.array([START]), NOW + SECOND)
    assert command[0] == pytest.approx(300.0 + RATE, rel=1e-9)
    assert report.command.at_range
    assert report.command.at_rate
    for second in range(2, 60):
        state, command, report = loop.step(state, np.array([START]), NOW + second * SECOND)
    assert command[0] == UPPER
    assert report.command.at_range


def test_manual_commands_outlive_a_failed_sensor():
    loop = controller()
    state = loop.request_manual_input(
        loop.set_mode(started(loop), Mode.MANUAL), np.array([299.0]))[0]
    _, command, report = loop.step(state, np.array([math.nan]), NOW + 10 * SECOND)
    np.testing.assert_array_equal(command, [299.0])
    assert 'not finite' in say(report.reason)


@pytest.mark.parametrize('value', [math.nan, math.inf])
def test_a_manual_command_that_is_not_finite_is_refused(value):
    loop = controller()
    state = loop.request_manual_input(
        loop.set_mode(started(loop), Mode.MANUAL), np.array([299.0]))[0]
    same, reason = loop.request_manual_input(state, np.array([value]))
    assert same is state
    assert say(reason) == (
        f'manual coolant_temperature {value} K is not finite: the old one is kept')


def test_a_manual_command_is_forgotten_with_the_mode():
    loop = controller()
    state = loop.request_manual_input(
        loop.set_mode(started(loop), Mode.MANUAL), np.array([290.0]))[0]
    state = loop.set_mode(loop.set_mode(state, Mode.AUTOMATIC), Mode.MANUAL)
    _, command, _ = loop.step(state, np.array([START]), NOW + 3600 * SECOND)
    np.testing.assert_array_equal(command, started(loop).command)


def test_back_in_automatic_mode_the_law_acts():
    loop = controller()
    state = loop.request_setpoint(started(loop), np.array([316.0]))[0]
    automatic = loop.step(state, np.array([320.0]), NOW + SECOND)
    detour = loop.set_mode(loop.set_mode(state, Mode.MANUAL), Mode.AUTOMATIC)
    assert content(loop.step(detour, np.array([320.0]), NOW + SECOND)) == content(automatic)


# The loop: the true reactor, sampled every second.

def drive(loop, seconds, *, kelvin=START, setpoint=SETPOINT):
    """Return the temperatures and commands of a closed loop after a change of set-point."""
    run = simulate(loop, Process(REACTOR, 0, np.array([kelvin]), REACTOR.nominal_input), [
        at(1.0, SetpointRequest(0, np.array([setpoint])))], duration=seconds)
    assert set(run.reasons) == {None}
    return run.states[1:, 0], run.commands[1:, 0]


@pytest.mark.parametrize('name', ['reactor_nz3', 'reactor_nz4'])
@pytest.mark.parametrize(('kelvin', 'setpoint'), [(START, SETPOINT), (308.0, 322.0)])
@pytest.mark.parametrize('input_weight', [1.0, 0.1])
def test_a_sampled_loop_reaches_its_setpoint(name, kelvin, setpoint, input_weight):
    temperatures, commands = drive(
        controller(name, input_weight=input_weight), 480, kelvin=kelvin, setpoint=setpoint)
    assert np.max(np.abs(temperatures[-60:] - setpoint)) < 0.01
    assert np.all((commands >= LOWER) & (commands <= UPPER))
    assert np.max(np.abs(np.diff(commands))) <= RATE + 1e-9
    # on its way it does not overshoot by more than a tenth of a kelvin
    travelled = np.sign(setpoint - kelvin) * (temperatures - setpoint)
    assert np.max(travelled) < 0.1


def test_a_ramped_loop_follows_its_ramp():
    temperatures, _ = drive(controller(setpoint_ramp=0.02), 900)
    assert abs(temperatures[-1] - SETPOINT) < 0.01
    # the ramp alone takes 500 s
    assert temperatures[249] == pytest.approx(START - 5.0, abs=1.0)


def test_the_linear_model_leaves_the_sampled_loop_off_target():
    temperatures, _ = drive(controller('reactor_linear'), 480)
    assert temperatures[-1] - SETPOINT == pytest.approx(1.9334, abs=1e-2)


def test_a_full_schedule_refuses_more_but_not_what_holds_at_once():
    loop = controller()
    state = started(loop)
    for n in range(1000):
        state, refused = loop.request_setpoint(state, np.array([316.0]), NOW + (n + 1) * SECOND)
        assert refused is None
    full, refused = loop.request_setpoint(state, np.array([317.0]), NOW + 2000 * SECOND)
    assert full is state
    assert say(refused).startswith('1000 set-points are scheduled already: wait')
    state, refused = loop.request_setpoint(state, np.array([317.0]))
    assert refused is None
    np.testing.assert_array_equal(state.setpoint.requested, [317.0])


def test_a_schedule_does_not_outlive_its_clock():
    loop = controller()
    state = loop.request_setpoint(started(loop), np.array([316.0]), NOW + 50 * SECOND)[0]
    state = loop.step(state, np.array([START]), NOW - 100 * SECOND)[0]
    assert state.setpoint.scheduled == ()
    assert loop.step(state, np.array([START]), NOW + 51 * SECOND)[2].target.setpoint == START


def test_manual_commands_are_refused_in_automatic_mode():
    loop = controller()
    state = started(loop)
    same, refused = loop.request_manual_input(state, np.array([299.0]))
    assert same is state
    assert say(refused) == 'manual command refused in automatic mode: switch to manual mode first'


def test_asking_for_the_mode_in_force_changes_nothing():
    loop = controller()
    state = loop.set_mode(started(loop), Mode.MANUAL)
    state = loop.request_manual_input(state, np.array([290.0]))[0]
    assert loop.set_mode(state, Mode.MANUAL) is state


def test_what_a_step_returns_and_takes_cannot_be_changed_afterwards():
    loop = controller()
    asked = np.array([312.0])
    state = loop.request_setpoint(started(loop), asked)[0]
    asked[0] = 999.0
    assert state.setpoint.requested[0] == 312.0
    state, command, _ = loop.step(state, np.array([START]), NOW + SECOND)
    with pytest.raises(ValueError, match='read-only'):
        command[0] = 0.0
    assert state.command[0] == command[0]


@pytest.mark.parametrize(('change', 'message'), [
    ({'state_weight': np.array([0.0])}, r'state_weight must be finite, at least 0 and not all 0'),
    ({'state_weight': np.array([-1.0])}, 'state_weight must be'),
    ({'input_weight': np.array([0.0])}, r'input_weight must be finite and above 0, got \[0\.0\]'),
    ({'input_weight': np.array([np.nan])}, 'input_weight must be'),
    ({'setpoint_ramp': np.zeros(1)}, r'setpoint_ramp must be above 0, got \[0\.0\]'),
])
def test_settings_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(controller().settings, **change)


@pytest.mark.parametrize(('lower', 'upper', 'rate', 'message'), [
    (290.0, 280.0, 1.0, r'input limits must be lower < upper, got \[290\.0\] and \[280\.0\]'),
    (280.0, 290.0, 0.0, r'input rate must be above 0, got \[0\.0\]'),
    (280.0, 290.0, np.nan, 'input rate must be above 0'),
])
def test_limits_that_make_no_sense_are_refused(lower, upper, rate, message):
    with pytest.raises(ValueError, match=message):
        InputLimits(np.array([lower]), np.array([upper]), np.array([rate]))
