# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retraining from bags, end to end within one process."""

from dataclasses import asdict, replace
import json
from pathlib import Path
import signal
import sys

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode
from koopman_ros.core.paths import model_path
from koopman_ros.learning import drift_estimation, pipeline, retrain, TrainingTask, write_report
from koopman_ros.learning.downsampling import coverage, visited_cells
from koopman_ros.learning.identification import Stopped
from koopman_ros.learning.identification.alternatives import TransformedDrift
from koopman_ros.learning.lift.metrics import lifted_rate
from koopman_ros.learning.pipeline_progress import PipelineProgress
from koopman_ros.model import load, ModelFileError, save
from koopman_ros.records import BagReadError
from support.known_plants import box
from support.quick_retraining import page_of, quick_retraining
from support.random_lifts import random_lift
from support.recorded_runs import (
    driven,
    INPUTS,
    linear_run,
    NOISE,
    reactor,
    STATES,
    write_bag,
)

SHIPPED = str(model_path('reactor_nz4'))


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp('bag') / 'run.mcap', driven(reactor(0.8), 20.0))


@pytest.fixture(scope='module', autouse=True)
def few_methods():
    """
    Estimate by a few methods alone, and try laws in a few loops.

    What they find is the matter of test_identify and test_law_check.
    """
    with quick_retraining(4, windows=(10, 20)):
        yield


def small(bag, output, present=SHIPPED, **others):
    return TrainingTask((str(bag),), str(output), str(present), STATES, INPUTS, coordinates=2,
                        starts=1, dead_time={'coolant_temperature': 0.0}, **{
                            'model_class': 'identity lift', **others})


@pytest.fixture(scope='module')
def accepted(bag, tmp_path_factory):
    """Return the result of a training that replaces a model, its progress, and its folder."""
    folder = tmp_path_factory.mktemp('accepted')
    (folder / 'new.safetensors').write_bytes(Path(SHIPPED).read_bytes())
    told = []
    retrained = retrain(small(bag, folder / 'new.safetensors'),
                        lambda share, text: told.append((share, text)) or False)
    return retrained, told, folder


@pytest.fixture
def estimated(accepted, monkeypatch):
    """Let a retraining go on from what the accepted one has estimated."""
    monkeypatch.setattr(
        drift_estimation, 'identify_measured', lambda *_, **__: (accepted[0].found, ()))


@pytest.fixture
def learned(accepted, estimated, monkeypatch):
    """Let it go on from what the accepted one has learned, too."""
    monkeypatch.setattr(pipeline, 'compare_classes', lambda *_, **__: accepted[0].learned)


def test_accepted_lift_is_written_and_the_one_before_is_kept(accepted):
    retrained, _, folder = accepted
    assert retrained.accepted
    assert retrained.model_file == str(folder / 'new.safetensors')
    # no temporary file is left
    assert sorted(path.name for path in folder.iterdir()) == [
        'new.previous.safetensors', 'new.safetensors']
    assert (folder / 'new.previous.safetensors').read_bytes() == Path(SHIPPED).read_bytes()
    model, found = load(folder / 'new.safetensors'), retrained.found
    origin = model.provenance
    assert (origin.plant, origin.seed) == (load(SHIPPED).provenance.plant, 0)
    assert origin.method == f'{found.method}, drift of degree {found.drift.degree}'
    assert origin.metrics['noise'] == float(found.noise[0]) == pytest.approx(NOISE, rel=0.1)
    assert origin.metrics['rollout_rmse'] == float(retrained.decision.rmse[0])
    assert {('temperature', 'coolant_temperature'): origin.metrics['coverage']} == (
        retrained.coverage)
    assert 0.2 < origin.metrics['coverage'] < 1.0
    assert origin.metrics['sample_interval'] == pytest.approx(1.0)
    # over the middle of the box, where twenty minutes tell enough
    x, u = np.linspace(310.0, 322.0, 25)[:, None], np.full((25, 1), 288.0)
    rate = model.states.scale * (model.drift(model.states.to_deviation(x))
                                 + model.inputs.to_deviation(u) @ model.B.T)
    # K/min, of rates up to 15
    assert np.max(np.abs(rate - reactor(0.8).derivative(x, u))) < 0.6


def test_progress_rises_to_the_end(accepted):
    shares, words = zip(*accepted[1], strict=True)
    assert list(shares) == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, pytest.approx(0.99))
    assert words[0] == 'reading bags'
    assert {'estimating: drift of degree 3', 'learning: identity lift, n_z 2, start 1 of 1',
            'judging: identity lift'} < set(words)
    assert words[-2:] == ('judging: further closed loops', 'writing')


def test_progress_does_not_fall_when_more_has_to_be_done():
    shares = []
    progress = PipelineProgress(lambda share, text: bool(shares.append(share)))
    for done, total in ((1, 4), (2, 4), (2, 12), (7, 12)):
        progress.estimating(done, total, 'drift')
    assert shares == sorted(shares)
    assert shares[1] == shares[2] < shares[3]


def test_rejected_lift_is_kept_aside_and_has_the_same_bits(bag, accepted, tmp_path):
    present = accepted[2] / 'new.safetensors'
    output = tmp_path / 'deep' / 'er' / 'new.safetensors'
    retrained = retrain(small(bag, output, present))
    assert not retrained.accepted
    assert 'is not 10 % below that of the current model' in retrained.reasons[0]
    # nothing replaces the output, and the same data and seed give the same numbers
    assert [path.name for path in output.parent.iterdir()] == ['new.rejected.safetensors']
    rejected = load(retrained.model_file)
    assert rejected.provenance.accepted is False
    assert rejected.provenance.reasons == retrained.reasons
    again = tmp_path / 'again.safetensors'
    accepted_one = load(present)
    assert accepted_one.rate_band is not None
    # a model that is worse than the current one runs no loops on other plants
    save(replace(rejected, rate_band=accepted_one.rate_band, provenance=replace(
        rejected.provenance, accepted=True, reasons=(),
        closed_loops=accepted_one.provenance.closed_loops)), again)
    assert again.read_bytes() == present.read_bytes()


def test_the_disturbance_of_each_episode_is_said_as_a_shift(accepted):
    retrained, *_ = accepted
    found = retrained.found
    states = found.drift.box.states
    offsets = np.outer([0.1, -0.1], found.drift.slope(states.center)[:, 0])
    assert 'of each episode' not in retrained.found_text
    shifted = replace(retrained, found=replace(found, offsets=offsets))
    assert f'{states.names[0]} by -0.1, +0.1 {states.units[0]}' in shifted.found_text


def test_report_without_matplotlib(accepted, monkeypatch):
    retrained, _, _ = accepted
    monkeypatch.setitem(sys.modules, 'matplotlib.figure', None)
    files = write_report(retrained)
    assert [path.name for path in files] == ['new.json', 'new.md']
    figures = json.loads(files[0].read_text())
    assert figures == retrained.summary()
    assert figures['accepted'] is True
    said = figures['closed_loop_statement']
    assert ' 0 of 8 loops ' in said
    assert 'simulated closed loops: ' + said in str(load(retrained.model_file))
    assert figures['measurements_used'] == figures['measurements_read'] == 1201
    # UA is 0.8 of 2.092 1/min
    gain = figures['input_gain']['temperature']['coolant_temperature']
    assert 60.0 * gain == pytest.approx(0.8 * 2.0921, rel=0.02)
    page = files[1].read_text()
    for words in ('is accepted.**', '1201 of 1201 values used', said,
                  '| operating point | eigenvalues |',
                  f'| the current model | {retrained.decision.current_rmse[0]:.5g} |'):
        assert words in page
    assert figures['free_runs']['record']['fit_percent']['temperature'] > 95.0
    diverging = replace(retrained, decision=replace(
        retrained.decision, current_rmse=np.array([np.inf])))
    assert diverging.summary()['heldout_error_of_current_model'] == {'temperature': None}


@pytest.mark.usefixtures('learned')
def test_models_of_alternative_drifts_are_kept_next_to_the_model(
        bag, accepted, tmp_path, monkeypatch):
    """That of a training before goes."""
    drift = accepted[0].found.drift
    found = replace(
        accepted[0].found, alternatives=(
            TransformedDrift(drift.box, drift, np.eye(1), np.zeros(1)),
            replace(drift, coefficients=1.02 * drift.coefficients),
            # more coordinates than a file may have
            replace(drift, degree=33, coefficients=np.pad(
                drift.coefficients, ((0, 34 - len(drift.coefficients)), (0, 0))))))
    monkeypatch.setattr(
        drift_estimation, 'identify_measured', lambda *_, **__: (found, ()))
    (tmp_path / 'new.alternative_7.safetensors').touch()
    told = []
    retrained = retrain(small(bag, tmp_path / 'new.safetensors'),
                        lambda share, text: told.append((share, text)) or False)
    assert told == sorted(told, key=lambda pair: pair[0])
    assert 'judging: further closed loops' in [text for _, text in told]
    names = ['new.alternative_1.safetensors', 'new.alternative_2.safetensors']
    assert [Path(file).name for file in retrained.alternative_files] == names
    assert names[0] in page_of(retrained)
    assert sorted(path.name for path in tmp_path.glob('*alternative*')) == names
    x, u = np.linspace(308.0, 320.0, 9)[:, None], np.full((9, 1), 290.0)
    for file, factor in zip(retrained.alternative_files, (1.0, 1.02), strict=True):
        rate = lifted_rate(load(file), 60.0)(x, u)
        own = replace(drift, coefficients=factor * drift.coefficients).rate(x, u)
        assert rate == pytest.approx(own, abs=1e-6)


@pytest.mark.usefixtures('learned')
def test_rejected_lift_that_diverges_is_kept_all_the_same(bag, tmp_path, monkeypatch):
    original = pipeline.evaluate_model
    monkeypatch.setattr(pipeline, 'evaluate_model', lambda *arguments, **named: replace(
        original(*arguments, **named), rmse=np.array([np.inf]), reasons=('it diverges',)))
    retrained = retrain(small(bag, tmp_path / 'new.safetensors'))
    assert 'rollout_rmse' not in load(retrained.model_file).provenance.metrics


def test_previous_model_is_copied_where_there_are_no_hard_links(tmp_path, monkeypatch):
    def reject(*_):
        raise PermissionError

    monkeypatch.setattr(pipeline.os, 'link', reject)
    output = tmp_path / 'a.safetensors'
    for content in (b'first', b'second'):
        output.write_bytes(content)
        assert pipeline._place(output, True) == output
        assert (tmp_path / 'a.previous.safetensors').read_bytes() == content
        assert output.read_bytes() == content


def test_a_linear_plant_of_known_gain_needs_no_lift(tmp_path):
    """The gain is given in 1/s whatever the time unit of the present lift, here seconds."""
    bag = write_bag(tmp_path / 'linear.mcap', linear_run(200))
    present, seconds = load(SHIPPED), tmp_path / 'seconds.safetensors'
    save(replace(present, A=present.A / 60.0, B=present.B / 60.0, time_unit='s'), seconds)
    gain = {'temperature': {'coolant_temperature': 1.0 / 60.0}}
    retrained = retrain(small(bag, tmp_path / 'new.safetensors', seconds, input_gain=gain))
    assert 'does not predict the motion better than a linear model' in retrained.reasons[0]
    assert (retrained.learned, retrained.decision, retrained.model_file) == (None, None, '')
    assert list(tmp_path.glob('*.safetensors')) == [seconds]
    # dT/dt = -(T - 315) / 2 + (Tc - 288), in minutes
    assert retrained.found.drift.degree == 1
    assert retrained.found.drift.input_matrix == pytest.approx(np.array([[1.0 / 60.0]]), rel=1e-12)
    assert retrained.summary()['input_gain']['temperature'] == {
        'coolant_temperature': pytest.approx(1.0 / 60.0, rel=1e-12)}
    assert 'is rejected.**' in page_of(retrained)


@pytest.mark.parametrize(('stage', 'done_before'), [
    ('reading bags', 'bag'), ('estimating: drift of degree 3', 'bag'),
    ('learning: identity lift, n_z 2', 'estimated'), ('judging: id', 'estimated')])
def test_stops_at_any_stage_and_writes_nothing(bag, tmp_path, request, stage, done_before):
    request.getfixturevalue(done_before)
    with pytest.raises(Stopped):
        retrain(small(bag, tmp_path / 'new.safetensors'), lambda _, text: text.startswith(stage))
    assert list(tmp_path.iterdir()) == []


def files_in(folder):
    return sorted(path.name for path in folder.iterdir())


KEPT = ['new.unfinished.json', 'new.unfinished.md', 'new.unfinished.safetensors']


@pytest.mark.parametrize('key', [False, True], ids=['by the watch', 'by Ctrl-C'])
@pytest.mark.parametrize(('stage', 'tried', 'untried'), [
    ('judging: polynomial', ['linear'],
     ('polynomial', 'neural drift', 'identity lift', 'free lift')),
    ('learning: neural drift', ['linear', 'polynomial'],
     ('neural drift', 'identity lift', 'free lift'))])
def test_an_interrupted_training_keeps_the_best_class_so_far(
        bag, tmp_path, estimated, key, stage, tried, untried):
    def stop(_, text):
        if key and text.startswith(stage):
            signal.raise_signal(signal.SIGINT)
        return text.startswith(stage)

    task = small(bag, tmp_path / 'new.safetensors', model_class='best')
    if key:
        with pytest.raises(KeyboardInterrupt) as interrupt:
            retrain(task, stop)
        result = interrupt.value.result
        assert f'classes not tried: {untried[0]}' in str(interrupt.value)
    else:
        result = retrain(task, stop)
    assert [one.name for one in result.learned.contenders] == tried
    assert result.learned.untried == untried
    assert (result.verdict, result.accepted, result.model_class) == (
        'unfinished', False, tried[-1])
    assert files_in(tmp_path) == KEPT
    assert result.model_file == str(tmp_path / KEPT[-1])
    kept = load(result.model_file)
    assert kept.provenance.accepted is False
    assert kept.provenance.reasons == result.reasons
    assert kept.provenance.model_class == tried[-1]
    assert len(kept.dead_time) == 1
    page, figures = ((tmp_path / name).read_text() for name in KEPT[1::-1])
    assert f'classes not tried: {", ".join(untried)}' in page
    assert json.loads(figures)['accepted'] is None
    assert list(json.loads(figures)['classes']) == tried


def test_what_is_kept_goes_when_the_training_ends(bag, tmp_path, learned, accepted, monkeypatch):
    def compare_classes(*_, on_class, **__):
        on_class(accepted[0].learned)
        return accepted[0].learned

    monkeypatch.setattr(pipeline, 'compare_classes', compare_classes)
    task, seen = small(bag, tmp_path / 'new.safetensors'), []
    assert retrain(task, lambda *_: bool(seen.append(files_in(tmp_path)))).accepted
    assert KEPT in seen
    assert files_in(tmp_path) == ['new.safetensors']
    # also one that was judged, but not written
    unfinished = retrain(task, lambda _, text: text == 'writing')
    assert unfinished.verdict == 'unfinished'
    assert 'before the acceptance test' in unfinished.reasons[0]
    assert 'not tried' not in unfinished.reasons[0]


def test_without_an_output_an_interrupt_writes_nothing(bag, tmp_path, learned, accepted,
                                                       monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pipeline, 'compare_classes', lambda *_, on_class, **__: (
        on_class(accepted[0].learned), accepted[0].learned)[1])
    result = retrain(small(bag, ''), lambda _, text: text == 'writing')
    assert (result.verdict, result.model_file) == ('unfinished', '')
    assert files_in(tmp_path) == []


def test_ctrl_c_before_the_first_class_ends_a_training_with_nothing(bag, tmp_path, estimated):
    def press(_, text):
        if text.startswith('judging: linear'):
            signal.raise_signal(signal.SIGINT)
        return False

    with pytest.raises(KeyboardInterrupt) as interrupt:
        retrain(small(bag, tmp_path / 'new.safetensors', model_class='best'), press)
    assert interrupt.value.result is None
    assert files_in(tmp_path) == []


def test_a_task_survives_json():
    task = TrainingTask(('a', 'b'), 'new.safetensors', 'x.safetensors', STATES,
                        (*INPUTS, replace(INPUTS[0], name='other', measured=None, delay=2.5),
                         replace(INPUTS[0], name='feed', command=None)), disturbances=('feed',),
                        seed=3, input_gain={'temperature': {'other': 2.1}})
    assert TrainingTask.of(json.loads(json.dumps(asdict(task)))) == task
    with pytest.raises(TypeError, match='nonsense'):
        TrainingTask.of({**asdict(task), 'nonsense': 1})
    with pytest.raises(TypeError, match='nonsense'):
        TrainingTask.of({**asdict(task), 'states': [{**asdict(STATES[0]), 'nonsense': 1}]})


@pytest.mark.parametrize(('values', 'error', 'words'), [
    ({'model': '/nowhere/x.safetensors'}, ModelFileError, 'no model file at /nowhere/x.safetens'),
    ({'model': '/dev/zero'}, ModelFileError, '/dev/zero: it is not a regular file'),
    ({'model': 'two.safetensors'}, ValueError, r'the task has temperature \[K\]: give the same'),
    ({'inputs': (replace(INPUTS[0], unit='degC'),)}, ValueError, 'the task has '
                                                                 'coolant_temperature'),
    ({'states': STATES * 2}, ValueError, r'has temperature \[K\], temperature \[K\]: give'),
    ({'states': ()}, ValueError, 'the task has none'),
    ({'input_gain': {'temperature': {'valve': 1.0}}}, ValueError,
     'input_gain names valve acting on temperature'),
    ({'input_gain': {'temperature': {'coolant_temperature': float('nan')}}}, ValueError,
     'is nan, must be finite'),
    ({'output': 'new.bin'}, ValueError, "output = 'new.bin' must end in .safetensors"),
    ({'output': 'file/new.safetensors'}, OSError, 'file'),
    ({'bags': ('/nowhere/run.mcap',)}, BagReadError, '/nowhere/run.mcap'),
    ({'bags': ('short.mcap',)}, ValueError, 'no usable segment of measurements: 0 of 9 '
     'values used; 9 dropped: in a segment'),
    ({'states': (replace(STATES[0], place=replace(STATES[0].place, topic='/other')),)},
     BagReadError, "has no topic '/other'"),
    ({'margin': 2.0}, ValueError, 'margin = 2.0'),
    ({'disturbances': ('feed',)}, ValueError, 'the disturbances have feed, must be some of'),
    ({'disturbances': ('coolant_temperature',), 'input_matrix_degree': 1}, ValueError,
     'must not depend on the state: give a constant B'),
    ({'model': '', 'input_gain': {'temperature': {'steam': 1.0}}}, ValueError,
     'names steam acting on temperature: the lift has the st'),
])
def test_a_mismatch_is_an_immediate_error(bag, tmp_path, monkeypatch, values, error, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'file').touch()
    save(random_lift(), tmp_path / 'two.safetensors')
    write_bag(tmp_path / 'short.mcap', linear_run(9))
    with pytest.raises(error, match=words):
        retrain(replace(TrainingTask((str(bag),), 'new.safetensors', SHIPPED, STATES, INPUTS),
                        **values))


BOX = box([0.0], [10.0], [100.0], [200.0])


@pytest.mark.parametrize(('x', 'u', 'cells'), [
    ([0.0, 0.2, 0.5, 5.0, 9.9, 10.0], [100.0, 101.0, 105.0, 150.0, 199.0, 200.0],
     [[0, 0], [5, 5], [9, 9]]),
    # outside counts for the border
    ([-3.0, 40.0], [90.0, 150.0], [[0, 0], [9, 5]])])
@pytest.mark.parametrize('nominal', [5.0, 2.0])
def test_visited_cells_and_their_share_of_all(x, u, cells, nominal):
    times = np.arange(float(len(x)))
    episodes = [Episode(times, np.array(x)[:, None], times, np.array(u)[:, None])]
    within = replace(BOX, states=replace(BOX.states, center=np.array([nominal])))
    assert visited_cells(episodes, within).tolist() == cells
    assert coverage(episodes, within) == {('x1', 'u1'): pytest.approx(len(cells) / 100.0)}


def test_cells_of_two_states_under_an_input_that_is_held():
    episodes = [Episode(np.arange(2.0), np.array([[0.05, 0.95], [0.55, 0.45]]),
                        np.array([-1.0, 0.5]), np.array([[0.35], [0.95]]))]
    within = box([0.0, 0.0], [1.0, 1.0], [0.0], [1.0])
    assert visited_cells(episodes, within).tolist() == [[0, 9, 3], [5, 4, 9]]
    # no two of these cells share a pair of states, or of a state and the input
    assert coverage(episodes, within) == dict.fromkeys(
        [('x1', 'x2'), ('x1', 'u1'), ('x2', 'u1')], 0.02)


def test_first_lift_is_learned_without_a_present_one(bag, tmp_path):
    """Its nominal point is found in the data; B is known here, in 1/s."""
    rate = float(reactor(0.8).B[0, 0]) / 60.0
    retrained = retrain(small(
        bag, tmp_path / 'first.safetensors', '', plant='jacket', model_class='polynomial',
        input_gain={'temperature': {'coolant_temperature': rate}}))
    assert retrained.reasons == ()
    assert retrained.present is None
    model = load(retrained.model_file)
    assert (model.provenance.plant, model.time_unit) == ('jacket', 's')
    assert [(box.names, box.units) for box in (model.states, model.inputs)] == [
        ((signal.name,), (signal.unit,)) for signal in (*STATES, *INPUTS)]
    # in the middle of the data, and held there by its nominal input, but for 0.01 K/s
    middle = 0.5 * (model.states.lower + model.states.upper)
    np.testing.assert_allclose(model.states.center, middle, atol=0.1 * model.states.scale[0])
    drift = reactor(0.8).derivative(model.states.center, model.inputs.center) / 60.0
    assert abs(drift[0]) < 0.01
    # compared with a linear model alone, in figures and on the page
    figures = retrained.summary()
    assert figures['heldout_error_of_current_model'] is None
    assert figures['heldout_error']['temperature'] < 0.9 * figures[
        'heldout_error_of_linear_model']['temperature']
    assert 'current model' not in page_of(retrained)
