# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drifts of plants of which one output is in the record, beside what is known of them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import fsolve

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.learning.identification import (
    DriftModel,
    identify_structure,
    identify_unmeasured,
    network_candidates,
    Stopped,
    unmeasured_states,
)
from koopman_ros.learning.identification.drift import longest_step, prediction_error, Segments
from koopman_ros.learning.identification.network_drift import NetworkDrift
from koopman_ros.learning.identification.polynomial_candidates import PolynomialSearch
from support.known_plants import box, methods

PLANT = PlantDescription('one output', ('level',), ('m',), ('flow',), ('l/s',), 's', np.zeros(1),
                         np.zeros(1), None)
PERIOD, NOISE = 0.2, 0.02


@pytest.fixture(autouse=True)
def one_network(monkeypatch):
    """Try one network only."""
    monkeypatch.setattr(network_candidates, 'UNITS', (3,))
    monkeypatch.setattr(network_candidates, 'STARTS', 1)


A = np.array([[-0.5, 1.0], [-0.8, -0.2]])
B = np.array([0.0, 1.0])


def oscillator(x, u):
    """Damped, moved through what is not measured."""
    return A @ x + B * u


def saddle(x, u):
    """Unstable in the origin, and moved where it is measured."""
    y, w = x
    return np.array([0.6 * y + w + u, -w - 0.5 * y + 0.3 * y ** 2])


def record(rate, *, samples=1200, gain=0.0, size=1.0, seed=0):
    """Return noisy outputs of a plant under steps of random height and length, fed back."""
    rng = np.random.default_rng(seed)
    x, wanted, left = np.zeros(2), 0.0, 0
    measured, inputs = np.empty((samples, 1)), np.empty((samples, 1))
    for k in range(samples):
        if not left:
            wanted, left = rng.uniform(-size, size), int(rng.integers(5, 40))
        left -= 1
        measured[k] = x[0] + NOISE * rng.standard_normal()
        u = inputs[k, 0] = wanted - gain * measured[k, 0]
        x = runge_kutta_step(lambda x, u=u: rate(x, u), x, PERIOD)
    time = PERIOD * np.arange(samples)
    return Episode(time, measured, time, inputs)


def test_modes_and_gain_of_a_linear_plant():
    found = identify_unmeasured(PLANT, [record(oscillator, samples=600)], 2, highest_degree=1)
    drift = found.drift
    # as few as suffice
    assert {score.method.partition(', ')[2] for score in found.scores} == {
        '1 state not measured', '2 states not measured'}
    assert found.hidden == 1
    assert drift.box.states.names == ('level', 'hidden_1')
    assert drift.box.states.units == ('m', '1')
    slope = drift.slope(drift.box.states.center)
    # neither depends on the coordinates
    assert np.sort_complex(np.linalg.eigvals(slope)) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(A)), rel=0.02)
    gain = -np.linalg.solve(slope, drift.input_matrix)[0, 0]
    assert gain == pytest.approx(-np.linalg.solve(A, B)[0], rel=0.01)
    # nothing disturbs the plant, so that a simulation errs by the noise alone
    assert found.method.startswith('output error')
    assert min(score.rmse[0] for score in found.scores) == pytest.approx(NOISE, rel=0.3)
    assert found.noise[0] == pytest.approx(NOISE, rel=0.15)


@pytest.mark.parametrize(('rate', 'hidden'), [
    (oscillator, 1), (lambda x, u: np.array([u - 0.4 * x[0] - 0.1 * x[0] ** 3, -x[1]]), 0)])
def test_states_are_added_where_the_measured_ones_do_not_explain_the_record(rate, hidden):
    found = identify_structure(PLANT, [record(rate, samples=500)], methods=methods(20))
    assert found.hidden == hidden
    assert bool(found.steps) == bool(hidden)
    # with a state more the plant is explained no better
    assert ('unmeasured_states' in found.searched) == bool(hidden)


@pytest.mark.parametrize(('curvature', 'degree'), [(0.0, 1), (0.015, 2)])
def test_a_curvature_that_is_small_beside_the_noise_is_learned(curvature, degree):
    found = identify_unmeasured(PLANT, [record(
        lambda x, u: oscillator(x, u) - np.array([0.0, curvature * x[0] ** 2]), samples=800)], 1,
        networks=False, dead_times=False)
    linear = max(score.rmse[0] for score in found.scores)
    # so little above the noise that a filter, which sees each measurement, might not show it
    assert linear < 1.1 * NOISE
    assert found.drift.degree == degree


def test_an_input_may_act_by_a_product_with_the_state():
    found = identify_structure(PLANT, [record(
        lambda x, u: np.array([-x[0] + (1.0 + 0.5 * x[0]) * u, -x[1]]), samples=500)],
        methods=methods(20))
    assert found.hidden == 0
    assert found.drift.input_matrix_at(np.array([[0.5], [-0.5]])).ravel() == pytest.approx(
        [1.25, 0.75], rel=0.05)
    assert 'B of degree 1' in found.steps[-1]
    assert found.searched == ('input_matrix_degree',)


def test_the_best_so_far_is_taken_when_the_time_is_over():
    found = identify_unmeasured(PLANT, [record(oscillator, samples=400)], 2, budget=0.0)
    assert found.hidden == 1
    assert any('stopped after 0 s: drift of degree 1 with 2' in step for step in found.steps)


def test_an_order_whose_simulations_diverge_is_said(monkeypatch):
    linear = PolynomialSearch.linear
    monkeypatch.setattr(PolynomialSearch, 'linear', lambda self, hidden, monitor: (
        None if hidden == 1 else linear(self, hidden, monitor)))
    found = identify_unmeasured(PLANT, [record(oscillator, samples=400)], 2, budget=0.0)
    assert found.hidden == 2
    assert 'drift of degree 1 with 1 state not measured: diverges' in found.steps


def test_a_model_is_not_dropped_because_its_filter_diverges(monkeypatch):
    def diverges(*_):
        raise ValueError('the estimate of the unmeasured states diverges')

    monkeypatch.setattr(unmeasured_states, '_with_gain', diverges)
    whole = record(oscillator, samples=400)
    found = identify_unmeasured(PLANT, [whole], 1, highest_degree=1, networks=False,
                                dead_times=False)
    slope = found.drift.slope(found.drift.box.states.center)
    assert np.sort_complex(np.linalg.eigvals(slope)) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(A)), rel=0.03)
    # the unmeasured state is that of the simulation: it moves at its rate, without noise
    for part in found.episodes:
        held = part.inputs_at(part.time)[:-1]
        begin, end = (found.drift.rate(x, held)[:, 1] for x in (part.x[:-1], part.x[1:]))
        change = np.diff(part.x[:, 1]) / PERIOD
        assert change == pytest.approx(0.5 * (begin + end), abs=0.3 * np.std(begin))


def test_a_constant_disturbance_of_each_day_is_no_part_of_the_drift():
    pushes = np.array([0.5, -0.2])
    days = [record(lambda x, u, push=push: oscillator(x, u) + np.array([push, 0.0]),
                   samples=400, seed=seed)
            for seed, push in enumerate(pushes)]
    found = identify_unmeasured(PLANT, days, 1, highest_degree=1)
    drift = found.drift
    assert drift.box.inputs.names == ('flow',)
    # as it moves the steady state, whatever the coordinates
    slope = drift.slope(drift.box.states.center)
    assert found.shifts[:, 0] == pytest.approx(-np.linalg.solve(A, [1.0, 0.0])[0] * (
        pushes - np.mean(pushes)), rel=0.05)
    assert np.sort_complex(np.linalg.eigvals(slope)) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(A)), rel=0.03)
    assert any('offset of each episode' in step for step in found.steps)
    # segments have that of their episode
    for some in (found.fitted, found.held_out):
        data = Segments.of(some, longest_step(some))
        error = prediction_error(drift.rate, data, drift.box.states.scale)
        assert error[0] == pytest.approx(found.noise[0], rel=0.3)


def test_offsets_of_two_days_are_no_unmeasured_states():
    def heated(x, u):
        return np.array([-0.2 * x[0] + 0.5 * u, 0.0])

    shifts = np.array([-1.0, 2.0])  # of the thermometer
    days = [record(heated, samples=400, seed=seed) for seed in range(2)]
    days = [replace(day, x=day.x + shift) for day, shift in zip(days, shifts, strict=True)]
    found = identify_structure(PLANT, days)
    drift = found.drift
    assert drift.box.states.names == ('level',)
    assert drift.degree == 1
    assert found.shifts[:, 0] == pytest.approx(shifts - np.mean(shifts), abs=0.01)
    assert drift.slope(drift.box.states.center) == pytest.approx(np.array([[-0.2]]), rel=0.02)


def test_steady_states_of_an_unstable_plant_from_closed_loop():
    found = identify_unmeasured(PLANT, [record(saddle, samples=700, gain=2.0, size=1.5)], 1,
                                highest_degree=2, dead_times=False)
    drift = found.drift
    assert drift.degree >= 2
    for y in (-0.3, 0.0, 0.3):
        hidden, u = fsolve(lambda q, y=y: drift.rate(np.array([y, q[0]]), q[1:]), [0.0, 0.0])
        assert u == pytest.approx(-0.1 * y - 0.3 * y ** 2, abs=5e-3)
        slope = drift.slope(np.array([y, hidden]))
        truth = np.array([[0.6, 1.0], [-0.5 + 0.6 * y, -1.0]])
        assert np.sort(np.linalg.eigvals(slope)) == pytest.approx(
            np.sort(np.linalg.eigvals(truth)), abs=0.06)
    # roll-outs of the segments grow by no more than can be judged
    longest = max(part.time[-1] - part.time[0] for part in found.held_out)
    assert 0.24 * longest < 3.0
    # the linear model of the same states is worse
    x = np.concatenate([part.x for part in found.held_out])
    u = np.zeros((len(x), 1))
    assert np.max(np.abs(found.linear.rate(x, u) - drift.rate(x, u))) > 0.05


def test_a_known_input_matrix_is_kept():
    gain = 1.0
    moved = record(lambda x, u: A @ x + np.array([gain, 0.0]) * u, samples=400)
    found = identify_unmeasured(replace(PLANT, B=np.array([[gain]])), [moved], 1, highest_degree=1,
                                dead_times=False)
    assert found.drift.input_matrix[0, 0] == pytest.approx(gain, rel=1e-12)


def duffing(x, u):
    """Oscillate on a spring that hardens; the speed is not measured."""
    y, w = x
    return np.array([w, u - 0.4 * w - y - 2.0 * y ** 3])


def test_the_simulation_of_a_nonlinear_plant_is_good_on_other_days():
    found = identify_unmeasured(PLANT, [record(duffing, samples=500, size=0.8)], 1,
                                highest_degree=3, dead_times=False, seed=2)
    assert isinstance(found.drift, DriftModel)
    other = record(duffing, samples=400, size=0.8, seed=5)
    settled = slice(100, None)
    errors = [np.sqrt(np.mean((simulated(drift, other)[settled] - other.x[settled, 0]) ** 2))
              for drift in (found.drift, found.linear)]
    assert errors[0] < 1.5 * NOISE < 0.5 * errors[1]


@pytest.mark.parametrize(('grows', 'base_grows', 'allowed'), [
    (-0.2, -0.2, True), (0.2, -0.2, False), (0.2, 0.2, True)])
def test_no_network_that_may_diverge_far_from_the_data_is_offered(grows, base_grows, allowed):
    """Unless the linear model that it is added to does as well."""
    def linear(slope):
        return DriftModel(box([-1.0], [1.0], [-1.0], [1.0]), 1, np.array([[0.0], [slope]]),
                          np.eye(1))

    network = NetworkDrift.added_to(linear(grows), 2, 0, ridge=1e-4, learn_input_matrix=True)
    own = SimpleNamespace(model=SimpleNamespace(drift=linear(base_grows)))
    assert network_candidates.Shared(own, None, True, 1.0).allowed(network) is allowed


def test_a_record_whose_simulations_all_diverge_is_rejected():
    with pytest.raises(ValueError, match='no drift fits the episodes: record longer'):
        identify_unmeasured(replace(PLANT, B=np.array([[1.0]])),
                            [record(saddle, samples=200, gain=2.0, size=0.1)], 1, highest_degree=1,
                            networks=False)


def simulated(drift, episode):
    """Simulate the level, from a start that is forgotten."""
    x = np.array([episode.x[0, 0], drift.box.states.center[1]])
    path = []
    for u in episode.u:
        path.append(x[0])
        x = runge_kutta_step(lambda x, u=u: drift.rate(x, u), x, PERIOD)
    return np.array(path)


def test_progress_is_reported_and_a_cancel_request_ends_the_job():
    said = []

    def watch(done, total, text):
        assert 0 <= done < total
        said.append(text)
        return len(said) > 3

    with pytest.raises(Stopped):
        identify_unmeasured(PLANT, [record(oscillator, samples=600)], 1, watch=watch)
    assert said[0] == 'drift of degree 1 with 1 state not measured'


@pytest.mark.parametrize(('plant', 'samples', 'length', 'words'), [
    (PLANT, 100, 100, 'record at least 160'),
    (PLANT, 600, 40, 'too short for a filter'),
    (replace(PLANT, input_matrix_degree=1), 600, 600, 'set input_matrix_degree to 0')])
def test_unsuitable_records_and_plants_are_rejected(plant, samples, length, words):
    whole = record(oscillator, samples=samples)
    with pytest.raises(ValueError, match=words):
        identify_unmeasured(plant, [whole.part(k, k + length) for k in range(0, samples, length)],
                            1)
