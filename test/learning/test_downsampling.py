# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What of a long record is taken: means that lose nothing, segments from all over its range."""

import numpy as np
import pytest

from koopman_ros.core.datasets import averaged, Episode
from koopman_ros.learning.downsampling import (
    cells_of,
    extremes,
    RecordStatistics,
    Selection,
)


def episode(x: np.ndarray, u: np.ndarray | None = None, period: float = 1.0) -> Episode:
    time = period * np.arange(len(x))
    u = np.zeros(len(x)) if u is None else u
    return Episode(time, x.reshape(len(x), -1), time, u.reshape(len(x), -1))


# Means of samples.


def test_means_of_a_ramp_lie_on_it() -> None:
    time = np.arange(103.0)
    found = averaged(Episode(time, 3.0 + 2.0 * time[:, None], np.array([0.0, 40.0]),
                             np.array([[1.0], [5.0]])), 10)
    assert found.time.tolist() == [4.5 + 10.0 * k for k in range(10)]
    assert found.x[:, 0] == pytest.approx(3.0 + 2.0 * found.time)
    # few changes stay where they are
    assert (found.input_time.tolist(), found.u[:, 0].tolist()) == ([0.0, 40.0], [1.0, 5.0])
    with pytest.raises(ValueError, match='an episode of 15 measurements has no two groups of 8'):
        averaged(episode(np.zeros(15)), 8)


def survey(*episodes: Episode) -> RecordStatistics:
    found = RecordStatistics.empty(episodes[0].x.shape[1], episodes[0].u.shape[1])
    for one in episodes:
        found.add(one)
    return found


def wave(samples: float, noise: float, count: int = 60_000) -> np.ndarray:
    """Return a wave of so many samples a period, of amplitude 1, with noise."""
    rng = np.random.default_rng(0)
    return np.sin(2.0 * np.pi * np.arange(count) / samples) + noise * rng.standard_normal(count)


def test_samples_are_averaged_as_far_as_the_motion_is_straight() -> None:
    """
    Over w samples a wave of p samples is (2 pi w / p)^4 / 720 sin^2 off a line, in mean squares.

    Weighed by the square of the slope, cos^2, a quarter of that is left: 0.00006 for w = 1024 of
    10000 samples, below 2 % of the noise of 0.1 squared, and 0.001, above, for w = 2048. Half of
    1024 are averaged.
    """
    found = survey(episode(wave(10_000, 0.1)))
    assert found.group(1) == 512
    # where it bends most a mean is off by less than its own noise
    assert (2.0 * np.pi * 512 / 10_000) ** 2 / 24.0 < 0.1 / np.sqrt(512)
    # ten times as fast, or ten times as little noise
    assert found.group(1) > survey(episode(wave(1000, 0.1))).group(1) >= 8
    assert found.group(1) > survey(episode(wave(10_000, 0.01))).group(1)
    # no more than what is needed
    assert [found.group(most) for most in (100_000, 60_000, 30_000, 10_000)] == [1, 1, 2, 8]


def test_surveys_of_parts_are_that_of_the_whole() -> None:
    parts = [episode(wave(500, 0.1, 5000) + k, np.full(5000, k)) for k in range(3)]
    merged, whole = survey(parts[0]).merged(survey(*parts[1:])), survey(*parts)
    assert merged.count == whole.count == 15_000
    for name in ('lower', 'upper', 'errors'):
        assert getattr(merged, name) == pytest.approx(getattr(whole, name))


# Segments.


def long_rest(count: int = 100_000) -> Episode:
    """Return a motion that is nearly always around 0, and was once everywhere else."""
    rng = np.random.default_rng(2)
    x, u = 0.05 * rng.standard_normal(count), 0.05 * rng.standard_normal(count)
    for corner, at in enumerate(range(count // 8, count, count // 4)):
        angle = 0.5 * np.pi * (corner + np.linspace(0.0, 1.0, 300))
        x[at:at + 300] = np.cos(angle)
        u[at:at + 300] = np.sin(angle)
    return episode(x, u)


def select(parts: list[Episode], most: int = 8000, seed: int = 0) -> Selection:
    whole = survey(*parts)
    found = Selection(whole.lower, whole.upper, 1, most)
    for number, part in enumerate(parts):
        one = found.empty()
        one.offer(number, part, np.random.default_rng([seed, number]))
        found = found.merged(one)
    return found


def visited(episodes: list[Episode], like: Selection) -> set[tuple[int, ...]]:
    values = np.vstack([np.hstack([one.x, one.inputs_at(one.time)]) for one in episodes])
    return set(map(tuple, cells_of(values, like.lower, like.upper).tolist()))


def test_the_selection_covers_every_cell() -> None:
    whole = long_rest()
    found = select([whole])
    chosen = found.episodes()
    assert 7500 < sum(map(len, chosen)) <= 8000
    assert visited(chosen, found) == visited([whole], found)
    # the extremes are there, and segments from all of the time
    lows, highs = zip(*map(extremes, chosen), strict=True)
    np.testing.assert_array_equal(np.min(lows, axis=0), found.lower)
    np.testing.assert_array_equal(np.max(highs, axis=0), found.upper)
    tenths = {int(10 * one.time[0] / whole.time[-1]) for one in chosen}
    assert len(tenths) >= 8
