# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The supervisor: laws in their order, hold, safe input, and back with hysteresis."""

import numpy as np
import pytest

from koopman_ros.control import exchange, Supervisor
from koopman_ros.control.supervisor import Requested
from koopman_ros.reasons import Code, reason
from support.closed_loops import START
from support.sampled_loops import (
    controller,
    largest_step,
    levels,
    Reactor,
    SAFE,
    say,
    SECOND,
    settled,
    supervisor_settings,
)
from validation.robustness.loop import changed_reactor

SETTINGS = supervisor_settings(0.2, 1.0, hold_timeout=60.0, recovery_time=10.0)


def walk(requests: list[Requested], supervisor: Supervisor | None = None) -> list[Supervisor]:
    """Return where requests, one a second, lead."""
    supervisor = supervisor or Supervisor()
    result = []
    for second, request in enumerate(requests):
        supervisor = supervisor.at(SETTINGS, request, second * SECOND)
        result.append(supervisor)
    return result


FAR = reason(Code.OUTSIDE_TRAINING, ranges=(('T', 1.0, 2.0),), margin=0.2, level='sdre')
NO_LAW = reason(Code.LAW_FAILED, level='linear', cause=reason(Code.COMMAND_NOT_FINITE))
BLINDED = reason(Code.NO_MEASUREMENT)
BEST = Requested('sdre')
LINEAR = Requested('linear', FAR)
HOLD = Requested('hold', NO_LAW)
BLIND = Requested('hold', BLINDED, passing=True)


def test_down_at_once_and_up_after_a_while():
    supervisors = walk([BEST, LINEAR, *[BEST] * 12])
    assert [s.level for s in supervisors[:2]] == ['sdre', 'linear']
    assert [s.level for s in supervisors[2:]] == ['linear'] * 10 + ['sdre'] * 2
    assert say(supervisors[5].reason) == f'{say(FAR)} (over, waiting for it to stay so)'
    assert supervisors[-1].reason is None


def test_a_relapse_starts_the_wait_anew():
    supervisors = walk([LINEAR, *[BEST] * 8, LINEAR, *[BEST] * 11])
    assert [s.level for s in supervisors[:20]] == ['linear'] * 20
    assert supervisors[20].level == 'sdre'


def test_a_hold_becomes_the_safe_input_and_stays_it():
    supervisors = walk([*[HOLD] * 70, BEST, HOLD, *[BEST] * 11])
    assert [s.level for s in supervisors[:61]] == ['hold'] * 61
    assert {s.level for s in supervisors[61:82]} == {'safe'}
    assert say(supervisors[61].reason) == f'{say(NO_LAW)}; held for longer than 60 s'
    assert supervisors[82].level == 'sdre'


@pytest.mark.parametrize('before', [BEST, LINEAR])
def test_after_a_passing_hold_the_level_before_it_is_resumed(before):
    supervisors = walk([before, BLIND, before, before])
    assert [s.level for s in supervisors] == [before.level, 'hold', before.level, before.level]


def test_a_passing_hold_does_not_stop_the_way_to_the_safe_input():
    supervisors = walk([Requested('safe', FAR), BLIND, BLIND, *[BEST] * 11])
    assert [s.level for s in supervisors[:13]] == ['safe'] * 13
    assert supervisors[13].level == 'sdre'


def test_a_passing_hold_does_not_shorten_a_recovery():
    supervisors = walk([LINEAR, BLIND, *[BEST] * 12])
    assert [s.level for s in supervisors[2:]] == ['linear'] * 10 + ['sdre'] * 2


@pytest.mark.parametrize(('level', 'outside', 'allowed'), [
    ('sdre', 0.2, 'sdre'), ('sdre', 0.21, 'linear'),
    ('sdre', 1.01, 'safe'), ('linear', 0.11, 'linear'),
    ('linear', 0.1, 'sdre'), ('linear', 0.9, 'linear'),
    ('safe', 0.51, 'safe'), ('safe', 0.5, 'linear'), ('safe', 0.05, 'sdre'),
])
def test_thresholds_have_hysteresis(level, outside, allowed):
    request = Supervisor(level).allowed(SETTINGS, outside, ())
    assert request.level == allowed
    assert (request.reason is None) is (allowed == 'sdre')


@pytest.mark.parametrize(('change', 'words'), [
    ({'learned': -0.1}, 'margins'), ({'learned': 2.0}, 'margins'),
    ({'learned': float('nan')}, 'margins'), ({'hold_timeout': -1.0}, 'hold_timeout'),
    ({'recovery_time': float('nan')}, 'recovery_time')])
def test_settings_that_make_no_sense_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        supervisor_settings(**change)


# In the loop.

def test_a_reactor_that_starts_far_above_is_caught_by_the_linear_law():
    loop = Reactor(controller(), kelvin=331.0)
    loop.ask(320.0)
    samples = loop.run(460)
    assert levels(samples) == ['linear', 'sdre']
    assert 'outside the trained range (temperature 305 K to 327 K)' in say(
        samples[0].report.reason)
    change = next(k for k, s in enumerate(samples) if s.report.level == 'sdre')
    assert abs(samples[change].command - samples[change - 1].command) < 0.01
    assert settled(samples, 320.0, 1e-3) < 450


def test_far_below_the_safe_input_is_commanded_and_left_again():
    loop = Reactor(controller(), kelvin=290.0)
    loop.ask(320.0)
    samples = loop.run(560)
    assert levels(samples) == ['safe', 'linear', 'sdre']
    assert min(s.command for s in samples) == SAFE
    assert largest_step(samples) <= 1.0 + 1e-9
    assert settled(samples, 320.0, 1e-3) < 560


@pytest.mark.parametrize('blind', [0, 10])
def test_a_reactor_about_to_run_away_is_cooled_whatever_the_sensor_does(blind):
    loop = Reactor(controller(), kelvin=340.0, coolant=300.0)
    loop.run(5)
    if blind:
        assert levels(loop.run(blind, lambda _: float('nan'))) == ['safe']
    samples = loop.run(420)
    assert max(s.temperature for s in loop.samples) < 345.0
    assert levels(samples)[-1] == 'sdre'


def test_a_disturbance_that_drives_the_reactor_out_is_overcome():
    loop = Reactor(controller())
    loop.run(10)
    loop.change(system=changed_reactor(heat_transfer=0.6))
    samples = loop.run(600)
    assert levels(samples) == ['sdre', 'linear', 'sdre']
    assert max(s.temperature for s in samples) < 333.0
    assert settled(samples, START, 1e-3) < 600


@pytest.mark.parametrize(('change', 'words'), [
    ({'max_gain': 1e-9}, 'the gain exceeds its bound'),
    ({'max_residual': -1.0}, 'the Riccati residual is too large'),
    ({'input_weight': np.array([1e-6]), 'max_gain': 1e9}, 'predicted unstable at a sample every'),
], ids=['gain', 'residual', 'sampling'])
def test_without_a_law_the_command_is_held_then_safe_and_the_loop_comes_back(change, words):
    loop = Reactor(controller())
    loop.run(30)
    held = loop.samples[-1].command
    loop.do(exchange(controller(**change)))
    samples = loop.run(100)
    assert levels(samples) == ['hold', 'safe']
    assert words in say(samples[0].report.reason)
    assert samples[0].report.command.law.form == ''
    assert {s.command for s in samples[:61]} == {held}
    loop.do(exchange(controller()))
    back = loop.run(40)
    assert levels(back) == ['safe', 'sdre']
    assert largest_step(back) <= 1.0 + 1e-9


def test_far_out_the_supervisor_keeps_the_learned_law_from_acting():
    loop = Reactor(controller(), kelvin=331.0)
    first = loop.run(1)[0]
    assert first.report.level == 'linear'
    assert first.report.measurement.outside == pytest.approx(4.0 / 11.0)
    assert first.report.target.outside == 0.0
    loose = Reactor(controller(supervisor={'learned': 50.0, 'linear': 50.0}),
                 kelvin=331.0)
    assert loose.run(1)[0].report.level == 'sdre'
