# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The public names: from a record to a closed loop, and what wrong calls say."""

import doctest
import importlib
import inspect
from pathlib import Path
import subprocess
import sys
import traceback

import numpy as np
import pandas as pd
import pytest

import koopman_ros
from koopman_ros import (
    at,
    build,
    Controller,
    InputLimits,
    learn,
    load,
    Process,
    read,
    run_loop,
    save,
    SetpointRequest,
    simulate,
    State,
    Tuning,
)
from koopman_ros.core.paths import model_path
from support.quick_retraining import quick_retraining

PERIOD, ROWS, LATE = 0.5, 400, 6


def table(seed=0):
    """Return a run of a tank that empties linearly, with a little noise and a late pump."""
    decay, rng = np.exp(-0.2 * PERIOD), np.random.default_rng(seed)
    pump, level = np.repeat(rng.uniform(0.0, 10.0, ROWS // 10), 10), [2.0]
    for value in np.concatenate([np.full(LATE, pump[0]), pump])[:ROWS - 1]:
        level.append(decay * level[-1] + (1.0 - decay) * 0.5 * value)
    return pd.DataFrame({'time [s]': PERIOD * np.arange(ROWS), 'pump [V]': pump,
                         'level [m]': level + 1e-3 * rng.standard_normal(ROWS)})


RECORD = read(table(), ['level'], ['pump'])


@pytest.fixture(scope='module')
def result():
    with quick_retraining(4, degrees=(1, 2)):
        return learn(RECORD, model_class='linear')


@pytest.fixture(scope='module')
def tanks():
    return load(model_path('two_tanks'))


def controller(model, **given):
    limits = InputLimits(lower=0.0, upper=12.0, rate=2.0)
    return Controller(model, Tuning.for_model(model, **{'limits': limits, **given}))


def test_the_package_is_imported_at_once():
    code = ('import koopman_ros, sys; '
            'print([one for one in ("torch", "rclpy", "scipy", "numpy") if one in sys.modules])')
    found = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                           check=True)
    assert found.stdout.strip() == '[]'


@pytest.mark.parametrize('name', koopman_ros.__all__)
def test_a_public_name_says_what_it_is(name):
    text = inspect.getdoc(getattr(koopman_ros, name))
    assert text, name
    assert f'`{name}`' in koopman_ros.__doc__
    assert name in dir(koopman_ros)


@pytest.fixture
def examples(tanks, result, tmp_path, monkeypatch):
    """Return the names of the examples, in a folder with a table and a model."""
    monkeypatch.chdir(tmp_path)
    table().to_csv('log.csv', index=False)
    save(tanks, 'two_tanks.safetensors')
    plant = build('two_tanks')
    names = {name: getattr(koopman_ros, name) for name in koopman_ros.__all__}
    return {**names, 'model': tanks, 'controller': controller(tanks), 'result': result,
            'plant': Process(plant, 0, plant.nominal_state, plant.nominal_input)}


@pytest.mark.parametrize('name', [
    name for name in koopman_ros.__all__ if name not in ('FreeRun', 'simulate')])
def test_the_example_of_a_public_name_runs(name, examples):
    runner, said = doctest.DocTestRunner(verbose=False), []
    example = doctest.DocTestParser().get_doctest(
        inspect.getdoc(getattr(koopman_ros, name)), examples, name, None, 0)
    assert example.examples, f'{name} has no example'
    with quick_retraining(4, degrees=(1, 2)):
        assert runner.run(example, out=said.append).failed == 0, ''.join(said)


def test_another_name_is_none():
    with pytest.raises(AttributeError, match="no attribute 'lern'"):
        _ = koopman_ros.lern
    assert importlib.import_module('koopman_ros.learning').learn is learn


def test_a_record_becomes_a_model_with_its_dead_time(result, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert result.accepted
    assert not result.reasons
    printed = str(result)
    assert 'no unmeasured state, dead time 3 s of pump: accepted' in printed
    assert 'free run of 394 measurements' in printed
    result.save('tank.safetensors')
    model = load('tank.safetensors')
    assert model.dead_time == pytest.approx([LATE * PERIOD])
    assert model.eigenvalues.real == pytest.approx([-0.2], rel=0.02)
    assert simulate(model, RECORD).fit == pytest.approx([99.9], abs=0.2)
    # no other file is written
    assert [path.name for path in tmp_path.iterdir()] == ['tank.safetensors']


def test_what_is_known_is_taken(result):
    with quick_retraining(4, degrees=(1, 2)):
        found = learn(RECORD, model_class='linear', dead_time={'pump': 2.5}, unmeasured_states=0)
    assert found.model.dead_time == [2.5]


def test_a_record_that_tells_nothing_is_rejected_with_reasons():
    noise = np.random.default_rng(3).standard_normal(ROWS)
    record = read(table().assign(**{'level [m]': noise}), ['level'], ['pump'])
    with quick_retraining(4, degrees=(1, 2)):
        found = learn(record, model_class='linear', unmeasured_states=0)
    assert not found.accepted
    assert 'the inputs explain nothing of the record' in '; '.join(found.reasons)
    assert ': rejected\nreason: ' in str(found)


def test_a_loop_is_run_and_drawn(tanks, tmp_path):
    plant = build('two_tanks')
    run = run_loop(
        controller(tanks), Process(plant, 0, plant.nominal_state, plant.nominal_input),
        [at(20.0, SetpointRequest(0, [0.1, 0.15]))], duration=200.0, period=5.0)
    assert run.states[-1] == pytest.approx([0.1, 0.15], abs=1e-3)
    run.draw(tmp_path / 'loop.png')
    assert (tmp_path / 'loop.png').read_bytes().startswith(b'\x89PNG')


X = np.array([0.1, 0.15])
WRONG = {
    'no record': (lambda m: learn(table()), TypeError, 'record must be of the class Record'),
    'test that is none': (lambda m: learn(RECORD, test=table()), TypeError, 'test must be of'),
    'misspelt setting': (lambda m: learn(RECORD, unmesured=1), TypeError, 'unmeasured_states'),
    'unknown class': (lambda m: learn(RECORD, model_class='cubic'), ValueError, 'polynomial'),
    'unknown input': (lambda m: learn(RECORD, dead_time={'pmp': 1.0}), ValueError, 'pump'),
    'negative time': (lambda m: learn(RECORD, dead_time={'pump': -3.0}), ValueError, '0 s'),
    'unknown disturbance': (lambda m: learn(RECORD, disturbances=['rain']), ValueError, 'rain'),
    'unknown column': (lambda m: read(table(), ['height'], ['pump']), ValueError, 'level [m]'),
    'inputs as states': (lambda m: read(table(), ['level'], ['level']), ValueError, 'level'),
    'unit of another kind': (lambda m: read(table(), ['level [K]'], ['pump']), ValueError, 'K'),
    'no model': (lambda m: Controller(None, Tuning()), TypeError, 'class LiftedModel'),
    'swapped arguments': (lambda m: Controller(Tuning.for_model(m), m), TypeError, 'model must'),
    'too few limits': (lambda m: controller(m, limits=InputLimits(
        lower=[0.0] * 3, upper=[12.0] * 3)), ValueError, 'pump_1, pump_2'),
    'crossed limits': (lambda m: InputLimits(lower=12.0, upper=0.0), ValueError,
                       'lower = 12.0 must be below upper = 0.0'),
    'equal limits': (lambda m: controller(m, limits=InputLimits(lower=[0.0, 3.0], upper=3.0)),
                     ValueError, 'pump_2'),
    'negative weight': (lambda m: controller(m, state_weight=-1.0), ValueError, 'state_weight'),
    'text': (lambda m: controller(m, state_weight='large'), ValueError, 'state_weight'),
    'NaN': (lambda m: controller(m, state_weight=[np.nan, 1.0]), ValueError, 'state_weight'),
    'misspelt field': (lambda m: controller(m, state_wait=1.0), TypeError, 'state_wait'),
    'one measurement': (lambda m: controller(m).step(State(), [0.1], 1), ValueError, 'level_1'),
    'transposed': (lambda m: controller(m).step(State(), X[:, None], 1), ValueError, 'level_1'),
    'time in s': (lambda m: controller(m).step(State(), X, 1.5), TypeError, 'nanoseconds'),
    'unknown plant': (lambda m: build('three_tanks'), ValueError, 'two_tanks'),
    'no duration': (lambda m: run_loop(controller(m), Process(build('two_tanks'), 0, X, X),
                                       duration=-1.0), ValueError, 'duration'),
    'set-point outside': (lambda m: run_loop(
        controller(m), Process(build('two_tanks'), 0, X, X),
        [at(0.0, SetpointRequest(0, [9.0, 0.15]))], duration=5.0), ValueError, 'level_1'),
    'no file': (lambda m: load('none.safetensors'), (OSError, ValueError), 'none.safetensors'),
    'other signals': (lambda m: simulate(m, RECORD), ValueError, 'level_1'),
    # tables
    'transposed table': (lambda m: read(table().T, ['level'], ['pump']), ValueError, 'level'),
    'one column': (lambda m: read(table()['level [m]'], ['level'], ['pump']),
                   (TypeError, ValueError), ''),
    'array': (lambda m: read(table().to_numpy(), ['level'], ['pump']), (TypeError, ValueError),
              ''),
    'numbers of columns': (lambda m: read(table(), [0], [1]), TypeError, 'states'),
    'swapped table': (lambda m: read(['level'], table(), ['pump']), TypeError, 'states'),
    'empty table': (lambda m: read(table()[:0], ['level'], ['pump']), ValueError, ''),
    'one row': (lambda m: read(table()[:1], ['level'], ['pump']), ValueError, ''),
    'shuffled rows': (lambda m: read(table().sample(frac=1.0, random_state=1), ['level'],
                                     ['pump']), ValueError, ''),
    'missing values': (lambda m: read(table().assign(**{'level [m]': np.nan}), ['level'],
                                      ['pump']), ValueError, 'level'),
    'words for numbers': (lambda m: read(table().assign(**{'level [m]': 'high'}), ['level'],
                                         ['pump']), ValueError, 'high'),
    'columns of two lengths': (lambda m: read({'time': [0, 1, 2], 'level': [1, 2],
                                               'pump': [1, 2, 3]}, 'level', 'pump'),
                               ValueError, 'level'),
    'no table': (lambda m: read('none.csv', ['level'], ['pump']), OSError, 'none.csv'),
    'unknown time': (lambda m: read(table(), ['level'], ['pump'], time='clock'), ValueError,
                     'clock'),
    'period below 0': (lambda m: read(table(), ['level'], ['pump'], period=-1.0), ValueError,
                       'period'),
    'name of a tag': (lambda m: read(table(), ['LI-101'], ['pump']), ValueError,
                      "'level = LI-101'"),
    # training
    'count as text': (lambda m: learn(RECORD, unmeasured_states='one'), TypeError,
                      'unmeasured_states'),
    'half a state': (lambda m: learn(RECORD, unmeasured_states=1.5), TypeError, '1.5'),
    'states below -1': (lambda m: learn(RECORD, unmeasured_states=-2), ValueError, '-2'),
    'time for all inputs': (lambda m: learn(RECORD, dead_time=3.0), TypeError, "{'pump': 3.0}"),
    'lag for all inputs': (lambda m: learn(RECORD, lag=3.0), TypeError, 'lag'),
    'seed as text': (lambda m: learn(RECORD, seed='a'), TypeError, 'seed'),
    'no function': (lambda m: learn(RECORD, on_progress=3), TypeError, 'on_progress'),
    # settings
    'pair for limits': (lambda m: controller(m, limits=(0.0, 12.0)), TypeError, 'InputLimits'),
    'names of YAML': (lambda m: InputLimits(min=0.0), TypeError, 'min'),
    'limits by name': (lambda m: InputLimits(lower={'pump_1': 0.0}), ValueError, 'lower'),
    'matrix of weights': (lambda m: controller(m, state_weight=np.eye(2)), ValueError,
                          'state_weight'),
    'time by name': (lambda m: controller(m, dead_time={'pump_1': 1.0}), ValueError, 'dead_time'),
    'unknown law': (lambda m: controller(m, fallback_order=('sdr',)), ValueError, 'sdr'),
    'law as text': (lambda m: controller(m, fallback_order='sdre'), TypeError, 'fallback_order'),
    'unknown estimator': (lambda m: controller(m, estimator='kalman'), ValueError, 'kalman'),
    'unknown signal': (lambda m: controller(m, controlled=('level_3',)), ValueError, 'level_3'),
    'time as text': (lambda m: controller(m, hold_timeout='60'), TypeError, 'hold_timeout'),
    'switch as text': (lambda m: controller(m, safe_latch='yes'), TypeError, 'safe_latch'),
    'tuning of no model': (lambda m: Tuning.for_model('two_tanks'), TypeError, 'LiftedModel'),
    # steps
    'no state': (lambda m: controller(m).step(None, X, 1), TypeError, 'state'),
    'swapped state': (lambda m: controller(m).step(X, State(), 1), TypeError, 'state'),
    'measurement by name': (lambda m: controller(m).step(State(), {'level_1': 0.1}, 1),
                            ValueError, 'measurement'),
    'measured text': (lambda m: controller(m).step(State(), ['a', 'b'], 1), ValueError, "'a'"),
    'complex numbers': (lambda m: controller(m).step(State(), [1j, 0.1], 1), ValueError, 'real'),
    'swapped request': (lambda m: controller(m).request_setpoint(X, State()), TypeError, 'state'),
    'one set-point': (lambda m: controller(m).request_setpoint(State(), 0.1), ValueError,
                      'level_1'),
    # loops
    'plant by name': (lambda m: Process('two_tanks', 0, X, X), TypeError, 'ControlAffineSystem'),
    'one state': (lambda m: Process(build('two_tanks'), 0, [0.1], X), ValueError, 'level_1'),
    'start in s': (lambda m: Process(build('two_tanks'), 0.5, X, X), TypeError, 'nanoseconds'),
    'swapped loop': (lambda m: run_loop(Process(build('two_tanks'), 0, X, X), controller(m),
                                        duration=1.0), TypeError, 'controller'),
    'system as plant': (lambda m: run_loop(controller(m), build('two_tanks'), duration=1.0),
                        TypeError, 'plant'),
    'another plant': (lambda m: run_loop(controller(m), Process(
        build('pendulum'), 0, [0.0, 0.0], [0.0]), duration=1.0), ValueError, '1 inputs'),
    'event without time': (lambda m: run_loop(controller(m), Process(
        build('two_tanks'), 0, X, X), [SetpointRequest(0, X)], duration=1.0), TypeError, 'at'),
    'swapped event': (lambda m: at(SetpointRequest(0, X), 20.0), TypeError, 's'),
    'event of numbers': (lambda m: at(20.0, X), TypeError, 'SetpointRequest'),
    'duration as text': (lambda m: run_loop(controller(m), Process(
        build('two_tanks'), 0, X, X), duration='10 s'), TypeError, 'duration'),
}


@pytest.mark.parametrize('call', WRONG.values(), ids=WRONG)
def test_a_wrong_call_is_a_sentence(tanks, call):
    attempt, kind, words = call
    with pytest.raises(kind) as raised:
        attempt(tanks)
    assert words in str(raised.value)
    # raised by this package, or by Python for the call itself
    *_, last = traceback.extract_tb(raised.value.__traceback__)
    assert isinstance(raised.value, OSError) or Path(last.filename) == Path(__file__) or Path(
        koopman_ros.__file__).parent in Path(last.filename).parents, last.filename


@pytest.mark.parametrize('given', [
    {'state_weight': [1, 2]}, {'state_weight': pd.Series([1.0, 2.0])}, {'state_weight': 3},
    {'limits': InputLimits(lower=[0, 0], upper=pd.Series([12, 12]), rate=[2, 2])}])
def test_numbers_of_any_kind_work(tanks, given):
    state, command, _ = controller(tanks, **given).step(State(), pd.Series(X), 1_000_000_000)
    assert np.all(np.isfinite(command))
    assert controller(tanks, **given).step(state, list(X), 2_000_000_000)[1] is not None


def test_lists_integers_and_gaps_work(tanks):
    loop = controller(tanks, fallback_order=['sdre', 'linear'], controlled=['level_1', 'level_2'])
    run = run_loop(loop, Process(build('two_tanks'), np.int64(0), [0.1, 0.15], [6, 6]),
                   at(5, SetpointRequest(0, [0.1, 0.15])), duration=20, period=5)
    assert run.setpoints[-1] == pytest.approx([0.1, 0.15])
    for gap in (np.nan, None):
        assert np.all(np.isfinite(loop.step(State(), [gap, 0.1], np.int64(1))[1]))


def test_a_reason_prints_its_sentence(tanks):
    _, refused = controller(tanks).request_setpoint(State(), [9.0, 0.15])
    assert 'level_1' in str(refused)
    assert 'StatusCode' not in f'{refused}'
