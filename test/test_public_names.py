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
    export_c,
    InputLimits,
    learn,
    load,
    Process,
    read,
    run_loop,
    save,
    SensorLimits,
    SetpointRequest,
    simulate,
    State,
    Tuning,
)
from koopman_ros.core.paths import model_path
from koopman_ros.learning.identification import identify
from support.pictures import drawn_figures, title
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
    with drawn_figures() as figures:
        run.draw(tmp_path / 'loop.png')
    assert 'level 1 ends' in title(figures['loop.png'])
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
    'record as episodes': (
        lambda m: identify(RECORD.plant, RECORD), TypeError, 'record.episodes'),
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
    'no source': (lambda m: read(None, ['level'], ['pump']), ValueError, 'None is not a record'),
    'no files': (lambda m: read([], ['level'], ['pump']), ValueError, 'at least one'),
    'text of a table': (lambda m: read('time,level,pump\n0,1,2', ['level'], ['pump']), ValueError,
                        r'\n0,1,2'),
    'numbers for columns': (lambda m: read({'time': 0, 'level': 1, 'pump': 2}, ['level'],
                                           ['pump']), ValueError, 'time, level, pump'),
    'complex column': (lambda m: read(table().assign(**{'level [m]': 1j}), ['level'], ['pump']),
                       ValueError, 'level [m]'),
    'equal columns': (lambda m: read(pd.concat([table(), table()[['level [m]']]], axis=1),
                                     ['level'], ['pump']), ValueError, 'rename'),
    'no times': (lambda m: read(table().drop(columns='time [s]'), ['level'], ['pump']),
                 ValueError, 'period'),
    'one time': (lambda m: read(table().assign(**{'time [s]': 0.0}), ['level'], ['pump']),
                 ValueError, 'repeated time'),
    'lower case': (lambda m: read(table(), ['Level'], ['pump']), ValueError, 'level [m]'),
    'period as text': (lambda m: read(table(), ['level'], ['pump'], period='1 s'), TypeError,
                       'period'),
    'tolerance below 0': (lambda m: read(table(), ['level'], ['pump'], tolerance=-1.0),
                          ValueError, 'tolerance'),
    'column of times as number': (lambda m: read(table(), ['level'], ['pump'], time=0), TypeError,
                                  'time'),
    'day first as text': (lambda m: read(table(), ['level'], ['pump'], dayfirst='yes'), TypeError,
                          'dayfirst'),
    'name as number': (lambda m: read(table(), ['level'], ['pump'], name=3), TypeError, 'name'),
    'name of two lines': (lambda m: read(table(), ['level'], ['pump'], name='tank\n1'),
                          ValueError, 'printable'),
    'endless name': (lambda m: read(table(), ['level'], ['pump'], name=101 * 'x'), ValueError,
                     '100'),
    'another order of a record': (lambda m: RECORD.of(['level'], ['pump']), TypeError, 'states'),
    'another unit of a record': (lambda m: RECORD.of({'level': 'K'}, {'pump': 'V'}), ValueError,
                                 "'K'"),
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
    'time in words': (lambda m: learn(RECORD, dead_time={'pump': '3 s'}), TypeError, 'pump'),
    'time that is none': (lambda m: learn(RECORD, dead_time={'pump': np.nan}), ValueError, '0 s'),
    'time in ns': (lambda m: learn(RECORD, dead_time={'pump': 3e9}), ValueError, 'longer than'),
    'lag below 0': (lambda m: learn(RECORD, lag={'pump': -3.0}, unmeasured_states=0), ValueError,
                    'half of a sample'),
    'half a point': (lambda m: learn(RECORD, characteristics={'pump': (0, 0, 1)}), ValueError,
                     'pairs'),
    'points in words': (lambda m: learn(RECORD, characteristics={'pump': '0:0'}), ValueError,
                        'pump'),
    'table for a record': (lambda m: learn('log.csv'), TypeError, 'Record'),
    'state as disturbance': (lambda m: learn(RECORD, disturbances='level'), ValueError,
                             'have level'),
    'state as command': (lambda m: learn(RECORD, as_state='level'), ValueError, 'names level'),
    'names as numbers': (lambda m: learn(RECORD, as_state=[1]), TypeError, 'as_state'),
    'samples as text': (lambda m: learn(RECORD, most_samples='all'), TypeError, 'most_samples'),
    'few samples': (lambda m: learn(RECORD, most_samples=1), ValueError, '1000'),
    'no start': (lambda m: learn(RECORD, starts=0), ValueError, 'starts'),
    'margin as text': (lambda m: learn(RECORD, margin='10 %'), TypeError, 'margin'),
    'short record': (lambda m: learn(read(table()[:12], ['level'], ['pump'])), ValueError,
                     'at least 160'),
    'constant input': (lambda m: learn(read(table().assign(**{'pump [V]': 3.0}), ['level'],
                                            ['pump'])), ValueError, 'pump is constant'),
    'test of other signals': (lambda m: learn(RECORD, test=read({
        'time': range(20), 'height [m]': range(20), 'pump [V]': range(20)}, ['height'],
        ['pump'])), ValueError, 'height'),
    'lag for all inputs': (lambda m: learn(RECORD, lag=3.0), TypeError, 'lag'),
    'seed as text': (lambda m: learn(RECORD, seed='a'), TypeError, 'seed'),
    'no function': (lambda m: learn(RECORD, on_progress=3), TypeError, 'on_progress'),
    # settings
    'pair for limits': (lambda m: controller(m, limits=(0.0, 12.0)), TypeError, 'InputLimits'),
    'three limits of two': (lambda m: InputLimits(lower=[0.0, 0.0], upper=[1.0, 1.0, 1.0]),
                            ValueError, 'upper must be as long'),
    'column of limits': (lambda m: InputLimits(lower=[[0.0], [0.0]], upper=12.0), ValueError,
                         'lower'),
    'complex limits': (lambda m: InputLimits(upper=1j), ValueError, 'real'),
    'rate below 0': (lambda m: InputLimits(rate=-1.0), ValueError, 'at least 0'),
    'crossed sensor limits': (lambda m: controller(m, sensor=SensorLimits(
        lower=1.0, upper=0.0)), ValueError, 'below'),
    'pair for a sensor': (lambda m: controller(m, sensor=(0.0, 1.0)), TypeError, 'SensorLimits'),
    'no weight of an input': (lambda m: controller(m, input_weight=0.0), ValueError, 'above 0'),
    'no weight': (lambda m: Controller(m, Tuning()), ValueError, 'state_weight'),
    'time below 0': (lambda m: controller(m, hold_timeout=-1.0), ValueError, '86400'),
    'names of outputs': (lambda m: Controller(m, Tuning.for_model(m), ['level_1']), TypeError,
                         'outputs'),
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
    'row of a table': (lambda m: controller(m).step(State(), X[None, :], 1), ValueError,
                       '(1, 2)'),
    'another order': (lambda m: controller(m).step(State(), pd.Series(
        X, ['level_2', 'level_1']), 1), ValueError, 'level_2, level_1'),
    'nothing measured': (lambda m: controller(m).step(State(), None, 1), ValueError, 'level_1'),
    'class of a state': (lambda m: controller(m).step(State, X, 1), TypeError, 'state'),
    'date': (lambda m: controller(m).step(State(), X, pd.Timestamp('2026-01-01')), TypeError,
             'nanoseconds'),
    'one applied input': (lambda m: controller(m).step(State(), X, 1, [1.0]), ValueError,
                          'pump_2'),
    'quality in words': (lambda m: controller(m).step(State(), X, 1, quality='good'), ValueError,
                         'quality'),
    'hold at a time in s': (lambda m: controller(m).hold(State(), 1.5), TypeError, 'nanoseconds'),
    'cause in words': (lambda m: controller(m).hold(State(), 1, 'lost'), TypeError, 'cause'),
    'set-point by name': (lambda m: controller(m).request_setpoint(State(), {'level_1': 0.1}),
                          ValueError, 'set-point'),
    'set-point as a column': (lambda m: controller(m).request_setpoint(State(), X[:, None]),
                              ValueError, '(2, 1)'),
    'set-point at a time in s': (lambda m: controller(m).request_setpoint(State(), X, 20.0),
                                 TypeError, 'nanoseconds'),
    'misspelt signal': (lambda m: controller(m).request_setpoint(State(), [0.1], 0, ('levl',)),
                        ValueError, 'level_1'),
    'swapped set-point': (lambda m: SetpointRequest(X, 0), TypeError, 'nanoseconds'),
    'set-point in s': (lambda m: SetpointRequest(0.5, X), TypeError, 'nanoseconds'),
    'swapped request': (lambda m: controller(m).request_setpoint(X, State()), TypeError, 'state'),
    'one set-point': (lambda m: controller(m).request_setpoint(State(), 0.1), ValueError,
                      'level_1'),
    # loops
    'plant by name': (lambda m: Process('two_tanks', 0, X, X), TypeError, 'ControlAffineSystem'),
    'one state': (lambda m: Process(build('two_tanks'), 0, [0.1], X), ValueError, 'level_1'),
    'start that is none': (lambda m: Process(build('two_tanks'), 0, [np.nan, 0.1], X), ValueError,
                           'finite'),
    'start in words': (lambda m: Process(build('two_tanks'), 0, ['a', 'b'], X), ValueError, "'a'"),
    'start as a column': (lambda m: Process(build('two_tanks'), 0, X[:, None], X), ValueError,
                          '(2, 1)'),
    'one input': (lambda m: Process(build('two_tanks'), 0, X, [1.0]), ValueError, 'pump_2'),
    'swapped start': (lambda m: Process(build('two_tanks'), X, 0, X), TypeError, 'nanoseconds'),
    'no plant': (lambda m: build(None), TypeError, 'two_tanks'),
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
    'event before the start': (lambda m: at(-1.0, SetpointRequest(0, X)), ValueError, '-1.0 s'),
    'event at no time': (lambda m: at(np.nan, SetpointRequest(0, X)), ValueError, 'finite'),
    'event after the end': (lambda m: run_loop(controller(m), Process(
        build('two_tanks'), 0, X, X), at(50.0, SetpointRequest(0, X)), duration=10.0, period=4.0),
        ValueError, 'after the last sample, at 8 s'),
    'period in ns': (lambda m: run_loop(controller(m), Process(
        build('two_tanks'), 0, X, X), duration=10.0, period=5e9), ValueError, 'period'),
    'period of 0': (lambda m: run_loop(controller(m), Process(
        build('two_tanks'), 0, X, X), duration=10.0, period=0.0), ValueError, 'above 0'),
    'endless loop': (lambda m: run_loop(controller(m), Process(
        build('two_tanks'), 0, X, X), duration=np.inf), ValueError, 'finite'),
    'model for a controller': (lambda m: run_loop(m, Process(
        build('two_tanks'), 0, X, X), duration=10.0), TypeError, 'Controller'),
    'matrix as a list': (lambda m: run_loop(controller(m), Process(
        build('two_tanks'), 0, X, X), duration=10.0, C=[1.0, 2.0]), ValueError, '(2, 2)'),
    'events by time': (lambda m: run_loop(controller(m), Process(
        build('two_tanks'), 0, X, X), {0.0: SetpointRequest(0, X)}, duration=10.0), TypeError,
        'at(20.0'),
    'one set-point of two': (lambda m: run_loop(controller(m), Process(
        build('two_tanks'), 0, X, X), at(0.0, SetpointRequest(0, [0.1])), duration=10.0),
        ValueError, 'level_2'),
    'event of numbers': (lambda m: at(20.0, X), TypeError, 'SetpointRequest'),
    'duration as text': (lambda m: run_loop(controller(m), Process(
        build('two_tanks'), 0, X, X), duration='10 s'), TypeError, 'duration'),
    # free runs, files and code
    'swapped free run': (lambda m: simulate(RECORD, m), TypeError, 'model must be'),
    'file for a model': (lambda m: simulate('two_tanks.safetensors', RECORD), TypeError, 'str'),
    'controller for a model': (lambda m: simulate(controller(m), RECORD), TypeError,
                               'Controller'),
    'samples in s': (lambda m: simulate(m, RECORD, 2.5), TypeError, 'init'),
    'swapped file': (lambda m: save('tanks.safetensors', m), TypeError, 'LiftedModel'),
    'record for a model': (lambda m: save(RECORD, 'tanks.safetensors'), TypeError, 'Record'),
    'plant for a file': (lambda m: load('two_tanks'), ValueError, 'two_tanks'),
    'swapped export': (lambda m: export_c('tanks', controller(m)), TypeError, 'Controller'),
    'export of a model': (lambda m: export_c(m, 'tanks'), TypeError, 'LiftedModel'),
    'name of two words': (lambda m: export_c(controller(m), 'tanks', name='My Tank'), ValueError,
                          'tank_1'),
    'no sample period': (lambda m: export_c(controller(m), 'tanks', sample_period=0.0),
                         ValueError, 'above 0 s'),
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
    # one name and one number of one signal
    assert loop.request_setpoint(State(), 0.1, 0, 'level_1')[1] is None
    named = pd.Series([0.1, 0.15], ['level_1', 'level_2'])
    assert np.all(np.isfinite(loop.step(State(), named, 1)[1]))
    for gap in (np.nan, None):
        assert np.all(np.isfinite(loop.step(State(), [gap, 0.1], np.int64(1))[1]))


def test_a_reason_prints_its_sentence(tanks):
    _, refused = controller(tanks).request_setpoint(State(), [9.0, 0.15])
    assert 'level_1' in str(refused)
    assert 'StatusCode' not in f'{refused}'
