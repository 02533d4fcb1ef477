# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Range and rate limits of the inputs, and hand-overs that the input does not feel."""

from copy import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from koopman_ros.control import InputLimits, Mode, ModeChange, State
from koopman_ros.control.bumpless import BumplessTransfer, limit, with_step
from koopman_ros.evaluation import exchange, restart
from studies.robustness.loop import changed_reactor
from support.closed_loops import (
    controller,
    EPOCH,
    largest_step,
    Reactor,
    SETPOINT,
    settled,
    shipped,
    START,
)


@pytest.mark.parametrize(('previous', 'wanted', 'seconds', 'rate', 'u', 'at_range', 'at_rate'), [
    # the first command has no rate
    (None, 0.0, 0.0, 2.0, 0.0, False, False), (None, 5.0, 0.0, 2.0, 5.0, False, False),
    (None, 5.1, 0.0, 2.0, 5.0, True, False), (None, -9.0, 0.0, 2.0, -1.0, True, False),
    (None, 1e308, 0.0, 2.0, 5.0, True, False), (None, np.inf, 0.0, 2.0, 5.0, True, False),
    # the rate counts from the last one
    (1.0, 3.0, 1.0, 2.0, 3.0, False, False), (1.0, 3.5, 1.0, 2.0, 3.0, False, True),
    (1.0, -0.9, 0.5, 2.0, 0.0, False, True), (1.0, 9.0, 1.0, 2.0, 3.0, True, True),
    (1.0, 9.0, 10.0, 2.0, 5.0, True, False), (1.0, 3.0, 0.0, 2.0, 1.0, False, True),
    (1.0, 1.0, 0.0, 2.0, 1.0, False, False),
    # a range that was tightened is reached at the rate
    (8.0, 3.0, 0.1, 2.0, 7.8, False, True), (8.0, 9.0, 0.1, 2.0, 7.8, True, True),
    # no rate limit, at the first answer of all, too
    (-1.0, 4.0, 1e-9, np.inf, 4.0, False, False), (-1.0, 4.0, 0.0, np.inf, 4.0, False, False),
    # a command that exceeds a limit by rounding alone was computed within it
    (None, 5.0 + 1e-14, 0.0, 2.0, 5.0, False, False),
    (1.0, 3.0 + 1e-14, 1.0, 2.0, 3.0, False, False)])
def test_limits(previous, wanted, seconds, rate, u, at_range, at_rate):
    bounds = InputLimits(np.array([-1.0]), np.array([5.0]), np.array([rate]))
    command, *active = limit(
        bounds, np.ones(1), np.array([wanted]),
        None if previous is None else np.array([previous]), seconds)
    assert (command[0], *active) == (pytest.approx(u, rel=1e-15), at_range, at_rate)


def step(size: float) -> BumplessTransfer:
    return BumplessTransfer(np.array([size]), np.array([size]))


def faded(seconds: float, constant: float) -> float:
    return (1.0 + seconds / constant) * float(np.exp(-seconds / constant))


@pytest.mark.parametrize('steps', [[10.0], [1.0] * 10, [0.3, 4.7, 5.0]])
def test_an_offset_fades_by_its_formula_however_it_is_sampled(steps):
    transfer = step(3.0)
    for seconds in steps:
        transfer = transfer.after(seconds, 30.0)
    np.testing.assert_allclose(transfer.offset, [3.0 * faded(10.0, 30.0)], rtol=1e-12)


def test_offsets_add_up():
    transfer = with_step(step(2.0).after(10.0, 30.0), np.array([-1.0])).after(20.0, 30.0)
    expected = 2.0 * faded(30.0, 30.0) - faded(20.0, 30.0)
    np.testing.assert_allclose(transfer.offset, [expected], rtol=1e-12)


def test_an_offset_ends():
    transfer, seconds = step(5.0), 0
    while transfer is not None:
        transfer, seconds = transfer.after(1.0, 30.0), seconds + 1
    assert 500 < seconds < 1000
    assert step(5.0).after(1e9, 30.0) is None
    # without a time constant, with the next sample
    assert step(5.0).after(0.0, 0.0).offset[0] == 5.0
    assert step(5.0).after(1e-9, 0.0) is None


DRIFTED = 0.8


@cache
def at_rest(setpoint: float, heat_transfer: float) -> Reactor:
    loop = Reactor(controller(), changed_reactor(heat_transfer=heat_transfer))
    loop.run(10)
    loop.ask(setpoint)
    loop.run(480)
    assert abs(loop.kelvin - setpoint) < 1e-6
    return loop


def loop_at(setpoint: float, heat_transfer: float = 1.0) -> Reactor:
    """Return a loop at rest at a set-point; with another heat transfer than the model's."""
    loop = copy(at_rest(setpoint, heat_transfer))
    loop.samples = list(loop.samples)
    return loop


def test_automatic_to_manual_and_back_at_rest():
    loop = loop_at(SETPOINT, DRIFTED)
    loop.do(ModeChange(Mode.MANUAL))
    loop.run(60)
    loop.do(ModeChange(Mode.AUTOMATIC))
    loop.run(60)
    assert largest_step(loop.samples[480:]) < 1e-6


def test_from_a_coolant_that_the_law_would_not_choose():
    loop = loop_at(START)
    loop.manual(loop.samples[-1].command - 4.0)
    before = loop.run(300)[-1]
    loop.do(ModeChange(Mode.AUTOMATIC))
    samples = loop.run(420)
    assert abs(samples[0].command - before.command) < 0.01
    assert abs(samples[1].command - samples[0].command) < 0.01
    # and smoothly on its way from there
    assert largest_step(samples) < 0.12
    assert settled(samples, START, 1e-3) < 420


@pytest.mark.parametrize('change', [
    {'input_weight': np.array([0.05])}, {'state_weight': np.array([0.1])},
    {'observer_bandwidth': 12.0 / 60.0}, {'bumpless_transfer_time': 5.0},
    {'limits': InputLimits(np.array([270.0]), np.array([320.0]), np.array([5.0]))},
], ids=lambda change: next(iter(change)))
def test_retuning(change):
    # at rest nothing is felt
    loop = loop_at(SETPOINT, DRIFTED)
    loop.do(exchange(controller(**change)))
    assert largest_step(loop.run(60)) < 1e-6
    # and under way the command goes on where it was
    loop.ask(START)
    before = loop.run(25)
    loop.do(exchange(controller()))
    after = loop.run(2)
    assert abs(after[0].command - before[-1].command) < 0.2 + largest_step(before[-2:])


def test_a_storm_of_tunings_does_not_stop_the_feedback():
    tunings = [controller(), controller(input_weight=np.array([0.05]))]
    loop = Reactor(tunings[0])
    loop.run(10)
    loop.ask(SETPOINT)
    for second in range(300):
        loop.do(exchange(tunings[second % 2]))
        loop.run(1)
    assert settled(loop.samples[10:], SETPOINT, 0.05) < 290


LINEAR = shipped('reactor_linear')
SCALED = replace(LINEAR, B=LINEAR.B / 2.0, states=replace(
    LINEAR.states, scale=LINEAR.states.scale * 2.0))


@pytest.mark.parametrize(('other', 'more'), [('reactor_nz3', 0.0), (SCALED, 0.5)],
                         ids=['reactor_nz3', 'in other units of scale'])
def test_another_model_at_rest(other, more):
    loop = loop_at(SETPOINT, DRIFTED)
    before = loop.samples[-1].report.estimate.disturbance
    for model in (other, 'reactor_nz4', other):
        loop.do(exchange(controller(model)))
        samples = loop.run(100)
        assert largest_step(samples) < 1e-6
        assert settled(samples, SETPOINT, 1e-3) == 0
    # the linear model leaves more to the disturbance
    assert abs(float(samples[0].report.estimate.disturbance[0] - before[0])) > more


@pytest.mark.parametrize('at_rest', [True, False])
def test_a_restart_takes_over_from_the_coolant_in_force(at_rest):
    loop = loop_at(SETPOINT, DRIFTED)
    if not at_rest:
        loop.ask(START)
        loop.run(25)
    before = loop.samples[-1].command
    loop.do(restart)
    samples = loop.run(400)
    assert samples[0].command == before
    assert largest_step(samples) < (1e-6 if at_rest else 0.5)
    # what it found is what it holds
    assert settled(samples, float(samples[0].temperature), 1e-3) < 400


def test_a_coolant_that_is_no_number_is_not_taken_over():
    loop = controller()
    assert loop.initialise(State(), np.array([np.nan])).command is None
    state = loop.initialise(State(), np.array([1e300]))
    np.testing.assert_array_equal(state.command, [305.15])
    # later it is no news
    assert loop.initialise(state, np.array([290.0])) is state


def test_who_wants_no_transfer_is_answered_by_the_law_from_the_first_measurement_on():
    free = controller(bumpless_transfer_time=0.0, observer_bandwidth=0.0, limits=InputLimits(
        np.array([278.15]), np.array([305.15]), np.array([np.inf])))
    measured = np.array([START + 2.0])
    _, alone, _ = free.step(State(), measured, EPOCH)
    _, after, _ = free.step(free.initialise(State(), np.array([290.0])), measured, EPOCH)
    assert alone[0] != 290.0
    np.testing.assert_array_equal(after, alone)
    # with a transfer it begins where the input is
    usual = controller()
    _, begun, _ = usual.step(usual.initialise(State(), np.array([290.0])), measured, EPOCH)
    assert begun[0] == 290.0
