# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The way back from the safe input, and where that leads."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from koopman_ros.control import Controller, InputLimits, Settings, State
from koopman_ros.control.supervisor import leads_home, rest_under, WayBack
from koopman_ros.lifting import Coordinates, linearised_model, Provenance
from koopman_ros.ros.model_loading import rests_outside
from support.closed_loops import REACTOR, shipped, START
from support.sampled_loops import (
    controller,
    largest_step,
    levels,
    Reactor,
    SAFE,
    SECOND,
    settled,
)
from validation.robustness.disturbances import CHANGED
from validation.robustness.loop import changed_reactor

NOMINAL = 300.0  # K, of the coolant
LEAD = 0.25

def rest_of(plant, coolant=SAFE):
    """Return the cold temperature at which a reactor rests under a coolant, in K."""
    return float(brentq(lambda T: plant.derivative(np.array([T]), np.array([coolant]))[0],
                        coolant, 320.0))


def narrow(model=None):
    """Return a lift that knows the shipped one's middle only."""
    model = model or shipped('reactor_nz4')
    center = model.states.center
    return replace(model, states=replace(model.states, lower=center - 1.5, upper=center + 1.5))


def rested(plant, model='reactor_nz4', noise=0.0):
    """Return a loop that finds its plant at rest under the safe coolant, far outside."""
    loop = Reactor(controller(model), plant, rest_of(plant), noise=noise)
    loop.ask(START)
    return loop


@pytest.mark.parametrize('plant', [REACTOR, *CHANGED.values()], ids=['as it was', *CHANGED])
def test_after_a_dead_sensor_the_loop_comes_back_by_itself(plant):
    if plant is not REACTOR:
        loop = rested(plant)
    else:
        loop = Reactor(controller(), plant)
        loop.run(5)
        silent = loop.run(260, lambda _: None)
        assert silent[-1].report.level == 'safe'
        assert silent[-1].command == SAFE
        assert silent[-1].temperature == pytest.approx(rest_of(plant), abs=0.1)
    samples = loop.run(320)
    assert samples[-1].report.level == 'sdre'
    assert settled(samples, START, 0.2) < 310
    assert max(s.temperature for s in samples) < START + 1.5
    assert largest_step(samples) <= 1.0 + 1e-9


def test_a_noisy_sensor_does_not_keep_it_there():
    loop = rested(CHANGED['UA +20 %'], noise=0.1)
    samples = loop.run(320)
    assert samples[-1].report.level == 'sdre'
    assert settled(samples, START, 0.3) < 320


def test_even_a_lift_of_narrow_data_comes_back():
    samples = rested(REACTOR, narrow()).run(450)
    assert samples[-1].report.level == 'sdre'
    assert samples[-1].temperature == pytest.approx(START, abs=0.2)


@pytest.mark.parametrize('noise', [0.0, 0.1])
def test_a_sensor_that_stands_still_brings_the_coolant_no_further_than_the_lead(noise):
    plant = changed_reactor(heat_transfer=0.6)
    loop = rested(plant)
    rng = np.random.default_rng(1)
    samples = loop.run(200, lambda _: 298.0 + noise * rng.standard_normal())
    assert levels(samples) == ['safe']
    assert samples[-1].report.command.way_back == pytest.approx(LEAD, abs=0.6 * noise)
    # the plant that loses most of its cooling does not even then run away
    assert max(s.temperature for s in samples) < 327.0


def test_nothing_moves_before_the_plant_rests_and_the_safe_input_is_back_with_the_first_fault():
    loop = rested(CHANGED['UA +20 %'])
    assert {s.command for s in loop.run(30)} == {SAFE}
    led = loop.run(4)
    assert [s.report.command.way_back for s in led] == pytest.approx([LEAD] * 4, abs=0.1)
    assert led[-1].command == SAFE + 4.0
    blind = loop.run(5, lambda _: float('nan'))
    assert {s.report.command.way_back for s in blind} == {0.0}
    assert blind[-1].command == SAFE
    assert loop.run(1)[0].command == SAFE


def test_a_hot_reactor_that_stands_still_keeps_the_safe_coolant():
    boundary = float(brentq(lambda T: REACTOR.derivative(np.array([T]), np.array([SAFE]))[0],
                            335.0, 380.0))
    loop = Reactor(controller(), kelvin=boundary - 1e-6, coolant=SAFE)
    samples = loop.run(120)
    assert samples[60].temperature > boundary - 0.2
    assert {s.command for s in samples} == {SAFE}


@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_it_leads_back_from_either_side(side):
    """A plant dx/dt = u - x + 0.2 whose safe input takes it to 4 half widths from its nominal."""
    box = Coordinates(('x',), ('1',), np.zeros(1), np.ones(1), -np.ones(1), np.ones(1))
    model = linearised_model(-np.eye(1), np.eye(1), box, replace(box, names=('u',)), 's',
                             Provenance('plant'))
    step = Controller(model, Settings.for_model(
        model, state_weight=np.ones(1), input_weight=np.ones(1),
        limits=InputLimits(np.array([-9.0]), np.array([9.0]), np.ones(1)),
        observer_bandwidth=0.5, transfer_time=5.0, safe_input=np.array([4.0 * side])))
    state = step.initialise(State(), np.array([4.0 * side]))
    state, refused = step.request_setpoint(state, np.array([-0.5 * side]))
    assert refused is None
    x, shares = 4.0 * side + 0.2, []
    for second in range(1, 150):
        state, u, report = step.step(state, np.array([x]), second * SECOND)
        shares.append(report.command.way_back)
        x += (u[0] + 0.2 - x) * -np.expm1(-1.0)
    assert max(shares) > 0.5
    assert report.level == 'sdre'
    assert x == pytest.approx(-0.5 * side, abs=1e-3)


def test_the_input_is_ahead_of_the_plant_by_the_lead():
    way = WayBack(2.0, 2.0, 0)
    assert way.share == 0.0
    assert way.moved(2.0, 29 * SECOND, 10.0).share == 0.0
    led = way.moved(2.0, 30 * SECOND, 10.0)
    assert led.share == LEAD
    half = led.moved(1.0, 31 * SECOND, 10.0)
    assert half.share == pytest.approx(LEAD + 0.5)
    # what has been reached is not given up for noise, but the way starts anew further out
    assert half.moved(1.5, 32 * SECOND, 10.0) == half
    assert half.moved(0.0, 33 * SECOND, 10.0).share == 1.0
    assert half.moved(2.2, 34 * SECOND, 10.0) == WayBack(2.2, 2.2, 34 * SECOND)


def test_what_comes_back_by_itself_is_waited_for():
    way = WayBack(2.0, 2.0, 0)
    for second in range(1, 60):
        way = way.moved(2.0 - 0.02 * second, second * SECOND, 10.0)
        assert way.share == 0.0


def test_home_is_where_the_input_pushes():
    model = shipped('reactor_nz4')
    safe, nominal = np.array([SAFE]), np.array([NOMINAL])
    assert leads_home(model, np.array([299.0]), safe, nominal)
    assert not leads_home(model, np.array([340.0]), safe, nominal)
    assert leads_home(model, np.array([340.0]), nominal, safe)
    assert not leads_home(model, np.array([299.0]), nominal, nominal)


# What a model tells of the safe input.

@pytest.mark.parametrize('name', ['reactor_nz3', 'reactor_nz4'])
@pytest.mark.parametrize('coolant', [SAFE, 282.0, 292.0])
def test_a_model_tells_where_the_safe_input_rests(name, coolant):
    rest = rest_under(shipped(name), np.array([coolant]), 0.25)
    assert rest.x[0] == pytest.approx(rest_of(REACTOR, coolant), abs=0.05)
    assert rest.outside == pytest.approx(max(0.0, (305.0 - rest.x[0]) / 11.0))
    assert rest.holding is None


@pytest.mark.parametrize('name', ['reactor_nz3', 'reactor_nz4', 'reactor_linear'])
def test_shipped_models_are_not_complained_of(name):
    assert rests_outside(Controller(shipped(name), controller().settings)) == ''


def test_a_lift_of_narrow_data_says_that_the_safe_coolant_leads_out_of_its_range():
    narrowed = controller(narrow())
    # what holds the true reactor a quarter of half the width below the range
    edge = float(narrowed.model.states.lower[0]) - 0.25 * 1.5
    holding = float(brentq(lambda u: REACTOR.derivative(np.array([edge]), np.array([u]))[0],
                           SAFE, 305.0))
    assert narrowed.rest.holding[0] == pytest.approx(holding, abs=0.05)
    words = rests_outside(Controller(narrowed.model, narrowed.settings))
    assert 'under safe_coolant = 5' in words
    assert 'leaves the trained range' in words
    assert 'record data from there and train again, or set safe_coolant to 25.8' in words
    warmer = replace(narrowed.settings, safe_input=np.array([holding + 0.1]))
    assert rests_outside(Controller(narrowed.model, warmer)) == ''


def test_a_safe_input_that_drives_the_reactor_up_is_told_as_well():
    hot = controller(safe_input=np.array([305.15]))
    assert hot.rest.holding[0] < 305.15
    assert 'or less' in rests_outside(hot)
