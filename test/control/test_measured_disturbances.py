# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Feed-forward of measured disturbances, and their sensors: lost, not finite, out of range."""

from dataclasses import replace
import math

import numpy as np
import pytest

from koopman_ros.control import Controller, events, State
from koopman_ros.core.status import StatusCode
from koopman_ros.estimation import check_disturbances, MeasuredDisturbances
from koopman_ros.evaluation import at, exchange, run_loop
from koopman_ros.event_log.records import decoded, encoded
from koopman_ros.model import Coordinates
from koopman_ros.plants import equilibrium_input, one_state_reactor, Process, ReactorParameters
from koopman_ros.tuning import DisturbanceLimits
from support.closed_loops import REACTOR, SECOND, shipped, START, USUAL

NOMINAL, STEP = 350.0, 5.0  # K, of the feed
FEED = Coordinates(('feed_temperature',), ('K',), *np.array(
    [[NOMINAL], [STEP], [NOMINAL - 10.0], [NOMINAL + 10.0]]))
PLAIN = shipped('reactor_nz4')
# q/V = 1/min: the rate of the temperature by that of the feed
FED = replace(PLAIN, disturbances=FEED, E=np.array([[STEP / PLAIN.states.scale[0]]]))
BEGIN = 10  # s
# of an unmeasured step, after which the observer has it
UNMEASURED_PEAK = 0.909


def reactor(kelvin):
    return one_state_reactor(replace(ReactorParameters(), feed_temperature=kelvin),
                             REACTOR.nominal_state)


def controller(model=FED, limits=None, **settings):
    return Controller(model, replace(
        USUAL, disturbances=limits or DisturbanceLimits(), **settings))


def run(loop, measure=lambda kelvin, seconds: kelvin, *more, before=NOMINAL, duration=120):
    """Step the feed by 5 K after 10 s, as `measure` has it; return the run and the errors."""
    def feed(seconds):
        return before + STEP * (seconds >= BEGIN)

    def changed(now):
        return replace(now, plant=replace(now.plant, system=reactor(before + STEP)))

    x = np.array([START])
    u = equilibrium_input(reactor(before), x)
    found = run_loop(loop, Process(reactor(before), 0, x, u), [at(BEGIN, changed), *more],
                     duration=duration, state=loop.initialise(State(), u),
                     disturbances=lambda seconds: np.array([measure(feed(seconds), seconds)]))
    assert not found.failure
    return found, found.states[:, 0] - START


@pytest.mark.parametrize(('settings', 'share'), [
    ({}, 0.1), ({'fallback_order': ('linear',)}, 0.1), ({'fallback_order': ('mpc',)}, 0.1),
    ({'estimator': 'measured_state'}, 0.1), ({'estimator': 'extended_kalman_filter'}, 0.15),
    ({'estimator': 'unscented_kalman_filter'}, 0.15)])
def test_a_measured_step_of_the_feed_is_compensated_before_it_moves_the_state(settings, share):
    found, error = run(controller(**settings))
    assert np.abs(error).max() < share * UNMEASURED_PEAK
    assert abs(error[-1]) < 0.01
    # it is no unmeasured disturbance
    assert abs(found.reports[-1].estimate.disturbance[0]) < 0.01


def test_an_unmeasured_step_moves_it_further():
    found, error = run(Controller(PLAIN, USUAL))
    assert np.abs(error).max() == pytest.approx(UNMEASURED_PEAK, rel=1e-3)
    assert found.loop.state.disturbances is None
    # what a model does not have counts for nothing
    np.testing.assert_array_equal(found.commands, run(
        Controller(PLAIN, USUAL), lambda *_: math.nan)[0].commands)


def test_the_holding_input_includes_the_initial_feed():
    found, error = run(controller(), before=NOMINAL + 4.0)
    assert np.abs(error).max() < 0.1 * UNMEASURED_PEAK
    assert abs(found.reports[0].estimate.disturbance[0]) < 1e-3


def lost_from(second, value=math.nan):
    return lambda kelvin, seconds: kelvin if seconds < second else value


LIMITS = DisturbanceLimits(np.array([300.0]), np.array([400.0]), np.array([1.0]))


@pytest.mark.parametrize(('measure', 'code', 'peak'), [
    # held at the new value, as nothing had happened
    (lost_from(BEGIN + 1), StatusCode.DISTURBANCE_SILENT, 0.1),
    (lost_from(BEGIN + 1, 4000.0), StatusCode.OUTSIDE_SENSOR, 0.1),
    (lost_from(BEGIN + 1, 0.0), StatusCode.OUTSIDE_SENSOR, 0.1),
    # held at the one before: the observer alone compensates the step
    (lost_from(BEGIN), StatusCode.DISTURBANCE_SILENT, 1.01),
    (lost_from(0), StatusCode.DISTURBANCE_UNKNOWN, 1.01)])
def test_a_lost_sensor_holds_the_last_value_and_the_loop_runs_on(measure, code, peak):
    found, error = run(controller(limits=replace(LIMITS, rate=np.array([np.inf]))), measure,
                       duration=200)
    assert set(found.levels) == {'sdre'}
    assert np.abs(error).max() < peak * UNMEASURED_PEAK
    assert abs(error[-1]) < 0.01
    assert [one.code for one in found.loop.state.disturbances.faults] == [code]


def test_the_return_of_a_sensor_causes_no_bump():
    """After the observer has compensated the step, its measurement is nothing new."""
    back = 150  # s
    found, error = run(controller(), lambda kelvin, seconds: (
        kelvin if seconds < BEGIN or seconds >= back else math.nan), duration=200)
    assert not found.loop.state.disturbances.faults
    assert np.abs(np.diff(found.commands[back - 5:, 0])).max() < 0.01
    assert abs(error[-1]) < 0.01
    assert abs(found.reports[-1].estimate.disturbance[0]) < 0.01
    # after a moment it is new
    _, error = run(controller(), lambda kelvin, seconds: (
        kelvin if not BEGIN <= seconds < BEGIN + 3 else math.nan))
    assert np.abs(error).max() < 0.5 * UNMEASURED_PEAK


@pytest.mark.parametrize(('timeout', 'moves'), [(np.inf, True), (60.0, False)])
def test_a_sensor_that_reports_changes_alone_is_not_lost(timeout, moves):
    """Where a time-out says that it was, the observer has compensated the change already."""
    loop = controller(limits=DisturbanceLimits(timeout=np.array([timeout])))
    state = loop.initialise(State(), np.array([300.0]))
    for second in range(101):
        old = second < 100
        state, command, _ = loop.step(
            state, np.array([START]), (second + 1) * SECOND, None, None,
            np.array([NOMINAL if old else NOMINAL + STEP]), np.array([float(second) * old]))
    # as fast as the coolant may
    assert command == pytest.approx(299.0 if moves else 300.0, abs=0.01)


def test_a_model_takes_over_and_a_record_keeps_the_disturbance():
    usual = run(controller())[0]
    again = run(controller(), lambda kelvin, seconds: kelvin,
                at(60.0, lambda now: replace(now, state=decoded(encoded(now.state)))),
                at(70.0, exchange(controller(replace(FED)))))[0]
    np.testing.assert_allclose(again.commands, usual.commands, rtol=0, atol=1e-9)
    # between models that know it and one that does not
    plain = controller(PLAIN, bumpless_transfer_time=0.0)
    found, error = run(controller(), lambda kelvin, seconds: kelvin,
                       at(70.0, exchange(plain)), at(90.0, exchange(controller())))
    assert np.abs(np.diff(found.commands[65:, 0])).max() < 0.05
    assert np.abs(error[65:]).max() < 0.05
    assert abs(found.reports[-1].estimate.disturbance[0]) < 0.05


def test_a_set_point_is_feasible_where_the_feed_allows_it():
    loop = controller()
    for kelvin, rejected in ((NOMINAL, False), (NOMINAL + 60.0, True)):
        state = loop.step(loop.initialise(State(), np.array([290.0])), np.array([START]), SECOND,
                          disturbances=np.array([kelvin]))[0]
        state = state._replace(estimate=replace(state.estimate, w=np.zeros(1)))
        why = loop.request_setpoint(state, np.array([START - 12.0]))[1]
        assert (why is not None) is rejected


def test_another_number_of_disturbances_is_rejected():
    with pytest.raises(ValueError, match='one number for each of feed_temperature, got'):
        controller().step(State(), np.array([START]), SECOND, disturbances=np.ones(2))


@pytest.mark.parametrize(('value', 'age', 'code', 'held'), [
    (351.0, 0.0, None, 351.0), (math.nan, 0.0, StatusCode.NOT_FINITE, 350.0),
    (299.0, 0.0, StatusCode.OUTSIDE_SENSOR, 350.0),
    # 1 K/s, 10 s after the last one
    (359.9, 0.0, None, 359.9), (361.0, 0.0, StatusCode.JUMPED, 350.0),
    (356.0, 5.0, StatusCode.JUMPED, 350.0), (350.0, 10.0, None, 350.0),
    # a stamp that does not advance leaves no time to change
    (351.0, 10.0, StatusCode.JUMPED, 350.0), (395.0, 15.0, StatusCode.JUMPED, 350.0),
    (350.0, 15.0, None, 350.0), (352.0, 61.0, StatusCode.DISTURBANCE_SILENT, 350.0)])
def test_each_check_of_a_sensor_holds_its_own_value(value, age, code, held):
    signals = Coordinates(('feed', 'ambient'), ('K', 'K'), *np.array(
        [[350.0, 290.0], [5.0, 5.0], [340.0, 280.0], [360.0, 300.0]]))
    limits = DisturbanceLimits(*np.array(
        [[300.0, 250.0], [400.0, 320.0], [1.0, 1.0], [60.0, 60.0]]))
    last = MeasuredDisturbances(signals.center, (100 * SECOND, 100 * SECOND))
    found = check_disturbances(limits, signals, last, np.array([value, 291.0]),
                               np.array([age, 0.0]), 110 * SECOND)
    assert found.value.tolist() == [held, 291.0]
    assert [(one.code, one.values['signal']) for one in found.faults] == (
        [] if code is None else [(code, 'feed')])
    assert found.shifted(-SECOND).times_ns[1] == 109 * SECOND


def test_without_a_rate_a_sensor_may_change_with_any_stamp():
    loop = controller()
    before = loop.step(State(), np.array([START]), 100 * SECOND, disturbances=np.array([350.0]))[0]
    state = loop.step(before, np.array([START]), 110 * SECOND, disturbances=np.array([360.0]),
                      ages=np.array([15.0]))[0]
    assert state.disturbances.faults == ()
    assert state.disturbances.value.tolist() == [360.0]


def test_an_event_carries_disturbances_and_their_ages():
    loop = controller()
    event = events.Measurement(SECOND, np.array([START]), disturbances=np.array([352.0]),
                               ages=np.array([61.0]))
    state = events.apply(loop, State(), event).state
    assert state.disturbances.faults[0].code is StatusCode.DISTURBANCE_UNKNOWN
    state = events.apply(loop, State(), replace(event, ages=None)).state
    assert state.disturbances.value.tolist() == [352.0]
