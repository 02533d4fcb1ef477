# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Trends: order, jumps, bounds, and a decimation that loses no extreme."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from koopman_ros.core.arrays import Array
from koopman_ros.panel.trends import MAX_MARKS, Trends

NAN = math.nan


def _held(trends: Trends, pen: str = 'x') -> list[tuple[float, float]]:
    times, values = trends.window([pen], -math.inf, math.inf, 10_000)[pen]
    return list(zip(times.tolist(), values.tolist(), strict=True))


def _trends(times: Array, values: Array) -> Trends:
    trends = Trends()
    for time, value in zip(times.tolist(), values.tolist(), strict=True):
        trends.add('x', time, value)
    return trends


@pytest.mark.parametrize(('added', 'held'), [
    ([(step, -step) for step in range(5000)], [(step, -step) for step in range(5000)]),
    ([(1, 1), (2, 2), (3, 3), (1.5, 9), (1.7, 8)], [(1, 1), (1.5, 9), (1.7, 8)]),
    ([(1, 1), (2, 2), (0, 7)], [(0, 7)]), ([(1, 1), (2, 2), (2, 3)], [(1, 1), (2, 3)]),
    ([(1, 1), (2, 2), (1, 5)], [(1, 5)]),
    # gaps
    ([(1, math.inf), (2, -math.inf), (3, NAN), (4, 2)], [(1, NAN), (2, NAN), (3, NAN), (4, 2)])])
def test_times_rise_and_a_jump_back_drops_later_values(
        added: list[tuple[float, float]], held: list[tuple[float, float]]) -> None:
    trends = Trends()
    for time, value in added:
        trends.add('x', time, value)
    np.testing.assert_array_equal(_held(trends), held)
    assert trends.latest == held[-1][0]


@pytest.mark.parametrize('points', [1, 7, 1000, 5000])
def test_the_number_of_values_is_bounded(points: int) -> None:
    trends = Trends(points=points)
    for step in range(12_000):
        trends.add('x', step, step)
    assert _held(trends) == [(step, step) for step in range(12_000 - points, 12_000)]
    assert len(trends._pens['x']._times) <= points + 1024 + points // 4


def test_values_older_than_the_span_are_dropped() -> None:
    trends = Trends(span=100.0)
    for step in range(20_000):
        trends.add('x', 0.1 * step, step)
    times = [time for time, _ in _held(trends)]
    assert times[0] <= 1900.0
    assert len(times) < 4000


@pytest.mark.parametrize(('begin', 'end', 'expected'), [
    (2.5, 4.5, [2, 3, 4, 5]), (3.0, 4.0, [2, 3, 4, 5]), (3.2, 3.4, [3, 4]), (-5.0, 0.0, [0, 1]),
    (-5.0, -1.0, [0]), (100.0, 200.0, [9]), (8.5, 100.0, [8, 9]),
    (-math.inf, math.inf, list(range(10))), (4.0, 4.0, [3, 4, 5])])
def test_a_window_has_its_values_and_a_neighbour_on_each_side(
        begin: float, end: float, expected: list[float]) -> None:
    trends = _trends(np.arange(10.0), np.arange(10.0))
    assert trends.window(['x'], begin, end)['x'][0].tolist() == expected


@pytest.mark.parametrize('buckets', [-5, 1, 600, 10**12])
def test_buckets_are_bounded(buckets: int) -> None:
    assert not _held(Trends()), 'a pen without values'
    trends = _trends(np.arange(100_000.0), np.random.default_rng(0).normal(size=100_000))
    times, _ = trends.window(['x'], 0.0, 1e5, buckets)['x']
    assert 2 <= len(times) <= 4 * min(max(buckets, 1), 10_000)


def _check(times: Array, values: Array, begin: float, end: float, buckets: int) -> None:
    """Compare a window with all values."""
    found, shown = _trends(times, values).window(['x'], begin, end, buckets)['x']
    # in order, each value at its own time
    assert (np.diff(found) > 0.0).all()
    places = np.searchsorted(times, found)
    np.testing.assert_array_equal(times[places], found)
    np.testing.assert_array_equal(values[places], shown)
    inside, chosen = (times >= begin) & (times <= end), (found >= begin) & (found <= end)
    assert inside.any() == chosen.any()
    if not inside.any():
        return
    assert found[chosen][0] == times[inside][0]
    assert found[chosen][-1] == times[inside][-1]
    assert np.isnan(values[inside]).any() == np.isnan(shown[chosen]).any()
    assert len(found) <= 5 * buckets + 2
    # both extremes of the whole, and of any part within the width of a bucket
    lower, upper = max(begin, times[inside][0]), min(end, times[inside][-1])
    width = (upper - lower) / buckets * (1 + 1e-9)
    for share, length in ((0.0, 1.0), (0.0, 0.3), (0.3, 0.3), (0.6, 0.3)):
        first = lower + share * (upper - lower)
        last = first + length * (upper - lower)
        finite = values[(times >= first) & (times <= last) & inside & np.isfinite(values)]
        kept = shown[(found >= first - width) & (found <= last + width) & chosen
                     & np.isfinite(shown)]
        assert finite.size == 0 or (kept.min() <= finite.min() and kept.max() >= finite.max())


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(1e-6, 1e3), st.one_of(
        st.floats(-1e3, 1e3), st.sampled_from([0.0, 1.0, NAN]), st.floats(-1e300, 1e300))),
        min_size=1, max_size=200),
    st.integers(1, 20), st.floats(-0.2, 1.2), st.floats(0.0, 1.2),
    st.sampled_from([0.0, 1.7e9]))
def test_extremes_are_never_lost_and_order_is_kept(
        steps: list[tuple[float, float]], buckets: int, start: float, width: float,
        origin: float) -> None:
    times = origin + np.cumsum([step for step, _ in steps])
    times, places = np.unique(times, return_index=True)
    values = np.array([value for _, value in steps])[places]
    length = times[-1] - times[0] + 1.0
    begin = times[0] + start * length
    _check(times, values, begin, begin + width * length, buckets)


def test_marks_are_in_order_and_bounded_for_each_kind() -> None:
    trends = Trends()
    for time, kind in [(3.0, 'mode'), (1.0, 'setpoint'), (2.0, 'mode'), (5.0, 'alarm')]:
        trends.mark(time, kind, f'at {time:g}')
    assert [(mark.time, mark.kind, mark.text) for mark in trends.marks(1.0, 3.0)] == [
        (1.0, 'setpoint', 'at 1'), (2.0, 'mode', 'at 2'), (3.0, 'mode', 'at 3')]
    assert trends.marks(3.5, 4.5) == ()
    for step in range(MAX_MARKS + 100):
        trends.mark(10.0 + step, 'model', '<script>' + 'x' * 10_000 + '\n')
    marks = trends.marks(-math.inf, math.inf)
    assert len(marks) == MAX_MARKS + 4
    assert marks[4].time == 110.0
    assert all(len(mark.text) <= 200 for mark in marks)


def test_a_reset_drops_later_values_and_marks() -> None:
    trends = _trends(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 3.0]))
    trends.add('y', 2.5, 0.0)
    for time in (1.0, 2.0, 3.0):
        trends.mark(time, 'mode', '')
    trends.rewind(2.0)
    assert _held(trends) == [(1.0, 1.0), (2.0, 2.0)]
    assert _held(trends, 'y') == []
    assert [mark.time for mark in trends.marks(0.0, 9.0)] == [1.0, 2.0]
    assert trends.latest == 2.0
    trends.add('y', 2.2, 1.0)
    assert _held(trends, 'y') == [(2.2, 1.0)]
