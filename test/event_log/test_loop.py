# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Records of any sequence of events give the same commands again, from any snapshot on.

Values go through JSON bit-identical, and nothing but data comes back.
"""

from dataclasses import dataclass, replace
import json
from pathlib import Path
import re
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from koopman_ros.control import events, Mode
from koopman_ros.core.paths import config_directory
from koopman_ros.core.status import UNMEASURED
from koopman_ros.event_log import records
from koopman_ros.event_log.loop import Alternative, Lost, Replay
from koopman_ros.event_log.run import replay_records
from koopman_ros.event_log.sources import find_model
from koopman_ros.model import load_with_digest, save
from support.recorded_runs import COOLANT, MODELS, Recorded, SECOND, STEADY


def replayed(texts: list[str], alternative: Alternative | None = None) -> Replay:
    return replay_records(map(records.parse, texts), (), alternative)


def identical(found: Replay, part: str = 'replayed') -> list[bool]:
    """Tell of each command whether it is bit-identical to the recorded one."""
    return [(other := getattr(sample, part)) is not None
            and other.tobytes() == sample.recorded.tobytes() for sample in found.samples]


NEAR = st.floats(STEADY - 8.0, STEADY + 2.0)
# Anything that can come to a controller; a measurement is likelier than the rest.
MEASURED = st.tuples(st.just('measure'), NEAR, st.sampled_from([1.0, 1.0, 1.0, 0.5, 7.0]),
                     st.none() | st.floats(COOLANT - 5.0, COOLANT + 5.0))
HAPPENS = st.one_of(
    MEASURED, MEASURED, MEASURED, MEASURED,
    st.tuples(st.just('measure'), st.sampled_from([np.nan, STEADY + 60.0, 1e300, -1.0]),
              st.just(1.0), st.none()),
    st.tuples(st.just('measure'), NEAR, st.sampled_from([0.0, -0.5, -30.0, 90.0]), st.none(),
              st.none() | st.floats(0.0, 2.0)),
    st.tuples(st.just('silence'), st.floats(0.5, 120.0), st.sampled_from([*UNMEASURED, None])),
    st.tuples(st.just('setpoint'), st.floats(STEADY - 12.0, STEADY + 4.0),
              st.sampled_from([0.0, 0.0, 3.5, 1e6])),
    st.tuples(st.just('manual'), st.floats(COOLANT - 30.0, COOLANT + 30.0) | st.just(np.inf)),
    st.tuples(st.just('mode'), st.sampled_from(Mode)),
    st.tuples(st.just('clear')),
    st.tuples(st.just('analysis'), st.floats(0.0, 30.0), NEAR | st.sampled_from([np.nan, np.inf])),
    st.tuples(st.just('applied'), st.floats(COOLANT - 30.0, COOLANT + 30.0)),
    st.tuples(st.just('exchange'), st.sampled_from([
        {'model': 'reactor_nz3'}, {'model': 'reactor_nz4'}, {'coolant_temperature.weight': 0.3},
        {'model': 'reactor_linear', 'observer_bandwidth': 0.0}, {'observer_bandwidth': 0.1},
        {'setpoint_filter_time': 20.0, 'temperature.setpoint_ramp': 0.1},
        {'coolant_temperature.rate_limit': 0.2}, {'safe_latch': True},
        {'coolant_temperature.dead_time': 20.0}, {'coolant_temperature.dead_time': 2.5},
        {'estimator': 'extended_kalman_filter', 'temperature.analysis_delay': 60.0}])),
    st.tuples(st.just('snapshot')))


def happen(controller: Recorded, event: tuple) -> None:
    match event:
        case ('measure', *measurement):
            controller.measure(*measurement)
        case ('silence', seconds, cause):
            controller.do(events.Silence(controller.now + round(seconds * SECOND), cause))
        case ('setpoint', kelvin, ahead):
            stamp_ns = controller.now + round(ahead * SECOND) if ahead else 0
            controller.do(events.SetpointRequest(stamp_ns, np.array([kelvin])))
        case ('manual', kelvin):
            controller.do(events.ManualCommand(np.array([kelvin])))
        case ('mode', mode):
            controller.do(events.ModeChange(mode))
        case ('clear',):
            controller.do(events.ClearSafeState())
        case ('analysis', seconds, kelvin):
            controller.do(events.AnalysisValue(
                controller.now - round(seconds * SECOND), 'temperature', kelvin))
        case ('applied', kelvin):
            controller.do(events.Initialisation(np.array([kelvin])))
        case ('exchange', parameters):
            controller.exchange(**parameters)
        case ('snapshot',):
            controller.snapshot()


@settings(deadline=None, max_examples=20)
@given(st.lists(HAPPENS, max_size=60), st.sampled_from(sorted(MODELS)), st.integers(0, 59))
def test_any_run_is_reproduced_from_its_start_and_from_any_place(
        happened: list[tuple], model: str, place: int) -> None:
    controller = Recorded(model)
    for k, event in enumerate(happened):
        if k == place:
            controller.snapshot()
        happen(controller, event)
    found = replayed(controller.texts)
    assert all(identical(found))
    assert len(found.samples) == len(controller.commands)
    assert not found.lost
    late = controller.texts[place:]
    parsed = [records.parse(text) for text in late]
    snapshots = [k for k, record in enumerate(parsed)
                 if record.event in (records.START, records.SNAPSHOT)]
    before = sum('command' in record.fields for record in parsed[:min(snapshots, default=None)])
    found = replayed(late)
    assert [sample.replayed is None for sample in found.samples] == [
        k < before for k in range(len(found.samples))]
    assert all(identical(found)[before:])


def day(**options: object) -> Recorded:
    """Return a controller with a day of ordinary work behind it."""
    controller = Recorded(**options)
    for k in range(60):
        if k % 20 == 10:
            controller.do(events.SetpointRequest(0, np.array([STEADY - 0.1 * k])))
            controller.snapshot()
        controller.measure(STEADY - 0.05 * k)
    return controller


def test_a_reason_is_written_with_those_behind_it() -> None:
    controller = Recorded()
    controller.measure(STEADY, 1.0)
    for _ in range(2):
        controller.measure(np.nan, 100.0)
    written = [records.parse(text).fields for text in controller.texts[1:]]
    assert [(fields['level'], fields['reason']) for fields in written] == [
        ('sdre', []), ('hold', ['measurement_not_finite']),
        ('safe', ['held_too_long', 'measurement_not_finite'])]


def test_lost_records_are_reported_and_replay_continues_at_the_next_snapshot() -> None:
    texts = day().texts
    # the first snapshot behind it is that of the 30th measurement
    found = replayed([*texts[:20], *texts[22:]])
    assert found.lost == [Lost('a', 20, 21)]
    right = identical(found)
    assert len(right) == 58
    assert right.index(False) == 17
    assert right[17:28] == [False] * 11
    assert all(right[28:])


def test_controllers_on_one_topic_and_one_that_is_started_again() -> None:
    one, two = day(run='a'), day(run='b', name='reactor_nz3')
    both = [text for pair in zip(one.texts, two.texts, strict=True) for text in pair]
    found = replayed([*both, *day(run='c').texts])
    assert all(identical(found))
    assert (found.runs, found.begins_late) == (3, 0)
    assert found.models == ['reactor_nz4', 'reactor_nz3']


def test_same_model_under_the_same_parameters_commands_the_same() -> None:
    controller = Recorded(**{'temperature.setpoint_ramp': 0.1})
    for k in range(40):
        if k == 10:
            controller.do(events.SetpointRequest(0, np.array([STEADY - 6.0])))
        if k == 20:
            controller.exchange(**{'coolant_temperature.weight': 0.5})
        if k in (25, 30):
            controller.do(events.ModeChange(Mode.MANUAL if k == 25 else Mode.AUTOMATIC))
        controller.measure(STEADY - 0.1 * k)
    model, digest = MODELS['reactor_nz4']
    for texts in (controller.texts, day().texts[12:]):
        found = replayed(texts, Alternative(model, digest))
        assert records.parse(texts[0]).event in (records.START, records.SNAPSHOT)
        assert all(identical(found, 'alternative'))
    found = replayed(controller.texts, Alternative(
        model, digest, {'coolant_temperature.weight': 0.1}))
    assert not all(identical(found, 'alternative'))
    assert all(identical(found))


def test_a_model_that_rejects_the_setpoint_tracks_the_previous_one() -> None:
    found = replayed(day().texts, Alternative(*MODELS['reactor_linear']))
    assert all(sample.alternative is not None for sample in found.samples)
    assert not all(identical(found, 'alternative'))


def test_a_model_file_is_found_after_its_folder_moved(tmp_path: Path) -> None:
    path = tmp_path / 'own.safetensors'
    own = MODELS['reactor_nz4'][0]
    save(replace(own, provenance=replace(own.provenance, plant='another')), path)
    model, digest = load_with_digest(path)
    name = str(tmp_path / 'gone' / 'own.safetensors')
    for place in (tmp_path, path):
        assert find_model([place], name, digest).provenance == model.provenance
    with pytest.raises(records.RecordError, match=r'own.safetensors \(SHA-256 .* neither bundled'):
        find_model([config_directory() / 'models'], name, digest)


@pytest.mark.parametrize(('text', 'words'), [
    *((text, 'is not a record of a controller') for text in (
        '', '[]', '{}', '{"version":1,"run":"a","number":"x","event":"start"}', '[' * 100_000)),
    ('{"version":2}', 'version 2, this package')])
def test_text_that_is_no_record(text: str, words: str) -> None:
    with pytest.raises(records.RecordError, match=words):
        records.parse(text)


def event(measured: object) -> dict[str, object]:
    return {'stamp_ns': 1, 'measured': measured, 'applied': None, 'seconds': None}


@pytest.mark.parametrize(('place', 'change', 'words'), [
    (0, lambda fields: fields.pop('state'), 'record 0 of run a cannot be replayed'),
    (0, lambda fields: fields['state'].update({'@': 'os:system'}), "unknown class 'os:system'"),
    (0, lambda fields: fields['state'].update(extra=1), 'unexpected keyword'),
    (0, lambda fields: fields['state'].update(command={
        '@': 'array', 'dtype': '<f8', 'shape': [3], 'values': [1.0, 2.0, 3.0]}), 'record 0'),
    (0, lambda fields: fields['model'].update(digest='0' * 64), 'neither bundled nor found'),
    (0, lambda fields: fields['parameters'].update({'coolant_temperature.weight': -1.0}),
     r'rejects .coolant_temperature\.weight = -1\.0'),
    (0, lambda fields: fields['parameters'].update(other=1.0), 'parameters other, which this'),
    # what has a default may be missing, as in a later version
    (0, lambda fields: fields['state'].pop('mode'), ''),
    (1, {'event': 'unheard'}, "unknown event 'unheard'"),
    (1, {'fields': event({})}, 'is not a list of numbers'),
    (1, {'fields': event([])}, 'record 1 of run a cannot be replayed'),
    (1, {'fields': {}}, 'record 1 of run a cannot be replayed'),
    (1, {'number': 0}, 'record 0 of run a is repeated'),
])
def test_record_that_does_not_fit(place: int, change: Any, words: str) -> None:
    controller = Recorded()
    controller.measure(STEADY)
    texts = controller.texts
    record = records.parse(texts[place])
    if place:
        record = replace(record, **change)
    else:
        change(record.fields)
    texts[place] = record.text()
    if not words:
        assert all(identical(replayed(texts)))
        return
    with pytest.raises(records.RecordError, match=words):
        replayed(texts)


# Values.


@dataclass(frozen=True)
class Leaf:
    mode: Mode
    weights: np.ndarray
    note: object = None


class Plain:
    pass


FLOATS = st.floats() | st.sampled_from([-0.0, 5e-324, 1.7976931348623157e308, 0.1])
ARRAYS = st.lists(FLOATS, max_size=4).map(np.array) | st.lists(
    FLOATS, min_size=6, max_size=6).map(lambda values: np.array(values).reshape(2, 3)) | (
    st.lists(st.integers(-9, 9), max_size=3).map(lambda values: np.array(values, dtype=int))) | (
    st.just(np.zeros((0, 3))))
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | FLOATS | st.text(max_size=5) | ARRAYS
    | st.sampled_from(Mode) | FLOATS.map(np.float64),
    lambda inner: st.lists(inner, max_size=3).map(tuple) | st.dictionaries(
        st.text(max_size=3).filter(lambda key: key != '@'), inner, max_size=3) | st.builds(
        Leaf, st.sampled_from(Mode), ARRAYS, inner), max_leaves=12)


def exact(value: object) -> str:
    """Return a text that tells all values apart: of types, of bits, but not of several NaN."""
    with np.printoptions(floatmode='unique'):
        return re.sub(r'np\.float64\(([^)]*)\)', r'\1', repr(value))


@settings(max_examples=25, deadline=None)
@given(VALUES)
def test_values_survive_bit_identical(value: object) -> None:
    text = json.dumps(records.encoded(value), allow_nan=False)
    assert exact(records.decoded(json.loads(text))) == exact(value)


@pytest.mark.parametrize(('text', 'error'), [
    ({'@': 'os:system'}, ValueError), ({'@': 'subprocess:Popen', 'args': ['true']}, ValueError),
    ({'@': f'{__name__}:Plain'}, ValueError), ({'@': 'no_such_module:State'}, ValueError),
    ({'@': 'koopman_ros.control.state:State', 'other': 1}, TypeError),
    ({'@': f'{Mode.__module__}:Mode', 'name': 'ASLEEP'}, KeyError),
])
def test_only_known_data_is_made(text: dict, error: type[Exception]) -> None:
    with pytest.raises(error):
        records.decoded(text)


@pytest.mark.parametrize('value', [Plain(), {1, 2}, b'bytes', lambda: None])
def test_invalid_data_are_rejected(value: object) -> None:
    with pytest.raises(TypeError, match='cannot be written to a record'):
        records.encoded(value)
