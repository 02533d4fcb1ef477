# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Samples, their split into episodes and the scaling: checks and round trips."""

from dataclasses import replace
import math

import numpy as np
import pytest

from koopman_ros.learning import Plant, Scaling, split_by_episode
from support.small_plants import BENT, bent_samples


def timed(episodes=4, length=5):
    """Return samples at times of their own in each episode."""
    time = np.tile(0.25 * np.arange(length), episodes) + np.repeat(np.arange(episodes), length)
    return replace(bent_samples(episodes, length), time=time)


@pytest.mark.parametrize('name', ['x', 'dxdt', 'u'])
@pytest.mark.parametrize('value', [math.nan, math.inf])
def test_samples_that_are_not_finite(name, value):
    array = np.array(getattr(bent_samples(), name))
    array[[3, 5]] = value
    with pytest.raises(ValueError, match=f'{name} holds 2 values that are not finite: drop those'):
        replace(bent_samples(), **{name: array})


@pytest.mark.parametrize(('change', 'message'), [
    ({'x': np.zeros((179, 1))}, r'incompatible x: expected \(180, n\), got \(179, 1\)'),
    ({'dxdt': np.zeros(180)}, r'incompatible dxdt: expected \(180, n\), got \(180,\)'),
    ({'dxdt': np.zeros((180, 2))}, r'incompatible dxdt: expected \(180, 1\), got \(180, 2\)'),
    ({'u': np.zeros((180, 1, 1))}, r'incompatible u: expected \(180, n\), got \(180, 1, 1\)'),
    ({'episode': np.zeros(3, dtype=int)}, r'incompatible x: expected \(3, n\), got \(180, 1\)'),
    ({'time': np.zeros(179)}, r'incompatible time: expected \(180,\), got \(179,\)'),
    ({'time': np.zeros((180, 1))}, r'incompatible time: expected \(180,\), got \(180, 1\)'),
])
def test_samples_of_unequal_length(change, message):
    with pytest.raises(ValueError, match=message):
        replace(bent_samples(), **change)


@pytest.mark.parametrize('value', [0.25, 0.2, math.nan, math.inf])
def test_times_that_do_not_rise(value):
    time = np.array(timed().time)
    time[2] = value
    with pytest.raises(ValueError, match='time must rise from sample to sample within an episode'):
        replace(timed(), time=time)


def test_times_that_do_not_rise_in_episodes_side_by_side():
    mixed = {'x': np.zeros((4, 1)), 'dxdt': np.zeros((4, 1)), 'u': np.zeros((4, 1)),
             'episode': np.array([0, 1, 0, 1])}
    assert replace(bent_samples(), **mixed, time=np.array([0.0, 5.0, 1.0, 6.0])).time is not None
    with pytest.raises(ValueError, match='time must rise'):
        replace(bent_samples(), **mixed, time=np.array([1.0, 5.0, 0.0, 6.0]))


def test_time_may_start_again_with_each_episode():
    assert timed().time[5] == 1.0
    assert timed().time[4] == 1.0


def test_take_keeps_what_belongs_together():
    part = timed().take(np.array([3, 1]))
    assert len(part) == 10
    np.testing.assert_array_equal(part.episode, np.repeat([1, 3], 5))
    keep = np.isin(timed().episode, [1, 3])
    for name in ('x', 'dxdt', 'u', 'time'):
        np.testing.assert_array_equal(getattr(part, name), getattr(timed(), name)[keep])
    assert bent_samples().take(np.array([0])).time is None


def test_the_digest_tells_samples_apart():
    everything = bent_samples()
    assert everything.digest() == bent_samples().digest()
    assert len(everything.digest()) == 64
    for name in ('x', 'dxdt', 'u'):
        moved = np.array(getattr(everything, name))
        moved[-1] = np.nextafter(moved[-1], np.inf)
        assert replace(everything, **{name: moved}).digest() != everything.digest()
    assert replace(everything, episode=everything.episode + 1).digest() != everything.digest()


@pytest.mark.parametrize('episodes', [3, 4, 5, 9, 10, 20])
@pytest.mark.parametrize('seed', [0, 1])
def test_split_is_disjoint_and_covers(episodes, seed):
    everything = timed(episodes, length=7)
    parts = split_by_episode(everything, seed)
    numbers = [set(part.episode) for part in parts]
    assert sum(map(len, numbers)) == episodes
    assert set.union(*numbers) == set(range(episodes))
    held = max(1, episodes // 5)
    assert [len(n) for n in numbers] == [episodes - 2 * held, held, held]
    for part in parts:
        keep = np.isin(everything.episode, part.episode)
        for name in ('x', 'dxdt', 'u', 'episode', 'time'):
            np.testing.assert_array_equal(getattr(part, name), getattr(everything, name)[keep])


def test_split_depends_on_its_seed_alone():
    everything = bent_samples(20)
    first, again, other = (split_by_episode(everything, seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.episode, again.episode)
    assert set(first.episode) != set(other.episode)


def test_episodes_need_not_be_numbered_from_zero():
    everything = replace(bent_samples(3), episode=np.repeat([7, -2, 40], 30))
    assert sorted(int(part.episode[0]) for part in split_by_episode(everything, 0)) == [-2, 7, 40]


@pytest.mark.parametrize('episodes', [1, 2])
def test_too_few_episodes(episodes):
    with pytest.raises(ValueError, match=f'at least 3 episodes to hold some out, got {episodes}'):
        split_by_episode(bent_samples(episodes), 0)


def test_scaling_by_half_the_range_from_the_nominal_point():
    samples = bent_samples()
    scaling = Scaling.of(BENT, samples)
    np.testing.assert_array_equal(scaling.states.center, [3.0])
    np.testing.assert_array_equal(scaling.inputs.center, [0.5])
    np.testing.assert_array_equal(scaling.states.lower, samples.x.min(axis=0))
    np.testing.assert_array_equal(scaling.states.upper, samples.x.max(axis=0))
    np.testing.assert_array_equal(scaling.states.scale, np.ptp(samples.x, axis=0) / 2.0)
    assert (scaling.states.names, scaling.inputs.units, scaling.time_unit) == (
        ('level',), ('m/s',), 's')
    # the equation holds in deviations, too
    x, rate, u = scaling.deviations(samples)
    np.testing.assert_allclose(
        rate, (-x - 0.3 * scaling.states.scale * x * x) + u @ scaling.input_matrix(BENT.B).T,
        rtol=0, atol=1e-14)


def test_scaling_without_inputs():
    plant = Plant('free', ('x',), ('1',), (), (), 's', np.zeros(1), np.zeros(0), np.zeros((1, 0)))
    samples = replace(bent_samples(), u=np.zeros((180, 0)))
    scaling = Scaling.of(plant, samples)
    assert len(scaling.inputs) == 0
    assert scaling.input_matrix(plant.B).shape == (1, 0)
    assert scaling.deviations(samples)[2].shape == (180, 0)


@pytest.mark.parametrize(('name', 'value', 'message'), [
    ('u', 0.5, r'flow never moves from 0\.5 m/s: excite the plant'),
    ('x', 3.0, r'level never moves from 3\.0 m: excite the plant')])
def test_what_never_moves(name, value, message):
    still = replace(bent_samples(), **{name: np.full((180, 1), value)})
    with pytest.raises(ValueError, match=message):
        Scaling.of(BENT, still)


def test_a_plant_of_another_size():
    with pytest.raises(ValueError, match='the samples have 2 inputs, the plant 1: flow'):
        Scaling.of(BENT, replace(bent_samples(), u=np.zeros((180, 2))))
    with pytest.raises(ValueError, match=r'incompatible B: expected \(1, 1\), got \(2, 1\)'):
        Scaling.of(BENT, bent_samples()).input_matrix(np.ones((2, 1)))
