# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Episodes and samples: what acted when, how they are cut and split, and what is rejected."""

from dataclasses import replace
import math

import numpy as np
import pytest

from koopman_ros.core.datasets import cut, DriftSamples, Episode, split_by_episode, within
from koopman_ros.evaluation import LoopRun
from support.small_plants import BENT, bent_samples, TWO_STATE


def irregular(n=40, seed=0):
    """Return a episode with irregular times, and inputs that change between the samples."""
    rng = np.random.default_rng(seed)
    time = 5.0 + np.cumsum(rng.uniform(0.01, 0.3, n))
    input_time = np.concatenate(([4.0], np.sort(rng.uniform(5.0, time[-1] + 1.0, 15))))
    return Episode(time, rng.standard_normal((n, 2)), input_time, rng.standard_normal((16, 2)))


def test_inputs_hold_from_their_own_time_on_and_add_up_by_hand():
    episode = Episode(np.array([1.0, 3.0]), np.zeros((2, 1)), np.array([0.0, 0.5, 1.5, 2.0]),
                      np.array([[9.0], [2.0], [-4.0], [8.0]]))
    times = np.array([1.0, 1.25, 1.5, 1.999, 2.0, 3.0])
    assert episode.inputs_at(times)[:, 0].tolist() == [2.0, 2.0, -4.0, -4.0, 8.0, 8.0]
    times = np.array([1.0, 1.25, 1.5, 2.0, 3.0])
    assert episode.input_integral(times)[:, 0].tolist() == [0.0, 0.5, 1.0, -1.0, 7.0]


def test_inputs_that_were_measured_are_linear_between():
    # the first is 1 + t, then falls; the second is held
    episode = Episode(np.array([1.0, 3.0, 4.0]), np.zeros((3, 1)), np.array([0.0, 2.0, 4.0]),
                      np.array([[1.0, 5.0], [3.0, 7.0], [1.0, 9.0]]), (True, False))
    times = np.array([1.0, 1.5, 2.0, 3.0, 4.0])
    assert episode.inputs_at(times).tolist() == [
        [2.0, 5.0], [2.5, 5.0], [3.0, 7.0], [2.0, 7.0], [1.0, 9.0]]
    assert episode.input_integral(times).tolist() == [
        [0.0, 0.0], [1.125, 2.5], [2.5, 5.0], [5.0, 12.0], [6.5, 19.0]]
    begin, end = episode.inputs_between(np.array([1.0, 2.0, 3.0]))
    assert (begin.tolist(), end.tolist()) == (
        [[2.0, 5.0], [3.0, 7.0]], [[3.0, 5.0], [2.0, 7.0]])
    with pytest.raises(ValueError, match='one entry for each of 2 inputs'):
        replace(episode, linear=(True,))


@pytest.mark.parametrize('linear', [(), (True, False)])
def test_a_part_of_an_episode_keeps_the_applied_inputs(linear):
    episode = replace(irregular(), linear=linear)
    part = episode.part(7, 21)
    assert np.array_equal(part.time, episode.time[7:21])
    assert np.array_equal(part.x, episode.x[7:21])
    assert part.input_time[0] <= part.time[0] < part.input_time[1]
    times = np.linspace(part.time[0], part.time[-1], 500, endpoint=False)
    assert np.array_equal(part.inputs_at(times), episode.inputs_at(times))
    whole = episode.input_integral(part.time)
    assert part.input_integral(part.time) == pytest.approx(whole - whole[0], abs=1e-12)


def test_cut_leaves_no_interval_out():
    episodes = [irregular(40, 0), irregular(23, 1)]
    parts = cut(episodes, 8)
    assert max(map(len, parts)) <= 8
    # each begins where the last one ends, so that the steps add up
    for episode, own in zip(episodes, (parts[:6], parts[6:]), strict=True):
        assert [p.time[0] for p in own[1:]] == [p.time[-1] for p in own[:-1]]
        assert (own[0].time[0], own[-1].time[-1]) == (episode.time[0], episode.time[-1])
    assert sum(len(p) - 1 for p in parts) == 39 + 22
    lengths = [len(p) for p in parts[:6]]
    assert max(lengths) - min(lengths) <= 1
    # short ones are left whole
    assert [len(p) for p in cut([irregular(8)], 8)] == [8]
    assert [len(p) for p in cut([irregular(9)], 8)] == [5, 5]
    assert cut([irregular(9).part(0, 1)], 8) == []
    with pytest.raises(ValueError, match='at least 2 samples, got 1'):
        cut([irregular()], 1)


@pytest.mark.parametrize(('changes', 'words'), [
    ({'time': [0.0, 1.0]}, r'incompatible time and x: .* got \(2,\) and \(3, 1\)'),
    ({'u': [1.0, 2.0]}, r'signal, u\[:, None\] for'),
    ({'u': np.zeros((2, 1, 1))}, 'incompatible input_time and u'),
    ({'time': np.zeros((3, 1)), 'x': [0.0, 1.0, 2.0]}, 'pass the times first'),
    ({'x': [[1.0], [1j], [2.0]]}, 'x must be real, got complex numbers'),
    ({'x': [['1 V'], ['2 V'], ['3 V']]}, 'x must be numbers'),
    ({'time': [], 'x': np.zeros((0, 1))}, 'with n > 0'),
    ({'x': [[1.0], [np.nan], [2.0]]}, 'not finite'),
    ({'x': [[1.0, np.nan], [np.nan, np.inf], [2.0, 3.0]]}, 'not finite'),
    ({'u': [[1.0], [np.nan]]}, 'not finite'),
    ({'input_time': [0.0, np.inf]}, 'not finite'),
    ({'time': [0.0, 1.0, 1.0]}, 'sort the samples'),
    ({'input_time': [0.0, 0.0]}, 'input_time must increase'),
    ({'input_time': [0.1, 0.2]}, 'the input at the first measurement is unknown'),
])
def test_invalid_arrays_are_no_episode(changes, words):
    good = {'time': [0.0, 1.0, 2.0], 'x': np.zeros((3, 1)), 'input_time': [0.0, 1.0],
            'u': np.zeros((2, 1))}
    with pytest.raises(ValueError, match=words):
        Episode(**{name: np.array(value) for name, value in {**good, **changes}.items()})


def test_missing_states_are_interpolated():
    nan = np.nan
    x = np.array([[nan, 1.0, nan], [2.0, nan, nan], [8.0, 4.0, nan]])
    episode = Episode(np.array([0.0, 1.0, 4.0]), x, np.zeros(1), np.zeros((1, 1)))
    assert episode.interpolated().tolist() == [[2.0, 1.0, 0.0], [2.0, 1.75, 0.0], [8.0, 4.0, 0.0]]
    assert np.isnan(episode.x[0, 0])


# Samples.


def timed(episodes=4, length=5):
    """Return samples at times of their own in each episode."""
    time = np.tile(0.25 * np.arange(length), episodes) + np.repeat(np.arange(episodes), length)
    return replace(bent_samples(episodes, length), time=time)


@pytest.mark.parametrize(('change', 'message'), [
    ({'x': np.zeros((179, 1))}, r'incompatible x: expected \(180, n\), got \(179, 1\)'),
    ({'dxdt': np.zeros(180)}, r'incompatible dxdt: .* got \(180,\): .*pass .*dxdt\[:, None\]'),
    ({'x': np.full((180, 1), 1j)}, 'x must be real'),
    ({'dxdt': np.zeros((180, 2))}, r'incompatible dxdt: expected \(180, 1\), got \(180, 2\)'),
    ({'u': np.zeros((180, 1, 1))}, r'incompatible u: expected \(180, n\), got \(180, 1, 1\)'),
    ({'episode': np.zeros(3, dtype=int)}, r'incompatible x: expected \(3, n\), got \(180, 1\)'),
    ({'time': np.zeros(179)}, r'incompatible time: expected \(180,\), got \(179,\)'),
    ({'time': np.zeros((180, 1))}, r'incompatible time: expected \(180,\), got \(180, 1\)'),
    *(({name: np.full((180, 1), value)}, f'{name} contains 180 values that are not finite')
      for name in ('x', 'dxdt', 'u') for value in (math.nan, math.inf)),
])
def test_samples_of_unequal_length_or_not_finite(change, message):
    with pytest.raises(ValueError, match=message):
        replace(bent_samples(), **change)


@pytest.mark.parametrize('value', [0.25, 0.2, math.nan, math.inf])
def test_times_that_do_not_rise(value):
    time = np.array(timed().time)
    # it may start again with each episode
    assert time[4] == time[5] == 1.0
    time[2] = value
    with pytest.raises(ValueError, match='from sample to sample within an'):
        replace(timed(), time=time)
    # in episodes side by side, too
    mixed = {'x': np.zeros((4, 1)), 'dxdt': np.zeros((4, 1)), 'u': np.zeros((4, 1)),
             'episode': np.array([0, 1, 0, 1])}
    assert replace(bent_samples(), **mixed, time=np.array([0.0, 5.0, 1.0, 6.0])).time is not None
    with pytest.raises(ValueError, match='time must increase'):
        replace(bent_samples(), **mixed, time=np.array([1.0, 5.0, 0.0, 6.0]))


def test_take_keeps_whole_episodes():
    part = timed().take(np.array([3, 1]))
    assert len(part) == 10
    np.testing.assert_array_equal(part.episode, np.repeat([1, 3], 5))
    keep = np.isin(timed().episode, [1, 3])
    for name in ('x', 'dxdt', 'u', 'time'):
        np.testing.assert_array_equal(getattr(part, name), getattr(timed(), name)[keep])
    assert bent_samples().take(np.array([0])).time is None


def test_different_samples_have_different_digests():
    everything = bent_samples()
    assert everything.digest() == bent_samples().digest()
    assert len(everything.digest()) == 64
    for name in ('x', 'dxdt', 'u'):
        moved = np.array(getattr(everything, name))
        moved[-1] = np.nextafter(moved[-1], np.inf)
        assert replace(everything, **{name: moved}).digest() != everything.digest()
    assert replace(everything, episode=everything.episode + 1).digest() != everything.digest()


def test_split_is_disjoint_and_covers_by_its_seed_alone():
    for episodes in (3, 4, 5, 9, 10, 20):
        parts = split_by_episode(timed(episodes, length=7), seed=episodes)
        numbers = [set(part.episode) for part in parts]
        assert set.union(*numbers) == set(range(episodes))
        held = max(1, episodes // 5)
        assert [len(n) for n in numbers] == [episodes - 2 * held, held, held]
    everything = bent_samples(20)
    first, again, other = (split_by_episode(everything, seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.episode, again.episode)
    assert set(first.episode) != set(other.episode)
    # which need not be numbered from zero
    everything = replace(bent_samples(3), episode=np.repeat([7, -2, 40], 30))
    assert sorted(int(part.episode[0]) for part in split_by_episode(everything, 0)) == [-2, 7, 40]
    with pytest.raises(ValueError, match='at least 3 episodes'):
        split_by_episode(bent_samples(2), 0)


# What is given is checked where it is given.

def test_episodes_are_cut_where_a_state_leaves_a_range():
    x = np.array([[0.0, 5.0], [1.0, 5.0], [2.0, 5.0], [1.0, 9.5], [1.0, 5.0], [0.5, 5.0],
                  [0.4, -1.0], [0.3, 5.0]])
    episode = Episode(np.arange(8.0), x, np.array([0.0, 4.5]), np.array([[1.0], [2.0]]))
    first, second = within([episode], [0.0, 0.0], [2.0, 9.0])
    assert (first.time.tolist(), second.time.tolist()) == ([0.0, 1.0, 2.0], [4.0, 5.0])
    # with the inputs that acted
    assert second.inputs_at(second.time)[:, 0].tolist() == [1.0, 2.0]
    parts = within([episode, episode], 0.0, 9.0, samples=1)
    assert [len(part) for part in parts] == [3, 2, 1, 3, 2, 1]
    assert [len(part) for part in within([episode], -9.0, 99.0)] == [8]
    with pytest.raises(ValueError, match=r'lie between \[0\. 0\.\] and'):
        within([episode], [0, 0], [2, 9], samples=4)


@pytest.mark.parametrize(('plant', 'change', 'message'), [
    (BENT, {'state_names': 'level'}, "state_names is the string 'level'"),
    (BENT, {'state_units': ('pH',)}, "'pH' is dimensionless"),
    (BENT, {'nominal_state': (1j,)}, 'nominal_state must be real'),
    (BENT, {'time_unit': 'h'}, "time_unit must be 's' or 'min', got 'h'"),
    (BENT, {'state_units': ()}, r"incompatible state_names and state_units: .* \['level'\] and "),
    (TWO_STATE, {'state_names': ('x', 'x')}, 'expected different names and as many units'),
    (BENT, {'nominal_state': [3.0, 1.0]}, r"nominal_state: expected one number for each of \['"),
    (BENT, {'nominal_input': 0.5}, r"nominal_input: expected .* of \['flow'\], got 0\.5"),
    (BENT, {'B': [2.0]}, r'incompatible B: expected \(1, 1\), got \(1,\)'),
    (TWO_STATE, {'B': [[0.0, 1.0]]}, r'incompatible B: expected \(2, 1\), got \(1, 2\)'),
    (BENT, {'B': [[np.nan]]}, 'B must be finite')])
def test_a_plant_that_contradicts_itself(plant, change, message):
    with pytest.raises(ValueError, match=message):
        replace(plant, **change)


def test_lists_are_taken_for_arrays():
    plant = replace(TWO_STATE, state_names=['a', 'b'], nominal_state=[1, 2], B=[[0], [1]])
    assert plant.state_names == ('a', 'b')
    assert (plant.nominal_state.tolist(), plant.B.tolist()) == ([1.0, 2.0], [[0.0], [1.0]])
    samples = DriftSamples([[1.0], [2.0], [3.0]], [[0.0]] * 3, [[0.5]] * 3, [0, 0, 1], [0, 1, 0])
    assert samples.take([0]).x.tolist() == [[1.0], [2.0]]
    assert samples.digest() == replace(samples, episode=np.array([0, 0, 1])).digest()
    with pytest.raises(ValueError, match='episode must hold one integer'):
        replace(samples, episode=[0.0, 0.5, 1.0])


@pytest.mark.parametrize('described', [
    bent_samples(), BENT, irregular(), LoopRun(
        *(np.zeros((400, n)) for n in (1, 2, 2, 1, 1, 2)), (None,) * 400, '', None)],
    ids=lambda value: type(value).__name__)
def test_the_repr_of_large_objects_is_one_line(described):
    text = repr(described)
    assert text.startswith(f'{type(described).__name__}(')
    assert '\n' not in text
    assert len(text) < 250
    assert text == repr(BENT) or '<array (' in text
