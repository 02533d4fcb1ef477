# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Random step inputs: inside the box, repeatable, and refused where nothing fits."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.plants import (
    ExcitationError,
    IntegrationError,
    one_state_reactor,
    random_steps,
    RandomStepDesign,
    scalar_example,
    simulate,
    two_state_example,
    two_state_reactor,
)

DESIGN = RandomStepDesign(
    input_lower=281.3, input_upper=300.9, state_lower=305.0, state_upper=330.0,
    hold_time=(1.0, 4.0), sample_period=0.25)


def _inside(episode, design):
    return np.all((episode.x >= design.state_lower) & (episode.x <= design.state_upper))


def _changes(episode):
    """Return the numbers of the samples at which the input steps."""
    return np.flatnonzero(np.diff(episode.u[:, 0])) + 1


def test_samples_stay_inside_box_and_bounds_and_repeat_by_seed():
    system, levels = one_state_reactor(), set()
    for seed in range(4):
        episode, again = (random_steps(system, DESIGN, 30.0, seed) for _ in range(2))
        assert episode.x.shape == (121, 1)
        np.testing.assert_array_equal(episode.time, 0.25 * np.arange(121))
        assert _inside(episode, DESIGN)
        assert np.all((episode.u >= 281.3) & (episode.u <= 300.9))
        assert np.ptp(episode.u) > 10.0
        np.testing.assert_array_equal(again.x, episode.x)
        np.testing.assert_array_equal(again.u, episode.u)
        assert levels.isdisjoint(episode.u[:, 0])
        levels |= set(episode.u[:, 0])
    replayed = simulate(system, episode.x[0], episode.u, 0.25)
    np.testing.assert_array_equal(replayed.x, episode.x)


def test_random_hold_times():
    episode = random_steps(one_state_reactor(), DESIGN, 100.0, 0)
    lengths = np.diff(_changes(episode))
    assert set(lengths) <= set(range(4, 17))
    assert len(set(lengths)) > 5


def test_fixed_hold_time_and_a_last_step_cut_short():
    episode = random_steps(one_state_reactor(), replace(DESIGN, hold_time=1.5), 5.0, 0)
    assert _changes(episode).tolist() == [6, 12, 18]
    assert len(episode.u) == 20


def test_hold_time_that_floating_point_does_not_divide():
    # 0.3 / 0.1 is slightly below 3.
    assert replace(DESIGN, hold_time=0.3, sample_period=0.1).hold_samples == (3, 3)


def test_levels_that_leave_the_box_are_drawn_again():
    design = replace(DESIGN, input_upper=315.0)
    episode = random_steps(one_state_reactor(), design, 40.0, 0)
    assert _inside(episode, design)
    # the same levels without a box would have left it
    free = replace(design, state_lower=0.0, state_upper=999.0)
    assert not _inside(random_steps(one_state_reactor(), free, 40.0, 0), design)


def test_initial_state_can_be_chosen():
    episode = random_steps(one_state_reactor(), DESIGN, 5.0, 0, x0=[306.0])
    assert episode.x[0] == [306.0]


def test_two_states_in_a_box():
    design = RandomStepDesign(
        input_lower=[285.0], input_upper=[306.0], state_lower=[0.6, 305.0],
        state_upper=[1.0, 330.0], hold_time=(0.5, 3.0), sample_period=0.25)
    episode = random_steps(two_state_reactor(), design, 40.0, 1)
    assert _inside(episode, design)


def test_level_that_no_redraw_saves():
    design = replace(DESIGN, input_lower=310.0, input_upper=320.0, max_redraws=7)
    message = (
        r'one-state reactor: temperature reached 33\d\.\d+ K, outside the box \[305, 330\] K at '
        r'0\.\d+ min, and so it went with each of 8 levels of coolant_temperature in '
        r'\[310, 320\] K; narrow the input bounds, widen the box or shorten hold_time')
    with pytest.raises(ExcitationError, match=message):
        random_steps(one_state_reactor(), design, 40.0, 0)


def test_start_outside_the_box():
    message = (r'at the start temperature reached 300 K, outside the box \[305, 330\] K; '
               'choose x0 inside the box')
    with pytest.raises(ExcitationError, match=message):
        random_steps(one_state_reactor(), DESIGN, 5.0, 0, x0=[300.0])


def test_failure_that_is_not_the_box_is_passed_on():
    design = RandomStepDesign(
        input_lower=-1.0, input_upper=1.0, state_lower=-np.inf, state_upper=np.inf,
        hold_time=1.0, sample_period=1.0)
    broken = replace(
        two_state_example(), drift=lambda x: np.where(x > 0.5, np.inf, x))
    with pytest.raises(IntegrationError, match='its rate is not finite there'):
        random_steps(broken, design, 5.0, 0, x0=[1.0, 1.0])


@pytest.mark.parametrize(('changes', 'message'), [
    ({'sample_period': 0.0}, r'sample_period is 0\.0, must be finite and above 0'),
    ({'max_redraws': -1}, 'max_redraws is -1, must not be negative'),
    ({'hold_time': 0.3}, r'hold_time is 0\.3, must allow a whole number of sample periods of'),
    ({'hold_time': (0.3, 0.4)}, r'hold_time is \(0\.3, 0\.4\), must allow a whole number'),
    ({'hold_time': 0.0}, r'hold_time is 0\.0, must allow'),
    ({'hold_time': (1.0, np.inf)}, r'hold_time must be finite: entry \[1\] is inf'),
])
def test_design_is_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(DESIGN, **changes)


@pytest.mark.parametrize(('changes', 'duration', 'message'), [
    ({}, 0.3, r'duration is 0\.3 min, must be a multiple of the sample period of 0\.25 min'),
    ({}, 0.0, r'duration is 0\.0 min'),
    ({}, np.inf, 'duration is inf min'),
    ({'input_lower': [1.0, 2.0]}, 5.0, r'incompatible input_lower: expected \(1,\), got \(2,\)'),
    ({'input_lower': 301.0}, 5.0, r'input_lower \[301\.\] must lie below input_upper'),
    ({'state_upper': 300.0}, 5.0, r'state_lower \[305\.\] must lie below state_upper'),
    ({'state_upper': [1.0, 2.0]}, 5.0, r'incompatible state_upper: expected \(1,\), got \(2,\)'),
    ({'rtol': 1e-3}, 5.0, r'rtol is 0\.001'),
])
def test_design_must_fit_the_system(changes, duration, message):
    with pytest.raises(ValueError, match=message):
        random_steps(one_state_reactor(), replace(DESIGN, **changes), duration, 0)


def test_system_without_input_has_nothing_to_step():
    with pytest.raises(ValueError, match='scalar example has no input to step'):
        random_steps(scalar_example(), DESIGN, 5.0, 0)
