# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Loops in which the command of an input is a state of the model, whose rate the laws set."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.control import Controller, Mode, State
from koopman_ros.control.laws import Weights
from koopman_ros.core.datasets import DriftSamples, PlantDescription
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.evaluation.model_comparison import compare, PredictionWindows
from koopman_ros.learning.lift.edmd import Edmd
from koopman_ros.tuning import InputLimits, Tuning

PERIOD, LAG, LIMIT = 0.2, 0.2, 0.7


def rate(x, u):
    return -x + u + x * u * u


@pytest.fixture(scope='module')
def model():
    rng = np.random.default_rng(0)
    x = rng.uniform([-1.2, -LIMIT], [1.2, LIMIT], (400, 2))
    u = rng.uniform(-LIMIT, LIMIT, (400, 1))
    rates = np.column_stack((rate(*x.T), (u[:, 0] - x[:, 1]) / LAG))
    plant = PlantDescription(
        'tank', ('level', 'commanded_valve'), ('m', '1'), ('valve',), ('1',), 's', np.zeros(2),
        np.zeros(1), np.array([[0.0], [1.0 / LAG]]))
    return Edmd(3).learn(plant, DriftSamples(x, rates, u, np.arange(400) % 5))


def run(model, count=60, goal=0.5, late=0, manual=None, **tuning):
    """Return levels, commands and reports of a loop on the plant, whose input acts later."""
    controller = Controller(model, replace(Tuning.for_model(model), **tuning))
    assert controller.measured.names == controller.controlled.names == ('level',)
    state, x, path, commands, reports = State(), 0.0, [], [0.0] * late, []
    for k in range(1, count):
        if k == 5:
            state, rejection = controller.request_setpoint(state, np.array([goal]))
            assert rejection is None
        if manual is not None and k in manual:
            state = controller.set_mode(state, manual[k])
        state, command, report = controller.step(state, np.array([x]), k * round(
            PERIOD * NANOSECONDS))
        commands.append(float(command[0]))
        reports.append((report, state))
        acting = commands[-1 - late]
        for _ in range(4):
            x = runge_kutta_step(lambda x, u=acting: rate(x, u), x, PERIOD / 4)
        path.append(x)
    return np.array(path), np.array(commands[late:]), reports


@pytest.mark.parametrize('law', ['sdre', 'linear', 'mpc'])
def test_the_command_is_the_integral_of_the_law(model, law):
    path, commands, reports = run(model, fallback_order=(law,), observer_bandwidth=1.0)
    assert {report.level for report, _ in reports} == {law}
    assert path[-1] == pytest.approx(0.5, abs=2e-3)
    assert rate(path[-1], commands[-1]) == pytest.approx(0.0, abs=5e-3)
    # the state that is the command is the one that acted until the measurement
    states = model.states
    found = [states.to_physical(state.estimate.x)[1] for _, state in reports[1:]]
    np.testing.assert_allclose(found, commands[:-1], atol=1e-9)


def test_a_plan_costs_hardly_less_than_the_riccati_law(model):
    costs = []
    for law in ('sdre', 'mpc'):
        path, commands, _ = run(model, fallback_order=(law,))
        costs.append(np.sum((path - 0.5) ** 2) + np.sum((commands - commands[-1]) ** 2))
    assert costs[0] < 1.05 * costs[1]


@pytest.mark.parametrize('law', ['sdre', 'mpc'])
def test_limits_are_those_of_the_command(model, law):
    limits = InputLimits(np.array([-0.6]), np.array([0.45]), np.array([0.15]))
    path, commands, _ = run(model, 120, fallback_order=(law,), limits=limits)
    assert np.max(commands) <= 0.45
    assert np.max(np.abs(np.diff(commands))) <= 0.15 * PERIOD + 1e-12
    assert path[-1] == pytest.approx(0.5, abs=2e-3)


def test_after_manual_mode_the_law_begins_at_the_command(model):
    _, commands, _ = run(model, fallback_order=('sdre',), manual={
        30: Mode.MANUAL, 40: Mode.AUTOMATIC})
    np.testing.assert_allclose(np.diff(commands[30:45]), 0.0, atol=2e-3)


def test_it_acts_on_the_prediction_over_a_dead_time(model):
    path, _, _ = run(model, 100, late=4, dead_time=np.array([4 * PERIOD]),
                     fallback_order=('sdre',))
    assert np.max(path) < 0.51
    assert path[-1] == pytest.approx(0.5, abs=2e-3)


def test_recent_measurements_are_predicted_with_commands_that_act_at_once(model):
    loop = Controller(model, Tuning.for_model(model))
    u = np.repeat(np.random.default_rng(0).uniform(-0.6, 0.6, 10), 5)[:, None]
    path = [np.zeros(1)]
    for value in u:
        x = path[-1]
        for _ in range(4):
            x = runge_kutta_step(lambda x, u=value: rate(x, u), x, PERIOD / 4)
        path.append(x)
    windows = PredictionWindows(np.array(path), u, np.full(len(u), PERIOD), np.arange(
        30, 50)[None])
    found = compare(loop, loop, windows)
    assert found is not None
    assert found.candidate[0] < 0.01


def test_the_weight_of_the_input_is_one_of_its_command(model):
    weights = Weights.physical(model, [2.0, 0.0], [3.0])
    assert weights.Q[1, 1] == pytest.approx(3.0 * model.states.scale[1] ** 2)
    assert 0.0 < weights.R[0, 0] < 0.2 * 3.0 * model.inputs.scale[0] ** 2
