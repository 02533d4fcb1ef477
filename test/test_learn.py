# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Learning from files on the command line."""

from contextlib import redirect_stdout
import io
import json
import os
from pathlib import Path
import signal
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from koopman_ros import learn_files as learn
from koopman_ros.model import load
from support.pictures import drawn_figures, title
from support.quick_retraining import quick_retraining

N, PERIOD = 400, 0.5


def table(seed, late=0):
    """Return a run of a tank that empties linearly, with a little noise and a late pump."""
    decay = np.exp(-0.2 * PERIOD)
    rng = np.random.default_rng(seed)
    pump, level = np.repeat(rng.uniform(0.0, 10.0, N // 10), 10), [2.0]
    for value in np.concatenate([np.full(late, pump[0]), pump])[:N - 1]:
        level.append(decay * level[-1] + (1.0 - decay) * 0.5 * value)
    return pd.DataFrame({'time [s]': PERIOD * np.arange(N), 'pump [V]': pump,
                         'level [m]': level + 1e-3 * rng.standard_normal(N)})


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Change to a folder with a record; without matplotlib no pictures are drawn."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, 'matplotlib.figure', None)
    table(0).to_csv('day.csv', index=False)
    return tmp_path


def learned(*arguments, given=('day.csv', '--states', 'level', '--inputs', 'pump')):
    with quick_retraining(4, degrees=(1, 2)):
        return learn.main([*given, '--model_class', 'linear', *arguments])


@pytest.fixture(scope='module')
def drawn_day(tmp_path_factory):
    """Learn from a record with a late pump, test on another; return folder, output, figures."""
    folder = tmp_path_factory.mktemp('day')
    with (pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as printed,
          drawn_figures() as figures):
        patch.chdir(folder)
        for seed, name in enumerate(('day.csv', 'other.csv')):
            table(seed, late=6).to_csv(name, index=False)
        assert learned('--test', 'other.csv') == 0
    return folder, printed.getvalue(), figures


@pytest.fixture(scope='module')
def day(drawn_day):
    """Return folder and output alone."""
    return drawn_day[:2]


def test_pictures_name_their_record_and_show_no_rounding(drawn_day):
    *_, figures = drawn_day
    for name, words in (('day.png', 'Training of day from day.csv'),
                        ('day.free_run.png', 'record day'), ('day.test.png', 'test record other')):
        assert words in title(figures[name])
        assert 'accepted' in title(figures[name])
    # the linear model is the estimate, but for rounding, at a rate of up to 1 m/s
    difference, prediction, loops, band = figures['day.png'].axes[1:]
    assert min(np.abs(difference.get_ylim())) > 1e-4
    assert 'level [m]' in loops.get_xlabel()
    assert prediction.get_xlabel() == 'time [s]'
    for axes in (difference, prediction, loops, band):
        box = axes.get_legend().get_window_extent()
        assert axes.bbox.fully_containsx(box.x0)
        assert axes.bbox.fully_containsx(box.x1)


def test_a_file_is_learned_tested_and_reported(day):
    folder, printed = day
    for words in ('level [m], pump [V]', '400 of 400 values used',
                  'the new model (linear) is acc', 'test: free run of 394 measurements'):
        assert words in printed
    model = load(folder / 'day.safetensors')
    assert (model.states.names, model.inputs.units) == (('level',), ('V',))
    assert model.eigenvalues.real == pytest.approx([-0.2], rel=0.02)
    summary = json.loads((folder / 'day.json').read_text())
    # polynomials of other degrees, which explain the record of a linear plant as well
    others = [Path(file).name for file in summary['alternative_files']]
    assert others[:1] == ['day.alternative_1.safetensors']
    assert {path.name for path in folder.glob('day.*')} == {
        'day.csv', *(f'day.{name}' for name in (
            'safetensors', 'json', 'md', 'png', 'free_run.png', 'test.png')), *others}
    # no other class can be better than that of the drift
    assert set(summary['classes']) == {'linear'}
    runs = summary['free_runs']
    assert min(runs[name]['fit_percent']['level'] for name in ('record', 'test')) > 99.0
    assert {(model, name) for model, some in summary['free_runs_of'].items() for name in some} == {
        (model, name) for model in ('estimated drift', 'best linear model') for name in runs}
    assert '| test | level | best linear model |' in (folder / 'day.md').read_text()


@pytest.mark.usefixtures('folder')
def test_a_dead_time_and_a_characteristic_that_are_known_are_taken(day, capsys):
    assert learned('--dead_time', f'pump={6 * PERIOD}', '--characteristic', 'pump=0:0,10:5',
                   '--unmeasured_states', '0', '--model_output', 'known.safetensors',
                   given=[str(day[0] / 'day.csv'), '--states', 'level', '--inputs', 'pump']) == 0
    model = load('known.safetensors')
    assert model.dead_time == [6 * PERIOD]
    assert 'pump' in model.inputs.characteristics
    printed = capsys.readouterr().out
    assert f'no unmeasured state, dead time {6 * PERIOD:.4g} s of pump: accepted' in printed
    assert "next: control by load('known.safetensors')" in printed


def test_a_dead_time_is_found_and_belongs_to_the_model(day):
    folder, _ = day
    assert load(folder / 'day.safetensors').dead_time == pytest.approx([6 * PERIOD])
    assert json.loads((folder / 'day.json').read_text())['dead_time'] == {'pump': 6 * PERIOD}
    assert f'dead time of pump: {6 * PERIOD:.4g} s' in (folder / 'day.md').read_text()


def test_a_measured_disturbance_is_learned_and_keeps_its_role(folder, capsys):
    decay, rng = np.exp(-0.2 * PERIOD), np.random.default_rng(3)
    pump, rain = (np.repeat(rng.uniform(0.0, high, N // 10), 10) for high in (10.0, 4.0))
    level = [2.0]
    for u, d in zip(pump[:-1], np.roll(rain, 5)[:-1], strict=True):
        level.append(decay * level[-1] + (1.0 - decay) * (0.5 * u + 0.8 * d))
    pd.DataFrame({'time [s]': PERIOD * np.arange(N), 'pump [V]': pump, 'rain [mm]': np.roll(
        rain, 5), 'level [m]': level + 1e-3 * rng.standard_normal(N)}).to_csv(
            'day.csv', index=False)
    assert learned('--disturbances', 'rain') == 0
    for name in ('day.alternative_1', 'day'):
        model = load(folder / f'{name}.safetensors')
        assert (model.inputs.names, model.disturbances.names) == (('pump',), ('rain',))
    effect = model.E * model.states.scale / model.disturbances.scale
    assert effect == pytest.approx(0.16, rel=0.02)
    assert model.dead_time == pytest.approx(0.0)
    # the present model says which signal it is, and it takes no other role
    assert learned('--model', 'day.safetensors', '--model_output', 'new.safetensors') == 2
    assert 'the current model' in capsys.readouterr().out
    assert load(folder / 'new.rejected.safetensors').disturbances.names == ('rain',)
    assert learned('--disturbances', 'rain', '--input_matrix_degree', '1') == 1
    assert 'input_matrix_degree' in capsys.readouterr().err
    table(0).assign(**{'rain [mm]': 3.0}).to_csv('day.csv', index=False)
    assert learned('--disturbances', 'rain') == 1
    assert 'rain is 3 in the whole record: leave it out' in capsys.readouterr().err


def test_inputs_that_moved_together_are_not_moved_apart_by_dead_times(folder, capsys):
    rows = table(0, late=6)
    rows.assign(**{'fan [V]': 2.0 * rows['pump [V]'] + 1.0}).to_csv('day.csv', index=False)
    assert learned('--inputs', 'pump', 'fan') == 1
    assert 'pump and fan moved together' in capsys.readouterr().err


@pytest.mark.parametrize('seed', [3, 5])
def test_a_record_that_the_inputs_do_not_explain_is_rejected(folder, capsys, seed):
    noise = np.random.default_rng(seed).standard_normal(N)
    table(0).assign(**{'level [m]': noise}).to_csv('day.csv', index=False)
    assert learned('--unmeasured_states', '0') == 2
    assert 'the inputs explain nothing of the record' in capsys.readouterr().out


def test_a_drift_that_overflows_gives_no_warning(folder):
    noise = np.random.default_rng(4).standard_normal(N)
    table(0).assign(**{'level [m]': noise}).to_csv('day.csv', index=False)
    with quick_retraining(4, degrees=(1, 3)):
        assert learn.main(['day.csv', '--states', 'level', '--inputs', 'pump', '--model_class',
                           'linear', '--unmeasured_states', '0']) == 2


@pytest.mark.usefixtures('folder')
def test_a_present_model_names_the_signals_and_has_to_be_beaten(day, capsys):
    assert learned('--model', str(day[0] / 'day.safetensors'), '--model_class', 'same',
                   '--training_seed', '1', given=[str(day[0] / 'other.csv')]) == 2
    said = capsys.readouterr().out
    assert 'the new model (linear) is rejected' in said
    assert 'is not 10 % below that of the current model' in said


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--states', 'height'], "no column 'height', it has 'time [s]'"),
    (['--lag', 'heater'], '--lag heater must be inputs with a time in s'),
    (['--dead_time', 'pump=soon'], '--dead_time pump=soon must be inputs with a time in s'),
    (['--dead_time', 'heater=5'], 'dead_time names heater'),
    (['--characteristic', 'pump=0,1'], '--characteristic pump=0,1 must be inputs with points'),
    (['--characteristic', 'heater=0:0,1:1'], 'characteristics name heater'),
    (['--lag', 'heater=5'], 'lag names heater'),
    (['--restarts', '0'], 'restarts = 0 must be in [1, 100]'),
    (['--unmeasured_states', '1', '--input_matrix_degree', '1'], 'input_matrix_degree is 1'),
    (['--model', 'none.safetensors'], 'none.safetensors'),
    (['--test', 'none.csv'], 'none.csv'),
    (['--period', '-1'], 'period = -1.0 s'),
    (['--training_samples', 'many'], None),
])
def test_a_wrong_argument_is_a_sentence(folder, capsys, arguments, words):
    if words is None:
        with pytest.raises(SystemExit):
            learned(*arguments)
        return
    assert learned(*arguments) == 1
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(('option', 'days'), [('--dayfirst', 11), ('--no-dayfirst', 334)])
def test_an_option_says_which_number_of_a_date_is_the_day(tmp_path, capsys, option, days):
    """1/2 to 12/2 are eleven days, or eleven months."""
    file = tmp_path / 'log.csv'
    file.write_text('time,level [m],pump [V]\n' + ''.join(
        f'{number}/2/2026 00:00,{number}.5,1.0\n' for number in range(1, 13)))
    arguments = [str(file), '--states', 'level', '--inputs', 'pump']
    assert learn.main(arguments) == 1
    assert option in capsys.readouterr().err
    learn.main([*arguments, option])
    assert f'12 samples in {86400 * days:.6g} s' in capsys.readouterr().out


def test_the_module_is_the_program(tmp_path):
    found = subprocess.run(
        [sys.executable, '-m', 'koopman_ros', 'learn', 'day.csv'], capture_output=True, text=True,
        cwd=tmp_path, env={**os.environ, 'PYTHONPATH': str(Path(learn.__file__).parents[1])})
    assert found.returncode == 1
    assert found.stderr.startswith('learn: the signals are not known: give --states and --inputs')


# The program, whose estimates are few and whose closed loops are four.
QUICK = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from support.quick_retraining import quick_retraining
from koopman_ros import process_entry
with quick_retraining(4, degrees=(1, 2)):
    sys.exit(process_entry.learn())
"""


@pytest.mark.parametrize(('number', 'event', 'kept'), [
    (signal.SIGINT, b'judging: polynomial', 'linear'),
    (signal.SIGTERM, b'learning: neural drift', 'polynomial')])
def test_a_class_that_is_learned_outlives_a_signal(tmp_path, number, event, kept):
    rng = np.random.default_rng(0)
    pump, level = np.repeat(rng.uniform(1.0, 9.0, N // 10), 10), [2.0]
    for value in pump[:N - 1]:
        for _ in range(10):
            level.append(level[-1] + 0.1 * PERIOD * (0.1 * value - 0.1 * level[-1] ** 2))
    pd.DataFrame({'time [s]': PERIOD * np.arange(N), 'pump [V]': pump,
                  'level [m]': level[::10] + 1e-3 * rng.standard_normal(N)}
                 ).to_csv(tmp_path / 'day.csv', index=False)
    own, other = os.openpty()
    with subprocess.Popen(
            [sys.executable, '-c', QUICK, 'day.csv', '--states', 'level', '--inputs', 'pump',
             '--dead_time', 'pump=0', '--unmeasured_states', '0'], cwd=tmp_path,
            stdout=subprocess.PIPE, stderr=other, text=True) as process:
        os.close(other)
        terminal = b''
        while event not in terminal:
            terminal += os.read(own, 4096)
        process.send_signal(number)
        said, _ = process.communicate(timeout=60.0)
    os.close(own)
    assert process.returncode == 130
    assert {path.name for path in tmp_path.iterdir()} == {'day.csv', *(
        f'day.unfinished.{ending}' for ending in ('json', 'md', 'safetensors'))}
    model = load(tmp_path / 'day.unfinished.safetensors')
    assert (model.provenance.model_class, model.provenance.accepted) == (kept, False)
    assert 'classes not tried' in (tmp_path / 'day.unfinished.md').read_text()
    assert f'({kept}) is kept as day.unfinished.safetensors' in said
    assert f'next: --model_class {kept}' in said


def test_a_training_ends_by_a_signal(folder):
    arguments = ['learn', 'day.csv', '--states', 'level', '--inputs', 'pump']
    with subprocess.Popen([sys.executable, '-m', 'koopman_ros', *arguments],
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder,
                          env={**os.environ, 'PYTHONPATH': str(Path(learn.__file__).parents[1])}
                          ) as process:
        while '400 of 400 values used' not in process.stdout.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=60.0)
    assert process.returncode == 130
    assert said.strip().startswith('interrupted')
    assert [path.name for path in folder.iterdir()] == ['day.csv']
