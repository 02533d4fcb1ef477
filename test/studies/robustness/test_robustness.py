# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Figures of the robustness study against references that do not use its code."""

from dataclasses import replace
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from koopman_ros.control import at
from studies.robustness import disturbances, loop, stability
from studies.robustness.disturbances import Case
from studies.robustness.loop import REACTOR, START

PERIOD = 1.0 / 60.0  # min


def _first_order(temperature, coolant_weight=1.0):
    """Return slope a, gain b (1/min) and K of the scalar sampled regulator by hand."""
    a = REACTOR.drift_jacobian(np.array([temperature]))[0, 0]
    b = REACTOR.B[0, 0]
    pole, square = math.exp(a * PERIOD), math.exp(2.0 * a * PERIOD)
    # integrals of exp(a t) and exp(2 a t); weights over a period of state, product and input
    once, twice = (pole - 1.0) / a, (square - 1.0) / (2.0 * a)
    N = b / a * (twice - once)
    R = coolant_weight * PERIOD + (b / a) ** 2 * (twice - 2.0 * once + PERIOD)
    gain = b * once
    # (P (1 - pole^2) - twice) (R + gain^2 P) + (gain pole P + N)^2 = 0
    P = max(np.roots([gain ** 2, (1.0 - square) * R - twice * gain ** 2 + 2.0 * gain * pole * N,
                      N * N - twice * R]))
    return a, b, (gain * P * pole + N) / (R + gain ** 2 * P)


@pytest.mark.parametrize(('temperature', 'weight'), [(310.0, 1.0), (START, 0.1)])
def test_margins_without_observer_are_those_of_a_first_order_loop(temperature, weight):
    a, b, K = _first_order(temperature, weight)
    # of the plant between samples
    pole = math.exp(a * PERIOD)
    gain = b * (pole - 1.0) / a
    controller = loop.reactor_controller(bandwidth=0.0, coolant_weight=weight)
    found = stability.margins_at(controller, temperature)
    learned = -stability.linearised_controller(controller, temperature).D[0, 0]
    # as far as the lift's slope is that of the reactor
    assert learned == pytest.approx(K, rel=2e-3)
    K = learned
    # the pole of the closed loop leaves the unit circle at -1
    assert found.gain == pytest.approx((1.0 + pole) / (K * gain), rel=1e-6)
    # |K gain| = |exp(jw) - pole|; the rest of half a turn is the phase margin
    cosine = (1.0 + pole ** 2 - (K * gain) ** 2) / (2.0 * pole)
    if abs(cosine) > 1.0 or K * gain < 1.0 - pole:
        assert found.delay == math.inf
        return
    w = math.acos(cosine)
    phase = math.pi - np.angle(np.exp(1j * w) - pole)
    assert found.phase == pytest.approx(math.degrees(phase), rel=1e-4)
    assert found.delay == pytest.approx(phase / w, rel=1e-4)


def test_differences_of_the_step_agree_with_the_observer_by_hand():
    found = stability.linearised_controller(loop.reactor_controller(bandwidth=6.0), 316.0)
    a, b, K = _first_order(316.0)
    p = math.exp(-6.0 * PERIOD)
    # the observer predicts by Heun's method; disturbance in K/min, measured in K
    h = PERIOD
    drift, push = 1.0 + a * h + 0.5 * (a * h) ** 2, h * (1.0 + 0.5 * a * h)
    take, learn = 1.0 - p * p, (1.0 - p) ** 2 / h
    F = np.array([[(1.0 - take) * drift, (1.0 - take) * push, (1.0 - take) * b * push],
                  [-learn * drift, 1.0 - learn * push, -learn * b * push]])
    G = np.array([[take], [learn]])
    law = np.array([[-K, -1.0 / b]])
    scale = np.diag([1.0 / loop.shipped_model().states.scale[0]] * 2 + [1.0])
    A = np.vstack([F, law @ F])
    B = np.vstack([G, law @ G])
    # in the lift's scaled deviations; the lift is not the reactor to the last digit
    np.testing.assert_allclose(found.A, scale @ A @ np.linalg.inv(scale), atol=2e-3)
    np.testing.assert_allclose(found.B, scale @ B, atol=2e-3)
    np.testing.assert_allclose(found.D, law @ G, atol=2e-3)


def test_the_delay_margin_is_where_the_simulated_loop_begins_to_oscillate():
    controller = loop.reactor_controller(bandwidth=10.0, coolant_weight=0.1)
    at = stability.margins_at(controller, 316.0)
    assert at.delay == pytest.approx(8.92, abs=0.05)
    assert not stability.grows(controller, 316.0, delay=0.95 * at.delay, seconds=450.0)
    assert stability.grows(controller, 316.0, delay=1.05 * at.delay, seconds=450.0)
    assert stability.linearised_reactor(316.0).A[0, 0] == pytest.approx(
        math.exp(REACTOR.drift_jacobian(np.array([316.0]))[0, 0] * PERIOD), rel=1e-12)


def test_no_coolant_saves_what_is_hotter_than_the_boundary():
    """With the coolant on its way to the coldest as fast as it may, from scipy's integration."""
    boundary = stability.hottest_saved(300.0)

    def rate(t, x):
        return REACTOR.derivative(x, np.array([max(278.15, 300.0 - 60.0 * t)]))

    def gone(t, x):
        return x[0] - 400.0

    gone.terminal = True
    ends = [solve_ivp(rate, (0.0, 5.0), [boundary + d], rtol=1e-9, max_step=0.05,
                      events=gone).y[0, -1] for d in (-0.01, 0.01)]
    assert ends[0] < 330.0
    assert ends[1] > 399.0


@pytest.mark.parametrize(('temperature', 'fallback', 'end'), [
    (340.0, True, 'SAFE'), (340.0, False, 'RAN_AWAY'), (343.0, True, 'RAN_AWAY')])
def test_fallback_widens_the_region_of_attraction(temperature, fallback, end):
    assert stability.end_of(temperature, 316.0, fallback=fallback).name == end


def test_a_disturbance_leaves_no_offset_and_a_biased_sensor_its_bias():
    cases = {case.name: case for case in disturbances.cases()}
    found = disturbances.judge(replace(cases['UA −20 %, in the loop'], seconds=600.0))
    assert found['final_kelvin'] == pytest.approx(0.0, abs=1e-3)
    assert found['seconds_to_0.2_kelvin'] < 180.0
    # the coolant that makes up for it: UA (T_c - T) as before, from the heat balance
    assert found['disturbance_kelvin'] == pytest.approx(0.25 * (START - 300.0), abs=0.01)
    found = disturbances.judge(Case('', [at(0.0, loop.at_setpoint(START - 5.0))], START - 5.0,
                                    x0=[START - 5.0], seconds=600.0,
                                    sensor=loop.biased(1.0, 10.0)))
    assert found['final_kelvin'] == pytest.approx(-1.0, abs=1e-3)
    assert found['equivalent_bias_kelvin'] == pytest.approx(1.0, abs=1e-2)


def test_settling_counts_from_the_change():
    course = loop.run_loop(loop.reactor_controller(), REACTOR, np.array([START]), 300.0, 60.0,
                      [at(20.0, loop.at_setpoint(START - 1.0))])
    assert loop.settling(course, START, 0.01, 0.0) is None
    assert loop.settling(course, START - 1.0, 2.0, 20.0) == 0.0
    errors = course.states[:, 0] - (START - 1.0)
    first = course.times[np.flatnonzero(np.abs(errors) > 0.9)[-1] + 1]
    assert loop.settling(course, START - 1.0, 0.9, 20.0) == first - 20.0


def test_what_rests_outside_the_data_comes_back_from_the_safe_coolant():
    usual = stability.back_from_safe(REACTOR, 0.5)
    # by the heat balance; the trained range starts at 305 K, half its width is 11
    assert usual['rest_kelvin'] == pytest.approx(302.565, abs=1e-2)
    assert usual['outside'] == pytest.approx((305.0 - usual['rest_kelvin']) / 11.0, abs=1e-6)
    assert usual['seconds_to_0.2_kelvin'] < 300.0
    better_cooled = stability.back_from_safe(disturbances.CHANGED['UA +20 %'], 0.5)
    assert better_cooled['outside'] > 0.5
    assert better_cooled['seconds_to_0.2_kelvin'] < 300.0
