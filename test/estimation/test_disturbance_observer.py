# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Which measurements are accepted, what is estimated from them, and zero offset with it."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from koopman_ros.control import SensorLimits, Silence, State
from koopman_ros.core.signals import Outputs
from koopman_ros.estimation import (
    check,
    equivalent_bias,
    Estimate,
)
from koopman_ros.evaluation import perfect
from koopman_ros.model import Coordinates, LiftedModel, PolynomialObservables, Provenance
from koopman_ros.plants import Actuator, two_state_reactor
from studies.robustness.disturbances import CHANGED
from studies.robustness.loop import changed_reactor
from support.closed_loops import (
    controller,
    EPOCH,
    largest_step,
    levels,
    observing,
    REACTOR,
    Reactor,
    say,
    SECOND,
    SETPOINT,
    settled,
    shipped,
    START,
    UPPER,
)

MODEL = shipped('reactor_nz4')


@pytest.mark.parametrize('seconds', [1.0, 20.0, 40.0])
def test_the_prediction_follows_modes_that_are_faster_than_at_the_nominal_point(seconds):
    """dx/dt = -x - 8 x^3 relaxes 25 times as fast at x = 1 as at x = 0."""
    unit = Coordinates.spanning(('x',), ('1',), -np.ones(1), np.ones(1))
    model = LiftedModel(
        PolynomialObservables(np.array([[1], [3]])), np.array([[-1.0, -8.0], [0.0, -3.0]]),
        np.ones((1, 1)), unit, unit, 'min', Provenance('cubic'),
        readout=np.array([[-1.0, -8.0]]))
    x = np.array([1.0])
    assert model.drift(x) == pytest.approx(-9.0)
    found = observing(model, 0.1).predict(Estimate(x, np.zeros(1)), np.zeros(1), seconds)
    # d(x^-2)/dt = 2 x^-2 + 16
    t = seconds / 60.0
    assert found.x[0] == pytest.approx(((1.0 + 8.0) * math.exp(2.0 * t) - 8.0) ** -0.5, abs=1e-3)


@pytest.mark.parametrize('bandwidth', [0.5 / 60.0, 6.0 / 60.0, 1.0])
@pytest.mark.parametrize('seconds', [0.1, 1.0, 5.0])
def test_both_poles_of_the_error_are_where_they_were_put(bandwidth, seconds):
    # about the nominal point, where the drift is A x within a thousandth
    observer, size = observing(MODEL.linearised, bandwidth), 1e-6
    columns = []
    for dx, dw in np.eye(2) * size:
        before = Estimate(np.array([dx]), np.array([dw]))
        after = observer.correct(
            observer.predict(before, np.zeros(1), seconds), np.zeros(1), seconds)
        columns.append([after.x[0], after.w[0]])
    poles = np.linalg.eigvals(np.array(columns).T / size)
    p = np.exp(-bandwidth * seconds)
    # the model's own motion within a sample is neglected in the design
    moved = abs(np.expm1(MODEL.linearised.A[0, 0] * seconds / 60.0))
    np.testing.assert_allclose(np.abs(poles), p, rtol=0, atol=2.0 * np.sqrt(moved))
    assert np.max(np.abs(poles)) < 1.0
    assert np.prod(poles).real == pytest.approx(p * p, rel=2.0 * moved + 1e-3)


def test_prediction_is_that_of_the_differential_equation():
    estimate, u = Estimate(np.array([-0.5]), np.array([0.3])), np.array([0.4])
    observer = observing(MODEL, 0.1)
    exact = solve_ivp(lambda _, x: MODEL.drift(x) + MODEL.B @ u + estimate.w, (0.0, 1.0),
                      estimate.x, rtol=1e-10, atol=1e-12).y[:, -1]
    predicted = observer.predict(estimate, u, 60.0)
    np.testing.assert_allclose(predicted.x, exact, rtol=0, atol=1e-3)
    state = estimate
    for _ in range(60):
        state = observer.predict(state, u, 1.0)
    np.testing.assert_allclose(state.x, exact, rtol=0, atol=2e-5)
    # and nothing after very long
    assert observer.predict(estimate, u, 3600.0) is None


def test_an_estimate_far_outside_returns_to_the_measurement():
    # where a polynomial drift carries a prediction away faster than corrections bring it back
    model = shipped('two_state')
    observer = observing(model, 0.02)
    estimate = Estimate(np.array([-0.697, 2.545]), np.array([0.253, 0.918]))
    for _ in range(900):
        predicted = observer.predict(estimate, np.array([-0.998]), 0.5) or estimate
        estimate = observer.correct(predicted, np.zeros(2), 0.5)
    assert np.max(np.abs(estimate.x)) < 0.5


def test_the_disturbance_is_bounded():
    observer = observing(MODEL, 0.1, 0.5)
    huge = observer.correct(Estimate(np.zeros(1), np.zeros(1)), np.array([1e6]), 1.0)
    np.testing.assert_allclose(np.abs(observer.as_input(huge.w)), 0.5, rtol=1e-12)
    assert observer.at_bound(huge.w)
    assert not observer.at_bound(0.99 * huge.w)
    np.testing.assert_array_equal(observer.bounded(np.array([np.nan])), [0.0])
    np.testing.assert_array_equal(observer.bounded(np.array([np.inf])), [0.0])


@pytest.mark.parametrize('kelvin', [308.0, 316.0, START])
@pytest.mark.parametrize('bias', [-1.5, 0.7, 2.0])
def test_equivalent_bias_is_the_bias(kelvin, bias):
    true = MODEL.states.to_deviation(np.array([kelvin]))
    x = true + bias / MODEL.states.scale
    # at rest under the input that holds the true state
    estimate = Estimate(x, MODEL.drift(true) - MODEL.drift(x))
    found = equivalent_bias(MODEL, estimate) * MODEL.states.scale
    np.testing.assert_allclose(found, [bias], rtol=0, atol=1e-5)
    # none explains a disturbance that is too large
    assert np.isnan(equivalent_bias(MODEL.linearised, Estimate(np.zeros(1), np.array([1e9]))))[0]


# The nominal loop's step response of 10 K takes 194 s to stay within 1e-3 K.
RESPONSE, MORE = 194, 120  # s


def asked(*arguments, **others):
    """Return a loop that is asked for a step of 10 K after ten seconds."""
    loop = Reactor(*arguments or (controller(),), **others)
    loop.run(10)
    loop.ask(SETPOINT)
    return loop


def test_nominal_step_response():
    loop = asked()
    samples = loop.run(RESPONSE + MORE)
    assert settled(samples, SETPOINT, 1e-3) <= RESPONSE
    assert min(s.temperature for s in samples) > SETPOINT - 0.1
    # the model is so good that there is next to nothing to estimate
    assert max(abs(float(s.report.estimate.disturbance[0])) for s in samples) < 0.01


CHANGED_HERE = [*CHANGED][::2]


@pytest.mark.parametrize(('plant', 'others'), [
    # the others come back from the safe input, in the tests of the supervisor
    *((CHANGED[name], {}) for name in CHANGED_HERE),
    (REACTOR, {'actuator': Actuator(lag=10.0, delay=1.0)}),
    # a biased measurement of the coolant brings no offset
    (CHANGED['UA −20 %'], {'input_sensor': lambda u, _: u - 1.5})],
    ids=[*CHANGED_HERE, 'lag and delay', 'told less'])
def test_the_law_controls_a_plant_that_differs_from_its_model(plant, others):
    loop = asked(controller(), plant, **others)
    samples = loop.run(RESPONSE + MORE)
    assert settled(samples, SETPOINT, 1e-3) <= RESPONSE + MORE - 10
    assert plant is REACTOR or abs(float(samples[-1].report.estimate.disturbance[0])) > 0.4


def test_two_state_reactor_under_the_lift_of_the_one_state_one():
    plant = two_state_reactor()
    loop = Reactor(controller(), plant, kelvin=float(plant.nominal_state[1]))
    loop.run(10)
    setpoint = float(plant.nominal_state[1]) - 3.0
    loop.ask(setpoint)
    # its own slow mode, -1.05/min, takes 224 s to fade to a fiftieth
    assert settled(loop.run(420), setpoint, 1e-3) <= 224 + 130


def test_the_panel_shows_a_sensor_bias():
    loop = Reactor(controller(), sensor=lambda y, _: y + 2.0)
    loop.run(1)
    loop.ask(START)
    last = loop.run(400)[-1]
    # what is measured has no offset; the reactor has, and nobody in the loop can know
    assert last.temperature + 2.0 == pytest.approx(START, abs=1e-3)
    bias = loop.loop.controller.equivalent_bias(loop.loop.state)
    np.testing.assert_allclose(bias, [2.0], rtol=0, atol=2e-3)
    assert float(last.report.estimate.disturbance[0]) == pytest.approx(1.07, abs=0.02)


def test_minutes_at_the_limit_leave_nothing_behind():
    loop = Reactor(controller())
    loop.run(10)
    loop.change(system=changed_reactor(feed=-40.0))
    saturated = loop.run(300)
    assert all(s.command == UPPER for s in saturated[-200:])
    assert START - saturated[-1].temperature > 10.0
    loop.change(system=REACTOR)
    samples = loop.run(RESPONSE + MORE)
    assert max(s.temperature for s in samples) - START < 0.5
    assert settled(samples, START, 1e-3) <= RESPONSE + MORE


@pytest.mark.parametrize('tells', [True, False])
def test_an_actuator_that_reaches_less_than_is_commanded(tells):
    loop = asked(input_sensor=perfect if tells else None)
    # 292.29 K would be needed
    loop.act(Actuator(lower=298.15))
    stuck = loop.run(300)
    assert all(s.report.measurement.follows for s in stuck[20:]) is not tells
    loop.act(Actuator())
    samples = loop.run(RESPONSE + MORE)
    below = SETPOINT - min(s.temperature for s in samples)
    assert below < 0.5 if tells else below > 1.0
    assert settled(samples, SETPOINT, 1e-3) <= RESPONSE + MORE or not tells


def test_without_the_observer_the_offset_stays():
    loop = asked(controller(observer_bandwidth=0.0), CHANGED['UA −20 %'])
    assert abs(loop.run(300)[-1].temperature - SETPOINT) > 3.0


@pytest.mark.parametrize(('bandwidth', 'low', 'high'), [(2.0, 0.0, 0.03), (12.0, 0.09, 0.4)])
def test_bandwidth_trades_noise_for_speed(bandwidth, low, high):
    loop = Reactor(controller(observer_bandwidth=bandwidth / 60.0), noise=0.1)
    commands = np.array([s.command for s in loop.run(600)[200:]])
    assert low < np.std(commands) < high
    # the filter adds no offset
    assert abs(np.mean([s.temperature for s in loop.samples[200:]]) - START) < 0.02


# Which measurements are accepted.

@pytest.mark.parametrize(('value', 'words'), [
    (math.nan, 'the measured temperature is nan, not finite: check the sensor'),
    (math.inf, 'is inf, not finite'),
    (1e300, 'outside the range of the sensor, 253.15 K to 423.15 K: check'),
    (-0.0, 'the measured temperature -0 K is outside the range of the sensor'),
    (START + 30.0, 'to 354.475 K in 1 s, at most 2 K and 2 K/s are possible: check the sensor'),
])
def test_one_bad_measurement_holds_the_command(value, words):
    loop = asked()
    before = loop.run(20)[-1].command
    bad = loop.run(1, lambda _: value)[0]
    assert (bad.command, bad.report.level) == (before, 'hold')
    assert words in say(bad.report.reason)
    assert bad.report.command.law.form == ''
    np.testing.assert_array_equal(bad.report.target.setpoint, [SETPOINT])
    # and the next good one is used
    after = loop.run(1)
    assert (after[0].report.level, after[0].report.reason) == ('sdre', None)


@pytest.mark.parametrize(('by', 'seconds'), [(-3.0, 0), (-9.0, 3)])
def test_a_jump_that_stays_is_accepted_when_the_plant_could_have_got_there(by, seconds):
    loop = Reactor(controller())
    loop.run(10)
    loop.change(x=np.array([loop.kelvin + by]))
    samples = loop.run(300)
    assert [s.report.level for s in samples[:seconds + 1]] == ['hold'] * seconds + ['sdre']
    if seconds:
        # it is no disturbance
        assert abs(float(samples[seconds].report.estimate.disturbance[0])) < 0.01
    assert settled(samples, START, 1e-3) < 280


def test_only_measurements_taken_for_jumps_differ():
    limits = SensorLimits(*(np.array([x]) for x in (-100.0, 100.0, 1.0, 1.0)))
    outputs, last, seen = Outputs(('level',), ('m',), np.eye(1)), None, []
    for second, y in ((0, 0.0), (5, 4.0), (6, 14.0), (17, 14.1)):
        verdict = check(limits, outputs, last, np.array([y]), second * SECOND, np.zeros(1),
                        lambda _: np.ones(1))
        last = verdict.accepted
        seen.append((verdict.fault is None, verdict.moved))
    assert seen == [(True, False), (True, False), (False, False), (True, True)]


@pytest.mark.parametrize(('step', 'gone', 'stuck'), [
    (0.01, 0.9, False), (0.01, 1.1, True), (0.8, 3.1, False), (0.8, 3.3, True)])
def test_a_signal_is_stuck_where_the_model_moves_by_more_than_noise_and_resolution_hide(
        step, gone, stuck):
    limits = SensorLimits(*(np.array([x]) for x in (-100.0, 100.0, np.inf, 2.0)))
    outputs, last = Outputs(('level',), ('m',), np.eye(1)), None
    for second, y in enumerate((0.0, step, 3 * step, *[2 * step] * 60)):
        verdict = check(limits, outputs, last, np.array([y]), second * SECOND, np.zeros(1),
                        lambda _, moves=second == 10: np.array([gone * moves]), 15 * SECOND)
        last = verdict.accepted
        assert last.resolution == pytest.approx([0.0 if second == 0 else step])
        # two dead times after the model has moved
        assert (verdict.fault is not None) == (stuck and second >= 9 + 30)


def test_a_sensor_that_freezes_under_way_is_found_out():
    loop = asked()
    loop.run(10)
    value = loop.kelvin
    frozen = loop.run(40, lambda _: value)
    assert levels(frozen) == ['sdre', 'hold']
    first = next(s for s in frozen if s.report.level == 'hold')
    assert first.second - frozen[0].second == 21
    assert 'for longer than 20 s while the model moved' in say(first.report.reason)
    # what the observer made of it is forgotten
    assert abs(float(first.report.estimate.disturbance[0])) < 0.05


def test_a_plant_at_rest_is_not_frozen_and_nothing_is_when_that_is_switched_off():
    assert levels(Reactor(controller()).run(100, lambda _: START)) == ['sdre']
    loop = asked(controller(sensor={'stuck_sensor_timeout': 0.0}))
    assert levels(loop.run(60, lambda _: START)) == ['sdre']


@pytest.mark.parametrize('heartbeat', [60.0, 0.0])
def test_a_sensor_that_reports_on_change_neither_jumps_nor_is_stuck(heartbeat):
    reported = START

    def deadband(kelvin):
        nonlocal reported
        if abs(kelvin - reported) > 2.0:
            reported = kelvin
        return reported

    loop = asked(controller(sensor={
        'report_on_change': np.array([heartbeat]), 'deadband': np.array([2.0])}))
    samples = loop.run(300, deadband)
    assert levels(samples) == ['sdre']
    if heartbeat:
        assert all(abs(s.temperature - SETPOINT) < 2.5 for s in samples[200:])


def test_a_plant_that_rests_where_the_model_was_not_trained_is_not_frozen():
    """As an empty tank, which the extrapolated model expects to go on falling."""
    own = controller()
    loop, outside = asked(own), float(own.model.states.lower[0]) - 3.0
    # when the jump there is believed
    assert levels(loop.run(100, lambda _: outside)[40:]) == ['linear']


def test_rare_measurements_are_not_taken_for_a_gap():
    loop = controller()
    state = loop.initialise(State(), np.array([300.0]))
    for k in range(30):
        state, command, report = loop.step(
            state, np.array([START + 1e-9 * k]), EPOCH + 60 * k * SECOND)
        assert report.measurement.missed == 0
        assert report.level == 'sdre'
    assert command[0] == pytest.approx(300.0, abs=1e-3)


def test_missed_measurements_are_counted():
    loop = controller()
    state, missed = State(), []
    for second in (0, 1, 2, 3, 7, 8):
        state, _, report = loop.step(state, np.array([START]), EPOCH + second * SECOND)
        missed.append(report.measurement.missed)
    assert missed == [0, 0, 0, 0, 3, 0]


@pytest.mark.parametrize('ahead', [15, 3600])
def test_stamps_that_stood_still_while_it_was_watched_do_not_stop_the_law(ahead):
    """The plant was halted, or its clock was an hour ahead for a moment."""
    loop = Reactor(controller())
    loop.run(10)
    loop.ask(START - 2.0)
    loop.do(Silence(EPOCH + (9 + ahead) * SECOND))
    samples = loop.run(300)
    assert levels(samples) == ['sdre']
    assert abs(samples[9].command - samples[0].command) > 0.5
    assert largest_step(samples) <= 1.0 + 1e-9
    assert abs(samples[-1].temperature - (START - 2.0)) < 0.01
