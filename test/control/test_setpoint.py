# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The set-point: what is refused, when a request takes effect, and its ramp."""

import numpy as np
import pytest

from koopman_ros.control import Setpoint
from koopman_ros.control.setpoint import advance, HORIZON_NANOSECONDS, refusal, request
from koopman_ros.units import NANOSECONDS as SECOND
from support.closed_loops import shipped
from support.sampled_loops import say

MODEL = shipped('reactor_nz4')
# a wall clock, far from where time starts
NOW = 1_785_000_000 * SECOND


def kelvin(value):
    return np.array([value])


def moved(setpoint, now_ns=NOW, *, measured=320.0, ramp=np.inf, seconds=1.0):
    return advance(setpoint, kelvin(measured), MODEL, kelvin(ramp), now_ns, seconds)


def schedule(setpoint):
    return [(time_ns, float(value[0])) for time_ns, value in setpoint.scheduled]


OUTSIDE = (' is outside the trained range 305 K to 327 K: the old one is kept; choose one inside, '
           'or load a model trained over a wider range')


@pytest.mark.parametrize(('value', 'text'), [
    *((value, '') for value in (306.0, 314.4, *MODEL.states.lower, *MODEL.states.upper)),
    (300.0, 'temperature set-point 300 K' + OUTSIDE),
    (330.123, 'temperature set-point 330.123 K' + OUTSIDE),
    # by a hair
    (np.nextafter(MODEL.states.lower[0], 0.0), 'temperature set-point 305 K' + OUTSIDE),
    (np.nextafter(MODEL.states.upper[0], np.inf), 'temperature set-point 327 K' + OUTSIDE),
    *((value, f'temperature set-point {value} K is not finite: the old one is kept')
      for value in (np.nan, np.inf, -np.inf)),
])
def test_refusals_say_why(value, text):
    assert say(refusal(MODEL, kelvin(value))) == text


@pytest.mark.parametrize(('effective_ns', 'waits'), [
    (0, False), (1, False), (SECOND, False), (NOW - 1, False), (NOW, False), (NOW + 1, True),
    (NOW + SECOND, True), (NOW + HORIZON_NANOSECONDS, True),
    (NOW + HORIZON_NANOSECONDS + 1, False), (2 * NOW, False)])
def test_past_and_foreign_stamps_act_at_once_and_others_wait(effective_ns, waits):
    setpoint = request(Setpoint(), kelvin(310.0), effective_ns, NOW)
    assert schedule(setpoint) == ([(effective_ns, 310.0)] if waits else [])
    assert (setpoint.requested is None) is waits
    # before the first measurement nobody knows; that tells what lies ahead
    setpoint = request(Setpoint(), kelvin(310.0), effective_ns, None)
    setpoint = moved(setpoint, NOW, measured=320.0, seconds=0.0)
    assert bool(setpoint.scheduled) is waits
    np.testing.assert_array_equal(setpoint.requested, [320.0 if waits else 310.0])


def test_scheduled_requests_take_effect_in_time_order():
    setpoint = Setpoint()
    for ahead, value in ((30, 310.0), (10, 312.0), (20, 314.0), (10, 316.0)):
        setpoint = request(setpoint, kelvin(value), NOW + ahead * SECOND, NOW)
    # the later request for the same time replaces the earlier one
    assert schedule(setpoint) == [
        (NOW + 10 * SECOND, 316.0), (NOW + 20 * SECOND, 314.0), (NOW + 30 * SECOND, 310.0)]
    # of several that are due the latest counts
    np.testing.assert_array_equal(moved(setpoint, NOW + 25 * SECOND).active, [314.0])
    active = []
    for elapsed in range(0, 41, 5):
        setpoint = moved(setpoint, NOW + elapsed * SECOND)
        active.append(float(setpoint.active[0]))
    assert active == [320.0, 320.0, 316.0, 316.0, 314.0, 314.0, 310.0, 310.0, 310.0]
    assert schedule(setpoint) == []


def test_a_request_at_once_ends_the_schedule():
    setpoint = request(Setpoint(), kelvin(310.0), NOW + SECOND, NOW)
    setpoint = request(setpoint, kelvin(316.0), 0, NOW)
    assert schedule(setpoint) == []
    np.testing.assert_array_equal(moved(setpoint, NOW).active, [316.0])
    np.testing.assert_array_equal(moved(setpoint, NOW + SECOND).active, [316.0])


@pytest.mark.parametrize(('measured', 'held'), [
    (320.0, 320.0), (400.0, MODEL.states.upper[0]), (200.0, MODEL.states.lower[0])])
def test_the_first_measurement_is_held(measured, held):
    setpoint = moved(Setpoint(), measured=measured, seconds=0.0)
    np.testing.assert_array_equal(setpoint.active, [held])
    np.testing.assert_array_equal(setpoint.requested, [held])
    # and stays when the temperature moves on
    np.testing.assert_array_equal(moved(setpoint, NOW + SECOND, measured=310.0).active, [held])


def test_without_a_ramp_the_setpoint_steps_and_without_a_request_it_stays():
    before = Setpoint(active=kelvin(320.0))
    np.testing.assert_array_equal(
        moved(request(before, kelvin(310.0), 0, NOW), seconds=1e-9).active, [310.0])
    np.testing.assert_array_equal(moved(before, measured=310.0).active, [320.0])


@pytest.mark.parametrize('goal', [310.0, 324.0])
def test_the_ramp_reaches_its_goal_and_stays(goal):
    setpoint = request(moved(Setpoint(), seconds=0.0), kelvin(goal), 0, NOW)
    direction = np.sign(goal - 320.0)
    for second in range(1, 40):
        setpoint = moved(setpoint, NOW + second * SECOND, ramp=0.5)
        expected = 320.0 + direction * min(0.5 * second, abs(goal - 320.0))
        assert setpoint.active[0] == pytest.approx(expected, rel=1e-12)
    assert setpoint.active[0] == goal


@pytest.mark.parametrize('before', [moved(Setpoint(), seconds=0.0), Setpoint()])
def test_the_ramp_starts_from_the_first_measurement_and_with_time(before):
    setpoint = request(before, kelvin(310.0), 0, NOW)
    np.testing.assert_array_equal(moved(setpoint, ramp=0.5, seconds=0.0).active, [320.0])
