# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lags of inputs: applied inputs of a record, drifts that have them as states, and the search."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.solvers import differences
from koopman_ros.learning.identification import (
    find_dead_times,
    find_lags,
    identify,
    identify_with_characteristics,
    lagged,
    with_lag,
)
from support.known_plants import methods

PLANT = PlantDescription('tank', ('level',), ('m',), ('pump', 'valve'), ('V', '1'), 's',
                         np.full(1, np.nan), np.full(2, np.nan), None)
RATE, GAINS = -0.05, np.array([0.1, -0.04])


def record(lags, count=500, noise=0.01, seed=0):
    """Return an episode of a linear plant whose inputs step at random, behind lags."""
    rng = np.random.default_rng(seed)
    n = len(lags)
    u = np.repeat(rng.uniform(-1.0, 1.0, (count // 10, n)), 10, axis=0)
    rates = 1.0 / np.where(lags, lags, 1e-3)
    A = np.zeros((1 + 2 * n, 1 + 2 * n))
    A[0, 0], A[0, 1:1 + n] = RATE, GAINS[:n]
    A[1:1 + n, 1:1 + n], A[1:1 + n, 1 + n:] = -np.diag(rates), np.diag(rates)
    step, y = expm(A), np.concatenate(([0.0], u[0], u[0]))
    path = []
    for value in u:
        y[1 + n:] = value
        path.append(y[:1 + n])
        y = step @ y
    path = np.array(path)
    time = np.arange(float(count))
    return Episode(time, path[:, :1] + noise * rng.standard_normal((count, 1)), time, u), (
        path[:, 1:])


def plant_of(count):
    names, units = PLANT.input_names[:count], PLANT.input_units[:count]
    return PlantDescription('tank', ('level',), ('m',), names, units, 's', np.full(1, np.nan),
                            np.full(count, np.nan), None)


def test_the_applied_inputs_are_states_and_the_commands_the_inputs():
    lags = np.array([4.0, 0.0])
    episode, applied = record(lags)
    late = lagged(episode, lags)
    assert late.linear == (True, False)
    # once it does not matter what was applied before
    assert late.time[0] == 16.0
    np.testing.assert_allclose(late.inputs_at(late.time), np.column_stack(
        (applied[:, 0], episode.u[:, 1]))[16:], atol=1e-12)
    assert lagged(episode, np.array([200.0, 0.0])) is None
    assert lagged(episode, np.zeros(2)) is episode
    found = with_lag(identify(plant_of(2), [late], degrees=(1,), methods=methods(20)), lags)
    for part in (*found.fitted, *found.held_out):
        np.testing.assert_allclose(part.inputs_at(part.time), episode.inputs_at(part.time),
                                   atol=1e-9)
        np.testing.assert_allclose(part.x[:, 1], np.interp(
            part.time, episode.time, applied[:, 0]), atol=1e-9)
    drift = found.drift
    assert drift.box.states.names == ('level', 'applied_pump')
    assert (found.hidden, drift.box.inputs.names) == (1, PLANT.input_names)
    x, u = np.array([0.3, -0.2]), np.array([0.5, 0.7])
    expected = [RATE * x[0] + GAINS @ [x[1], u[1]], (u[0] - x[1]) / 4.0]
    np.testing.assert_allclose(drift.rate(x, u), expected, atol=0.01)
    # its derivatives are those of its rate
    xi, v = drift.box.states.to_deviation(x), drift.box.inputs.to_deviation(u)
    both = differences(lambda y: drift.scaled_rate(y[..., :2], y[..., 2:]), np.append(xi, v),
                       np.ones(4))
    np.testing.assert_allclose(drift.scaled_slope(xi, v), both[:, :2], atol=1e-6)
    np.testing.assert_allclose(drift.scaled_input_matrix(xi), both[:, 2:], atol=1e-6)


@pytest.mark.parametrize('interval', [0.1, 1.0 / 60.0, 0.7])
def test_commands_behind_a_lag_are_those_of_the_record_whatever_the_rounding(interval):
    episode, lag = record([5.0], noise=0.0)[0], np.array([5.0 * interval])
    late = replace(episode, time=interval * episode.time, input_time=interval * episode.time
                   ).delayed(np.array([3.0 * interval]))
    # what changes at a measurement acts from there on
    np.testing.assert_array_equal(late.inputs_at(late.time), episode.u[:-3])
    found = with_lag(identify(plant_of(1), [lagged(late, lag)], degrees=(1,), methods=methods(20)),
                     lag)
    for part in (*found.fitted, *found.held_out):
        middle = part.input_time[:-1] + 0.5 * np.diff(part.input_time)
        np.testing.assert_allclose(part.u[:-1], late.inputs_at(middle), atol=1e-9)


def test_a_lag_is_found_and_none_where_there_is_none():
    lags = np.array([5.0, 0.0])
    found = find_lags(plant_of(2), [record(lags, 400)[0]], np.zeros(2), range(2))
    np.testing.assert_allclose(found, lags, rtol=0.15)


@pytest.mark.parametrize('lag', [[4.0], [0.0]])
def test_a_characteristic_behind_a_lag_is_one_of_the_applied_input(lag):
    """A valve moves slowly, and its flow depends on where it is."""
    lag = np.array(lag)
    episode, applied = record(lag, 800, noise=0.0)
    x, u = np.zeros(len(episode)), applied[:, 0] if lag[0] else episode.u[:, 0]
    flow = np.interp(u, [-1.0, 0.0, 1.0], [-0.2, 0.0, 1.0])
    for k in range(1, len(x)):
        x[k] = x[k - 1] + RATE * x[k - 1] + 0.5 * (flow[k - 1] + flow[k if lag[0] else k - 1])
    rng = np.random.default_rng(0)
    episode = replace(episode, x=x[:, None] + 0.02 * rng.standard_normal((len(x), 1)))
    found = with_lag(identify_with_characteristics(
        plant_of(1), [lagged(episode, lag)], degrees=(1,), methods=methods(20)), lag)
    drift = found.drift
    one = drift.characteristics['pump']
    values = np.linspace(-0.9, 0.9, 19)
    ends = np.interp(one.values[[0, -1]], [-1.0, 0.0, 1.0], [-0.2, 0.0, 1.0])
    expected = (np.interp(values, [-1.0, 0.0, 1.0], [-0.2, 0.0, 1.0]) - ends[0]) / np.diff(ends)
    effect = (one.effect(values) - one.values[0]) / np.ptp(one.values)
    np.testing.assert_allclose(effect, expected, atol=0.04)
    assert found.linear.characteristics.keys() == drift.box.inputs.characteristics.keys()
    # behind a lag the command acts linearly
    assert bool(drift.box.inputs.characteristics) is not lag.any()
    xi, v = np.array([0.3, -0.4])[:len(drift.box.states)], np.array([0.55])
    n = len(xi)
    both = differences(lambda y: drift.scaled_rate(y[..., :n], y[..., n:]), np.append(xi, v),
                       np.ones(n + 1))
    np.testing.assert_allclose(drift.scaled_slope(xi, v), both[:, :n], atol=1e-6)
    np.testing.assert_allclose(drift.scaled_input_matrix(xi), both[:, n:], atol=1e-6)


def test_a_lag_and_a_dead_time_of_the_same_input_are_found():
    """Where simulations by a cubic drift diverge."""
    lag, late = np.array([3.0]), 12.0
    episode = record(lag, 1000)[0]
    episode = replace(episode, input_time=episode.input_time - late)
    dead_time = find_dead_times([episode], [False]).values
    found = find_lags(plant_of(1), [episode.delayed(dead_time)], np.zeros(1), [0])
    # behind the lag the dead time is found again
    dead_time = find_dead_times([lagged(episode, found)], [False]).values
    np.testing.assert_allclose(dead_time, late, atol=0.5)
    np.testing.assert_allclose(found, lag, rtol=0.15)
