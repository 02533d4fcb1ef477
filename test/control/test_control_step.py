# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control step: set-points, sensor failures, time and manual mode, one measurement each."""

from dataclasses import replace
from itertools import pairwise
import math
from pathlib import Path
import sys
import warnings

import numpy as np
import pytest

import koopman_ros
from koopman_ros.control import Arrival, Controller, Form, InputLimits, Mode, State, Tuning
from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.setpoint import advance, HORIZON_NANOSECONDS, rejection, request, Setpoint
from koopman_ros.core.status import StatusCode
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.export import c_code
from koopman_ros.parameters.controller import built, table_of
from support.closed_loops import content, COOLANT, say, SETPOINT, shipped, START

NOW = 1_785_000_000 * SECOND
LOWER, UPPER, RATE = 280.0, 304.0, 0.8


def plain(model, limits, **settings):
    """Return a controller of any model with weights of one."""
    return Controller(model, Tuning.for_model(
        model, state_weight=np.ones(model.n_x), input_weight=np.ones(model.n_u), limits=limits,
        **settings))


def controller(*, rate=RATE, **settings):
    return plain(shipped('reactor_nz4'), InputLimits(
        np.array([LOWER]), np.array([UPPER]), np.array([rate])), **settings)


def started(loop=None, *requests):
    """Return a state that has seen one measurement, then set-points with their stamps."""
    loop = loop or controller()
    state = loop.step(State(), np.array([START]), NOW)[0]
    for kelvin, *effective_ns in requests:
        state, rejected = loop.request_setpoint(state, np.array([kelvin]), *effective_ns)
        assert rejected is None
    return state


def measured(loop, state, kelvin, seconds):
    """Measure so many seconds after the start."""
    return loop.step(state, np.array([kelvin]), NOW + round(seconds * SECOND))


# One step.

def test_a_step_is_a_short_list_of_calls_that_seldom_change_the_file():
    loop, state, files = controller(observer_bandwidth=0.1), State(), []
    noise = 0.01 * np.random.default_rng(1).standard_normal(60)
    for second, error in enumerate(noise.tolist()):
        state = measured(loop, state, START + error, second)[0]
    package = str(Path(koopman_ros.__file__).parent)

    def called(frame, event, _):
        if event == 'call' and frame.f_code.co_filename.startswith(package):
            files.append(frame.f_code.co_filename)

    before = sys.getprofile()
    sys.setprofile(called)
    try:
        report = measured(loop, state, START, len(noise))[2]
    finally:
        sys.setprofile(before)
    assert (report.level, report.reason) == ('sdre', None)
    assert len(files) < 140
    assert sum(one != other for one, other in pairwise(files)) < 60


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
    assert (state.time_ns, state.command) == (NOW, command)


def test_a_start_away_from_the_nominal_point_holds_the_measured_state():
    _, command, report = controller().step(State(), np.array([SETPOINT]), NOW)
    np.testing.assert_array_equal(report.target.setpoint, [SETPOINT])
    np.testing.assert_allclose(command, [COOLANT], rtol=0, atol=1e-3)


def test_the_input_of_a_law_is_remembered_within_the_range():
    """A later law takes over from what was commanded, whatever this one would have liked."""
    loop = plain(shipped('reactor_nz4'), InputLimits(
        np.array([298.0]), np.array([UPPER]), np.array([np.inf])))
    state, command, report = measured(loop, started(loop, (321.5,)), START, 1.0)
    assert report.level == 'sdre'
    assert report.command.at_range
    np.testing.assert_array_equal([command, state.law_input], [[298.0]] * 2)


def test_arguments_and_results_of_a_step_are_read_only():
    loop, asked = controller(), np.array([312.0])
    state = loop.request_setpoint(started(loop), asked)[0]
    asked[0] = 999.0
    assert state.setpoint.requested[0] == 312.0
    with pytest.raises(ValueError, match='read-only'):
        measured(loop, state, START, 1)[1][0] = 0.0


# Sensor failures.

def test_a_sensor_that_fails_from_the_start_gives_the_nominal_input():
    state, command, report = controller().step(State(), np.array([math.nan]), NOW)
    np.testing.assert_array_equal(command, [300.0])
    assert report.target is None
    assert 'not finite' in say(report.reason)
    # the first valid measurement is what is held
    report = measured(controller(), state, 315.0, 1)[2]
    np.testing.assert_array_equal(report.target.setpoint, [315.0])
    # within the limits
    cold = plain(shipped('reactor_nz4'), InputLimits(
        np.array([280.0]), np.array([295.0]), np.array([RATE])))
    _, command, report = cold.step(State(), np.array([math.nan]), NOW)
    np.testing.assert_array_equal(command, [295.0])
    assert report.command.at_range


# Time.

@pytest.mark.parametrize(('late', 'arrival'), [
    (0, Arrival.REPEATED), (1, Arrival.LATE), (SECOND, Arrival.LATE)])
def test_a_measurement_again_or_out_of_order_changes_nothing(late, arrival):
    loop = controller()
    state, command, _ = measured(loop, started(loop, (306.0,)), START, 10)
    again, repeated, report = loop.step(state, np.array([310.0]), NOW + 10 * SECOND - late)
    assert report.measurement.arrival is arrival
    assert (content(again), repeated) == (content(state), command)


def test_an_earlier_stamp_starts_time_afresh():
    loop = controller()
    state, command, _ = measured(loop, started(loop), 323.5, 100)
    state = loop.request_setpoint(state, np.array([316.0]), NOW + 150 * SECOND)[0]
    state, held, report = measured(loop, state, 323.5, 0)
    assert report.measurement.clock_went_back
    np.testing.assert_array_equal(held, command)
    assert state.time_ns == NOW
    # a schedule does not outlive its clock
    assert state.setpoint.scheduled == ()
    assert measured(loop, state, START, 151)[2].target.setpoint == START
    state = loop.request_setpoint(state, np.array([306.0]))[0]
    _, moved, report = measured(loop, state, 323.5, 1)
    assert not report.measurement.clock_went_back
    assert moved[0] == pytest.approx(held[0] - RATE, rel=1e-12)


@pytest.mark.parametrize(('ramp', 'read', 'per_second'), [
    (np.inf, lambda command, report: command[0], RATE),
    (0.1, lambda command, report: report.target.setpoint[0], 0.1),
], ids=['rate limit', 'ramp'])
@pytest.mark.parametrize(('stamps', 'counted'), [
    # an hour without measurements counts as two of the usual intervals
    ((1, 2, 3, 3600, 3601), (1.0, 1.0, 2.0, 1.0)),
    # a burst does not slow the next ones
    ((1, 2, 2.001, 3), (1.0, 0.001, 0.999)),
    ((1, 1.25, 2.25, 2.251), (0.25, 1.0, 0.001))], ids=['gap', 'burst', 'irregular'])
def test_elapsed_time_counts_but_for_gaps(ramp, read, per_second, stamps, counted):
    loop = controller(setpoint_ramp=np.array([ramp]))
    state, values = started(loop, (306.0,)), []
    for second in stamps:
        state, *outcome = measured(loop, state, START, second)
        values.append(read(*outcome))
    np.testing.assert_allclose(np.diff(values), -per_second * np.array(counted), rtol=1e-9)


@pytest.mark.parametrize('offset', [2, 50, 1000])
def test_two_clocks_in_turn_move_the_command_no_faster_than_one(offset):
    loop = controller()
    state, commands = started(loop), []
    for second in range(1, 5):
        state, *_ = measured(loop, state, START, second)
    state = loop.request_manual_input(loop.set_mode(state, Mode.MANUAL), np.array([LOWER]))[0]
    for second in range(5, 20):
        for at in (second, second - offset):
            state, command, _ = measured(loop, state, START, at)
            commands.append(command[0])
    # the first step counts from the last command
    assert commands[0] - commands[-1] <= 14.0 * RATE + 1e-9
    assert np.max(np.abs(np.diff(commands))) <= RATE + 1e-9
    assert commands[-1] < commands[0] - 10.0 * RATE


@pytest.mark.parametrize(('countable', 'seconds'), [
    (None, 1.0), (5.0, 1.0), (0.25, 0.25), (0.0, 0.0)])
def test_ramp_and_rate_limit_count_no_more_than_another_clock_allows(countable, seconds):
    for ramp, read in ((np.inf, lambda command, report: command[0] - 300.0),
                       (0.1, lambda command, report: (report.target.setpoint[0] - START) * 8.0)):
        loop = controller(setpoint_ramp=np.array([ramp]))
        state = measured(loop, started(loop, (START,)), START, 1)[0]
        state = loop.request_setpoint(state, np.array([306.0]))[0]
        _, command, report = loop.step(
            state, np.array([START]), NOW + 2 * SECOND, None, countable)
        assert read(command, report) == pytest.approx(-RATE * seconds, abs=1e-6)


@pytest.mark.parametrize('seconds', [1.5, 1.0 * SECOND, np.float64(1.0), '1'])
def test_a_time_is_an_integer_of_nanoseconds(seconds):
    loop, state = controller(), started()
    for give in (lambda: loop.step(state, np.array([START]), seconds),
                 lambda: loop.hold(state, seconds), lambda: loop.request_setpoint(
                     state, np.array([START]), seconds)):
        with pytest.raises(TypeError, match='integer of nanoseconds'):
            give()
    assert loop.step(state, np.array([START]), np.int64(NOW + SECOND))[0].time_ns == NOW + SECOND


@pytest.mark.parametrize(('recorded', 'nanoseconds', 'warned'), [
    (5.0, 5 * SECOND, False), (5.0, SECOND // 10, False), (5.0, 5, True), (5.0, 5000, True),
    (5.0, 5_000_000, True), (None, 60 * SECOND, False), (None, 60, True), (None, 60_000, True)])
def test_measurements_much_closer_together_than_in_the_record_are_a_warning(
        recorded, nanoseconds, warned):
    model = shipped('reactor_nz4')
    model = replace(model, provenance=replace(model.provenance, metrics={} if recorded is None else
                                              {'sample_interval': recorded}))
    loop, state = Controller(model, Tuning.for_model(model)), State()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        for k in range(5):
            state = loop.step(state, np.array([START]), k * nanoseconds)[0]
    # once, not with each measurement
    assert ['nanoseconds' in str(one.message) for one in caught] == [True] * warned


def test_what_the_record_measured_is_measured_and_controlled_by_default():
    model = replace(shipped('two_state'), states_measured=('temperature',))
    loop = Controller(model, Tuning.for_model(model))
    assert (loop.measured.names, loop.controlled.names) == (('temperature',),) * 2
    assert loop.tuning.state_weight.tolist() == [0.0, 1.0 / model.states.scale[1] ** 2]
    kelvin = float(model.states.center[1])
    state, command, report = loop.step(State(), np.array([kelvin]), NOW)
    assert report.level == 'sdre'
    np.testing.assert_allclose(command, model.inputs.center, rtol=0, atol=0.1)
    assert loop.request_setpoint(state, np.array([kelvin + 1.0]))[1] is None
    with pytest.raises(ValueError, match=r'2 in place of 1; pass outputs='):
        loop.step(state, np.array([0.8, kelvin]), NOW + SECOND)
    # the node and the C export have the same default
    node = built(table_of(model, {'system': ''}).snapshot({}), model)
    assert (node.measured.names, node.controlled.names) == (('temperature',),) * 2
    assert '#define CONTROLLER_NY 1' in c_code(loop, 1.0)['controller.h']
    # other outputs can be given
    every = Controller(model, Tuning.for_model(model), Controller(
        shipped('two_state'), Tuning.for_model(model)).measured)
    assert every.controlled.names == ('concentration', 'temperature')


# Without measurements.

def test_a_setpoint_is_acted_on_from_the_estimate_while_nothing_is_measured():
    loop = controller()
    state = measured(loop, started(loop), START, 1)[0]
    state = loop.request_setpoint(state, np.array([START - 2.0]))[0]
    commands = [state.command[0]]
    # first after a quarter of an hour
    for second in np.arange(900.0, 3600.0, 5.0):
        state, command, report = loop.hold(state, NOW + round(second * SECOND), None)
        assert (report.level, report.reason) == (next(iter(loop.levels)), None)
        assert abs(command[0] - commands[-1]) <= 2.0 * RATE + 1e-9
        commands.append(command[0])
    wanted = loop.steady_state(state.setpoint.active)
    assert state.setpoint.active[0] == START - 2.0
    assert loop.model.states.to_physical(state.estimate.x) == pytest.approx(wanted, abs=0.01)
    assert commands[-1] == commands[-2] < commands[0] - 0.5


def test_a_hold_without_measurements_rejects_setpoints():
    loop = controller()
    state = measured(loop, started(loop), START, 1)[0]
    for cause in (StatusCode.NO_MEASUREMENT, StatusCode.STAMPS_STAND, StatusCode.TWO_SOURCES):
        held, command, report = loop.hold(state, NOW + 20 * SECOND, cause)
        assert (report.level, report.reason.code) == ('hold', cause)
        np.testing.assert_array_equal(command, state.command)
        same, rejected = loop.request_setpoint(held, np.array([316.0]))
        assert same is held
        assert (rejected.code, rejected.cause.code) == (StatusCode.SETPOINT_UNMEASURED, cause)
        # what lies ahead may be tracked then, and what is measured again is
        assert loop.request_setpoint(held, np.array([316.0]), NOW + 60 * SECOND)[1] is None
        again = measured(loop, held, START, 21)[0]
        assert loop.request_setpoint(again, np.array([316.0]))[1] is None


def test_a_manual_command_moves_at_the_rate_limit_without_measurements():
    for state in (started(), controller().initialise(State(), np.array([300.0]))):
        loop = controller()
        state = loop.request_manual_input(loop.set_mode(state, Mode.MANUAL), np.array([290.0]))[0]
        at, commands = NOW + 1200 * SECOND, [300.0]
        while commands[-1] != 290.0:
            state, command, report = loop.hold(state, at, None)
            assert (report.level, report.reason) == ('manual', None)
            commands.append(command[0])
            at += SECOND // 2
        # at most a second counts for the first one
        assert abs(commands[1] - 300.0) <= RATE + 1e-9
        assert np.max(np.abs(np.diff(commands[1:]))) <= 0.5 * RATE + 1e-9


@pytest.mark.parametrize('interval', [1, 5])
@pytest.mark.parametrize('held', [False, True])
def test_seconds_of_commands_in_a_silence_do_not_count_again(interval, held):
    loop = controller()
    state = started(loop)
    for k in range(1, 4):
        state = measured(loop, state, START, interval * k)[0]
    at = interval * 3
    state = loop.request_setpoint(state, np.array([305.0]))[0]
    first = state.command[0]
    for second in range(1, 11):
        state = loop.hold(state, NOW + (at + second) * SECOND, None)[0]
    # the law would go on, and measurements come late all at once
    assert first - state.command[0] == pytest.approx(10.0 * RATE)
    if held:
        state = loop.hold(state, NOW + round((at + 10.1) * SECOND))[0]
    for second in (8, 9, 9.5, 10, 11, 11.5):
        state, command, _ = measured(loop, state, START, at + second)
        assert first - command[0] == pytest.approx(max(10.0, second) * RATE)


def test_a_hold_leaves_its_seconds_to_the_next_command():
    loop = controller()
    state = measured(loop, started(loop), START, 5)[0]
    state = loop.request_setpoint(state, np.array([305.0]))[0]
    for second in range(6, 20):
        state = loop.hold(state, NOW + second * SECOND)[0]
    # of a clock that runs slower than that of the silence
    state, command, _ = measured(loop, state, START, 10)
    assert command[0] == pytest.approx(300.0 - 5.0 * RATE)


# Set-points.

def test_a_full_schedule_rejects_later_setpoints_but_not_immediate_ones():
    loop = controller()
    state = started(loop, *((316.0, NOW + (n + 1) * SECOND) for n in range(1000)))
    full, rejected = loop.request_setpoint(state, np.array([317.0]), NOW + 2000 * SECOND)
    assert full is state
    assert say(rejected).startswith('1000 set-points are already scheduled')
    state, rejected = loop.request_setpoint(state, np.array([317.0]))
    assert rejected is None
    np.testing.assert_array_equal(state.setpoint.requested, [317.0])


# Manual mode.

def manual(loop, *commands, state=None):
    """Return a state in manual mode after commands of the operator."""
    state = loop.set_mode(started(loop) if state is None else state, Mode.MANUAL)
    for kelvin in commands:
        state, rejected = loop.request_manual_input(state, np.array([kelvin]))
        assert rejected is None
    return state


def test_manual_mode_starts_from_the_last_command():
    loop = controller()
    state, command, _ = measured(loop, started(loop, (316.0,)), 320.0, 1)
    _, held, report = measured(loop, manual(loop, state=state), 310.0, 2)
    np.testing.assert_array_equal(held, command)
    assert (report.mode, report.level, report.reason) == (Mode.MANUAL, 'manual', None)
    # before the first command, from the nominal input
    _, command, _ = measured(loop, manual(loop, state=State()), 320.0, 0)
    np.testing.assert_array_equal(command, [300.0])


def test_manual_commands_are_followed_within_the_limits_whatever_the_sensor_does():
    loop = controller()
    state, command, report = measured(loop, manual(loop, 500.0), START, 1)
    assert command[0] == pytest.approx(300.0 + RATE, rel=1e-9)
    assert report.command.at_range
    assert report.command.at_rate
    for second in range(2, 60):
        state, command, report = measured(loop, state, START, second)
    assert command[0] == UPPER
    assert report.command.at_range
    state, command, report = measured(loop, manual(loop, 299.0), math.nan, 10)
    np.testing.assert_array_equal(command, [299.0])
    assert 'not finite' in say(report.reason)
    _, command, report = loop.hold(state, NOW + 20 * SECOND)
    np.testing.assert_array_equal(command, [299.0])
    assert 'no measurement' in say(report.reason)


@pytest.mark.parametrize(('automatic', 'value', 'code'), [
    (False, math.nan, StatusCode.MANUAL_NOT_FINITE), (True, 299.0, StatusCode.NOT_IN_MANUAL_MODE)])
def test_a_rejected_manual_command_has_a_reason(automatic, value, code):
    loop = controller()
    state = started(loop) if automatic else manual(loop, 290.0)
    assert loop.request_manual_input(state, np.array([value]))[1].code is code


def test_the_mode_changes_between_operator_and_law():
    loop = controller()
    state = manual(loop, 290.0)
    # asking for the mode that holds changes nothing
    assert loop.set_mode(state, Mode.MANUAL) is state
    # a manual command is forgotten with the mode
    again = manual(loop, state=loop.set_mode(state, Mode.AUTOMATIC))
    np.testing.assert_array_equal(measured(loop, again, START, 3600)[1], started(loop).command)
    # back in automatic mode the law acts as if nothing had been
    state = started(loop, (316.0,))
    detour = loop.set_mode(manual(loop, state=state), Mode.AUTOMATIC)
    assert content(measured(loop, detour, 320.0, 1)) == content(measured(loop, state, 320.0, 1))


@pytest.mark.parametrize(('part', 'name', 'value'), [
    ('', 'state_weight', 0.0), ('', 'state_weight', -1.0), ('', 'input_weight', 0.0),
    ('', 'input_weight', np.nan), ('', 'setpoint_ramp', -1.0), ('', 'safe_value', np.inf),
    ('', 'tracking_tolerance', -1.0), ('', 'bumpless_transfer_time', np.inf),
    ('sensor', 'rate', -1.0),
    ('sensor', 'jump', np.nan), ('sensor', 'stuck_sensor_timeout', -1.0), ('limits', 'rate', -1.0),
    ('', 'state_weight', 'heavy'), ('', 'learned_model_margin', -0.1), ('', 'hold_timeout', -1.0),
    ('', 'recovery_time', math.nan), ('', 'fallback_order', ()),
    ('', 'fallback_order', ('sdre', 'sdre'))])
def test_a_tuning_that_makes_no_sense_is_rejected(part, name, value):
    loop = controller()
    tuning = loop.tuning
    with pytest.raises(ValueError, match=name):
        replace(loop, tuning=replace(tuning, **{name: value}) if not part else replace(
            tuning, **{part: replace(getattr(tuning, part), **{name: value})}))


def test_margins_in_the_wrong_order_are_rejected():
    loop = controller()
    with pytest.raises(ValueError, match='margin'):
        replace(loop, tuning=replace(loop.tuning, learned_model_margin=2.0))


@pytest.mark.parametrize('part', ['limits', 'sensor'])
def test_limits_in_the_wrong_order_are_rejected(part):
    loop = controller()
    for upper in (300.0, 400.0):
        with pytest.raises(ValueError, match='400'):
            replace(loop, tuning=replace(loop.tuning, **{part: replace(
                getattr(loop.tuning, part), lower=400.0, upper=upper)}))


# The set-point by itself.

MODEL = shipped('reactor_nz4')


def kelvin(value):
    return np.array([value])


def moved(setpoint, now_ns=NOW, *, measured=320.0, ramp=np.inf, seconds=1.0, lag=0.0):
    return advance(setpoint, kelvin(measured), MODEL.states, kelvin(ramp), now_ns, seconds, lag)


@pytest.mark.parametrize(('ramp', 'lag'), [(np.inf, 0.0), (0.5, 0.0), (np.inf, 4.0)])
def test_the_setpoints_ahead_are_those_that_will_be_active(ramp, lag):
    setpoint = replace(Setpoint(), requested=kelvin(310.0), active=kelvin(310.0), scheduled=(
        (NOW + 4 * SECOND, kelvin(314.0)), (NOW + 9 * SECOND, kelvin(312.0)),
        (NOW + 60 * SECOND, kelvin(320.0))))
    found = setpoints.ahead(setpoint, MODEL.states, kelvin(ramp), lag, NOW, 30.0)
    if np.isinf(ramp) and not lag:
        assert [(seconds, float(value[0])) for seconds, value in found] == [
            (4.0, 314.0), (9.0, 312.0)]
    for seconds, value in found:
        setpoint = moved(setpoint, NOW + round(seconds * SECOND), ramp=ramp, lag=lag,
                         seconds=30.0 / setpoints.MAX_AHEAD)
        assert value == pytest.approx(setpoint.active)
    assert not setpoints.ahead(setpoint, MODEL.states, kelvin(ramp), lag, NOW, 3.0)


def schedule(setpoint):
    return [(time_ns, float(value[0])) for time_ns, value in setpoint.scheduled]


@pytest.mark.parametrize(('value', 'code'), [
    *((value, None) for value in (306.0, 314.4, *MODEL.states.lower, *MODEL.states.upper)),
    *((value, StatusCode.SETPOINT_OUTSIDE) for value in (
        300.0, 330.123, np.nextafter(MODEL.states.lower[0], 0.0),
        np.nextafter(MODEL.states.upper[0], np.inf))),
    *((value, StatusCode.SETPOINT_NOT_FINITE) for value in (np.nan, np.inf, -np.inf))])
def test_a_setpoint_outside_the_training_range_is_rejected(value, code):
    rejected = rejection(MODEL.states, kelvin(value))
    assert (rejected and rejected.code) is code


@pytest.mark.parametrize(('effective_ns', 'waits'), [
    (0, False), (1, False), (SECOND, False), (NOW - 1, False), (NOW, False), (NOW + 1, True),
    (NOW + SECOND, True), (NOW + HORIZON_NANOSECONDS, True),
    (NOW + HORIZON_NANOSECONDS + 1, False), (2 * NOW, False)])
def test_past_and_foreign_stamps_act_at_once_and_others_wait(effective_ns, waits):
    setpoint = request(Setpoint(), kelvin(310.0), effective_ns, NOW)
    assert schedule(setpoint) == ([(effective_ns, 310.0)] if waits else [])
    assert (setpoint.requested is None) is waits
    # before the first measurement nobody knows; that tells what lies ahead
    setpoint = request(Setpoint(), kelvin(310.0), effective_ns, None)
    setpoint = moved(setpoint, NOW, measured=320.0, seconds=0.0)
    assert bool(setpoint.scheduled) is waits
    np.testing.assert_array_equal(setpoint.requested, [320.0 if waits else 310.0])


def test_scheduled_requests_take_effect_in_time_order():
    setpoint = Setpoint()
    for ahead, value in ((30, 310.0), (10, 312.0), (20, 314.0), (10, 316.0)):
        setpoint = request(setpoint, kelvin(value), NOW + ahead * SECOND, NOW)
    # the later request for the same time replaces the earlier one
    assert schedule(setpoint) == [
        (NOW + 10 * SECOND, 316.0), (NOW + 20 * SECOND, 314.0), (NOW + 30 * SECOND, 310.0)]
    # of several that are due the latest counts
    np.testing.assert_array_equal(moved(setpoint, NOW + 25 * SECOND).active, [314.0])
    active = []
    for elapsed in range(0, 41, 5):
        setpoint = moved(setpoint, NOW + elapsed * SECOND)
        active.append(float(setpoint.active[0]))
    assert active == [320.0, 320.0, 316.0, 316.0, 314.0, 314.0, 310.0, 310.0, 310.0]
    assert schedule(setpoint) == []


def test_a_request_at_once_ends_the_schedule():
    setpoint = request(Setpoint(), kelvin(310.0), NOW + SECOND, NOW)
    setpoint = request(setpoint, kelvin(316.0), 0, NOW)
    assert schedule(setpoint) == []
    np.testing.assert_array_equal(moved(setpoint, NOW).active, [316.0])
    np.testing.assert_array_equal(moved(setpoint, NOW + SECOND).active, [316.0])


@pytest.mark.parametrize(('measured', 'held'), [
    (320.0, 320.0), (400.0, MODEL.states.upper[0]), (200.0, MODEL.states.lower[0])])
def test_the_first_measurement_is_held(measured, held):
    setpoint = moved(Setpoint(), measured=measured, seconds=0.0)
    np.testing.assert_array_equal(setpoint.active, [held])
    np.testing.assert_array_equal(setpoint.requested, [held])
    # and stays when the temperature moves on
    np.testing.assert_array_equal(moved(setpoint, NOW + SECOND, measured=310.0).active, [held])


def test_without_a_ramp_the_setpoint_steps_and_without_a_request_it_stays():
    before = Setpoint(active=kelvin(320.0))
    np.testing.assert_array_equal(
        moved(request(before, kelvin(310.0), 0, NOW), seconds=1e-9).active, [310.0])
    np.testing.assert_array_equal(moved(before, measured=310.0).active, [320.0])


@pytest.mark.parametrize('goal', [310.0, 324.0])
def test_the_ramp_reaches_its_goal_and_stays(goal):
    setpoint = request(moved(Setpoint(), seconds=0.0), kelvin(goal), 0, NOW)
    direction = np.sign(goal - 320.0)
    for second in range(1, 40):
        setpoint = moved(setpoint, NOW + second * SECOND, ramp=0.5)
        expected = 320.0 + direction * min(0.5 * second, abs(goal - 320.0))
        assert setpoint.active[0] == pytest.approx(expected, rel=1e-12)
    assert setpoint.active[0] == goal


def test_the_filter_follows_a_step_with_its_time_constant():
    setpoint = request(moved(Setpoint(), seconds=0.0), kelvin(310.0), 0, NOW)
    for second in range(1, 20):
        setpoint = moved(setpoint, NOW + second * SECOND, lag=10.0)
        assert setpoint.active[0] == pytest.approx(310.0 + 10.0 * math.exp(-0.1 * second))
    loop = controller(setpoint_filter_time=10.0)
    report = measured(loop, started(loop, (310.0,)), START, 1)[2]
    assert report.target.setpoint[0] == pytest.approx(310.0 + (START - 310.0) * math.exp(-0.1))


# What is given as lists, and what has another size.

@pytest.mark.parametrize(('act', 'message'), [
    (lambda loop, state: loop.step(state, [START, 1.0], NOW + SECOND),
     r'incompatible measurement: expected one number for each of temperature, got \['),
    (lambda loop, state: loop.step(state, [START], NOW + SECOND, [290.0, 290.0]),
     'incompatible applied input: expected one number for each of coolant_temperature, got '),
    (lambda loop, state: loop.initialise(State(), [[290.0]]), 'incompatible applied input: '),
    (lambda loop, state: loop.request_setpoint(state, [SETPOINT] * 2), 'incompatible set-point: '),
    (lambda loop, state: loop.request_manual_input(loop.set_mode(state, Mode.MANUAL), []),
     'incompatible manual input: expected one number for each of coolant_temperature, got ')],
    ids=['measurement', 'applied', 'found', 'set-point', 'manual'])
def test_another_size_is_rejected(act, message):
    loop = controller()
    with pytest.raises(ValueError, match=message):
        act(loop, started(loop))


def test_one_number_of_one_signal_needs_no_list():
    loop = controller()
    _, command, _ = loop.step(started(loop), START, NOW + SECOND)
    np.testing.assert_array_equal(command, loop.step(started(loop), [START], NOW + SECOND)[1])
    assert loop.request_setpoint(started(loop), SETPOINT)[1] is None
