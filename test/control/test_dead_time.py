# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Closed loops whose inputs act late: as without dead time, only later; wrong dead times."""

from dataclasses import replace
from itertools import pairwise
import math

import numpy as np
import pytest
from scipy.linalg import expm

from koopman_ros.control import Controller, InputLimits, SetpointRequest, State
from koopman_ros.control.fallback import PredictionSettings
from koopman_ros.control.laws import StateDependentRiccati
from koopman_ros.core.status import StatusCode
from koopman_ros.estimation import AppliedInputs, Estimate, PendingInputs
from koopman_ros.estimation.kalman_filters import uncertainty
from koopman_ros.evaluation import at, exchange, perfect, run_loop
from koopman_ros.evaluation.optimal_cost import cost_along, Task
from koopman_ros.event_log.records import decoded, encoded
from koopman_ros.model import Coordinates, linearised_model, Provenance
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.plants import (
    Actuator,
    equilibrium_input,
    one_state_reactor,
    Process,
    ReactorParameters,
)
from koopman_ros.tuning import largest_bandwidth, Tuning
from support.closed_loops import COOLANT, FOULED, REACTOR, SECOND, SETPOINT, shipped, START

REACTOR_MODEL = shipped('reactor_nz4')

# K^2 min of the step by a coolant that moves by 1 K/s at most, found by least squares.
LEAST = 33.85


def late_reactor(seconds, known=None, plant=REACTOR, **given):
    """Return a reactor at rest with a late coolant, and its controller by default parameters."""
    model = replace(REACTOR_MODEL, dead_time=np.array([seconds if known is None else known]))
    table = table_of(model, given)
    loop = built(table.amended(table.snapshot({}), **given), model)
    x = np.array([START])
    u = equilibrium_input(plant, x)
    # without noise a plant at rest is like a sensor that is stuck
    loop = replace(loop, tuning=replace(loop.tuning, sensor=replace(
        loop.tuning.sensor, stuck_sensor_timeout=0.0)))
    return loop, Process(plant, 0, x, u, Actuator(dead_time=seconds), u), loop.initialise(
        State(), u)


def step(loop, plant, state, duration, *events):
    run = run_loop(loop, plant, [at(5.0, SetpointRequest(0, np.array([SETPOINT]))), *events],
                   duration=duration, state=state, input_sensor=perfect)
    assert not run.failure
    assert set(run.levels) == {'sdre'}
    return run


@pytest.mark.parametrize(('seconds', 'known', 'estimator'), [
    (30.5, 27.0, ''), (60.0, 54.0, 'extended_kalman_filter')])
def test_a_late_coolant_brings_no_overshoot(seconds, known, estimator):
    run = step(*late_reactor(seconds, known, estimator=estimator), 150.0 + 2.0 * seconds)
    assert SETPOINT - run.states.min() < 0.3
    assert abs(run.states[-1, 0] - SETPOINT) < 0.5
    # beside the least cost from the same rest, which lasts until a command acts
    late = math.ceil(seconds)
    acting = np.concatenate((np.tile(run.commands[0], (late, 1)), run.commands))[:len(run.times)]
    task = Task(REACTOR, run.states[0], np.array([SETPOINT]), np.array([COOLANT]), np.ones(1),
                np.ones(1), 1.0 / 60.0, len(acting))
    at_rest = cost_along(task, run.states[:1], run.commands[:1])
    assert cost_along(task, run.states, acting) < 1.02 * ((5 + late) * at_rest + LEAST)


def test_a_late_coolant_leaves_no_offset_on_a_changed_plant():
    run = step(*late_reactor(10.0, 11.0, FOULED), 400)
    assert abs(run.states[-1, 0] - SETPOINT) < 0.02


WARMER = one_state_reactor(replace(
    ReactorParameters(), feed_temperature=ReactorParameters().feed_temperature + 5.0),
    nominal_state=REACTOR.nominal_state)


def load_error(law, plant, period, samples):
    """Return the integral of the error in K s after a step of the feed, which is not measured."""
    start, plant, total = float(plant.x[0]), replace(plant, system=WARMER), 0.0
    for k in range(samples):
        plant = plant.until(k * period * SECOND)
        error = float(plant.x[0]) - start
        total += abs(error) * period
        plant = plant.commanded(law(k, plant.x), k * period * SECOND)
    return total


@pytest.mark.parametrize(('known', 'share'), [(60.0, 0.7), (120.0, 0.7), (120.0, 1.3)])
def test_an_unmeasured_load_step_costs_no_more_than_with_a_tuned_pi_controller(known, share):
    period, samples = 3, 300
    loop, plant, _ = late_reactor(share * known, known)
    x = np.array([320.0])
    rest = equilibrium_input(REACTOR, x)
    plant, state = replace(plant, x=x, u=rest, command=rest), loop.initialise(State(), rest)

    def controlled(k, x):
        nonlocal state
        state, u, _ = loop.step(state, x, (k + 1) * period * SECOND)
        return u

    # by the rules of Skogestad
    rate, effect = (float(-REACTOR.drift_jacobian(x)[0, 0]) / 60.0,
                    float(REACTOR.input_matrix(x)[0, 0]) / 60.0)
    late = known + 0.5 * period
    gain, reset, integral = 0.5 / (effect * late), min(1.0 / rate, 8.0 * late), 0.0

    def pi(k, x):
        nonlocal integral
        error = float(x[0]) - 320.0
        integral += error * period / reset
        return rest - gain * (error + integral)

    ours, usual = (load_error(law, plant, period, samples) for law in (controlled, pi))
    assert ours <= 1.05 * usual


def test_a_dead_time_twice_as_long_as_known_leaves_the_loop_stable():
    run = step(*late_reactor(20.0, 10.0), 400)
    assert np.ptp(run.states[-60:]) < 0.1 < np.ptp(run.states[100:200])
    assert abs(run.states[-1, 0] - SETPOINT) < 0.1


def test_a_takeover_a_record_and_a_fallback_keep_the_inputs_under_way():
    loop, plant, state = late_reactor(20.0)
    whole = step(loop, plant, state, 60.0)
    # of a hand-over to a controller with the same settings nothing is seen
    again = step(loop, plant, state, 60.0, at(20.0, exchange(replace(loop))),
                 at(30.0, lambda now: replace(now, state=decoded(encoded(now.state)))))
    np.testing.assert_allclose(again.commands, whole.commands, rtol=0, atol=1e-9)
    half = step(loop, plant, state, 20.0).loop.state
    assert len(half.applied.times_ns) == 21
    forgetful = half._replace(applied=AppliedInputs().corrected(half.command))
    now_ns = half.time_ns + SECOND
    commands = [loop.step(one, np.array([START]), now_ns)[1][0] for one in (half, forgetful)]
    assert commands[0] == pytest.approx(whole.commands[21, 0], abs=0.2)
    assert abs(commands[1] - commands[0]) > 0.3
    # where stamps go back, the inputs under way go with them
    back = loop.step(half, np.array([START]), half.time_ns - 1800 * SECOND)[0]
    assert np.diff(back.applied.times_ns).tolist()[-3:] == [SECOND] * 3


def test_a_prediction_that_diverges_is_a_failure_of_the_level():
    loop, _, state = late_reactor(3600.0, observer_bandwidth=0.0)
    hot = np.array([loop.model.states.upper[0]])
    applied = AppliedInputs().corrected(np.array([1e3])).followed_by(
        0, state.command, loop.estimation.dead_ns)
    _, command, report = loop.step(state._replace(applied=applied), hot, SECOND)
    assert report.level == 'hold'
    assert report.reason.cause.code is StatusCode.NOT_PREDICTED
    assert report.reason.cause.values['seconds'] < 3600.0
    np.testing.assert_array_equal(command, state.command)


def quantised(step, stuck_from=math.inf):
    """Return a sensor with a resolution, which is stuck from a time in s on."""
    kept = []

    def read(value, second):
        if second >= stuck_from and kept:
            return kept[0]
        kept[:] = [np.round(value / step) * step]
        return kept[0]

    return read


@pytest.mark.parametrize(('share', 'plant', 'start'), [
    (1.0, FOULED, 10.0), (1.3, FOULED, 400.0), (1.3, REACTOR, 10.0)])
def test_no_sensor_is_called_stuck_before_an_effect_can_be_seen(share, plant, start):
    loop, process, state = late_reactor(60.0 * share, 60.0, plant)
    loop = replace(loop, tuning=replace(loop.tuning, sensor=replace(
        loop.tuning.sensor, jump=np.array([0.5]), stuck_sensor_timeout=20.0)))
    run = run_loop(loop, process, [at(start, SetpointRequest(0, np.array([SETPOINT])))],
                   duration=start + 400.0, period=2.0, state=state, sensor=quantised(0.5))
    assert {report.level for report in run.reports} == {'sdre'}


def test_a_stuck_sensor_behind_a_dead_time_is_found():
    loop, process, state = late_reactor(60.0, stuck_sensor_timeout=20.0)
    loop = replace(loop, tuning=replace(loop.tuning, sensor=replace(
        loop.tuning.sensor, stuck_sensor_timeout=20.0)))
    run = run_loop(loop, process, [at(10.0, SetpointRequest(0, np.array([SETPOINT])))],
                   duration=260.0, period=2.0, state=state, sensor=quantised(0.1, 40.0))
    held = [2.0 * k for k, report in enumerate(run.reports) if report.level == 'hold']
    # the coolant acts from 70 s on, and two dead times more are waited for
    assert 190.0 < held[0] < 220.0
    assert run.reports[int(held[0] / 2.0)].reason.code is StatusCode.FROZEN


@pytest.mark.parametrize(('rate', 'acts'), [(8.0, True), (2e298, False)])
def test_a_mode_too_fast_to_predict_over_the_dead_time_is_a_failure_of_the_level(rate, acts):
    model = linearised_model(np.array([[-rate]]), np.array([[rate]]), *(
        Coordinates((name,), ('m',), np.zeros(1), np.ones(1), -np.ones(1), np.ones(1))
        for name in 'xu'), 's', Provenance(plant=''))
    loop = Controller(replace(model, dead_time=np.array([100.0])), Tuning.for_model(model))
    state = loop.initialise(State(), np.zeros(1))
    report = loop.step(state, np.array([0.1]), SECOND)[2]
    assert report.level == ('sdre' if acts else 'hold')
    if not acts:
        assert report.reason.cause.code is StatusCode.NOT_PREDICTED
        return
    shorter = replace(loop.best, prediction=PredictionSettings(longest=0.9 * 100.0 * rate))
    pending = PendingInputs(state.applied, SECOND, loop.estimation.dead_ns)
    found = [level.compute(np.zeros(1), Estimate(np.zeros(1), np.zeros(1)), None, 1.0, None,
                           state.command, pending)[1] for level in (loop.best, shorter)]
    assert found[0].failure is None
    assert found[1].failure.code is StatusCode.NOT_PREDICTED


@pytest.mark.parametrize(('known', 'given', 'bandwidth'), [
    (0.0, {}, 0.1), (5.0, {}, 0.1), (40.0, {}, 0.048), (40.0, {'dead_time': 0.0}, 0.1),
    (0.0, {'dead_time': 80.0}, 0.03), (40.0, {'dead_time': -1.0}, 0.048),
    (40.0, {'observer_bandwidth': 0.1}, 0.1)])
def test_the_default_bandwidth_falls_with_the_dead_time(known, given, bandwidth):
    model = replace(REACTOR_MODEL, dead_time=np.array([known]))
    named = {f'coolant_temperature.{name}' if name == 'dead_time' else name: value
             for name, value in given.items()}
    table = table_of(model, named)
    loop = built(table.amended(table.snapshot({}), **named), model)
    assert loop.tuning.observer_bandwidth == pytest.approx(bandwidth)
    seconds = given.get('dead_time', -1.0)
    assert loop.estimation.dead_ns == (round((known if seconds < 0.0 else seconds) * SECOND),)


def test_the_default_noise_of_a_filter_falls_with_the_dead_time():
    loop, outputs = late_reactor(0.0)[0], late_reactor(0.0)[0].measured
    noise, _, _ = uncertainty(loop.model, outputs, loop.tuning)
    for seconds in (60.0, 120.0):
        model = replace(REACTOR_MODEL, dead_time=np.array([seconds]))
        slowest = -float(model.drift_jacobian(np.zeros(1))[0, 0]) / 60.0
        # K/s of the temperature for a coolant of one scale more
        gain = float((model.B[0, 0] * model.states.scale[0]) / 60.0)
        limited = uncertainty(model, outputs, loop.tuning)[1]
        assert limited == pytest.approx(
            (0.5 * largest_bandwidth(seconds, slowest)) ** 2 / 3.0 * noise / gain)
        own = replace(loop.tuning, disturbance_noise=np.array([3.0]))
        np.testing.assert_array_equal(uncertainty(model, outputs, own)[1],
                                      uncertainty(loop.model, outputs, own)[1])


class ReadingLaw(StateDependentRiccati):
    """A law that remembers the covariance at which it was evaluated."""

    reads_covariance = True

    def compute(self, estimate, target, memory, interval, previous):
        found = super().compute(estimate, target, memory, interval, previous)
        return replace(found, memory=(estimate.x, estimate.covariance))


class OtherLaw(ReadingLaw):
    reads_covariance = False


@pytest.mark.parametrize('kind', ['extended', 'unscented'])
def test_the_covariance_is_predicted_over_a_dead_time_for_a_law_that_reads_it(kind):
    found = {}
    for law in (ReadingLaw, OtherLaw):
        loop, plant, state = late_reactor(
            30.0, estimator=f'{kind}_kalman_filter',
            fallback_order=(f'{__name__}:{law.__name__}',))
        now = run_loop(loop, plant, [at(5.0, SetpointRequest(0, np.array([SETPOINT])))],
                       duration=20.0, period=2.0, state=state).loop.state
        found[law] = now.law_memory
        measured = now.estimate.covariance[0, 0]
    (x, P), (alone, none) = found[ReadingLaw], found[OtherLaw]
    assert P[0, 0] != pytest.approx(measured, rel=0.1)
    assert none is None
    np.testing.assert_allclose(alone, x, atol=1e-6 if kind == 'extended' else 1e-3)


@pytest.mark.parametrize(('levels', 'estimator'), [
    (('mpc', 'linear'), 'extended_kalman_filter'), (('linear',), ''),
    (('pi',), 'extended_kalman_filter')])
def test_every_law_and_filter_acts_on_the_prediction(levels, estimator):
    gains = {'pi.temperature.gain': 1.0, 'pi.temperature.integral_time': 60.0}
    loop, plant, state = late_reactor(
        30.0, 27.0, estimator=estimator, fallback_order=levels, **gains)
    run = run_loop(loop, plant, [at(5.0, SetpointRequest(0, np.array([SETPOINT])))],
                   duration=440.0, period=2.0, state=state)
    assert set(run.levels) == {levels[0]}
    # a PI law has its own overshoot, and without prediction it would swing
    assert SETPOINT - run.states.min() < (1.0 if levels == ('pi',) else 0.3)
    assert abs(run.states[-1, 0] - SETPOINT) < 0.5
    plan = run.reports[-1].command.plan
    assert plan is None or plan.times[0] == 27.0


# Several inputs.

A, B = np.array([[-0.2, 0.1], [0.0, -0.3]]), np.array([[0.3, 0.1], [0.1, 0.4]])
PERIOD = 0.5  # s


def two_inputs(dead_time, **given):
    x, u = (Coordinates((f'{name}1', f'{name}2'), ('1', '1'), np.zeros(2), np.ones(2),
                        np.full(2, -5.0), np.full(2, 5.0)) for name in 'xu')
    model = replace(linearised_model(A, B, x, u, 's', Provenance('two inputs')),
                    dead_time=np.array(dead_time))
    return Controller(model, Tuning.for_model(model, **given))


AT_REST = ((-100 * SECOND, np.zeros(2)),)


class Linear:
    """The plant of that model, whose inputs act late."""

    def __init__(self, dead_time, x, time_ns=0, commands=AT_REST):
        self.dead_time, self.x, self.time_ns, self.commands = dead_time, x, time_ns, commands

    @property
    def u(self):
        return self.commands[-1][1]

    applied = u

    def commanded(self, u, time_ns):
        return Linear(self.dead_time, self.x, self.time_ns, (*self.commands, (time_ns, u)))

    def acting(self, seconds):
        return np.array([next(u[i] for time, u in reversed(self.commands)
                              if time / SECOND + dead <= seconds + 1e-9)
                         for i, dead in enumerate(self.dead_time)])

    def until(self, time_ns):
        now, end, x = self.time_ns / SECOND, time_ns / SECOND, self.x
        edges = {now, end} | {edge for time, _ in self.commands for dead in self.dead_time
                              if now < (edge := time / SECOND + dead) < end}
        for begin, later in pairwise(sorted(edges)):
            block = np.zeros((3, 3))
            block[:2, :2], block[:2, 2] = A, B @ self.acting(begin)
            x = (expm((later - begin) * block) @ np.append(x, 1.0))[:2]
        return Linear(self.dead_time, x, time_ns, self.commands)


@pytest.mark.parametrize('dead_time', [(0.7, 0.7), (2.2, 0.7), (0.0, 1.5)])
def test_each_input_is_computed_for_the_state_at_which_it_acts(dead_time):
    """Where the model is right, as if there were no dead time."""
    loop = two_inputs(dead_time)
    goal = np.array([2.0, -1.0])
    run = run_loop(loop, Linear(dead_time, np.zeros(2)), [at(2.0, SetpointRequest(0, goal))],
                   duration=30.0, period=PERIOD)
    gain, target = loop.best.law, loop.best.target(goal, np.zeros(2), None)
    plant = Linear(dead_time, np.zeros(2), commands=run.loop.plant.commands)
    for k, dead in ((k, dead) for k in range(4, 30) for dead in enumerate(dead_time)):
        i, seconds = dead
        x = plant.until(round((k * PERIOD + seconds) * SECOND)).x
        law = gain.compute(loop.estimation.level(State().supervisor).estimator.restart(
            None, x, None), target, None, PERIOD, None).u
        assert run.commands[k, i] == pytest.approx(law[i], abs=0.02), (k, i)
    np.testing.assert_allclose(run.states[-1], goal, atol=5e-3)


def test_a_plan_uses_the_inputs_under_way():
    """With different dead times it costs less than the law that acts on predicted states."""
    dead_time, goal, costs = (0.2, 3.3), np.array([2.0, -1.0]), []
    for law in ('sdre', 'mpc'):
        loop = two_inputs(dead_time, fallback_order=(law,), limits=InputLimits(
            np.full(2, -4.0), np.full(2, 4.0), np.array([2.0, 0.8])))
        run = run_loop(loop, Linear(dead_time, np.zeros(2)), [at(2.0, SetpointRequest(0, goal))],
                       duration=30.0, period=PERIOD)
        assert set(run.levels) == {law}
        target, e = loop.best.target(goal, np.zeros(2), None), run.states[4:] - goal
        acted = np.array([run.loop.plant.acting(time) for time in run.times[4:]])
        costs.append(np.sum(e ** 2) + np.sum((acted - target.u) ** 2))
        np.testing.assert_allclose(run.states[-1], goal, atol=5e-3)
    assert costs[1] < costs[0]
    # the plan keeps the rates by itself
    reports = [report.command for report in run.reports[5:]]
    assert not any(report.at_rate for report in reports)
    assert any(report.plan.at_rate[1] for report in reports)
    assert reports[0].plan.times[0] == 0.2
