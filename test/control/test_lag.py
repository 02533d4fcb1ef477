# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Closed loops whose input follows its command with a lag, which is a part of the model."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.control import Controller, InputLimits, SetpointRequest, State
from koopman_ros.core.datasets import DriftSamples, PlantDescription
from koopman_ros.estimation import DisturbanceObserver, Estimate
from koopman_ros.evaluation import at, exchange, perfect, run_loop
from koopman_ros.evaluation.optimal_cost import cost_along, optimum, Task
from koopman_ros.event_log.records import decoded, encoded
from koopman_ros.learning.lift.edmd import Edmd
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.plants import Actuator, ControlAffineSystem, equilibrium_input, Process
from koopman_ros.plants.process import _with_input_lag
from koopman_ros.tuning import Tuning
from support.closed_loops import COOLANT, FOULED, REACTOR, SECOND, SETPOINT, shipped, START
from support.lagged_reactor import lagged_model

BEGIN = 5.0
# as the optimum has them
NO_LIMITS = {'coolant_temperature.rate_limit': 0.0, 'coolant_temperature.min': -20.0,
             'coolant_temperature.max': 100.0}


def controller_of(model, **given):
    table = table_of(model, given)
    loop = built(table.amended(table.snapshot({}), **given), model)
    # without noise a plant at rest is like a sensor that is stuck
    return replace(loop, tuning=replace(loop.tuning, sensor=replace(
        loop.tuning.sensor, stuck_sensor_timeout=0.0)))


def step(loop, lag, duration, *events, plant=REACTOR, period=1.0):
    x = np.array([START])
    u = equilibrium_input(plant, x)
    run = run_loop(loop, Process(plant, 0, x, u, Actuator(lag=lag), u), [
        at(BEGIN, SetpointRequest(0, np.array([SETPOINT]))), *events], duration=duration,
        period=period, state=loop.initialise(State(), u), input_sensor=perfect, C=np.eye(1))
    assert not run.failure
    assert set(run.levels) == {'sdre'}
    return run


@pytest.mark.parametrize(('lag', 'duration', 'least'), [
    # K^2 min of the step, found by `optimum`
    (18.0, 120.0, 44.01), (60.0, 180.0, 77.30)])
def test_a_law_with_the_lag_in_its_model_is_nearly_optimal(lag, duration, least):
    task = Task(_with_input_lag(REACTOR, np.array([lag / 60.0]), lambda u: u), np.zeros(2),
                np.array([SETPOINT, COOLANT]), np.array([COOLANT]), np.array([1.0, 0.0]),
                np.ones(1), 1.0 / 60.0, 0)
    run = step(controller_of(lagged_model(lag), **NO_LIMITS), lag, duration)
    assert SETPOINT - run.states.min() < 0.3
    begin = int(BEGIN)
    assert cost_along(task, np.hstack([run.states, run.inputs])[begin:],
                      run.commands[begin:]) < 1.05 * least
    # beside the same controller with a model without the lag
    ignorant = step(controller_of(shipped('reactor_nz4'), **NO_LIMITS), lag, duration)
    assert SETPOINT - ignorant.states.min() > 0.3


@pytest.mark.parametrize(('lag', 'duration', 'settings'), [
    (18.0, 300.0, {}), (60.0, 440.0, {'estimator': 'extended_kalman_filter',
                                      'coolant_temperature.disturbance_noise': 1.3})])
def test_a_lag_leaves_no_offset_on_a_changed_plant(lag, duration, settings):
    loop = controller_of(lagged_model(lag), **settings)
    run = step(loop, lag, duration, plant=FOULED, period=2.0)
    assert abs(run.states[-1, 0] - SETPOINT) < 0.02
    assert SETPOINT - run.states.min() < 0.8
    # the applied input is calculated, and the disturbance an equivalent change of it
    estimate, states = run.loop.state.estimate, loop.model.states
    assert states.to_physical(estimate.x)[1] == pytest.approx(run.inputs[-1, 0], abs=0.01)
    assert estimate.w[1] == 0.0
    missing = loop.best.estimator.as_input(estimate.w)[0] * loop.model.inputs.scale[0]
    assert missing == pytest.approx(COOLANT - run.inputs[-1, 0], abs=0.6)


def test_an_exchange_a_restart_and_a_record_keep_the_applied_input():
    model = lagged_model(60.0)
    loop = controller_of(model)
    assert isinstance(loop.best.estimator, DisturbanceObserver)
    assert (loop.measured.names, loop.controlled.names) == (('temperature',), ('temperature',))
    whole = step(loop, 60.0, 60.0)
    again = step(loop, 60.0, 60.0, at(20.0, exchange(replace(loop))),
                 at(30.0, lambda now: replace(now, state=decoded(encoded(now.state)))))
    np.testing.assert_allclose(again.commands, whole.commands, rtol=0, atol=1e-9)
    # a model without it takes over, and this one again
    before = whole.loop.state
    other = controller_of(shipped('reactor_nz4'))
    back = loop.switch_to(other, other.switch_to(loop, before))
    u = float(model.inputs.to_physical(model.inputs.to_deviation(before.command))[0])
    for state in (back, loop.step(loop.initialise(State(), before.command),
                                  whole.measured[-1], SECOND)[0]):
        assert model.states.to_physical(state.estimate.x)[1] == pytest.approx(u)
        assert state.estimate.w[1] == 0.0


@pytest.mark.parametrize(('given', 'measured', 'estimator'), [
    ({}, ('temperature',), 'DisturbanceObserver'),
    ({'estimator': 'measured_state'}, ('temperature',), 'MeasuredState'),
    ({'estimator': 'extended_kalman_filter'}, ('temperature',), 'ExtendedKalmanFilter'),
    ({'states_measured': ('temperature [K]', 'applied_coolant_temperature [K]')},
     ('temperature', 'applied_coolant_temperature'), 'DisturbanceObserver')])
def test_the_applied_input_is_measured_or_not(given, measured, estimator):
    loop = controller_of(lagged_model(18.0), **given)
    assert loop.measured.names == measured
    assert type(loop.best.estimator).__name__ == estimator
    assert loop.tuning.state_weight[1] == 0.0 or len(measured) == 2
    x = np.array([START, float(loop.model.inputs.center[0])])[:len(measured)]
    state = loop.step(State(), x, SECOND)[0]
    assert isinstance(state.estimate, Estimate)
    # what is measured of the input is not taken for a command that was not reached
    late, follows = loop.estimation.applied(state, state.command - 5.0)
    assert follows
    np.testing.assert_array_equal(late.command, state.command)


SLOW, VALVE_LAG = 60.0, 20.0  # s
TANK = ControlAffineSystem(
    'tank', ('level',), ('m',), ('valve',), ('percent',), 's', drift=lambda x: -x / SLOW,
    B=np.array([[0.01 / SLOW]]), nominal_state=np.array([0.3]), nominal_input=np.array([30.0]))
VALVE = Actuator(lower=0.0, upper=100.0, lag=VALVE_LAG, rangeability=30.0)


def tank_model():
    """Return a polynomial model of level and valve, which is not exact for the valve's curve."""
    x = np.stack(np.meshgrid(np.linspace(0.02, 0.6, 15), np.linspace(5.0, 95.0, 31)),
                 axis=-1).reshape(-1, 2)
    u = x[::-1, 1:]
    rates = np.hstack([TANK.derivative(x[:, :1], VALVE.effect(x[:, 1:])),
                       (u - x[:, 1:]) / VALVE_LAG])
    center = float(VALVE.position(np.array([30.0]))[0])
    plant = PlantDescription(
        'tank', ('level', 'applied_valve'), ('m', 'percent'), ('valve',), ('percent',), 's',
        np.array([0.3, center]), np.array([center]), np.array([[0.0], [1.0 / VALVE_LAG]]))
    return Edmd(5).learn(plant, DriftSamples(x, rates, u, np.arange(len(x)) % 5))


@pytest.mark.parametrize(('start', 'step'), [(0.3, 0.001), (0.15, 0.3)])
def test_behind_a_lag_and_a_valve_steps_of_any_size_are_nearly_optimal(start, step):
    """Of a step far below the model's steady-state error, the observer takes that error away."""
    model = tank_model()
    loop = Controller(model, replace(
        Tuning.for_model(model), observer_bandwidth=0.05, limits=InputLimits(
            np.zeros(1), np.full(1, 100.0), np.full(1, np.inf))))
    u0, u1 = (VALVE.position(np.array([100.0 * x])) for x in (start, start + step))
    weights = loop.best.law.weights
    task = Task(_with_input_lag(TANK, np.array([VALVE_LAG]), VALVE.effect),
                np.array([start, u0[0]]), np.array([start + step, u1[0]]), u1,
                np.diag(weights.Q) / model.states.scale ** 2,
                np.diag(weights.R) / model.inputs.scale ** 2, 1.0, 200)
    assert task.Q[1] == 0.0
    run = run_loop(loop, Process(TANK, 0, np.array([start]), u0, VALVE, u0), [
        at(0.0, SetpointRequest(0, np.array([start]))),
        at(BEGIN, SetpointRequest(0, np.array([start + step])))], duration=BEGIN + 199.0,
        C=np.eye(1), state=loop.initialise(State(), u0))
    assert set(run.levels) == {'sdre'}
    begin = int(BEGIN)
    cost = cost_along(task, np.hstack([run.states, run.inputs])[begin:], run.commands[begin:])
    assert cost < 1.05 * optimum(task).cost
