# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Characteristics of inputs that records show, and drifts that are not affine in the inputs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.message_fields import place
from koopman_ros.learning import retrain, TrainingTask
from koopman_ros.learning.identification import (
    identify,
    identify_measured,
    identify_with_characteristics,
    prediction_error,
    Segments,
    structure_search,
)
from koopman_ros.learning.identification.characteristics import NotMonotoneError, smoothed
from koopman_ros.learning.identification.input_functions import NonAffineDrift
from koopman_ros.model import load
from koopman_ros.records import read, RecordedInput, RecordedState
from support.known_plants import methods
from support.quick_retraining import quick_retraining
from support.sampling import sampled

PERIOD, SAMPLES, HOLD, NOISE = 0.2, 600, 6, 0.01
PLANT = PlantDescription('tank', ('level',), ('m',), ('valve',), ('1',), 's', np.full(1, np.nan),
                         np.full(1, np.nan), None)


def record(rate, low, high, seed=0):
    """Return a noisy record of dx/dt = rate(x, u) under random steps of u."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(low, high, SAMPLES // HOLD), HOLD)
    x = np.zeros(SAMPLES)
    for k in range(SAMPLES - 1):
        x[k + 1] = x[k]
        for _ in range(20):
            middle = x[k + 1] + 0.005 * rate(x[k + 1], u[k])
            x[k + 1] += 0.01 * rate(middle, u[k])
    time = PERIOD * np.arange(SAMPLES)
    return Episode(time, (x + NOISE * np.std(x) * rng.standard_normal(SAMPLES))[:, None],
                   time, u[:, None])


def identified(episode, plant=PLANT, **options):
    return identify_with_characteristics(plant, [episode], degrees=(1,), methods=methods(20),
                                         **options)


def test_an_unstable_plant_whose_simulation_is_lost_has_none():
    """A magnet that holds a ball, in closed loop for 528 of its time constants."""
    rate, period, count = 44.0, 0.004, 3000
    A = np.array([[0.0, 1.0], [rate ** 2, 0.0]])
    step, gain = sampled(A, np.array([[0.0], [rate ** 2]]), period)
    rng, noise = np.random.default_rng(0), np.array([1e-3, 1e-3 * rate])
    goal = np.repeat(rng.uniform(-1.0, 1.0, count // 40), 40)
    x, u = np.zeros((count, 2)), np.zeros(count)
    for k in range(count):
        gap, speed = x[k] + noise * rng.standard_normal(2)
        u[k] = -goal[k] - 3.0 * (gap - goal[k]) - 2.0 / rate * speed
        if k + 1 < count:
            x[k + 1] = step @ x[k] + gain[:, 0] * u[k]
    time = period * np.arange(count)
    plant = replace(PLANT, state_names=('gap', 'speed'), state_units=('1', '1'),
                    nominal_state=np.full(2, np.nan))
    found = identified(Episode(time, x + noise * rng.standard_normal(x.shape), time, u[:, None]),
                       plant)
    assert not found.drift.characteristics
    assert found.drift.input_matrix[1, 0] == pytest.approx(rate ** 2, rel=0.1)


@pytest.mark.parametrize(('g', 'exact'), [
    (lambda u: (30.0 ** u - 1.0) / 29.0, 1e-3),
    (lambda u: np.maximum(u - 0.3, 0.0) / 0.7, 1e-2),
    (lambda u: 0.5 + 0.5 * np.tanh(5.0 * (u - 0.5)) / np.tanh(2.5), 1e-3)],
    ids=['equal percentage', 'dead zone', 'between two ends'])
def test_a_smoothed_characteristic_rises_with_the_slope_of_the_true_one(g, exact):
    u = np.linspace(0.0, 1.0, 21)
    assert np.max(np.abs(smoothed(u, g(u)) - g(u))) < exact
    errors, largest = [], []
    for seed in range(10):
        noisy = g(u) + 0.01 * np.random.default_rng(seed).standard_normal(len(u))
        found = smoothed(u, noisy)
        assert np.all(np.diff(found) >= 0.0)
        rising = [np.maximum.accumulate(noisy), found]
        errors.append([np.std(np.diff(one - g(u)) / np.diff(u)) for one in rising])
        largest.append([np.max(np.abs(one - g(u))) for one in rising])
    by_estimates, by_smoothed = np.mean(errors, axis=0)
    assert by_smoothed < 0.75 * by_estimates
    assert np.max(largest, axis=0)[1] < 1.1 * np.max(largest, axis=0)[0]


@pytest.mark.parametrize(('g', 'low', 'high'), [
    (lambda u: u * u, 0.0, 1.0),
    (lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.2, 0.0), -1.0, 1.0),
    (lambda u: -np.clip(u, -0.6, 0.6), -1.0, 1.0)],
    ids=['square', 'dead zone', 'reverse, saturated'])
def test_a_characteristic_is_found(g, low, high):
    found = identified(record(lambda x, u: -x + g(u), low, high))
    one = found.drift.box.inputs.characteristics['valve']
    u = np.linspace(one.values[0], one.values[-1], 101)
    true = (g(u) - g(u[0])) / (g(u[-1]) - g(u[0]))
    assert (one.effect(u) - u[0]) / (u[-1] - u[0]) == pytest.approx(true, abs=0.04)
    assert not any(isinstance(one, NonAffineDrift) for one in found.alternatives)


def test_a_characteristic_is_found_again_with_the_degree_that_it_allows():
    """About the line that the drift seems to be without it, it errs by 6 % of the range."""
    def effect(u):
        return np.sign(u) * np.maximum(np.abs(u) - 0.4, 0.0)

    found = identify_with_characteristics(
        PLANT, [record(lambda x, u: -x - 5.0 * x ** 3 + effect(u), -1.4, 1.4)], degrees=(1, 3),
        methods=methods(20))
    assert found.drift.degree == 3
    one = found.drift.characteristics['valve']
    u = np.linspace(one.values[0], one.values[-1], 101)
    low, high = effect(u[[0, -1]])
    assert (one.effect(u) - u[0]) / (u[-1] - u[0]) == pytest.approx(
        (effect(u) - low) / (high - low), abs=0.025)


def test_the_best_linear_model_has_a_constant_input_matrix():
    """A tank whose inflow also cools it: the drift is linear, the effect of the input is not."""
    found = identify(replace(PLANT, input_matrix_degree=1),
                     [record(lambda x, u: 1.0 - x - 0.8 * x * u, -0.5, 1.0)], degrees=(1,),
                     methods=methods(20))
    assert found.drift.varying_input_matrix
    assert not found.linear.varying_input_matrix
    errors = [np.mean(prediction_error(rate, Segments.of(found.held_out, PERIOD), np.ones(1)))
              for rate in (found.drift.rate, found.linear.rate)]
    assert errors[0] < 0.7 * errors[1]


@pytest.mark.parametrize('seed', range(2))
def test_a_linear_input_has_none(seed):
    found = identified(record(lambda x, u: -x + u, -1.0, 1.0, seed))
    assert not found.drift.box.inputs.characteristics
    assert (found.warnings, found.alternatives) == ((), ())


@pytest.mark.parametrize('given', [{}, {'valve': [0.0, 0.0, 0.5, 0.25, 1.0, 1.0]}],
                         ids=['found', 'given'])
def test_the_model_file_has_it_and_the_free_run_uses_it(given, tmp_path):
    episode = record(lambda x, u: -x + u * u, 0.0, 1.0)
    task = TrainingTask(
        (), str(tmp_path / 'model.safetensors'), '',
        (RecordedState('level', 'm', place('level', 'level', 'm')),),
        (RecordedInput('valve', '1', place('valve', 'valve', '1')),), model_class='linear',
        dead_time={'valve': 0.0}, characteristics=given)
    with quick_retraining(4, degrees=(1,)):
        retrained = retrain(task, record=read({
            'time [s]': episode.time, 'level [m]': episode.x[:, 0], 'valve [1]': episode.u[:, 0]},
            'level', 'valve'))
    assert retrained.accepted
    model = load(retrained.model_file)
    assert str(model.inputs.characteristics['valve']) in str(model)
    assert len(model.inputs.characteristics['valve'].values) == (3 if given else 21)
    assert retrained.summary()['characteristics'].keys() == {'valve'}
    assert retrained.free_runs['record'].fit[0] > (90.0 if given else 98.0)


def test_one_that_acts_on_a_state_that_is_not_measured_is_found(monkeypatch):
    """A valve fills a tank that drains into the measured one."""
    monkeypatch.setattr(structure_search, 'MOST_UNMEASURED', 1)
    rng = np.random.default_rng(0)
    step = expm(PERIOD * np.array([[-1.0, 1.0, 0.0], [0.0, -0.5, 1.0], [0.0, 0.0, 0.0]]))[:2]
    u = np.repeat(rng.uniform(0.0, 1.0, 100), 8)
    x = np.zeros((len(u), 2))
    for k in range(len(u) - 1):
        x[k + 1] = step @ np.append(x[k], 30.0 ** (u[k] - 1.0))
    time = PERIOD * np.arange(len(u))
    noise = NOISE * np.std(x[:, 0]) * rng.standard_normal(len(u))
    episode = Episode(time, (x[:, 0] + noise)[:, None], time, u[:, None])
    # to the measured state alone the effect seems to rise and fall
    with pytest.raises(NotMonotoneError):
        identified(episode)
    found = structure_search.with_characteristics(
        PLANT, [episode], ['valve'], dead_times=False).characteristics['valve']
    u = np.linspace(found.values[0], found.values[-1], 101)
    true = (30.0 ** u - 30.0 ** u[0]) / (30.0 ** u[-1] - 30.0 ** u[0])
    assert (found.effect(u) - u[0]) / (u[-1] - u[0]) == pytest.approx(true, abs=0.04)


def test_one_that_is_given_is_kept():
    episode = record(lambda x, u: -x + u * u, 0.0, 1.0)
    line = {'valve': Characteristic.of([0.0, 1.0], [0.0, 1.0])}
    found = identified(episode, replace(PLANT, characteristics=line), given=line)
    assert found.drift.box.inputs.characteristics.keys() == line.keys()
    assert len(found.drift.box.inputs.characteristics['valve'].values) == 2


def test_an_effect_that_rises_and_falls_is_rejected():
    with pytest.raises(ValueError, match='valve rises and falls'):
        identified(record(lambda x, u: -x + u * u, -1.0, 1.0))


def test_a_search_does_not_end_at_an_effect_that_rises_and_falls():
    found, candidates = identify_measured(
        PLANT, [record(lambda x, u: -x + u * u, -1.0, 1.0)], degrees=(1,), methods=methods(20))
    assert any('valve rises and falls' in warning for warning in found.warnings)
    assert not found.drift.characteristics
    assert candidates == {'valve'}


def test_a_drift_that_is_not_affine_in_the_input_competes():
    def rate(x, u):
        return -x + u - 0.8 * x * u * u

    found = identified(record(rate, -1.0, 1.0))
    assert 'not affine in valve' in found.warnings[-1]
    other = found.alternatives[0]
    assert isinstance(other, NonAffineDrift)
    x, u = (np.random.default_rng(0).uniform(-0.4, 0.4, (2, 50, 1)))
    errors = [np.std(one.rate(x, u) - rate(x, u)) for one in (other, found.drift)]
    assert errors[0] < 0.5 * errors[1]


def test_products_of_many_states_are_left_out_and_said():
    """As their number rises with the square of the states, they would take minutes."""
    rng = np.random.default_rng(0)
    names = tuple(f'level_{k}' for k in range(6))
    plant = PlantDescription('line', names, ('m',) * 6, ('valve', 'pump'), ('1', '1'), 's',
                             np.full(6, np.nan), np.full(2, np.nan), None)
    u = np.repeat(rng.uniform(-1.0, 1.0, (125, 2)), 6, axis=0)
    x = np.zeros((750, 6))
    for k in range(749):
        x[k + 1] = x[k] + PERIOD * (np.append(u[k, 0], x[k, :-1]) - x[k] + 0.5 * u[k, 1])
    time = PERIOD * np.arange(750)
    (said,) = identified(Episode(time, x, time, u), plant, given=plant.input_names).steps
    assert said.startswith('left out: 336 products')
