# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The panel's view of a loop: faceplates, silences, alarms, marks, and answers to requests."""

from collections.abc import Mapping
from dataclasses import replace
import json
import math
from typing import Any

import pytest

from koopman_ros.panel.alarms import AlarmState, Priority
from koopman_ros.panel.plant import (
    CONTROLLER,
    ERROR,
    LOST,
    OK,
    ParameterView,
    pen,
    PLANT,
    PlantView,
    REQUESTS,
    Snapshot,
    TRAINER,
    WARN,
)
from koopman_ros.panel.requests import (
    Action,
    action_text,
    Answer,
    MANUAL,
    PATIENCE,
    Requests,
    SETPOINT,
)
from koopman_ros.parameters.wire import Signals
from koopman_ros.units import display_unit, to_kelvin

REACTOR = Signals({'temperature': 'K'}, {'coolant_temperature': 'K'}, ('temperature',))
TANKS = Signals({'level_1': 'm', 'level_2': 'm'}, {'pump_1': 'V', 'pump_2': 'V'},
                ('level_1', 'level_2'))
CONTROL = 'controller: control'
NOW = 1_790_000_000.0  # s of Unix time


def parameter(name: str, value: Any, **details: Any) -> ParameterView:
    return replace(ParameterView(name, value, '', '', '', -math.inf, math.inf, False), **details)


def view(signals: Signals = REACTOR, **read: str) -> PlantView:
    usual = {name: display_unit(unit) for name, unit in signals.units.items()}
    return PlantView(signals, {**usual, **read}, 3600.0, NOW)


def measure(own: PlantView, celsius: float, seconds: float, wall: float | None = None) -> None:
    own.hear('measured', {'temperature': to_kelvin(celsius)}, seconds,
             NOW + seconds if wall is None else wall)


def answered(own: PlantView, level: str = 'sdre', mode: str = 'automatic', wall: float = NOW
             ) -> None:
    own.record('measurement', {'mode': mode, 'level': level}, wall)


# Faceplates.


def test_numbers_are_those_that_people_read() -> None:
    own = view()
    measure(own, 51.8, 1.0)
    own.hear('active_setpoints', {'temperature': to_kelvin(45.0)}, 0.5, NOW + 1.0)
    own.hear('predicted', {'temperature': to_kelvin(51.7)}, 1.0, NOW + 1.0)
    own.hear('commands', {'coolant_temperature': to_kelvin(20.0)}, 1.0, NOW + 1.0)
    own.internals({'disturbance [K]': 0.5, 'estimated_temperature [degC]': 51.0,
                   'estimated_concentration [mol/L]': 0.88})
    now = own.snapshot(NOW + 1.0)
    (state,), (given,) = now.states, now.inputs
    assert (state.label, state.unit, state.controlled) == ('temperature', '°C', True)
    assert [state.measured, state.setpoint, state.asked, state.predicted] == pytest.approx(
        [51.8, 45.0, 45.0, 51.7])
    assert (given.label, given.command, given.disturbance) == (
        'coolant temperature', pytest.approx(20.0), 0.5)
    assert math.isnan(given.applied)
    assert given.text(given.applied) == '–'
    # that of the measured state is none of an unmeasured one
    assert now.estimates == (('concentration', '0.88 mol/L'),)
    # of a filter with how well it is known, and of another model others
    own.internals({'estimated_latent_1 [1]': 0.25, 'deviation_latent_1 [1]': 0.0123})
    assert own.snapshot(NOW + 1.2).estimates == (('latent 1', '0.25 ± 0.012 1'),)


def test_a_signal_is_shown_in_the_unit_that_its_operators_read() -> None:
    own = view(temperature='degF')
    own.trained({'temperature': (to_kelvin(40.0), to_kelvin(60.0))}, {})
    measure(own, 50.0, 1.0)
    own.record('setpoint', {'accepted': True, 'signals': ['temperature'],
                            'value': [to_kelvin(45.0)], 'reason': []}, NOW)
    face = own.snapshot(NOW).states[0]
    assert face.unit == '°F'
    assert [face.measured, face.asked, *face.training] == pytest.approx(
        [122.0, 113.0, 104.0, 140.0])
    assert face.abnormal == ''
    bare = view(temperature='degF')
    bare.parameters('controller', {
        name: parameter(name, value, unit='degC') for name, value in (
            ('temperature.sensor_min', 0.0), ('temperature.sensor_max', 100.0))})
    low, high = bare.snapshot(NOW).states[0].span
    assert (low, high) == pytest.approx((32.0 - 18.0, 212.0 + 18.0))
    # of the others nothing changes
    assert bare.snapshot(NOW).inputs[0].unit == '°C'


def test_a_plan_lies_ahead_until_nothing_is_planned() -> None:
    own = view(temperature='degF')
    own.planned(['temperature [degC]', 'coolant_temperature [degC]'], 100.0, [0.0, 1.0, 3.0],
                [[50.0, 20.0], [45.0, 21.0], [40.0, 21.0]])
    own.limits({'at_range_coolant_temperature [-1 lower, 1 upper]': 1.0,
                'at_rate_coolant_temperature [-1 falling, 1 rising]': 1.0,
                'at_limit_temperature [-1 lower, 1 upper]': -1.0})
    answered(own, 'mpc')
    now = own.snapshot(NOW)
    assert [time for time, _ in now.states[0].plan] == [100.0, 101.0, 103.0]
    assert [value for _, value in now.states[0].plan] == pytest.approx([122.0, 113.0, 104.0])
    assert now.inputs[0].plan == ((100.0, 20.0), (101.0, 21.0), (103.0, 21.0))
    assert now.states[0].active == 'kept above its lower limit'
    assert now.inputs[0].active == 'at its upper limit, rising as fast as it may'
    # one that is lost on its way leaves the last; limits that are over are
    answered(own, 'mpc')
    own.limits({'at_rate_coolant_temperature [-1 falling, 1 rising]': 0.0})
    assert (own.snapshot(NOW).inputs[0].active, len(own.snapshot(NOW).inputs[0].plan)) == ('', 3)
    answered(own, 'sdre')
    assert own.snapshot(NOW).states[0].plan == own.snapshot(NOW).inputs[0].plan == ()


@pytest.mark.parametrize(('names', 'rows'), [
    (['temperature [degC]'], [[1.0], [1.0, 2.0]]), (['temperature [m]'], [[1.0], [2.0]]),
    (['temperature [degC]', 'coolant_temperature [degC]'], [[1.0], [2.0]]),
    (['temperature'], [[1.0], [2.0]]), (['level [m]'], [[1.0], [2.0]])])
def test_what_is_no_plan_of_these_signals_is_passed_over(
        names: list[str], rows: list[list[float]]) -> None:
    own = view()
    own.planned(names, 100.0, [0.0, 1.0], rows)
    assert own.snapshot(NOW).states[0].plan == own.snapshot(NOW).inputs[0].plan == ()


def test_a_limit_of_a_state_is_drawn_also_where_there_is_only_one() -> None:
    own = view(coolant_temperature='degC')
    own.parameters('controller', {name: parameter(
        name, value, unit='degC', lower=-273.15, upper=1e9) for name, value in (
        ('mpc.temperature.min', -273.15), ('mpc.temperature.max', 60.0),
        ('coolant_temperature.min', 5.0), ('coolant_temperature.max', 40.0))})
    measure(own, 50.0, 1.0)
    now = own.snapshot(NOW)
    assert now.states[0].limits == (-math.inf, 60.0)
    assert now.inputs[0].limits == (5.0, 40.0)
    # and the bar is long enough for it
    assert now.states[0].span[1] >= 60.0


def test_the_first_of_the_levels_is_no_fallback() -> None:
    for levels, fallback in ((('mpc', 'sdre'), True), (('sdre', 'linear'), False), (None, False)):
        own = view()
        if levels:
            own.parameters('controller', {'levels': parameter('levels', levels)})
        own.record('measurement', {'mode': 'automatic', 'level': 'sdre'}, NOW)
        assert own.snapshot(NOW).fallback is fallback


def test_a_file_that_another_training_replaced_offers_its_predecessor() -> None:
    own = view()
    own.parameters('controller', {'model': parameter('model', 'runs/new.safetensors')})
    state = {'mode': {'name': 'AUTOMATIC'}}

    def model(event: str, name: str, digest: str) -> str:
        own.record(event, {'model': {'name': name, 'digest': digest}, 'state': state}, NOW)
        return own.snapshot(NOW).previous_model

    assert model('snapshot', 'runs/new.safetensors', 'a') == ''
    # the same file once more
    assert model('model', 'runs/new.safetensors', 'a') == ''
    assert model('model', 'runs/new.safetensors', 'b') == 'runs/new.previous.safetensors'
    own.parameters('controller', {'model': parameter('model', 'runs/new.previous.safetensors')})
    assert own.snapshot(NOW).previous_model == 'runs/new.safetensors'


def test_bars_hold_ranges_and_values() -> None:
    own = view()
    own.trained({'temperature': (to_kelvin(32.0), to_kelvin(54.0)),
                 'coolant_temperature': (to_kelvin(8.0), to_kelvin(28.0))}, {})
    own.parameters(CONTROLLER, {name: parameter(name, value) for name, value in {
        'coolant_temperature.min': 5.0, 'coolant_temperature.max': 32.0}.items()})
    measure(own, 43.0, 1.0)
    own.hear('commands', {'coolant_temperature': to_kelvin(32.0)}, 1.0, NOW + 1.0)
    now = own.snapshot(NOW + 1.0)
    (state,), (given,) = now.states, now.inputs
    assert state.training == pytest.approx((32.0, 54.0))
    assert state.span == pytest.approx((29.8, 56.2))
    assert state.share(43.0) == pytest.approx(0.5)
    assert [state.share(value) for value in (0.0, 99.0, math.nan)] == [0.0, 1.0, 0.0]
    assert (state.decimals, state.text(43.0)) == (1, '43.0')
    assert given.limits == (5.0, 32.0)
    assert given.abnormal == 'at its upper limit'
    # a value that left the range is on the bar, and said to be out
    measure(own, 80.0, 2.0)
    (state,) = own.snapshot(NOW + 2.0).states
    assert state.span[1] == pytest.approx(80.0)
    assert state.abnormal == 'above the trained range'


def test_a_set_point_that_is_asked_for_is_shown_beside_the_one_that_is_tracked() -> None:
    own = view(TANKS)
    for name, value in (('level_1', 0.10), ('level_2', 0.15)):
        own.hear('active_setpoints', {name: value}, 1.0, NOW)
    own.record('setpoint', {'value': [0.2], 'signals': ['level_2'], 'accepted': True,
                            'reason': []}, NOW)
    own.record('setpoint', {'value': [9.9], 'signals': ['level_1'], 'accepted': False,
                            'reason': ['setpoint_outside']}, NOW)
    first, second = own.snapshot(NOW).states
    assert (first.setpoint, first.asked, second.setpoint, second.asked) == (0.1, 0.1, 0.15, 0.2)


def test_a_snapshot_stays_what_it_was() -> None:
    own = view()
    measure(own, 50.0, 1.0)
    before = own.snapshot(NOW)
    held = repr(before)
    measure(own, 60.0, 2.0)
    own.status(CONTROL, ERROR, 'broken', {'a': 'b'}, NOW)
    own.parameters(CONTROLLER, {'a': parameter('a', 1.0)})
    assert repr(before) == held
    with pytest.raises(TypeError):
        before.statuses['x'] = before.status('x')  # type: ignore[index]


# Levels, silences, alarms and marks.


def test_fallback_is_said_with_its_reason() -> None:
    own = view()
    answered(own)
    own.status(CONTROL, OK, 'automatic', {'reason': 'none'}, NOW)
    now = own.snapshot(NOW)
    assert (now.mode, now.level, now.fallback, now.reason) == (
        'automatic', 'learned law', False, '')
    answered(own, 'hold')
    own.status(CONTROL, ERROR, 'held: check', {'reason': 'the sensor is frozen'}, NOW)
    now = own.snapshot(NOW)
    assert (now.level, now.fallback, now.reason) == ('hold', True, 'the sensor is frozen')
    answered(own, 'manual', 'manual')
    now = own.snapshot(NOW)
    assert (now.mode, now.fallback) == ('manual', False)


@pytest.mark.parametrize('fields', [
    {}, {'mode': 'automatic'}, {'value': 'x', 'accepted': True}, {'value': [1, 2], 'accepted': 1},
    {'value': [{}], 'accepted': True, 'signals': ['nobody']}, {'model': []}, {'state': 3}])
@pytest.mark.parametrize('event', [
    'measurement', 'setpoint', 'manual_command', 'mode', 'model', 'snapshot', 'unheard-of'])
def test_records_that_are_none_change_nothing(event: str, fields: Mapping[str, Any]) -> None:
    own = view()
    answered(own)
    own.record(event, fields, NOW)
    assert own.snapshot(NOW).level == 'learned law'


def test_who_is_not_heard_is_named_with_the_time() -> None:
    own = view()
    assert own.snapshot(NOW + 1.0).silences == ()
    silences = own.snapshot(NOW + 10.0).silences
    assert [(one.source, one.since, one.ever) for one in silences] == [
        (CONTROLLER, NOW, False), (PLANT, NOW, False)]
    for second in range(1, 20):
        measure(own, 50.0, float(second))
        own.status(CONTROL, OK, 'automatic', {}, NOW + second)
    assert own.snapshot(NOW + 20.0).silences == ()
    (silence,) = (one for one in own.snapshot(NOW + 30.0).silences if one.source == PLANT)
    assert (silence.since, silence.ever) == (NOW + 19.0, True)


def test_a_slow_plant_is_not_silent_between_its_measurements() -> None:
    own = view()
    for minute in range(1, 5):
        measure(own, 50.0, 60.0 * minute)
    assert PLANT not in [one.source for one in own.snapshot(NOW + 240.0 + 59.0).silences]
    assert PLANT in [one.source for one in own.snapshot(NOW + 240.0 + 400.0).silences]


def test_silence_and_levels_are_alarms_by_priority_and_marks() -> None:
    own = view()
    measure(own, 50.0, 1.0, NOW)
    for second in range(4):
        own.status(CONTROL, WARN, 'extrapolates', {}, NOW + second)
        own.status('trainer: recording', WARN, 'disk is filling', {}, NOW + second)
        own.status('other', ERROR, 'is down', {}, NOW + second)
        own.advance(NOW + second)
    assert [(alarm.key, alarm.priority) for alarm in own.snapshot(NOW + 3.0).standing] == [
        ('other', Priority.HIGH), (CONTROL, Priority.MEDIUM), ('trainer: recording', Priority.LOW)]
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


def test_only_the_nodes_of_the_own_loop_are_taken_for_it() -> None:
    own = PlantView(REACTOR, {name: display_unit(unit) for name, unit in REACTOR.units.items()},
                    3600.0, NOW, {'line_1/plant': PLANT, 'line_1/controller': CONTROLLER,
                                  'line_1/trainer': TRAINER})
    measure(own, 50.0, 1.0, NOW)
    answered(own)
    own.hear('commands', {'coolant_temperature': to_kelvin(20.0)}, 1.0, NOW)
    own.status('line_1/controller: control', OK, 'automatic', {'reason': 'none'}, NOW)
    own.status('line_1/trainer: training', OK, 'idle', {'model_file': 'a'}, NOW)
    for second in range(1, 10):
        for node in ('controller: control', 'trainer: training', 'plant: simulation'):
            own.status(f'line_2/{node}', ERROR, 'of the other line', {}, NOW + second, 'other')
        own.advance(NOW + second)
    now = own.snapshot(NOW + 10.0)
    assert {one.source for one in now.silences} == {CONTROLLER, PLANT, TRAINER}
    assert (now.mode, now.level, now.plant) == ('', '', '')
    assert all('other line' not in alarm.text for alarm in now.standing)
    for name, values in ((CONTROL, {'reason': 'none'}),
                         ('trainer: training', {'model_file': 'a'})):
        status = now.status(name)
        assert (status.level, status.message, status.values) == (ERROR, LOST, values)
    assert 'last command' in now.inputs[0].abnormal
    # one that is back is shown again
    own.status('line_1/controller: control', OK, 'automatic', {}, NOW + 10.0)
    now = own.snapshot(NOW + 10.0)
    assert (now.mode, now.status(CONTROL).message) == ('automatic', 'automatic')
    assert now.inputs[0].abnormal == ''


def test_statuses_of_other_nodes_crowd_out_none_of_the_own_loop() -> None:
    own = view()
    for i in range(200):
        own.status(f'driver_{i}: io', OK, 'ok', {}, NOW)
    own.status(CONTROL, ERROR, 'held', {}, NOW)
    own.status('controller: actuators', WARN, 'stuck', {}, NOW)
    own.advance(NOW + 2.0)
    now = own.snapshot(NOW + 2.0)
    assert {alarm.key for alarm in now.standing} == {CONTROL, 'controller: actuators'}
    assert len(now.statuses) < 100


def test_a_warning_has_one_alarm_whatever_else_is_wrong() -> None:
    own = view()
    own.status(CONTROL, WARN, 'request refused: a; stuck', {'condition': 'requests'}, NOW)
    own.status(REQUESTS, WARN, 'request refused: a', {}, NOW)
    own.status('controller: actuators', WARN, 'stuck', {}, NOW)
    own.advance(NOW + 2.0)
    assert [(alarm.key, alarm.priority) for alarm in own.snapshot(NOW + 2.0).standing] == [
        ('controller: actuators', Priority.MEDIUM), (REQUESTS, Priority.LOW)]
    own.status(REQUESTS, OK, 'in order', {}, NOW + 3.0)
    own.advance(NOW + 9.0)
    assert [alarm.key for alarm in own.snapshot(NOW + 9.0).standing
            if alarm.state is not AlarmState.RETURNED and 'silence' not in alarm.key] == [
        'controller: actuators']


def test_many_short_errors_are_an_alarm() -> None:
    def alarmed(seconds: float, errors: int) -> bool:
        own = view()
        for k in range(2 * errors):
            now = NOW + seconds * k / 2
            measure(own, 50.0, seconds * k / 2 + 1.0, now)
            own.status(CONTROL, OK if k % 2 else ERROR, 'held', {}, now)
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
    own.parameters(CONTROLLER, {
        'coolant_temperature.min': parameter('coolant_temperature.min', 5.0),
        'coolant_temperature.max': parameter('coolant_temperature.max', 32.0)})
    assert own.limited('coolant_temperature', 60.0) == 32.0
    assert own.limited('coolant_temperature', 20.0) == 20.0


# Trends.


def test_pens_and_marks_are_in_the_time_of_the_plant() -> None:
    own = view()
    own.hear('active_setpoints', {'temperature': to_kelvin(45.0)}, 0.0, NOW)
    for second in range(1, 4):
        measure(own, 50.0 + second, float(second))
    own.record('mode', {'mode': 'manual'}, NOW)
    found = own.trends.window([pen('measured', 'temperature'),
                               pen('active_setpoints', 'temperature')], 0.0, 10.0)
    times, values = found['temperature']
    assert times.tolist() == [1.0, 2.0, 3.0]
    assert values.tolist() == pytest.approx([51.0, 52.0, 53.0])
    assert found['temperature set-point'][1].tolist() == pytest.approx([45.0] * 3)
    assert [(mark.time, mark.text) for mark in own.trends.marks(0.0, 10.0)] == [
        (3.0, 'manual mode')]


def test_time_that_begins_again_begins_the_trends_again() -> None:
    own = view()
    for second in (100.0, 101.0, 1.0):
        measure(own, 50.0, second, NOW)
    times, _ = own.trends.window(['temperature'], 0.0, 200.0)['temperature']
    assert times.tolist() == [1.0]
    assert own.snapshot(NOW).time == 1.0


# Parameters.


@pytest.mark.parametrize(('value', 'text', 'read'), [
    (1.5, ' 2,5 ', 2.5), (3, '4', 4), (True, 'False', False), ('a', 'b', 'b'),
    (('a',), '[b, c]', ('b', 'c')), ((0.0,), '1, 2.5', (1.0, 2.5))])
def test_texts_are_read_as_values_of_their_type(value: Any, text: str, read: Any) -> None:
    found = parameter('p', value).read(text)
    assert found == read
    assert type(found) is type(read)


@pytest.mark.parametrize(('given', 'text', 'words'), [
    (parameter('p', 1.0), 'x', "'x' is not a number"),
    (parameter('p', 1), '1.5', "'1.5' is not a whole number"),
    (parameter('p', True), 'on', 'write true or false'),
    (parameter('p', 1.0, range='[0, 2] m', lower=0.0, upper=2.0), '3', r'must be \[0, 2\] m'),
    (parameter('p', 1.0), 'nan', 'must be a finite number'),
    (parameter('p', (1.0,)), 'a', 'write numbers with commas between them'),
    (parameter('p', 'a', choices=('a', 'b'), range='one of a, b'), 'c', 'must be one of a, b')])
def test_what_cannot_be_is_refused_before_it_is_sent(
        given: ParameterView, text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        given.read(text)


# Requests.


def asked(value: float = 318.15, words: str = '') -> tuple[Requests, list[Answer]]:
    requests = Requests({SETPOINT: ('temperature',), MANUAL: ('coolant_temperature',)},
                        lambda *_: words)
    answers: list[Answer] = []
    requests.add(SETPOINT, 'temperature', value, 0.0, answers.append)
    return requests, answers


def setpoint(value: float, accepted: bool = True, *codes: str) -> dict[str, Any]:
    return {'value': [value], 'accepted': accepted, 'reason': list(codes)}


def test_a_record_answers_the_request_of_its_value() -> None:
    requests, answers = asked()
    requests.record(SETPOINT, setpoint(300.0), 0.1)
    requests.record(MANUAL, setpoint(318.15), 0.1)
    requests.record('measurement', {}, 0.1)
    assert not answers
    requests.record(SETPOINT, setpoint(318.15), 0.2)
    requests.record(SETPOINT, setpoint(318.15), 0.3)
    assert answers == [Answer(True, 'accepted')]


def test_a_refusal_is_said_in_words() -> None:
    requests, answers = asked(words='outside 32 to 54 degC')
    requests.record(SETPOINT, setpoint(318.15, False, 'setpoint_outside'), 0.1)
    assert [str(answer) for answer in answers] == ['refused: outside 32 to 54 degC']


def test_a_refusal_whose_words_are_not_known_waits_for_the_status() -> None:
    requests, answers = asked()
    requests.record(SETPOINT, setpoint(318.15, False, 'setpoint_not_held'), 0.1)
    requests.status('automatic')
    assert not answers
    requests.status('request refused: it cannot be held')
    assert answers == [Answer(False, 'it cannot be held')]


def test_a_refusal_without_words_names_its_codes_in_time() -> None:
    requests, answers = asked()
    requests.record(SETPOINT, setpoint(318.15, False, 'setpoint_not_held'), 0.1)
    requests.advance(0.2)
    assert not answers
    requests.advance(10.0)
    assert answers == [Answer(False, 'setpoint not held')]


def test_a_controller_that_does_not_answer_is_said_so() -> None:
    requests, answers = asked()
    requests.advance(PATIENCE)
    assert not answers
    requests.advance(PATIENCE + 0.1)
    assert answers[0].text.startswith('the controller did not answer within 3 s')
    assert not answers[0].accepted


def test_an_action_is_a_line_of_json_without_a_number_that_is_none() -> None:
    action = Action('<script>', 'setpoint', 'temperature', 45.0, math.nan)
    assert json.loads(action_text(action, Answer(False, 'outside'), 12.3456)) == {
        'stamp': 12.346, 'who': '<script>', 'what': 'setpoint temperature', 'old': 'nan',
        'new': 45.0, 'accepted': False, 'answer': 'outside'}


def test_what_is_shown_first_has_no_numbers_yet() -> None:
    now: Snapshot = view(TANKS).snapshot(NOW)
    assert [face.text(face.measured) for face in now.states] == ['–', '–']
    assert [face.abnormal for face in now.states] == ['no measurement', 'no measurement']
    assert (now.mode, now.level, now.standing) == ('', '', ())
