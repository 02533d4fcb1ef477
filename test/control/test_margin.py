# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The delay margin of a loop against an analytic one and against simulated loops; defaults."""

from dataclasses import replace
import math

import numpy as np
import pytest

from koopman_ros.control import Controller, State, Tuning
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.estimation import Estimate
from koopman_ros.model import Coordinates, linearised_model, Provenance
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.tuning import largest_bandwidth
from support.closed_loops import shipped


def first_order(rate, gain, interval, dead_time=0.0):
    """Return a model of dx/dt = -rate x + gain u, sampled by an interval in s, with noise."""
    signals = (Coordinates((name,), ('m',), np.zeros(1), np.ones(1), -np.ones(1), np.ones(1))
               for name in 'xu')
    return replace(linearised_model(
        np.array([[-rate]]), np.array([[gain]]), *signals, 's', Provenance(
            plant='', metrics={'noise': 0.01, 'sample_interval': interval})),
        dead_time=np.array([dead_time]))


def spread(controller, rate, gain, interval, dead_time, duration):
    """Return how far a loop moves in the last third of a time, from a start beside its target."""
    x, decay = 0.02, math.exp(-rate * interval)
    state, seen, late = State(), [], round(dead_time / interval)
    commands = [0.0] * (late + 1)
    for k in range(round(duration / interval)):
        state, u, _ = controller.step(state, np.array([x]), round(k * interval * SECOND))
        if k == 0:
            state, rejected = controller.request_setpoint(state, np.zeros(1))
            assert rejected is None
        commands.append(float(u[0]))
        x = decay * x + gain * (1.0 - decay) / rate * commands[-1 - late]
        seen.append(x)
    return np.ptp(seen[-len(seen) // 3:])


@pytest.mark.parametrize('interval', [0.05, 0.5])
def test_the_margin_of_a_sampled_integrator_is_the_analytic_one(interval):
    model = first_order(0.0, 1.0, interval)
    loop = Controller(model, Tuning.for_model(model, estimator='measured_state'))
    here = Estimate(np.array([0.01]), np.zeros(1))
    u = loop.best.compute(np.zeros(1), here, None, interval, None, None)[1].u
    gain = -float(u[0]) / 0.01
    # of gain h / (z - 1)
    omega = 2.0 / interval * math.asin(0.5 * gain * interval)
    assert loop.delay_margin == pytest.approx(0.5 * math.pi / omega - 0.5 * interval, rel=1e-3)


@pytest.mark.parametrize(('dead_time', 'settings'), [
    (0.0, {'estimator': 'extended_kalman_filter', 'disturbance_noise': np.array([0.5])}),
    (20.0, {'estimator': 'disturbance_observer', 'observer_bandwidth': 0.05}),
    (20.0, {'estimator': 'extended_kalman_filter', 'disturbance_noise': np.array([0.02])})])
def test_a_loop_is_stable_up_to_its_margin(dead_time, settings):
    rate, interval = 1.0 / 60.0, 2.0
    model = first_order(rate, rate, interval, dead_time)
    loop = Controller(model, Tuning.for_model(model, **settings))
    loop = replace(loop, tuning=replace(loop.tuning, sensor=replace(
        loop.tuning.sensor, stuck_sensor_timeout=0.0)))
    margin = loop.delay_margin
    assert 4.0 < margin < 100.0
    for share, stable in ((0.7, True), (1.5, False)):
        delay = dead_time + 2.0 * round(share * margin / 2.0)
        moved = spread(loop, rate, rate, interval, delay, 600.0 + 15.0 * margin)
        assert (moved < 4e-3) == stable, (margin, delay, moved)


def load_error(command, time_constant, dead_time, interval):
    """Return the integral of the error after a load step of one input, behind a dead time."""
    x, decay, late = 0.0, math.exp(-interval / time_constant), round(dead_time / interval)
    commands, total = [0.0] * (late + 1), 0.0
    for k in range(round((10.0 * dead_time + 6.0 * time_constant) / interval)):
        commands.append(command(k, x))
        x = decay * x + (1.0 - decay) * (commands[-1 - late] + 0.1)
        total += abs(x) * interval
    return total


@pytest.mark.parametrize(('dead_time', 'share'), [(30.0, 1.0), (120.0, 0.7), (120.0, 1.3)])
def test_a_load_step_behind_a_dead_time_costs_no_more_than_with_a_tuned_pi_controller(
        dead_time, share):
    time_constant, interval = 62.0, dead_time / 20.0
    rate = 1.0 / time_constant
    model = first_order(rate, rate, interval, dead_time)
    loop = Controller(model, Tuning.for_model(
        model, estimator='disturbance_observer',
        observer_bandwidth=largest_bandwidth(dead_time, rate)))
    loop = replace(loop, tuning=replace(loop.tuning, sensor=replace(
        loop.tuning.sensor, stuck_sensor_timeout=0.0)))
    state = loop.initialise(State(), np.zeros(1))

    def controlled(k, x):
        nonlocal state
        state, u, _ = loop.step(state, np.array([x]), round(k * interval * SECOND))
        return float(u[0])

    # by the rules of Skogestad
    late = dead_time + 0.5 * interval
    gain, reset, integral = time_constant / (2.0 * late), min(time_constant, 8.0 * late), 0.0

    def pi(k, x):
        nonlocal integral
        integral -= gain * x * interval / reset
        return integral - gain * x

    costs = [load_error(law, time_constant, share * dead_time, interval)
             for law in (controlled, pi)]
    assert costs[0] <= 1.05 * costs[1]


@pytest.mark.parametrize('interval', [0.5, 2.0, 8.0])
@pytest.mark.parametrize('dead_time', [0.0, 30.0])
def test_a_filter_has_by_default_at_least_the_margin_of_the_observer(interval, dead_time):
    model = first_order(1.0 / 60.0, 1.0 / 120.0, interval, dead_time)
    bandwidth = 1.0 / 60.0 if dead_time == 0.0 else largest_bandwidth(dead_time, 1.0 / 60.0)
    observer, kalman = (Controller(model, Tuning.for_model(model, estimator=name, **given))
                        for name, given in (
                            ('disturbance_observer', {'observer_bandwidth': bandwidth}),
                            ('extended_kalman_filter', {})))
    assert kalman.delay_margin >= observer.delay_margin > max(30.0, dead_time)


@pytest.mark.parametrize('name', ['two_tanks', 'fed_reactor', 'reactor_nz4'])
def test_so_have_shipped_models(name):
    model = shipped(name)
    table = table_of(model, {'system': ''})
    observer, kalman = (built(table.amended(table.snapshot({}), estimator=estimator), model)
                        for estimator in ('disturbance_observer', 'extended_kalman_filter'))
    assert kalman.delay_margin >= observer.delay_margin


def test_a_controller_shows_its_margin_and_a_tuning_without_effect():
    model = first_order(1.0 / 60.0, 1.0 / 60.0, 2.0)
    loop = Controller(model, Tuning.for_model(
        model, estimator='extended_kalman_filter', observer_bandwidth=0.1))
    shown = str(loop)
    assert f'{loop.delay_margin:.3g} s' in shown
    assert 'observer_bandwidth = 0.1 1/s has no effect' in shown
    observing = Controller(model, Tuning.for_model(model, observer_bandwidth=0.1))
    assert 'no effect' not in str(observing)
    # a law without a model has no margin that could be calculated
    assert math.isnan(replace(observing, tuning=replace(
        observing.tuning, fallback_order=('pi',))).delay_margin)
