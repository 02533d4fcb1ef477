# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Free runs of models on records, against the exact solution of an oscillator."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode
from koopman_ros.learning import compare_classes, evaluate_model, learn_lift, simulate, Thresholds
from koopman_ros.learning.identification import DriftModel, Identified, identify
from koopman_ros.learning.pipeline import _failed_runs, DRIFT, LINEAR_MODEL
from koopman_ros.model import Box, Coordinates, linearised_model, Provenance
from koopman_ros.records import read
from support.heater_logs import COLD_DAY, DAYS, write_heater_logs
from support.pictures import drawn_figures, title
from support.sampling import sampled

A, B = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([[0.0], [1.0]])
N, PERIOD = 200, 0.1
STATES = Coordinates.spanning(('position', 'speed'), ('m', 'm/s'), -2.0 * np.ones(2),
                              2.0 * np.ones(2))
INPUTS = Coordinates.spanning(('force',), ('N',), -np.ones(1), np.ones(1))


def table(seed=0, x=(1.0, -0.5), push=0.0, period=PERIOD):
    """Return a run of the oscillator under random steps and a push, solved exactly."""
    step, gain = sampled(A, B, period)
    u = np.repeat(np.random.default_rng(seed).uniform(-1.0, 1.0, N // 10), 10)
    path = [np.array(x)]
    for value in u[:-1]:
        path.append(step @ path[-1] + gain[:, 0] * (value + push))
    return {'time': period * np.arange(N), 'force': u,
            **dict(zip(STATES.names, np.transpose(path), strict=True))}


def lifted(unit='s', slope=A):
    factor = 60.0 if unit == 'min' else 1.0
    return linearised_model(factor * slope, factor * B, STATES, INPUTS, unit, Provenance('test'))


def drift(slope=A):
    scaled = slope * STATES.scale / STATES.scale[:, None]
    return DriftModel(Box(STATES, INPUTS, 's'), 1, np.vstack([np.zeros(2), scaled.T]),
                      B * INPUTS.scale / STATES.scale[:, None])


@pytest.mark.parametrize(('model', 'states'), [
    (lifted(), ['position [m]', 'speed [m/s]']), (lifted('min'), ['speed [m/s]']),
    (drift(), ['speed [m/s]', 'position [m]']), (drift(), ['speed [m/s]'])])
def test_a_right_model_follows_the_record(model, states):
    tables = [table(), {**table(1, (0.0, 1.5)), 'position': np.where(
        np.arange(N) % 20, np.nan, table(1, (0.0, 1.5))['position'])}]
    run = simulate(model, read(tables, states, 'force [N]'))
    assert not run.diverged
    assert np.all(run.fit > 99.9)
    assert np.all(run.rmse < 1e-4)
    assert run.names == tuple(name for name in STATES.names if name in ' '.join(states))
    # the state that was not measured is found, too
    speed = run.paths[0][:, run.names.index('speed')]
    assert speed == pytest.approx(table()['speed'], abs=1e-3)
    assert run.paths[0].shape == (N, 2)


def test_a_model_that_is_faster_than_the_samples_is_followed():
    fast = np.array([[0.0, 1.0], [-25.0, -2.0]])
    step, gain = sampled(fast, B, 1.0)
    u, path = np.random.default_rng(3).uniform(-1.0, 1.0, N), [np.zeros(2)]
    for value in u[:-1]:
        path.append(step @ path[-1] + gain[:, 0] * value)
    record = read({'time': np.arange(N), 'force': u, 'position': np.array(path)[:, 0]},
                  'position [m]', 'force [N]')
    assert simulate(lifted(slope=fast), record).fit[0] > 97.0


def test_units_of_the_record_are_converted():
    values = table()
    run = simulate(lifted(), read({**values, 'position': 1e3 * values['position']},
                                  'position [mm]', 'force [N]'))
    assert (run.units, run.names) == (('m',), ('position',))
    assert run.fit[0] > 99.9


def test_errors_of_a_wrong_model_count_after_the_start(tmp_path):
    record = read(table(), 'position [m]', 'force [N]')
    stiffer = lifted(slope=A * [[1.0, 1.0], [1.4, 1.0]])
    run = simulate(stiffer, record, init=40, picture=tmp_path / 'run.png')
    error = run.paths[0][40:, 0] - table()['position'][40:]
    assert run.rmse[0] == pytest.approx(np.sqrt(np.mean(error ** 2)))
    spread = np.linalg.norm(table()['position'][40:] - np.mean(table()['position'][40:]))
    assert run.fit[0] == pytest.approx(100.0 * (1.0 - np.linalg.norm(error) / spread))
    assert 'position: error' in str(run)
    assert (tmp_path / 'run.png').read_bytes().startswith(b'\x89PNG')


def test_a_diverging_model_is_reported_and_drawn_within_the_data(tmp_path):
    run = simulate(lifted(slope=30.0 * np.eye(2)), read(table(), 'position [m]', 'force [N]'),
                   init=2)
    assert run.diverged
    assert run.rmse[0] == np.inf
    with drawn_figures() as figures:
        run.draw(tmp_path / 'run.png', 'rejected')
    position = figures['run.png'].axes[0]
    (low, high), values = position.get_ylim(), table()['position']
    assert low <= min(values) < max(values) <= high
    assert high - low <= 2.01 * np.ptp(values)
    assert 'diverges' in position.get_title(loc='left')
    assert title(figures['run.png']) == 'rejected'


def test_a_picture_of_days_counts_days(tmp_path):
    record = read({**table(), 'time': 7200.0 * np.arange(N)}, 'position [m]', 'force [N]',
                  name='basin')
    with drawn_figures() as figures:
        simulate(lifted(slope=1e-5 * A), record, init=2, picture=tmp_path / 'run.png')
    axes = figures['run.png'].axes[-1]
    assert axes.get_xlabel() == 'time [d]'
    assert axes.lines[0].get_xdata()[-1] == pytest.approx(7200.0 * (N - 1) / 86400.0)
    assert 'basin' in title(figures['run.png'])


@pytest.mark.parametrize(('slope', 'diverged', 'words'), [
    (A, False, ''), (A * [[1.0, 1.0], [1.4, 1.0]], False, 'above that of the best linear model'),
    # fits 0.5 and 1.1 % below
    (A * [[1.0, 1.0], [1.103, 1.0]], False, ''),
    (A * [[1.0, 1.0], [1.107, 1.0]], False, 'by more than 1 % of the motion'),
    (30.0 * np.eye(2), False, 'of the record diverges: from 0.2 s on'),
    (30.0 * np.eye(2), True, 'of the test record diverges: from 0.2 s on')])
def test_a_model_is_rejected_whose_free_run_diverges_or_is_worse_than_that_of_the_linear_model(
        slope, diverged, words):
    record = read(table(), 'position [m]', 'force [N]')
    own, linear = (dict.fromkeys(('record', 'test'), simulate(lifted(slope=one), record, init=2))
                   for one in (slope, A * [[1.0, 1.0], [1.1, 1.0]]))
    reasons = list(_failed_runs(own, dict.fromkeys((LINEAR_MODEL, DRIFT),
                                                   own if diverged else linear)))
    assert words in ' '.join(reasons)
    assert len(reasons) == bool(words) + (slope[0, 0] > 0.0 and not diverged)


def test_a_free_run_may_diverge_where_that_of_the_drift_leaves_the_record():
    record = read(table(), 'position [m]', 'force [N]')
    own, drift = (simulate(lifted(slope=slope), record, init=2)
                  for slope in (30.0 * np.eye(2), 0.2 * np.eye(2)))
    # an unstable plant, of which the one grows beyond all numbers and the other not so far
    assert own.diverged
    assert np.all(np.isfinite([drift.leaves, *drift.rmse]))
    runs = {'record': own}
    assert not list(_failed_runs(runs, {DRIFT: {'record': drift}, LINEAR_MODEL: runs}))
    # a stable plant with a drift that explodes
    stable = simulate(lifted(slope=A), record, init=2)
    assert list(_failed_runs(runs, {DRIFT: runs, LINEAR_MODEL: {'record': stable}}))


@pytest.mark.parametrize('usual', ['good', 'bad'])
def test_a_model_is_rejected_that_errs_more_than_the_mean_of_a_record_with_motion(usual):
    record = read(table(), 'position [m]', 'force [N]')
    runs = {name: simulate(lifted(slope=A * [[1.0, 1.0], [factor, 1.0]]), record, init=2)
            for name, factor in (('good', 1.1), ('bad', 0.3))}
    assert runs['bad'].fit[0] < 0.0
    own = {'record': runs[usual], 'test': runs['bad']}
    reasons = list(_failed_runs(own, {DRIFT: own, LINEAR_MODEL: own}))
    # motion that is as small as the usual error is none
    assert ['than the mean value does (fit -' in one for one in reasons] == [True] * (
        usual == 'good')


@pytest.mark.parametrize(('push', 'usual', 'found'), [
    (0.5, 0.01, 0.5), (0.5, 1.0, 0.0), (0.5, None, 0.0), (0.0, 0.01, 0.0)])
def test_a_constant_disturbance_is_found_where_the_first_samples_contradict(push, usual, found):
    model = lifted()
    if usual:
        # as a trained model says it
        model = replace(model, provenance=replace(model.provenance, metrics={
            f'free_run_{name}': usual for name in STATES.names}))
    run = simulate(model, read(table(push=push), ['position [m]', 'speed [m/s]'], 'force [N]'))
    assert run.disturbances == pytest.approx(np.array([[0.0, found]]), abs=0.05)
    assert np.all(run.fit > 90.0) == (push == found)
    known = simulate(model, read(table(push=push), ['position [m]', 'speed [m/s]'], 'force [N]'),
                     offsets=np.array([[0.0, push]]))
    assert known.disturbances.tolist() == [[0.0, push]]
    assert np.all(known.fit > 99.9)


@pytest.mark.parametrize(('period', 'init', 'count'), [
    (0.1, None, 50), (0.025, None, 80), (0.01, None, 100), (0.025, 30, 30)])
def test_a_disturbance_is_fitted_to_two_time_constants(period, init, count):
    # of 1 s, in half of the record at most
    run = simulate(lifted(), read(table(push=0.5, period=period), [
        'position [m]', 'speed [m/s]'], 'force [N]'), init, usual=np.full(2, 0.001))
    assert run.init == count
    without = simulate(lifted(), read(table(period=period), [
        'position [m]', 'speed [m/s]'], 'force [N]'), usual=np.full(2, 0.001))
    assert without.init == 50


@pytest.mark.parametrize(('signals', 'options', 'words'), [
    (('force', 'position'), {}, 'the states force and the model position, speed'),
    (('position [m]', 'speed'), {}, 'no input force'),
    (('position [s]', 'force'), {}, r"position: .* as 'position \[unit\]'"),
    (('position [m]', 'force [N]'), {'init': 0}, 'init = 0'),
])
def test_rejects_a_record_of_other_signals(signals, options, words):
    with pytest.raises(ValueError, match=words):
        simulate(lifted(), read(table(), *signals), **options)


def test_a_linear_model_of_a_heater_follows_it_on_another_day(tmp_path):
    write_heater_logs(tmp_path)
    days, other = (read([tmp_path / name for name in names], 'temperature [K]', 'heater')
                   for names in (DAYS, (COLD_DAY,)))
    run = simulate(identify(days.plant, days.episodes, degrees=(1,)), other)
    # of a motion by tens of kelvin, behind a thermometer whose lag is not in the model
    assert run.fit[0] > 50.0


def test_an_identification_with_unmeasured_states_is_learned_and_simulated_as_it_is():
    values = table()
    record = read(values, 'position [m]', 'force [N]')
    whole = np.column_stack([values[name] for name in STATES.names])
    parts = [Episode(values['time'], whole, values['time'], values['force'][:, None]).part(
        k, k + 21) for k in range(0, N - 20, 20)]
    found = Identified(drift(), 'output error', drift(), (), np.full(2, 1e-3), tuple(parts[:-2]),
                       tuple(parts[-2:]), hidden=1)
    learned = compare_classes(found, record.plant, Thresholds(), model_class='linear', n_z=3,
                              seed=0, starts=1, loops=4)
    assert learned.model.states.names == STATES.names
    assert np.all(evaluate_model(found, learned, None, Thresholds(), loops=4).rmse < 1e-5)
    for model in (found, learned, learned.model):
        assert simulate(model, record).fit[0] > 99.9
    with pytest.raises(ValueError, match='linear'):
        learn_lift(found, record.plant, 3, seed=0, starts=1)
