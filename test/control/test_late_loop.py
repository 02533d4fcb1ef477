# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Whatever happens to a loop whose input acts late: each sample has a command within limits."""

from dataclasses import replace
from functools import cache

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from koopman_ros.control import events, Mode, SetpointRequest, State
from koopman_ros.core.paths import model_path
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.event_log.records import decoded, encoded
from koopman_ros.model import load
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.plants import Actuator, plant_class, Process

MODEL = load(model_path('heated_line'))
SYSTEM = plant_class('heated_line')().system()
PERIOD_NS, COLD, HOT = 5 * NANOSECONDS, 308.0, 338.0
ODD = st.sampled_from([np.nan, np.inf, -1e300, 500.0, 0.0])
KELVIN = st.floats(COLD, HOT)
FEED = st.none() | st.floats(283.0, 303.0) | ODD
HAPPENS = st.one_of(
    *[st.tuples(st.just('run'), st.integers(1, 8), FEED)] * 3,
    st.tuples(st.just('faulty'), st.integers(1, 20), ODD | KELVIN, st.sampled_from([None, 1, 2])),
    st.tuples(st.just('silent'), st.integers(1, 20)),
    st.tuples(st.just('late'), st.integers(0, 60), st.floats(0.1, 0.6) | ODD),
    st.tuples(st.just('setpoint'), KELVIN | ODD, st.sampled_from([0, 0, 7])),
    st.tuples(st.just('manual'), st.floats(-50.0, 150.0) | ODD),
    st.tuples(st.just('mode'), st.sampled_from(Mode)), st.tuples(st.just('clear')),
    st.tuples(st.just('restart'), st.booleans()), st.tuples(st.just('replay')),
    st.tuples(st.just('reload'), st.sampled_from([0.0, 31.5, 45.0, 58.5, 300.0]),
              st.sampled_from(['sdre', 'pi']), st.booleans()))


@cache
def controller(seconds, law, latch):
    model = replace(MODEL, dead_time=np.array([seconds]))
    named = {'system': 'heated_line', 'fallback_order': (law, 'linear'), 'safe_latch': latch}
    table = table_of(model, named)
    return built(table.amended(table.snapshot({}), **named), model)


class Loop:
    """A heated line and its controller, whose commands are checked as they come."""

    def __init__(self, dead_time):
        actuator = Actuator(0.0, 100.0, dead_time=dead_time, rangeability=20.0)
        u = actuator.position(SYSTEM.nominal_input)
        self.plant = Process(SYSTEM, PERIOD_NS, SYSTEM.nominal_state, u, actuator, u)
        self.controller, self.state = controller(45.0, 'sdre', False), State()

    def do(self, event):
        outcome = events.apply(self.controller, self.state, event)
        self.state = outcome.state
        return outcome

    def sample(self, kelvin=None, feed=None, quality=None, silent=False):
        time_ns = self.plant.time_ns + PERIOD_NS
        self.plant = self.plant.until(time_ns)
        y = self.plant.x[1:] if kelvin is None else np.array([kelvin])
        command = self.do(events.Silence(time_ns) if silent else events.Measurement(
            time_ns, y, self.plant.applied,
            disturbances=None if feed is None else np.array([feed]),
            quality=None if quality is None else (quality,))).command
        if command is None:  # nothing is known yet
            assert silent
            assert self.state.command is None
            return
        assert np.isfinite(command).all()
        assert 0.0 <= command[0] <= 100.0
        self.plant = self.plant.commanded(command, time_ns)

    def happen(self, what, *given):
        now_ns = self.plant.time_ns
        match what, *given:
            case 'run', count, feed:
                for _ in range(count):
                    self.sample(feed=feed)
            case 'faulty', count, kelvin, quality:
                for _ in range(count):
                    self.sample(kelvin, quality=quality)
            case 'silent', count:
                for _ in range(count):
                    self.sample(silent=True)
            case 'late', ago, value:
                self.do(events.AnalysisValue(now_ns - ago * PERIOD_NS, 'concentration', value))
            case 'setpoint', kelvin, ahead:
                self.do(SetpointRequest(now_ns + ahead * PERIOD_NS, np.array([kelvin])))
            case 'manual', percent:
                self.do(events.ManualCommand(np.array([percent])))
            case 'mode', mode:
                self.do(events.ModeChange(mode))
            case 'clear',:
                self.do(events.ClearSafeState())
            case 'restart', known:
                self.state = State()
                if known:
                    self.do(events.Initialisation(self.plant.applied))
            case 'replay',:
                self.state = decoded(encoded(self.state))
            case 'reload', *other:
                other = controller(*other)
                self.state = other.switch_to(self.controller, self.state)
                self.controller = other


@settings(deadline=None, max_examples=12)
@given(st.lists(HAPPENS, max_size=12), st.sampled_from([31.5, 45.0, 58.5]))
def test_each_sample_has_a_command_within_limits(happened, dead_time):
    loop = Loop(dead_time)
    for event in happened:
        loop.happen(*event)
    # nothing of it lasts, but a latched safe state
    loop.happen('clear')
    loop.happen('mode', Mode.AUTOMATIC)
    loop.happen('run', 3, 293.15)


@pytest.mark.parametrize('dead_time', [31.5, 45.0, 58.5])
def test_the_loop_settles_after_any_sequence_of_events(dead_time):
    """A restart, a reload with another dead time and a change of mode, each in a step."""
    loop = Loop(dead_time)
    loop.happen('run', 3, 293.15)
    for number, event in enumerate((('restart', True), ('reload', 58.5, 'pi', False),
                                    ('reload', 45.0, 'sdre', True), ('mode', Mode.MANUAL))):
        loop.happen('setpoint', 328.15 if number % 2 else 323.15, 0)
        loop.happen('run', 5, 293.15)
        loop.happen(*event)
        loop.happen('run', 5, 293.15)
    loop.happen('mode', Mode.AUTOMATIC)
    loop.happen('run', 150, 293.15)
    assert loop.plant.x[1] == pytest.approx(328.15, abs=0.1)
