# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Simulation under held inputs against closed forms; random steps that stay inside a box."""

from dataclasses import replace
import pickle

import numpy as np
import pytest

from koopman_ros.plants import (
    advance,
    IntegrationError,
    IntegrationFailure,
    one_state_reactor,
    random_steps,
    RandomStepDesign,
    sample_derivatives,
    scalar_example,
    simulate,
    two_state_example,
    two_state_reactor,
)
from koopman_ros.plants.simulation import integration_limits


def _two_state_closed_form(x, u, t, mu, lambda_):
    """Solve the two-state example over a time t with its input held at u."""
    x1, x2 = x
    slow, fast = np.exp(2.0 * mu * t), np.exp(lambda_ * t)
    coupling = lambda_ * x1 * x1 * (slow - fast) / (2.0 * mu - lambda_)
    return np.array([x1 * np.exp(mu * t), x2 * fast - coupling + u * (fast - 1.0) / lambda_])


def _random_holds(count):
    return np.random.default_rng(1).uniform(281.3, 300.9, (count, 1))


@pytest.mark.parametrize(('mu', 'lambda_'), [(-0.1, 1.0), (0.2, -1.5)])
def test_two_state_example_against_its_closed_form(mu, lambda_):
    inputs = np.array([[1.0], [-2.0], [0.5], [40.0], [3.0]])
    episode = simulate(two_state_example(mu, lambda_), [5.0, 5.0], inputs, 1.0)
    expected = [np.array([5.0, 5.0])]
    for u in inputs[:, 0]:
        expected.append(_two_state_closed_form(expected[-1], u, 1.0, mu, lambda_))
    np.testing.assert_allclose(episode.x, expected, rtol=1e-9)


def test_advancing_hold_by_hold_is_simulating_to_the_bit():
    system, inputs = two_state_reactor(), _random_holds(5)
    episode = simulate(system, system.nominal_state, inputs, 1.0 / 60.0, start_time=7.0)
    # times are not summed up
    np.testing.assert_array_equal(episode.time, 7.0 + 1.0 / 60.0 * np.arange(6))
    np.testing.assert_array_equal(episode.u, inputs)
    state = system.nominal_state
    for n, u in enumerate(inputs):
        state = advance(system, state, u, 1.0 / 60.0)
        np.testing.assert_array_equal(state, episode.x[n + 1])


REACTOR, TWO_STATES = one_state_reactor(), two_state_reactor()
OUT_OF_BOUNDS = IntegrationFailure.OUT_OF_BOUNDS


@pytest.mark.parametrize(('system', 'x', 'u', 'duration', 'bounds', 'message', 'failure'), [
    (REACTOR, REACTOR.nominal_state, [310.0], 100.0, {},
     r'min, temperature outside \[200, 1000\] K', OUT_OF_BOUNDS),
    (REACTOR, [1001.0], [300.0], 1.0, {}, r'temperature = 1001 K at 10 min, .* left its bou',
     OUT_OF_BOUNDS),
    # bounds of the caller replace those of the system
    *((TWO_STATES, TWO_STATES.nominal_state, [320.0], 10.0, bounds, outside, OUT_OF_BOUNDS)
      for bounds, outside in (
          ({'upper': np.array([np.inf, 325.0])}, r'temperature outside \[200, 325\] K'),
          ({'lower': np.array([0.8, 200.0])}, r'concentration outside \[0\.8, inf\] mol/L'))),
    (scalar_example(), [1.0], [], 2.0, {}, 'at 11 s',
     IntegrationFailure.STEP_TOO_SMALL),
    (scalar_example(), [1e200], [], 1.0, {}, 'is not finite',
     IntegrationFailure.NON_FINITE),
])
def test_a_failing_simulation_names_state_and_time(
        system, x, u, duration, bounds, message, failure):
    evaluations = []

    def drift(x):
        evaluations.append(x)
        return system.drift(x)

    counted = replace(system, drift=drift)
    evaluations.clear()
    with pytest.raises(IntegrationError, match=message) as caught:
        simulate(counted, x, [u], duration, start_time=10.0,
                 limits=integration_limits(system, **bounds))
    # far from the limit of steps: it ends once the bound is passed
    assert len(evaluations) < 20_000
    assert caught.value.failure is failure
    copy = pickle.loads(pickle.dumps(caught.value))
    assert str(copy) == str(caught.value)
    assert (copy.failure, copy.time) == (failure, caught.value.time)


@pytest.mark.parametrize(('call', 'message'), [
    (lambda s: advance(s, [1.0, 2.0], [300.0], 1.0), r'incompatible x: expected \(1,\)'),
    (lambda s: advance(s, [np.nan], [300.0], 1.0), 'x must be'),
    (lambda s: advance(s, [320.0], [], 1.0), r'incompatible u: expected \(1,\), got \(0,\)'),
    (lambda s: advance(s, [320.0], [300.0], -1.0), r'duration is -1\.0 min, must be finite'),
    (lambda s: advance(s, [320.0], [300.0], np.nan), 'duration is nan min'),
    (lambda s: simulate(s, [320.0], [300.0], 1.0),
     r'incompatible inputs: expected \(any, 1\), got \(1,\)'),
    (lambda s: simulate(s, [320.0], np.zeros((0, 1)), 1.0), 'incompatible input_time and u: exp'),
    (lambda s: simulate(s, [320.0], [[300.0]], 0.0), r'sample_period is 0\.0 min, must be'),
    (lambda s: integration_limits(s, 1e-6), r'rtol is 1e-06, must lie in \[2\.22e-14, 1e-09\]'),
    (lambda s: integration_limits(s, np.nan), 'rtol is nan'),
    (lambda s: integration_limits(replace(TWO_STATES, nominal_state=[1e-315, 324.0])),
     'atol is .* must be finite and above 0'),
])
def test_arguments_that_do_not_fit(call, message):
    with pytest.raises(ValueError, match=message):
        call(one_state_reactor())


# Samples of a simulation.

def test_derivatives_are_exact_at_each_sample_but_the_last():
    system = two_state_reactor()
    inputs = np.array([[290.0], [295.0], [300.0]])
    episodes = [simulate(system, x0, inputs, 0.5) for x0 in ([0.9, 320.0], [0.8, 310.0])]
    samples = sample_derivatives(system, episodes)
    np.testing.assert_array_equal(samples.x, np.vstack([e.x[:-1] for e in episodes]))
    np.testing.assert_array_equal(samples.u[:, 0], np.tile(inputs[:, 0], 2))
    np.testing.assert_array_equal(samples.dxdt, system.derivative(samples.x, samples.u))
    np.testing.assert_array_equal(samples.episode, np.repeat([0, 1], 3))
    np.testing.assert_array_equal(samples.time, np.tile(0.5 * np.arange(3), 2))


# Random steps.

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


def test_hold_times_are_random_or_fixed_and_the_last_one_is_cut_short():
    episode = random_steps(one_state_reactor(), DESIGN, 100.0, 0)
    lengths = np.diff(_changes(episode))
    assert set(lengths) <= set(range(4, 17))
    assert len(set(lengths)) > 5
    episode = random_steps(one_state_reactor(), replace(DESIGN, hold_time=1.5), 5.0, 0, x0=[306.0])
    assert _changes(episode).tolist() == [6, 12, 18]
    assert len(episode.u) == 20
    assert episode.x[0] == [306.0]
    # 0.3 / 0.1 is slightly below 3
    assert replace(DESIGN, hold_time=0.3, sample_period=0.1).hold_samples == (3, 3)


@pytest.mark.parametrize(('changes', 'duration', 'message'), [
    ({}, 0.3, r'duration is 0\.3 min, must be a multiple of the sample period of 0\.25 min'),
    ({}, 0.0, r'duration is 0\.0 min'),
    ({}, np.inf, 'duration is inf min'),
    ({'sample_period': 0.0}, 5.0, r'sample_period is 0\.0, must be finite and above 0'),
    ({'max_redraws': -1}, 5.0, 'max_redraws is -1, must not be negative'),
    ({'hold_time': 0.3}, 5.0, 'hold_time is 0.3, must'),
    ({'hold_time': (0.3, 0.4)}, 5.0, r'hold_time is \(0\.3, 0\.4\), must'),
    ({'hold_time': 0.0}, 5.0, 'hold_time is 0.0, must'),
    ({'hold_time': (1.0, np.inf)}, 5.0, 'hold_time must be'),
    ({'input_lower': [1.0, 2.0]}, 5.0, r'incompatible input_lower: expected \(1,\), got \(2,\)'),
    ({'input_lower': 301.0}, 5.0, r'input_lower \[301\.\] must lie below input_upper'),
    ({'state_upper': 300.0}, 5.0, r'state_lower \[305\.\] must lie below state_upper'),
    ({'state_upper': [1.0, 2.0]}, 5.0, r'incompatible state_upper: expected \(1,\), got \(2,\)'),
    ({'rtol': 1e-3}, 5.0, r'rtol is 0\.001'),
])
def test_design_must_fit_the_system(changes, duration, message):
    with pytest.raises(ValueError, match=message):
        random_steps(one_state_reactor(), replace(DESIGN, **changes), duration, 0)
    with pytest.raises(ValueError, match='scalar example has no input to'):
        random_steps(scalar_example(), DESIGN, 5.0, 0)
