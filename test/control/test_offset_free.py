# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Zero offset on plants that are not the model, with the node's default tuning."""

import numpy as np
import pytest

from koopman_ros.control import perfect
from koopman_ros.plants import Actuator, two_state_reactor
from support.closed_loops import REACTOR, SETPOINT, START
from support.sampled_loops import controller, Reactor, settled, UPPER
from validation.robustness.disturbances import CHANGED
from validation.robustness.loop import changed_reactor

# The nominal loop's step response of 10 K takes 192 s to stay within 1e-3 K.
RESPONSE, MORE = 192, 120  # s

def test_nominal_step_response():
    loop = Reactor(controller())
    loop.run(10)
    loop.ask(SETPOINT)
    samples = loop.run(RESPONSE + MORE)
    assert settled(samples, SETPOINT, 1e-3) <= RESPONSE
    assert min(s.temperature for s in samples) > SETPOINT - 0.1
    # the model is so good that there is next to nothing to estimate
    assert max(abs(float(s.report.estimate.disturbance[0])) for s in samples) < 0.01


@pytest.mark.parametrize(('plant', 'others'), [
    *((plant, {}) for plant in CHANGED.values()),
    *((REACTOR, {'actuator': Actuator(lag=lag, delay=delay)})
      for lag, delay in ((10.0, 0.0), (0.0, 1.0), (10.0, 1.0))),
    # a biased measurement of the coolant brings no offset
    *((CHANGED['UA −20 %'], {'input_sensor': lambda u, _, error=error: u + error})
      for error in (-1.5, 1.5))],
    ids=[*CHANGED, 'lag 10 s', 'delay', 'lag and delay', 'told less', 'told more'])
def test_what_is_not_the_model_is_brought_to_its_setpoint(plant, others):
    loop = Reactor(controller(), plant, **others)
    loop.run(10)
    loop.ask(SETPOINT)
    samples = loop.run(RESPONSE + MORE)
    assert settled(samples, SETPOINT, 1e-3) <= RESPONSE + MORE - 10
    assert plant is REACTOR or abs(float(samples[-1].report.estimate.disturbance[0])) > 0.4


@pytest.mark.parametrize('step', [-3.0, 1.5])
def test_two_state_reactor_under_the_lift_of_the_one_state_one(step):
    plant = two_state_reactor()
    loop = Reactor(controller(), plant, kelvin=float(plant.nominal_state[1]))
    loop.run(10)
    setpoint = float(plant.nominal_state[1]) + step
    loop.ask(setpoint)
    # its own slow mode, -1.05/min, takes 224 s to fade to a fiftieth
    assert settled(loop.run(420), setpoint, 1e-3) <= 224 + 130


def test_a_biased_sensor_is_shown_for_what_it_is():
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
    loop = Reactor(controller(), input_sensor=perfect if tells else None)
    loop.run(10)
    loop.ask(SETPOINT)
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
    loop = Reactor(controller(observer_bandwidth=0.0), CHANGED['UA −20 %'])
    loop.run(10)
    loop.ask(SETPOINT)
    assert abs(loop.run(300)[-1].temperature - SETPOINT) > 3.0


@pytest.mark.parametrize(('bandwidth', 'low', 'high'), [(2.0, 0.0, 0.03), (6.0, 0.04, 0.09),
                                                       (12.0, 0.09, 0.4)])
def test_bandwidth_trades_noise_for_speed(bandwidth, low, high):
    loop = Reactor(controller(observer_bandwidth=bandwidth / 60.0), noise=0.1)
    commands = np.array([s.command for s in loop.run(800)[200:]])
    assert low < np.std(commands) < high
    # the filter adds no offset
    assert abs(np.mean([s.temperature for s in loop.samples[200:]]) - START) < 0.02
