# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Records of any sequence of events give the same commands again, from any snapshot on."""

from dataclasses import replace
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from koopman_ros.control import Mode
from koopman_ros.control.events import (
    Initialisation,
    ManualCommand,
    ModeChange,
    SetpointRequest,
    Silence,
)
from koopman_ros.lifting import load_with_digest, save
from koopman_ros.nodes.replay import replay_records
from koopman_ros.replay.loop import Alternative, Lost, Replay
from koopman_ros.replay.records import parse, RecordError, SNAPSHOT, START
from koopman_ros.replay.sources import Models
from koopman_ros.resources import config_directory
from support.recorded_runs import COOLANT, MODELS, Recorded, SECOND, STEADY


def replayed(texts: list[str], alternative: Alternative | None = None) -> Replay:
    return replay_records(map(parse, texts), (), alternative)


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
    st.tuples(st.just('measure'), NEAR, st.sampled_from([0.0, -0.5, -30.0, 90.0]), st.none()),
    st.tuples(st.just('silence'), st.floats(0.5, 120.0)),
    st.tuples(st.just('setpoint'), st.floats(STEADY - 12.0, STEADY + 4.0),
              st.sampled_from([0.0, 0.0, 3.5, 1e6])),
    st.tuples(st.just('manual'), st.floats(COOLANT - 30.0, COOLANT + 30.0) | st.just(np.inf)),
    st.tuples(st.just('mode'), st.sampled_from(Mode)),
    st.tuples(st.just('applied'), st.floats(COOLANT - 30.0, COOLANT + 30.0)),
    st.tuples(st.just('exchange'), st.sampled_from([
        {'model': 'reactor_nz3'}, {'model': 'reactor_nz4'}, {'coolant_weight': 0.3},
        {'model': 'reactor_linear', 'observer_bandwidth': 0.0}, {'observer_bandwidth': 6.0},
        {'setpoint_filter': 20.0, 'setpoint_ramp': 6.0}, {'coolant_rate_limit': 12.0}])),
    st.tuples(st.just('snapshot')))


def happen(controller: Recorded, event: tuple) -> None:
    match event:
        case ('measure', kelvin, after, applied):
            controller.measure(kelvin, after, applied)
        case ('silence', seconds):
            controller.do(Silence(controller.now + round(seconds * SECOND)))
        case ('setpoint', kelvin, ahead):
            stamp_ns = controller.now + round(ahead * SECOND) if ahead else 0
            controller.do(SetpointRequest(stamp_ns, np.array([kelvin])))
        case ('manual', kelvin):
            controller.do(ManualCommand(np.array([kelvin])))
        case ('mode', mode):
            controller.do(ModeChange(mode))
        case ('applied', kelvin):
            controller.do(Initialisation(np.array([kelvin])))
        case ('exchange', parameters):
            controller.exchange(**parameters)
        case ('snapshot',):
            controller.snapshot()


@settings(deadline=None, max_examples=50)
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
    snapshots = [k for k, text in enumerate(late) if parse(text).event in (START, SNAPSHOT)]
    before = sum('command' in parse(text).fields for text in late[:min(snapshots, default=None)])
    found = replayed(late)
    assert [sample.replayed is None for sample in found.samples] == [
        k < before for k in range(len(found.samples))]
    assert all(identical(found)[before:])


def day(**options: object) -> Recorded:
    """Return a controller with a day of ordinary work behind it."""
    controller = Recorded(**options)
    for k in range(60):
        if k % 20 == 10:
            controller.do(SetpointRequest(0, np.array([STEADY - 0.1 * k])))
            controller.snapshot()
        controller.measure(STEADY - 0.05 * k)
    return controller


def test_lost_records_are_named_and_the_next_snapshot_goes_on() -> None:
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
    controller = Recorded(setpoint_ramp=6.0)
    for k in range(40):
        if k == 10:
            controller.do(SetpointRequest(0, np.array([STEADY - 6.0])))
        if k == 20:
            controller.exchange(coolant_weight=0.5)
        if k in (25, 30):
            controller.do(ModeChange(Mode.MANUAL if k == 25 else Mode.AUTOMATIC))
        controller.measure(STEADY - 0.1 * k)
    model, digest = MODELS['reactor_nz4']
    for texts in (controller.texts, day().texts[12:]):
        found = replayed(texts, Alternative(model, digest))
        assert parse(texts[0]).event in (START, SNAPSHOT)
        assert all(identical(found, 'alternative'))
    found = replayed(controller.texts, Alternative(model, digest, {'coolant_weight': 0.1}))
    assert not all(identical(found, 'alternative'))
    assert all(identical(found))


def test_model_that_refuses_the_set_point_goes_by_what_was_tracked() -> None:
    texts = day().texts
    found = replayed(texts, Alternative(*MODELS['reactor_linear']))
    assert all(sample.alternative is not None for sample in found.samples)
    assert not all(identical(found, 'alternative'))


def test_own_model_is_found_where_it_lies_now(tmp_path: Path) -> None:
    path = tmp_path / 'own.safetensors'
    own = MODELS['reactor_nz4'][0]
    save(replace(own, provenance=replace(own.provenance, plant='another')), path)
    model, digest = load_with_digest(path)
    name = str(tmp_path / 'gone' / 'own.safetensors')
    moved = Models([tmp_path]).find(name, digest)
    assert moved.provenance == model.provenance
    assert Models([path]).find(name, digest).provenance == model.provenance
    with pytest.raises(RecordError, match=r'own.safetensors \(SHA-256 .* neither shipped nor'):
        Models([config_directory() / 'models']).find(name, digest)


@pytest.mark.parametrize(('text', 'words'), [
    ('', 'is no record of a controller'), ('[]', 'is no record of a controller'),
    ('{}', 'is no record of a controller'), ('{"version":2}', 'are of version 2, this package'),
    ('{"version":1,"run":"a","number":"x","event":"start"}', 'is no record'),
    ('[' * 100_000, 'is no record'),
])
def test_text_that_is_no_record(text: str, words: str) -> None:
    with pytest.raises(RecordError, match=words):
        parse(text)


@pytest.mark.parametrize(('change', 'words'), [
    (lambda fields: fields.pop('state'), 'record 0 of run a cannot be replayed'),
    (lambda fields: fields['state'].pop('mode'), None),
    (lambda fields: fields['state'].update({'@': 'os:system'}), "class 'os:system' is not known"),
    (lambda fields: fields['state'].update(extra=1), 'unexpected keyword'),
    (lambda fields: fields['state'].update(command={'@': 'array', 'dtype': '<f8', 'shape': [3],
                                                    'values': [1.0, 2.0, 3.0]}), 'record 1'),
    (lambda fields: fields['model'].update(digest='0' * 64), 'neither shipped nor found'),
    (lambda fields: fields['parameters'].update(coolant_weight=-1.0), 'refuses .coolant_weight'),
    (lambda fields: fields['parameters'].update(other=1.0), 'parameters other, which this'),
])
def test_snapshot_that_does_not_fit(change: object, words: str | None) -> None:
    controller = Recorded()
    controller.measure(STEADY)
    record = parse(controller.texts[0])
    change(record.fields)
    if words is None:
        # what has a default may be missing, as in a later version
        assert all(identical(replayed([record.text(), *controller.texts[1:]])))
        return
    with pytest.raises(RecordError, match=words):
        replayed([record.text(), *controller.texts[1:]])


@pytest.mark.parametrize(('change', 'words'), [
    ({'event': 'unheard'}, "the event 'unheard' is not known"),
    ({'fields': {'stamp_ns': 1, 'measured': {}, 'applied': None}}, 'is no list of numbers'),
    ({'fields': {'stamp_ns': 1, 'measured': [], 'applied': None}}, 'record 1 of run a cannot'),
    ({'fields': {}}, 'record 1 of run a cannot be replayed'),
    ({'number': 0}, 'record 0 of run a comes again, or after record 0'),
])
def test_event_that_does_not_fit(change: dict, words: str) -> None:
    controller = Recorded()
    controller.measure(STEADY)
    record = replace(parse(controller.texts[1]), **change)
    with pytest.raises(RecordError, match=words):
        replayed([controller.texts[0], record.text()])
