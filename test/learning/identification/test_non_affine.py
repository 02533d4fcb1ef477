# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drifts dx/dt = f(x, u) from records, with the command as a state."""

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.core.message_fields import place
from koopman_ros.core.solvers import differences
from koopman_ros.learning import retrain, TrainingTask
from koopman_ros.learning.identification import identify_non_affine, with_lag
from koopman_ros.learning.identification.drift import longest_step, Segments
from koopman_ros.learning.task import resolve_signals
from koopman_ros.model import load
from koopman_ros.records import read, RecordedInput, RecordedState
from support.known_plants import methods
from support.quick_retraining import quick_retraining

PLANT = PlantDescription('tank', ('level',), ('m',), ('valve',), ('1',), 's', np.full(1, np.nan),
                         np.full(1, np.nan), None)
PERIOD, LAG = 0.2, np.array([0.2])


def rate(x, u):
    """Return a rate that no characteristic of the input explains."""
    return -x + u + x * u * u


@pytest.fixture(scope='module')
def episode():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-0.7, 0.7, (100, 1)), 6, axis=0)
    path = [np.zeros(1)]
    for value in u[:-1]:
        x = path[-1]
        for _ in range(4):
            x = runge_kutta_step(lambda x, value=value: rate(x, value), x, PERIOD / 4)
        path.append(x)
    time = PERIOD * np.arange(len(u))
    noise = 0.01 * rng.standard_normal((len(u), 1))
    return Episode(time, np.array(path) + noise, time, u)


@pytest.fixture(scope='module')
def found(episode):
    return identify_non_affine(PLANT, [episode], ('valve',), degrees=(1,), methods=methods(20))


def test_the_drift_is_found(found):
    x, u = np.random.default_rng(1).uniform(-0.6, 0.6, (2, 50, 1))
    errors = [np.sqrt(np.mean((one.rate(x, u) - rate(x, u)) ** 2))
              for one in (found.drift, found.linear)]
    assert errors[0] < min(0.03, 0.3 * errors[1])
    assert 'not affine in valve' in found.drift.form
    xi, v = found.drift.box.states.to_deviation(x), found.drift.box.inputs.to_deviation(u)
    both = differences(lambda y: found.drift.scaled_rate(y[..., :1], y[..., 1:]),
                       np.hstack([xi, v]), np.ones(2))
    np.testing.assert_allclose(found.drift.scaled_slope(xi, v), both[..., :1], atol=1e-6)
    np.testing.assert_allclose(found.drift.scaled_input_slope(xi, v), both[..., 1:], atol=1e-6)


def test_with_the_command_as_a_state_it_is_affine_and_simulates_the_same(found):
    commanded = with_lag(found, LAG, ('valve',))
    drift = commanded.drift
    assert drift.box.states.names == ('level', 'commanded_valve')
    x, u = np.array([0.3, -0.2]), np.array([0.5])
    np.testing.assert_allclose(drift.rate(x, u), [
        found.drift.rate(x[:1], x[1:])[0], (u[0] - x[1]) / LAG[0]], rtol=1e-9)
    # pulses of the input move the command at once
    own, moved = (Segments.of(one.held_out, longest_step(one.held_out))
                  for one in (found, commanded))
    path, simulated, measured = (x.swapaxes(0, 1)[segments.sampled.T] for segments, x in (
        (own, own.path(found.drift.rate, own.x[0])), (moved, moved.path(drift.rate, moved.x[0])),
        (moved, moved.x)))
    np.testing.assert_allclose(simulated[:, :1], path, atol=1e-3)
    np.testing.assert_allclose(simulated[:, 1], measured[:, 1], atol=1e-6)
    assert drift.box.inputs.upper[0] == found.drift.box.inputs.upper[0]


def test_a_known_effect_of_the_input_is_rejected():
    with pytest.raises(ValueError, match='input_matrix'):
        identify_non_affine(PlantDescription(
            'tank', ('level',), ('m',), ('valve',), ('1',), 's', np.zeros(1), np.zeros(1),
            np.ones((1, 1))), [], ('valve',))


def test_a_training_with_the_command_as_a_state(episode, tmp_path):
    task = TrainingTask(
        (), str(tmp_path / 'model.safetensors'), '',
        (RecordedState('level', 'm', place('level', 'level', 'm')),),
        (RecordedInput('valve', '1', place('valve', 'valve', '1')),), model_class='polynomial',
        dead_time={'valve': 0.0}, as_state=('valve',), condition=1e6)
    with quick_retraining(4, degrees=(1,)):
        retrained = retrain(task, record=read({
            'time [s]': episode.time, 'level [m]': episode.x[:, 0], 'valve [1]': episode.u[:, 0]},
            'level', 'valve'))
    assert retrained.accepted, retrained.reasons
    # commands of the record act at once
    run = retrained.free_runs['record']
    assert (run.names, retrained.lag.tolist()) == (('level',), [0.0])
    assert run.fit[0] > 97.0
    model = load(retrained.model_file)
    assert model.states.names == ('level', 'commanded_valve')
    assert model.commanded == {0: 1}
    assert 'the law sets the rate of valve' in str(model)
    assert 'lag of valve' not in str(model)


@pytest.mark.parametrize(('wrong', 'words'), [
    ({'as_state': ('pump',)}, 'pump'), ({'unmeasured_states': 1}, 'unmeasured_states'),
    ({'input_gain': {'level': {'valve': 1.0}}}, 'input_matrix'),
    ({'characteristics': {'valve': [0.0, 0.0, 1.0, 1.0]}}, 'characteristic')])
def test_what_as_state_excludes(wrong, words):
    task = TrainingTask(
        (), 'model.safetensors', '', (RecordedState('level', 'm', place('level', 'level', 'm')),),
        (RecordedInput('valve', '1', place('valve', 'valve', '1')),),
        **{'as_state': ('valve',), **wrong})
    with pytest.raises(ValueError, match=words):
        resolve_signals(task, None)
