# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The ladder: learned law, linear law, hold, safe input, and back with hysteresis."""

import numpy as np
import pytest

from koopman_ros.control import LadderSettings, Rung, State
from koopman_ros.control.ladder import Need, Standing
from support.closed_loops import SETPOINT, START
from support.sampled_loops import (
    changed_reactor,
    controller,
    largest_step,
    Loop,
    rungs,
    SAFE,
    settled,
)

SECOND = 1_000_000_000
SETTINGS = LadderSettings(validity_margin=0.2, linear_margin=1.0, hold_timeout=60.0,
                          recovery_time=10.0)


def walk(needs: list[Need], standing: Standing | None = None) -> list[Standing]:
    """Return where needs, one a second, lead."""
    standing = standing or Standing()
    result = []
    for second, need in enumerate(needs):
        standing = standing.at(SETTINGS, need, second * SECOND)
        result.append(standing)
    return result


BEST = Need(Rung.LEARNED)
LINEAR = Need(Rung.LINEAR, 'far out')
HOLD = Need(Rung.HOLD, 'no law')
BLIND = Need(Rung.HOLD, 'blind', passing=True)


def test_down_at_once_and_up_after_a_while():
    standings = walk([BEST, LINEAR, *[BEST] * 12])
    assert [s.rung for s in standings[:2]] == [Rung.LEARNED, Rung.LINEAR]
    assert [s.rung for s in standings[2:]] == [Rung.LINEAR] * 10 + [Rung.LEARNED] * 2
    assert standings[5].reason == 'far out (over, waiting for it to stay so)'
    assert standings[-1].reason == ''


def test_a_relapse_starts_the_wait_anew():
    standings = walk([LINEAR, *[BEST] * 8, LINEAR, *[BEST] * 11])
    assert [s.rung for s in standings[:20]] == [Rung.LINEAR] * 20
    assert standings[20].rung is Rung.LEARNED


def test_a_hold_becomes_the_safe_input_and_stays_it():
    standings = walk([*[HOLD] * 70, BEST, HOLD, *[BEST] * 11])
    assert [s.rung for s in standings[:61]] == [Rung.HOLD] * 61
    assert {s.rung for s in standings[61:82]} == {Rung.SAFE}
    assert standings[61].reason == 'no law; held for longer than 60 s'
    assert standings[82].rung is Rung.LEARNED


@pytest.mark.parametrize('before', [BEST, LINEAR])
def test_after_a_passing_hold_the_rung_before_it_is_resumed(before):
    standings = walk([before, BLIND, before, before])
    assert [s.rung for s in standings] == [before.rung, Rung.HOLD, before.rung, before.rung]


def test_a_passing_hold_does_not_stop_the_way_to_the_safe_input():
    standings = walk([Need(Rung.SAFE, 'too far'), BLIND, BLIND, *[BEST] * 11])
    assert [s.rung for s in standings[:13]] == [Rung.SAFE] * 13
    assert standings[13].rung is Rung.LEARNED


def test_a_passing_hold_does_not_shorten_a_recovery():
    standings = walk([LINEAR, BLIND, *[BEST] * 12])
    assert [s.rung for s in standings[2:]] == [Rung.LINEAR] * 10 + [Rung.LEARNED] * 2


@pytest.mark.parametrize(('rung', 'outside', 'allowed'), [
    (Rung.LEARNED, 0.2, Rung.LEARNED), (Rung.LEARNED, 0.21, Rung.LINEAR),
    (Rung.LEARNED, 1.01, Rung.SAFE), (Rung.LINEAR, 0.11, Rung.LINEAR),
    (Rung.LINEAR, 0.1, Rung.LEARNED), (Rung.LINEAR, 0.9, Rung.LINEAR),
    (Rung.SAFE, 0.51, Rung.SAFE), (Rung.SAFE, 0.5, Rung.LINEAR), (Rung.SAFE, 0.05, Rung.LEARNED),
])
def test_thresholds_have_hysteresis(rung, outside, allowed):
    need = Standing(rung).allowed(SETTINGS, outside, 'outside')
    assert need.rung is allowed
    assert bool(need.reason) is (allowed is not Rung.LEARNED)


@pytest.mark.parametrize('change', [
    {'validity_margin': -0.1}, {'validity_margin': 2.0}, {'validity_margin': float('nan')},
    {'hold_timeout': -1.0}, {'recovery_time': float('nan')}])
def test_settings_that_make_no_sense_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        LadderSettings(**change)


# In the loop.

def test_a_reactor_that_starts_far_above_is_caught_by_the_linear_law():
    loop = Loop(controller(), kelvin=331.0)
    loop.state = loop.controller.request_setpoint(loop.state, np.array([320.0]))[0]
    samples = loop.run(460)
    assert rungs(samples) == [Rung.LINEAR, Rung.LEARNED]
    assert 'outside the trained range (temperature 305 K to 327 K)' in samples[0].report.reason
    change = next(k for k, s in enumerate(samples) if s.report.rung is Rung.LEARNED)
    assert abs(samples[change].command - samples[change - 1].command) < 0.01
    assert settled(samples, 320.0, 1e-3) < 450


def test_far_below_the_safe_input_is_commanded_and_left_again():
    loop = Loop(controller(), kelvin=290.0)
    loop.state = loop.controller.request_setpoint(loop.state, np.array([320.0]))[0]
    samples = loop.run(560)
    assert rungs(samples) == [Rung.SAFE, Rung.LINEAR, Rung.LEARNED]
    assert min(s.command for s in samples) == SAFE
    assert largest_step(samples) <= 1.0 + 1e-9
    assert settled(samples, 320.0, 1e-3) < 560


@pytest.mark.parametrize('blind', [0, 10])
def test_a_reactor_about_to_run_away_is_cooled_whatever_the_sensor_does(blind):
    loop = Loop(controller(), kelvin=340.0)
    loop.coolant = 300.0
    loop.state = loop.controller.take_over(State(), np.array([300.0]))
    loop.run(5)
    blinded = loop.run(blind, lambda _: float('nan'))
    assert {s.report.rung for s in blinded} <= {Rung.SAFE}
    samples = loop.run(420)
    assert max(s.temperature for s in loop.samples) < 345.0
    assert rungs(samples)[-1] is Rung.LEARNED


def test_a_disturbance_that_drives_the_reactor_out_is_overcome():
    loop = Loop(controller())
    loop.run(10)
    loop.plant = changed_reactor(heat_transfer_coefficient=0.6)
    samples = loop.run(600)
    assert rungs(samples) == [Rung.LEARNED, Rung.LINEAR, Rung.LEARNED]
    assert max(s.temperature for s in samples) < 333.0
    assert settled(samples, START, 1e-3) < 600


@pytest.mark.parametrize(('change', 'words'), [
    ({'max_gain': 1e-9}, 'the gain exceeds its bound'),
    ({'max_residual': -1.0}, 'the Riccati residual is too large'),
    ({'input_weight': np.array([1e-6]), 'max_gain': 1e9}, 'predicted unstable at a sample every'),
], ids=['gain', 'residual', 'sampling'])
def test_without_a_law_the_command_is_held_then_safe_and_the_loop_comes_back(change, words):
    loop = Loop(controller())
    loop.run(30)
    held = loop.samples[-1].command
    loop.replace(controller(**change))
    samples = loop.run(100)
    assert rungs(samples) == [Rung.HOLD, Rung.SAFE]
    assert words in samples[0].report.reason
    assert {s.command for s in samples[:61]} == {held}
    loop.replace(controller())
    back = loop.run(500)
    assert back[-1].report.rung is Rung.LEARNED
    assert largest_step(back) <= 1.0 + 1e-9
    assert settled(back, START, 1e-3) < 480


def test_far_out_the_ladder_keeps_the_learned_law_from_acting():
    loop = Loop(controller(), kelvin=331.0)
    first = loop.run(1)[0]
    assert first.report.rung is Rung.LINEAR
    assert first.report.outside == pytest.approx(4.0 / 11.0)
    assert first.report.setpoint_outside == 0.0
    loose = Loop(controller(ladder={'validity_margin': 50.0, 'linear_margin': 50.0}),
                 kelvin=331.0)
    assert loose.run(1)[0].report.rung is Rung.LEARNED


def test_the_setpoint_is_never_outside():
    loop = Loop(controller())
    loop.run(1)
    for kelvin in (304.9, 327.1, float('nan')):
        state, refused = loop.controller.request_setpoint(loop.state, np.array([kelvin]))
        assert state is loop.state
        assert refused
    assert loop.run(1)[0].report.active_setpoint[0] != SETPOINT
