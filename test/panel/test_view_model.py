# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""View model of a loop: faceplates, silences, alarms, marks, and answers to requests."""

from collections.abc import Mapping
from dataclasses import replace
import json
import math
import sys
from typing import Any

import numpy as np
import pytest

from koopman_ros.core.units import display_unit, to_kelvin
from koopman_ros.panel.alarms import Alarms, AlarmState, Priority
from koopman_ros.panel.conditions import grouped
from koopman_ros.panel.faceplates import pen, span_text
from koopman_ros.panel.model_page import experiment_obstacle
from koopman_ros.panel.requests import (
    Action,
    Answer,
    AuditEntry,
    MANUAL,
    Requests,
    SETPOINT,
    TIMEOUT,
)
from koopman_ros.panel.snapshot import (
    CONTROL,
    CONTROLLER,
    ERROR,
    EXPERIMENT,
    LOST,
    MEASUREMENTS,
    OK,
    PLANT,
    REQUESTS,
    TRAINER,
    WARN,
)
from koopman_ros.panel.trend_chart import _charts, _lines, line
from koopman_ros.panel.view_model import LoopViewModel
from koopman_ros.parameters.description import ParameterDescription
from koopman_ros.parameters.panel import ProcessLimits
from koopman_ros.parameters.signal_topics import Signals

REACTOR = Signals({'temperature': 'K'}, {'coolant_temperature': 'K'}, ('temperature',))
TANKS = Signals({'level_1': 'm', 'level_2': 'm'}, {'pump_1': 'V', 'pump_2': 'V'},
                ('level_1', 'level_2'))
NOW = 1_790_000_000.0  # s of Unix time


def parameter(name: str, value: Any, **details: Any) -> ParameterDescription:
    plain = ParameterDescription(name, value, '', '', '', -math.inf, math.inf, False)
    return replace(plain, **details)


def view(signals: Signals = REACTOR, **read: str) -> LoopViewModel:
    usual = {name: display_unit(unit) for name, unit in signals.units.items()}
    return LoopViewModel(signals, {**usual, **read}, 3600.0, NOW)


def measure(own: LoopViewModel, celsius: float, seconds: float, wall: float | None = None) -> None:
    own.take_signals('measured', {'temperature': to_kelvin(celsius)}, seconds,
                     NOW + seconds if wall is None else wall)


def answered(own: LoopViewModel, level: str = 'sdre', mode: str = 'automatic', wall: float = NOW
             ) -> None:
    own.take_record('measurement', {'mode': mode, 'level': level}, wall)


def status(own: LoopViewModel, *given: Any) -> None:
    own.conditions.take_status(*given)


# Faceplates.


def test_a_measured_disturbance_has_a_faceplate_and_a_trend_without_a_set_point() -> None:
    own = view(replace(REACTOR, disturbances={'feed': 'K'}))
    own.take_signals('measured_disturbances', {'feed': to_kelvin(76.0)}, 1.0, NOW + 1.0)
    # the plant is silent all the same
    assert math.isnan(own.snapshot(NOW + 1.0).time)
    measure(own, 51.8, 2.0)
    own.take_signals('measured_disturbances', {'feed': to_kelvin(77.0)}, 2.0, NOW + 2.0)
    own.take_model({'feed': (to_kelvin(66.0), to_kelvin(76.5))}, {})
    state, feed = own.snapshot(NOW + 2.0).states
    assert (state.name, feed.name, feed.controlled) == ('temperature', 'feed', False)
    assert (state.disturbance, feed.disturbance) == (False, True)
    assert [one.key for _, pens in _charts(own.snapshot(NOW + 2.0)) for one in pens
            if one.signal == 'feed'] == ['feed']
    assert feed.measured == pytest.approx(77.0)
    assert feed.abnormal == 'above the trained range'
    times, values = own.trends.window(['feed'], 0.0, 10.0, 10)['feed']
    assert (list(times), list(values)) == ([2.0], [pytest.approx(77.0)])


def test_values_are_in_the_units_that_people_read() -> None:
    own = view()
    measure(own, 51.8, 1.0)
    own.take_signals('active_setpoints', {'temperature': to_kelvin(45.0)}, 0.5, NOW + 1.0)
    own.take_signals('predicted', {'temperature': to_kelvin(51.7)}, 1.0, NOW + 1.0)
    own.take_signals('commands', {'coolant_temperature': to_kelvin(20.0)}, 1.0, NOW + 1.0)
    own.take_internals({'disturbance [K]': 0.5, 'estimated_temperature [degC]': 51.0,
                        'estimated_concentration [mol/L]': 0.88})
    now = own.snapshot(NOW + 1.0)
    (state,), (given,) = now.states, now.inputs
    assert (state.label, state.unit, state.controlled) == ('temperature', '°C', True)
    assert [state.measured, state.setpoint, state.target, state.predicted] == pytest.approx(
        [51.8, 45.0, 45.0, 51.7])
    assert (given.label, given.command, given.disturbance) == (
        'coolant temperature', pytest.approx(20.0), 0.5)
    assert math.isnan(given.applied)
    assert given.text(given.applied) == '–'
    # that of the measured state is none of an unmeasured one
    assert now.estimates == (('concentration', '0.88 mol/L'),)
    # of a filter with how well it is known, and of another model others
    own.take_internals({'estimated_latent_1 [1]': 0.25, 'deviation_latent_1 [1]': 0.0123})
    assert own.snapshot(NOW + 1.2).estimates == (('latent 1', '0.25 ± 0.012 1'),)


def test_a_signal_is_shown_in_the_unit_that_its_operators_read() -> None:
    own = view(temperature='degF')
    own.take_model({'temperature': (to_kelvin(40.0), to_kelvin(60.0))}, {})
    measure(own, 50.0, 1.0)
    own.take_record('setpoint', {'accepted': True, 'signals': ['temperature'],
                                 'value': [to_kelvin(45.0)], 'reason': []}, NOW)
    face = own.snapshot(NOW).states[0]
    assert face.unit == '°F'
    assert [face.measured, face.target, *face.training] == pytest.approx(
        [122.0, 113.0, 104.0, 140.0])
    assert face.abnormal == ''
    bare = view(temperature='degF')
    bare.take_parameters('controller', {
        name: parameter(name, value, unit='degC') for name, value in (
            ('temperature.sensor_min', 0.0), ('temperature.sensor_max', 100.0))})
    low, high = bare.snapshot(NOW).states[0].span
    assert (low, high) == pytest.approx((32.0 - 18.0, 212.0 + 18.0))
    # of the others nothing changes
    assert bare.snapshot(NOW).inputs[0].unit == '°C'


def test_a_plan_is_shown_until_it_is_empty() -> None:
    own = view(temperature='degF')
    own.take_plan(['temperature [degC]', 'coolant_temperature [degC]'], 100.0, [0.0, 1.0, 3.0],
                  [[50.0, 20.0], [45.0, 21.0], [40.0, 21.0]])
    own.take_limits({'at_range_coolant_temperature [-1 lower, 1 upper]': 1.0,
                     'at_rate_coolant_temperature [-1 falling, 1 rising]': 1.0,
                     'at_limit_temperature [-1 lower, 1 upper]': -1.0})
    answered(own, 'mpc')
    now = own.snapshot(NOW)
    assert [time for time, _ in now.states[0].plan] == [100.0, 101.0, 103.0]
    assert [value for _, value in now.states[0].plan] == pytest.approx([122.0, 113.0, 104.0])
    assert now.inputs[0].plan == ((100.0, 20.0), (101.0, 21.0), (103.0, 21.0))
    assert now.states[0].active == 'kept above its lower limit'
    assert now.inputs[0].active == 'at its upper limit, at its rate limit (rising)'
    # one that is lost on its way leaves the last; limits that are over are
    answered(own, 'mpc')
    own.take_limits({'at_rate_coolant_temperature [-1 falling, 1 rising]': 0.0})
    assert (own.snapshot(NOW).inputs[0].active, len(own.snapshot(NOW).inputs[0].plan)) == ('', 3)
    answered(own, 'sdre')
    assert own.snapshot(NOW).states[0].plan == own.snapshot(NOW).inputs[0].plan == ()


@pytest.mark.parametrize(('names', 'rows'), [
    (['temperature [degC]'], [[1.0], [1.0, 2.0]]), (['temperature [m]'], [[1.0], [2.0]]),
    (['temperature [degC]', 'coolant_temperature [degC]'], [[1.0], [2.0]]),
    (['temperature'], [[1.0], [2.0]]), (['level [m]'], [[1.0], [2.0]])])
def test_a_malformed_plan_is_ignored(
        names: list[str], rows: list[list[float]]) -> None:
    own = view()
    own.take_plan(names, 100.0, [0.0, 1.0], rows)
    assert own.snapshot(NOW).states[0].plan == own.snapshot(NOW).inputs[0].plan == ()


def test_a_limit_of_a_state_is_drawn_also_where_there_is_only_one() -> None:
    own = view(coolant_temperature='degC')
    own.take_parameters('controller', {name: parameter(
        name, value, unit='degC', lower=-273.15, upper=1e9) for name, value in (
        ('mpc.temperature.min', -273.15), ('mpc.temperature.max', 60.0),
        ('coolant_temperature.min', 5.0), ('coolant_temperature.max', 40.0))})
    measure(own, 50.0, 1.0)
    now = own.snapshot(NOW)
    assert now.states[0].limits == (-math.inf, 60.0)
    assert now.inputs[0].limits == (5.0, 40.0)
    # and the bar is long enough for it
    assert now.states[0].span[1] >= 60.0


def test_the_model_before_is_offered_and_the_predecessor_of_a_file_that_was_replaced() -> None:
    own = view()

    def model(event: str, name: str, digest: str) -> str:
        own.take_record(event, {
            'model': {'name': name, 'digest': digest}, 'parameters': {'model': name},
            'state': {'mode': {'name': 'AUTOMATIC'}}}, NOW)
        return own.snapshot(NOW).previous_model

    assert model('snapshot', 'runs/new.safetensors', 'a') == ''
    # the same file once more
    assert model('model', 'runs/new.safetensors', 'a') == ''
    assert model('model', 'runs/new.safetensors', 'b') == 'runs/new.previous.safetensors'
    # as a parameter of the same name, which the controller reads again
    assert model('parameters', 'runs/new.safetensors', 'c') == 'runs/new.previous.safetensors'
    assert model('parameters', 'reactor', 'd') == 'runs/new.safetensors'
    assert model('parameters', 'runs/new.safetensors', 'c') == 'reactor'


def test_bars_hold_ranges_and_values() -> None:
    own = view()
    own.take_model({'temperature': (to_kelvin(32.0), to_kelvin(54.0)),
                    'coolant_temperature': (to_kelvin(8.0), to_kelvin(28.0))}, {})
    own.take_parameters(CONTROLLER, {name: parameter(name, value) for name, value in {
        'coolant_temperature.min': 5.0, 'coolant_temperature.max': 32.0}.items()})
    measure(own, 43.0, 1.0)
    own.take_signals('commands', {'coolant_temperature': to_kelvin(32.0)}, 1.0, NOW + 1.0)
    now = own.snapshot(NOW + 1.0)
    (state,), (given,) = now.states, now.inputs
    assert state.training == pytest.approx((32.0, 54.0))
    assert state.span == pytest.approx((29.8, 56.2))
    assert state.share(43.0) == pytest.approx(0.5)
    assert [state.share(value) for value in (0.0, 99.0, math.nan)] == [0.0, 1.0, 0.0]
    assert (state.decimals, state.text(43.0), state.text(-0.01)) == (1, '43.0', '0.0')
    assert given.limits == (5.0, 32.0)
    assert given.abnormal == 'at its upper limit'
    # a value that left the range is on the bar, and said to be out
    measure(own, 80.0, 2.0)
    (state,) = own.snapshot(NOW + 2.0).states
    assert state.span[1] == pytest.approx(80.0)
    assert state.abnormal == 'above the trained range'


@pytest.mark.parametrize(('value', 'text'), [
    (sys.float_info.max, '1.79769e+308'), (-sys.float_info.max, '-1.79769e+308'),
    (5e-324, '0.00'), (math.inf, '–')])
def test_any_number_is_shown(value: float, text: str) -> None:
    own = view(TANKS)
    for setpoint in (value, 1.0, -value):
        own.take_signals('active_setpoints', {'level_1': setpoint}, 1.0, NOW)
        own.take_signals('measured', {'level_1': value}, 1.0, NOW)
        state = own.snapshot(NOW).states[0]
        assert state.text(state.measured) == text
        assert 0.0 <= state.share(state.measured) <= 1.0


@pytest.mark.parametrize(('bounds', 'text'), [
    ((31.85, 53.85), '31.9 to 53.8'), ((5.0 + 1e-9, 32.0 - 1e-9), '5.0 to 32.0'),
    ((-1.23, math.inf), '-1.2 to –')])
def test_limits_are_written_within_the_limits(bounds: tuple[float, float], text: str) -> None:
    assert span_text(bounds, 1) == text


def test_the_scale_of_an_input_without_negative_values_begins_at_zero() -> None:
    own = view(TANKS)
    own.take_parameters(CONTROLLER, {f'pump_1.{end}': parameter(f'pump_1.{end}', value)
                                     for end, value in (('min', 0.0), ('max', 12.0))})
    assert own.snapshot(NOW).inputs[0].span == pytest.approx((0.0, 13.2))


def test_the_target_of_a_ramp_is_shown() -> None:
    own = view(TANKS)
    for name, value in (('level_1', 0.10), ('level_2', 0.15)):
        own.take_signals('active_setpoints', {name: value}, 1.0, NOW)
    own.take_record('setpoint', {'value': [0.2], 'signals': ['level_2'], 'accepted': True,
                                 'reason': []}, NOW)
    own.take_record('setpoint', {'value': [9.9], 'signals': ['level_1'], 'accepted': False,
                                 'reason': ['setpoint_outside']}, NOW)
    first, second = own.snapshot(NOW).states
    assert (first.setpoint, first.target, second.setpoint, second.target) == (0.1, 0.1, 0.15, 0.2)
    # a controller that starts again has no target
    own.take_record('start', {'state': {'mode': {'name': 'AUTOMATIC'}}, 'model': {}}, NOW)
    assert own.snapshot(NOW).states[1].target == 0.15


def test_a_manual_command_is_shown_within_the_limits_until_the_mode_changes() -> None:
    own = view()
    own.take_parameters(CONTROLLER, {f'coolant_temperature.{end}': parameter(
        f'coolant_temperature.{end}', value) for end, value in (('min', 5.0), ('max', 32.0))})
    own.take_signals('commands', {'coolant_temperature': to_kelvin(20.0)}, 1.0, NOW)
    own.take_record('manual_command', {'accepted': True, 'value': [to_kelvin(45.0)]}, NOW)
    assert own.snapshot(NOW).inputs[0].manual == 32.0
    own.take_record('mode', {'mode': 'automatic'}, NOW)
    assert own.snapshot(NOW).inputs[0].manual == pytest.approx(20.0)


def test_a_snapshot_does_not_change() -> None:
    own = view()
    measure(own, 50.0, 1.0)
    before = own.snapshot(NOW)
    held = repr(before)
    measure(own, 60.0, 2.0)
    status(own, CONTROL, ERROR, 'broken', {'a': 'b'}, NOW)
    own.take_parameters(CONTROLLER, {'a': parameter('a', 1.0)})
    assert repr(before) == held
    with pytest.raises(TypeError):
        before.statuses['x'] = before.status('x')  # type: ignore[index]


# Levels, silences, alarms and marks.


@pytest.mark.parametrize(('levels', 'level', 'mode', 'reason', 'shown', 'fallback'), [
    (None, 'sdre', 'automatic', 'none', 'learned law', False),
    (('mpc', 'sdre'), 'sdre', 'automatic', 'none', 'learned law', True),
    (('sdre', 'linear'), 'hold', 'automatic', 'the sensor is frozen', 'hold', True),
    (('sdre', 'linear'), 'manual', 'manual', 'none', 'manual', False)])
def test_a_fallback_has_its_reason(levels: tuple[str, ...] | None, level: str, mode: str,
                                   reason: str, shown: str, fallback: bool) -> None:
    own = view()
    if levels:
        own.take_parameters(CONTROLLER, {'fallback_order': parameter('fallback_order', levels)})
    answered(own, level, mode)
    status(own, CONTROL, OK, mode, {'reason': reason}, NOW)
    now = own.snapshot(NOW)
    assert (now.mode, now.level, now.fallback, now.reason) == (
        mode, shown, fallback, '' if reason == 'none' else reason)


@pytest.mark.parametrize('fields', [
    {}, {'mode': 'automatic'}, {'value': 'x', 'accepted': True}, {'value': [1, 2], 'accepted': 1},
    {'value': [{}], 'accepted': True, 'signals': ['nobody']}, {'model': []}, {'state': 3}])
@pytest.mark.parametrize('event', [
    'measurement', 'setpoint', 'manual_command', 'mode', 'model', 'snapshot', 'unheard-of'])
def test_malformed_records_change_nothing(event: str, fields: Mapping[str, Any]) -> None:
    own = view()
    answered(own)
    own.take_record(event, fields, NOW)
    assert own.snapshot(NOW).level == 'learned law'


def test_a_silence_has_its_node_and_time() -> None:
    own = view()
    assert own.snapshot(NOW + 1.0).silences == ()
    silences = own.snapshot(NOW + 10.0).silences
    assert [(one.role, one.since, one.seen) for one in silences] == [
        (CONTROLLER, NOW, False), (PLANT, NOW, False)]
    for second in range(1, 20):
        measure(own, 50.0, float(second))
        status(own, CONTROL, OK, 'automatic', {}, NOW + second)
    assert own.snapshot(NOW + 20.0).silences == ()
    (silence,) = (one for one in own.snapshot(NOW + 30.0).silences if one.role == PLANT)
    assert (silence.since, silence.seen) == (NOW + 19.0, True)


def test_a_clock_that_is_set_back_hides_no_silence_and_feigns_none() -> None:
    own = view()
    for second in (1.0, 2.0):
        measure(own, 50.0, second)
        status(own, CONTROL, OK, 'automatic', {}, NOW + second)
    back = NOW - 3600.0
    measure(own, 50.0, 3.0, back + 3.0)
    own.advance(back + 3.2)
    assert own.snapshot(back + 3.2).silences == ()
    own.advance(back + 10.0)
    assert {(one.role, one.since) for one in own.snapshot(back + 10.0).silences} == {
        (PLANT, back + 3.0), (CONTROLLER, back + 3.0)}


def test_a_slow_plant_is_not_silent_between_its_measurements() -> None:
    own = view()
    for minute in range(1, 5):
        measure(own, 50.0, 60.0 * minute)
    assert PLANT not in [one.role for one in own.snapshot(NOW + 240.0 + 59.0).silences]
    assert PLANT in [one.role for one in own.snapshot(NOW + 240.0 + 400.0).silences]
    # nor one of which the controller knows that it has not changed
    answered(own, wall=NOW + 600.0)
    assert PLANT not in [one.role for one in own.snapshot(NOW + 240.0 + 400.0).silences]


def test_silence_and_levels_are_alarms_by_priority_and_marks() -> None:
    own = view()
    measure(own, 50.0, 1.0, NOW)
    for second in range(4):
        status(own, CONTROL, WARN, 'extrapolates', {}, NOW + second)
        status(own, 'trainer: recording', WARN, 'disk is filling', {}, NOW + second)
        status(own, 'other', ERROR, 'is down', {}, NOW + second)
        own.advance(NOW + second)
    assert [(alarm.key, alarm.priority) for alarm in own.snapshot(NOW + 3.0).standing] == [
        ('other: is down', Priority.HIGH), (f'{CONTROL}: extrapolates', Priority.MEDIUM),
        ('trainer: recording: disk is filling', Priority.MEDIUM)]
    # raised at once, in any order
    assert sorted(mark.text for mark in own.trends.marks(0.0, 10.0) if mark.kind == 'alarm') == [
        f'{CONTROL}: extrapolates', 'other: is down', 'trainer: recording: disk is filling']
    for second in range(4, 20):
        own.advance(NOW + second)
    standing = {alarm.key: alarm.priority for alarm in own.snapshot(NOW + 20.0).standing}
    assert standing['silence of controller'] is Priority.HIGH
    assert standing['silence of plant'] is Priority.HIGH
    assert standing['silence of trainer'] is Priority.LOW
    assert own.snapshot(NOW + 20.0).mode == ''


def test_a_simulated_plant_that_is_replaced_leaves_no_alarm() -> None:
    own = view()
    for second in range(1, 40):
        if second < 20:
            status(own, 'plant: simulation', ERROR, 'stopped', {}, NOW + second)
        measure(own, 50.0, float(second))
        status(own, CONTROL, OK, 'automatic', {}, NOW + second)
        own.advance(NOW + second)
        now = own.snapshot(NOW + second)
        if second == 19:
            assert [alarm.state for alarm in now.standing] == [AlarmState.UNACKNOWLEDGED]
    assert [alarm.state for alarm in now.standing] == [AlarmState.RETURNED]
    assert list(now.statuses) == [CONTROL]


def test_nodes_of_another_loop_are_ignored() -> None:
    read = {name: display_unit(unit) for name, unit in REACTOR.units.items()}
    own = LoopViewModel(REACTOR, read, 3600.0, NOW, {
        f'line_1/{role}': role for role in (PLANT, CONTROLLER, TRAINER)})
    measure(own, 50.0, 1.0, NOW)
    answered(own)
    own.take_signals('commands', {'coolant_temperature': to_kelvin(20.0)}, 1.0, NOW)
    status(own, 'line_1/controller: control', OK, 'automatic', {'reason': 'none'}, NOW)
    status(own, 'line_1/trainer: training', OK, 'idle', {'model_file': 'a'}, NOW)
    for second in range(1, 10):
        for node in ('controller: control', 'trainer: training', 'plant: simulation'):
            status(own, f'line_2/{node}', ERROR, 'of the other line', {}, NOW + second,
                   'other')
        own.advance(NOW + second)
    now = own.snapshot(NOW + 10.0)
    assert {one.role for one in now.silences} == {CONTROLLER, PLANT, TRAINER}
    assert (now.mode, now.level, now.plant) == ('', '', '')
    assert all('other line' not in alarm.text for alarm in now.standing)
    for name, values in ((CONTROL, {'reason': 'none'}),
                         ('trainer: training', {'model_file': 'a'})):
        task = now.status(name)
        assert (task.level, task.message, task.values) == (ERROR, LOST, values)
    assert 'last command' in now.inputs[0].abnormal
    # one that is back is shown again
    status(own, 'line_1/controller: control', OK, 'automatic', {}, NOW + 10.0)
    now = own.snapshot(NOW + 10.0)
    assert (now.mode, now.status(CONTROL).message) == ('automatic', 'automatic')
    assert now.inputs[0].abnormal == ''


def test_statuses_of_other_nodes_crowd_out_none_of_the_own_loop() -> None:
    own = view()
    for i in range(200):
        status(own, f'driver_{i}: io', OK, 'ok', {}, NOW)
    status(own, CONTROL, ERROR, 'held', {}, NOW)
    status(own, 'controller: actuators', WARN, 'stuck', {}, NOW)
    own.advance(NOW + 2.0)
    now = own.snapshot(NOW + 2.0)
    assert {alarm.key for alarm in now.standing} == {
        f'{CONTROL}: held', 'controller: actuators: stuck'}
    assert len(now.statuses) < 100
    # nor do those without a fault any that has one
    for second in range(3):
        status(own, 'driver_199: io', ERROR, 'down', {}, NOW + 3.0 + second)
        own.advance(NOW + 3.0 + second)
    assert 'driver_199: io: down' in [alarm.key for alarm in own.snapshot(NOW + 6.0).standing]
    assert len(own.snapshot(NOW + 6.0).statuses) == len(now.statuses)


def test_a_warning_has_one_alarm_whatever_else_is_wrong() -> None:
    own = view()
    status(own, CONTROL, WARN, 'request rejected: a; stuck', {'condition': 'requests'}, NOW)
    status(own, REQUESTS, WARN, 'request rejected: a', {}, NOW)
    status(own, 'controller: actuators', WARN, 'stuck', {}, NOW)
    own.advance(NOW + 2.0)
    assert [(alarm.key, alarm.priority) for alarm in own.snapshot(NOW + 2.0).standing] == [
        ('controller: actuators: stuck', Priority.MEDIUM)]
    # also seen by the plant
    status(own, 'plant: simulation', WARN, 'stuck', {}, NOW + 2.0)
    own.advance(NOW + 3.4)
    assert [alarm.key for alarm in own.snapshot(NOW + 3.4).standing] == [
        'controller: actuators: stuck']


WAITING = {'measurements': '0'}
LATE = {'measurements': '9', 'since last measurement [s]': '40'}


@pytest.mark.parametrize(('task', 'level', 'message', 'values', 'plant', 'expected'), [
    # the nodes of a loop start one after the other; later it is a fault
    (CONTROL, WARN, 'waiting', WAITING, None, {5.0: '', 40.0: 'silence of plant: waiting'}),
    (CONTROL, WARN, 'waiting', WAITING, 99.0, {
        5.0: '', 40.0: f'{CONTROL}: waiting: {CONTROL}: waiting'}),
    ('', OK, '', {}, None, {5.0: '', 40.0: 'silence of controller: no message from the controller'
                                           '; silence of plant: no measurement'}),
    # the silence of a plant is one alarm, in the words of the controller
    (CONTROL, ERROR, 'held', LATE, 2.0, {20.0: 'silence of plant: held'}),
    (MEASUREMENTS, WARN, 'late', {}, 2.0, {
        20.0: 'silence of plant: no measurement; '
              f'{MEASUREMENTS}: late: {MEASUREMENTS}: late (returned)'}),
    (CONTROL, OK, 'automatic', LATE, 2.0, {20.0: 'silence of plant: no measurement'}),
    # the operator who made a request reads the answer
    (REQUESTS, WARN, 'request rejected: outside', {}, 99.0, {5.0: '', 40.0: ''}),
    (EXPERIMENT, WARN, 'rejected: another node commands', {}, 99.0, {5.0: '', 40.0: ''}),
    # what has ended stands until it is acknowledged, and no longer
    (EXPERIMENT, ERROR, 'aborted: too hot', {}, 99.0, {
        5.0: f'{EXPERIMENT}: aborted: too hot: {EXPERIMENT}: aborted: too hot',
        40.0: f'{EXPERIMENT}: aborted: too hot: {EXPERIMENT}: aborted: too hot '
              '(returned)'}),
    ('other: io', ERROR, '', {}, 99.0, {
        5.0: 'other: io: no reason was given: other: io: no reason was given'})])
def test_a_condition_has_one_alarm(
        task: str, level: int, message: str, values: Mapping[str, str], plant: float | None,
        expected: Mapping[float, str]) -> None:
    own = view()
    for step in range(1, 401):
        seconds = 0.1 * step
        if plant is not None and seconds < plant:
            measure(own, 50.0, seconds)
        if task:
            own.take_record('silence', {'mode': 'automatic', 'level': 'sdre'}, NOW + seconds)
            status(own, task, level, message, values, NOW + seconds)
        own.advance(NOW + seconds)
        for moment in (moment for moment in expected if math.isclose(moment, seconds)):
            assert '; '.join(
                f'{alarm.key}: {alarm.text}' + (
                    ' (returned)' if alarm.state is AlarmState.RETURNED else '')
                for alarm in own.snapshot(NOW).standing) == expected[moment]


def test_many_short_errors_are_an_alarm() -> None:
    def alarmed(seconds: float, errors: int) -> bool:
        own = view()
        for k in range(2 * errors):
            now = NOW + seconds * k / 2
            measure(own, 50.0, seconds * k / 2 + 1.0, now)
            status(own, CONTROL, OK if k % 2 else ERROR, 'held', {}, now)
            own.advance(now)
        own.advance(now + 1.5)
        return any('repeated' in alarm.key and alarm.text.endswith('the last: held')
                   for alarm in own.snapshot(now).standing)

    assert alarmed(0.5, 20)
    assert not alarmed(0.5, 3)
    assert not alarmed(30.0, 20)


def test_a_manual_command_is_limited_as_the_controller_does() -> None:
    own = view()
    assert own.limited('coolant_temperature', 60.0) == 60.0
    own.take_parameters(CONTROLLER, {
        'coolant_temperature.min': parameter('coolant_temperature.min', 5.0),
        'coolant_temperature.max': parameter('coolant_temperature.max', 32.0)})
    assert own.limited('coolant_temperature', 60.0) == 32.0
    assert own.limited('coolant_temperature', 20.0) == 20.0


@pytest.mark.parametrize(('signal', 'mode', 'left', 'words'), [
    ('command', '', '0', ''), ('command', 'automatic', '0', 'stop it, or set experiment_signal'),
    ('setpoint', 'automatic', '0', ''), ('setpoint', 'manual', '0', 'in automatic mode'),
    ('manual', 'automatic', '0', 'in manual mode'), (None, 'automatic', '0', ''),
    ('setpoint', 'automatic', '12.5', 'is running')])
def test_an_experiment_that_cannot_start_has_a_reason(
        signal: str | None, mode: str, left: str, words: str) -> None:
    own = view()
    if mode:
        answered(own, mode=mode)
    if signal:
        own.take_parameters(TRAINER, {'experiment_signal': parameter('experiment_signal', signal)})
    status(own, EXPERIMENT, OK, 'finished', {'left [s]': left}, NOW)
    found = experiment_obstacle(own.snapshot(NOW))
    assert words in found
    assert bool(found) is bool(words)
    assert bool(own.snapshot(NOW).experiment) is (left != '0')


def test_each_warning_of_a_status_has_an_alarm_of_its_own() -> None:
    own = view()

    def standing(second: float, *warnings: str) -> list[tuple[str, AlarmState]]:
        values = {f'warning {number}': text for number, text in enumerate(warnings, 1)}
        status(own, 'controller: model', WARN if warnings else OK, '; '.join(warnings), values,
               NOW + second)
        measure(own, 50.0, second + 1.0)
        own.advance(NOW + second)
        return [(alarm.text.partition(': model: ')[2], alarm.state)
                for alarm in own.snapshot(NOW + second).standing]

    up, back = AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED
    standing(0.0, 'level_1 at 4.5 m')
    assert standing(2.0, 'level_1 at 4.6 m', 'retrain') == [('level_1 at 4.6 m', up)]
    assert standing(4.0, 'retrain', 'level_1 at 4.7 m') == [
        ('retrain', up), ('level_1 at 4.7 m', up)]
    standing(6.0, 'retrain')
    assert standing(12.0, 'retrain') == [('retrain', up), ('level_1 at 4.7 m', back)]
    standing(13.0)
    assert [state for _, state in standing(19.0)] == [back, back]
    # so has each reason for a control level, whose numbers may change
    for second, message in enumerate(('held: stuck for 5 s', 'held: stuck for 6 s', 'held: late')):
        for part in (0.0, 1.5):
            measure(own, 50.0, 20.0 + 2 * second + part)
            status(own, CONTROL, ERROR, message, {}, NOW + 20.0 + 2 * second + part)
    assert sorted(alarm.text for alarm in own.snapshot(NOW + 26.0).standing
                  if alarm.text.startswith(CONTROL)) == [
        f'{CONTROL}: held: late', f'{CONTROL}: held: stuck for 6 s']


def test_the_cause_is_nearest_to_the_plant_and_a_group_as_urgent_as_its_worst_alarm() -> None:
    alarms = Alarms(delay_on=0.0)
    for second, (key, priority) in enumerate((
            ('other: io', Priority.MEDIUM), ('plant: simulation: stopped', Priority.LOW),
            ('silence of plant', Priority.HIGH), ('controller: control: held', Priority.HIGH))):
        alarms.report(key, True, priority, key, NOW + second)
    found = [(cause.key, [one.key for one in rest]) for cause, rest in grouped(alarms.standing)]
    assert found == [
        ('plant: simulation: stopped', ['silence of plant', 'controller: control: held']),
        ('other: io', [])]
    # what is raised much later has another cause
    alarms.report('trainer: training: failed', True, Priority.LOW, '', NOW + 100.0)
    assert [cause.key for cause, _ in grouped(alarms.standing)][-1].startswith('trainer')


def test_alarms_of_a_node_that_is_gone_are_stale_and_return() -> None:
    own = view()

    def looked(second: float) -> tuple[list[AlarmState], int]:
        status(own, CONTROL, OK, 'automatic', {}, NOW + second)
        own.advance(NOW + second)
        now = own.snapshot(NOW + second)
        found = [alarm for alarm in now.standing if alarm.source == 'pump']
        return [alarm.state for alarm in found], sum(one.key in now.stale for one in found)

    for second in range(3):
        status(own, 'pump: bearing', ERROR, 'warm', {}, NOW + second)
        looked(float(second))
    assert looked(8.0) == ([AlarmState.UNACKNOWLEDGED], 0)
    assert looked(15.0) == ([AlarmState.UNACKNOWLEDGED], 1)
    looked(63.0)
    assert looked(70.0) == ([AlarmState.RETURNED], 0)


def test_a_line_has_a_gap_where_the_controller_was_silent() -> None:
    own = view()
    for second in (1.0, 2.0, 20.0, 21.0):
        own.take_signals('commands', {'coolant_temperature': 300.0}, second, NOW + second)
        measure(own, 50.0, second)
    for second in range(3, 20):
        measure(own, 50.0, float(second))
    for second in (1.0, 2.0, 20.0, 21.0):
        own.take_signals('commands', {'coolant_temperature': 300.0}, second + 30.0,
                         NOW + second + 30.0)
    _, values = own.trends.window(['coolant_temperature command'], 0.0, 60.0)[
        'coolant_temperature command']
    assert int(np.isnan(values).sum()) == 3


def test_an_alarm_of_a_measurement_has_a_delay_and_a_deadband() -> None:
    own = view()
    own.limits = {'temperature': ProcessLimits(
        high=50.0, low=40.0, deviation=3.0, deadband=0.5, delay=10.0)}
    own.take_signals('active_setpoints', {'temperature': to_kelvin(45.0)}, 0.0, NOW)

    def standing(celsius: float, second: float) -> dict[str, AlarmState]:
        answered(own, wall=NOW + second)
        measure(own, celsius, second, NOW + second)
        own.advance(NOW + second)
        return {alarm.key.rpartition(': ')[2]: alarm.state for alarm in own.alarms.standing
                if alarm.key.startswith('process')}

    up, back = AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED
    assert standing(50.2, 1.0) == {}
    assert standing(50.2, 10.0) == {}
    assert standing(50.2, 11.5) == {'high': up, 'deviation': up}
    # back by less than the deadband
    standing(49.6, 12.0)
    assert standing(49.6, 20.0) == {'high': up, 'deviation': up}
    standing(47.4, 21.0)
    assert standing(47.4, 27.0) == {'high': back, 'deviation': back}
    standing(39.0, 28.0)
    assert standing(39.0, 39.0)['low'] is up
    # the set-point is not controlled in manual mode
    other = view()
    other.limits, own = own.limits, other
    own.take_signals('active_setpoints', {'temperature': to_kelvin(45.0)}, 0.0, NOW)
    answered(own, mode='manual')
    for second in range(1, 20):
        measure(own, 49.0, float(second), NOW + second)
        own.advance(NOW + second)
    assert not [alarm for alarm in own.alarms.standing if 'deviation' in alarm.key]


# Trends.


def test_pens_and_marks_are_in_the_time_of_the_plant() -> None:
    own = view()
    own.take_signals('active_setpoints', {'temperature': to_kelvin(45.0)}, 0.0, NOW)
    for second in range(1, 4):
        measure(own, 50.0 + second, float(second))
    own.take_record('mode', {'mode': 'manual'}, NOW)
    found = own.trends.window([pen('measured', 'temperature'),
                               pen('active_setpoints', 'temperature')], 0.0, 10.0)
    times, values = found['temperature']
    assert times.tolist() == [1.0, 2.0, 3.0]
    assert values.tolist() == pytest.approx([51.0, 52.0, 53.0])
    assert found['temperature set-point'][1].tolist() == pytest.approx([45.0] * 3)
    assert [(mark.time, mark.text) for mark in own.trends.marks(0.0, 10.0)] == [
        (3.0, 'manual')]


def test_no_line_is_drawn_across_a_silence_of_the_plant() -> None:
    own = view()
    for second in (1.0, 2.0, 100.0, 101.0):
        measure(own, 50.0 + second, second)
    times, values = own.trends.window(['temperature'], 0.0, 200.0)['temperature']
    assert times.tolist() == pytest.approx([1.0, 2.0, 2.0, 100.0, 101.0])
    assert np.isnan(values).tolist() == [False, False, True, False, False]


def test_time_that_begins_again_begins_the_trends_again() -> None:
    own = view()
    for second in (100.0, 101.0, 1.0):
        measure(own, 50.0, second, NOW)
    times, _ = own.trends.window(['temperature'], 0.0, 200.0)['temperature']
    assert times.tolist() == [1.0]
    assert own.snapshot(NOW).time == 1.0


# Parameters and requests.


@pytest.mark.parametrize(('value', 'text', 'read'), [
    (1.5, ' 2,5 ', 2.5), (3, '4', 4), (True, 'False', False), ('a', 'b', 'b'),
    (('a',), '[b, c]', ('b', 'c')), ((0.0,), '1, 2.5', (1.0, 2.5))])
def test_texts_are_parsed_as_values_of_their_type(value: Any, text: str, read: Any) -> None:
    found = parameter('p', value).parse(text)
    assert found == read
    assert type(found) is type(read)


@pytest.mark.parametrize(('given', 'text', 'words'), [
    (parameter('p', 1.0), 'x', 'not a number'), (parameter('p', 1), '1.5', 'whole number'),
    (parameter('p', True), 'on', 'true or false'), (parameter('p', (1.0,)), 'a', 'numbers')])
def test_wrong_texts_are_rejected(
        given: ParameterDescription, text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        given.parse(text)


def record(value: float, accepted: bool = True, *codes: str) -> dict[str, Any]:
    return {'value': [value], 'accepted': accepted, 'reason': list(codes)}


@pytest.mark.parametrize(('words', 'events', 'answers'), [
    ('', [(SETPOINT, record(300.0)), (MANUAL, record(318.15)), ('measurement', {})], []),
    ('', [(SETPOINT, record(318.15)), (SETPOINT, record(318.15))], ['accepted']),
    ('outside 32 to 54 degC', [(SETPOINT, record(318.15, False, 'setpoint_outside'))],
     ['rejected: outside 32 to 54 degC']),
    # the sentence of a code follows with the status, or never
    ('', [(SETPOINT, record(318.15, False, 'setpoint_not_held')), 'automatic'], []),
    ('', [(SETPOINT, record(318.15, False, 'setpoint_not_held')),
          'request rejected: it cannot be held'], ['rejected: it cannot be held']),
    ('', [(SETPOINT, record(318.15, False, 'setpoint_not_held')), 2.0],
     ['rejected: setpoint not held']),
    ('', [TIMEOUT], []), ('', [TIMEOUT + 0.1], ['unknown: the controller did not answer'])])
def test_records_and_statuses_answer_requests(
        words: str, events: list[Any], answers: list[str]) -> None:
    requests = Requests({SETPOINT: ('temperature',), MANUAL: ('coolant_temperature',)},
                        lambda *_: words)
    found: list[Answer] = []
    requests.add(SETPOINT, 'temperature', 318.15, 0.0, found.append)
    for event in events:
        if isinstance(event, tuple):
            requests.take_record(event[0], event[1], 0.1)
        elif isinstance(event, str):
            requests.take_status(event)
        else:
            requests.advance(event)
    assert [str(answer).partition(' within')[0] for answer in found] == answers


def test_an_action_is_a_line_of_json() -> None:
    action = Action('<script>', 'setpoint', 'temperature', 45.0, math.nan)
    assert json.loads(AuditEntry.of(action, Answer(False, 'outside'), 12.3456).text()) == {
        'stamp': 12.346, 'who': '<script>', 'what': 'setpoint temperature', 'old': 'nan',
        'new': 45.0, 'accepted': False, 'answer': 'outside'}


def test_limits_that_are_near_in_a_chart_have_one_label_and_pens_differ_without_colour() -> None:
    own = view(TANKS)
    own.take_model({'level_1': (0.1, 1.0), 'level_2': (0.102, 1.0)}, {})
    now = own.snapshot(NOW)
    pens = _charts(now)[0][1]
    lines = _lines(pens, {face.name: face for face in now.states}, [])
    assert [(one['yAxis'], one['name']) for one in lines] == [
        (0.1, 'level 1, level 2 trained'), (0.102, ''), (1.0, 'level 1, level 2 trained'),
        (1.0, '')]
    # no two measurements of a chart have the same dashes
    assert len({str(line('measured', place)) for place in range(5)}) == 5
