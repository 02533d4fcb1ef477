# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Trends: order, jumps, filling in, bounds, and a decimation that loses no extreme."""

from itertools import pairwise
import math
import threading

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from koopman_ros.arrays import Array
from koopman_ros.panel.trends import MAX_KINDS, MAX_MARKS, MAX_PENS, Trends

NAN = math.nan


def _held(trends: Trends, pen: str = 'x') -> list[tuple[float, float]]:
    times, values = trends.window([pen], -math.inf, math.inf, 10_000)[pen]
    return list(zip(times.tolist(), values.tolist(), strict=True))


def _trends(times: object, values: object) -> Trends:
    trends = Trends()
    trends.extend('x', times, values)
    return trends


def test_what_is_added_is_held_in_order() -> None:
    trends = Trends()
    for step in range(5000):
        trends.add('x', step, -step)
        trends.add('y', step, 1.0)
    assert _held(trends) == [(step, -step) for step in range(5000)]
    assert trends.latest == 4999


def test_nothing_is_held_at_first() -> None:
    trends = Trends()
    times, values = trends.window(['x'], 0.0, 1.0)['x']
    assert times.size == values.size == 0
    assert trends.at(['x'], 1.0) == {}
    assert trends.marks(-math.inf, math.inf) == ()
    assert trends.latest is None
    trends.rewind(0.0)


@pytest.mark.parametrize(('added', 'held'), [
    ([(1, 1), (2, 2), (3, 3), (1.5, 9), (1.7, 8)], [(1, 1), (1.5, 9), (1.7, 8)]),
    ([(1, 1), (2, 2), (0, 7)], [(0, 7)]),
    ([(1, 1), (2, 2), (2, 3)], [(1, 1), (2, 3)]),
    ([(1, 1), (2, 2), (2, 2)], [(1, 1), (2, 2)]),
    ([(1, 1), (2, 2), (1, 5)], [(1, 5)]),
    ([(1, 1), (NAN, 5), (math.inf, 5), (-math.inf, 5), (2, 2)], [(1, 1), (2, 2)])])
@pytest.mark.parametrize('looked', [False, True])
def test_what_is_later_than_a_jump_back_is_dropped(
        added: list[tuple[float, float]], held: list[tuple[float, float]], looked: bool) -> None:
    trends = Trends()
    for time, value in added:
        trends.add('x', time, value)
        if looked:
            _held(trends)
    assert _held(trends) == held
    assert trends.latest == held[-1][0]


def test_what_was_returned_does_not_change() -> None:
    trends = Trends()
    for step in range(100):
        trends.add('x', step, step)
    (times, values), = trends._views(['x']).values()
    before = times.copy(), values.copy()
    for step in range(3000):
        trends.add('x', 50 + 0.01 * step, -1.0)
    trends.rewind(10.0)
    trends.extend('x', [5.5], [7.0])
    np.testing.assert_array_equal(times, before[0])
    np.testing.assert_array_equal(values, before[1])


@pytest.mark.parametrize('points', [1, 2, 7, 1000, 5000])
def test_the_number_of_values_is_bounded(points: int) -> None:
    trends = Trends(points=points)
    for step in range(12_000):
        trends.add('x', step, step)
    assert _held(trends) == [(step, step) for step in range(12_000 - points, 12_000)]
    pen = trends._pens['x']
    assert len(pen._times) <= max(1024, 1.25 * points + 1)
    trends.extend('x', np.arange(-5000.0, 0.0), np.zeros(5000))
    assert len(_held(trends)) == points


def test_what_is_older_than_the_span_goes_and_what_is_not_stays() -> None:
    trends = Trends(span=100.0)
    for step in range(20_000):
        trends.add('x', 0.1 * step, step)
        if step % 1000 == 999:
            times = trends._views(['x'])['x'][0]
            assert times[0] <= max(0.1 * step - 100.0, 0.0)
    assert len(trends._views(['x'])['x'][0]) < 4000


def test_memory_grows_with_what_is_held() -> None:
    trends = Trends()
    trends.add('x', 0.0, 0.0)
    assert len(trends._pens['x']._times) == 1024


def test_the_past_is_filled_in_before_what_is_live() -> None:
    trends = Trends()
    trends.add('x', 10.0, 1.0)
    trends.add('x', 11.0, 2.0)
    trends.extend('x', [8.0, 9.0, 10.0, 10.5, 12.0], [3.0, 4.0, 5.0, 6.0, 7.0])
    assert _held(trends) == [(8.0, 3.0), (9.0, 4.0), (10.0, 1.0), (11.0, 2.0)]
    trends.add('x', 12.0, 8.0)
    assert _held(trends)[-1] == (12.0, 8.0)


@pytest.mark.parametrize('order', [[0, 1, 2], [2, 1, 0], [1, 0, 2], [1, 1, 0]])
@pytest.mark.parametrize('live', [False, True])
def test_the_past_comes_in_parts_in_any_order(order: list[int], live: bool) -> None:
    trends = Trends()
    if live:
        trends.add('x', 100.0, 0.0)
    for part in order:
        times = np.arange(10.0) + 10 * part
        trends.extend('x', times, times)
    times = sorted(10 * part + step for part in set(order) for step in range(10))
    assert [time for time, _ in _held(trends)] == times + [100.0] * live


def test_a_second_filling_replaces_the_first() -> None:
    trends = _trends([1.0, 2.0, 3.0], [1.0, 1.0, 1.0])
    trends.extend('x', [2.0, 2.5], [5.0, 6.0])
    assert _held(trends) == [(1.0, 1.0), (2.0, 5.0), (2.5, 6.0), (3.0, 1.0)]


@pytest.mark.parametrize(('times', 'held'), [
    ([0.0, 1.0, 2.0, 0.5, 1.5], [0.0, 0.5, 1.5]), ([3.0, 2.0, 1.0], [1.0]),
    ([1.0, 1.0, 2.0], [1.0, 2.0]), ([1.0, NAN, 2.0, math.inf], [1.0, 2.0]), ([NAN], []), ([], [])])
def test_a_past_with_jumps_is_as_if_it_were_added(times: list[float], held: list[float]) -> None:
    values = np.arange(float(len(times)))
    filled, added = _trends(times, values), Trends()
    for time, value in zip(times, values, strict=True):
        added.add('x', time, value)
    assert _held(filled) == _held(added)
    assert [time for time, _ in _held(filled)] == held


@pytest.mark.parametrize(('times', 'values'), [
    ([1.0], [1.0, 2.0]), (1.0, 1.0), ([[1.0]], [[1.0]]), ([], [1.0])])
def test_times_and_values_of_different_shapes_are_refused(times: object, values: object) -> None:
    with pytest.raises(ValueError, match='incompatible times and values'):
        Trends().extend('x', times, values)


def test_pens_are_bounded() -> None:
    trends = Trends()
    for number in range(MAX_PENS):
        trends.add(str(number), 0.0, 0.0)
    with pytest.raises(ValueError, match=f'there are {MAX_PENS} pens'):
        trends.add('one more', 0.0, 0.0)
    # and those that are only asked for are not made
    assert len(Trends().window(map(str, range(1000)), 0.0, 1.0)) == 1000


@pytest.mark.parametrize(('span', 'points'), [(0.0, 1), (NAN, 1), (-1.0, 1), (1.0, 0)])
def test_bounds_are_checked(span: float, points: int) -> None:
    with pytest.raises(ValueError, match='span and points must be positive'):
        Trends(span, points)


def test_values_that_are_not_finite_are_gaps() -> None:
    trends = Trends()
    for time, value in enumerate([1.0, math.inf, -math.inf, NAN, 2.0]):
        trends.add('x', time, value)
    np.testing.assert_array_equal([value for _, value in _held(trends)], [1, NAN, NAN, NAN, 2])
    trends = _trends([0.0, 1.0], [math.inf, 2.0])
    np.testing.assert_array_equal([value for _, value in _held(trends)], [NAN, 2.0])


@pytest.mark.parametrize(('begin', 'end', 'expected'), [
    (2.5, 4.5, [2, 3, 4, 5]), (3.0, 4.0, [2, 3, 4, 5]), (3.2, 3.4, [3, 4]), (-5.0, 0.0, [0, 1]),
    (-5.0, -1.0, [0]), (100.0, 200.0, [9]), (8.5, 100.0, [8, 9]), (5.0, 4.0, []), (NAN, 4.0, []),
    (0.0, NAN, []), (-math.inf, math.inf, list(range(10))), (4.0, 4.0, [3, 4, 5])])
def test_a_window_has_its_values_and_a_neighbour_on_each_side(
        begin: float, end: float, expected: list[float]) -> None:
    trends = _trends(np.arange(10.0), np.arange(10.0))
    assert trends.window(['x'], begin, end)['x'][0].tolist() == expected


def test_neighbours_are_no_part_of_a_bucket() -> None:
    values = np.sin(np.arange(1000.0))
    values[[99, 901]] = 100.0
    times, found = _trends(np.arange(1000.0), values).window(['x'], 100.0, 900.0, 10)['x']
    assert (times[0], times[-1]) == (99.0, 901.0)
    assert values[100:901].max() == found[1:-1].max()
    assert values[100:901].min() == found[1:-1].min()


@pytest.mark.parametrize('buckets', [-5, 0, 1, 10, 600, 10**12])
def test_buckets_are_bounded(buckets: int) -> None:
    rng = np.random.default_rng(0)
    trends = _trends(np.arange(100_000.0), rng.normal(size=100_000))
    times, _ = trends.window(['x'], 0.0, 1e5, buckets)['x']
    assert 2 <= len(times) <= 4 * min(max(buckets, 1), 10_000)


def _check(times: Array, values: Array, begin: float, end: float, buckets: int) -> None:
    """Hold a window to what it promises, by a plain look at all values."""
    found, shown = _trends(times, values).window(['x'], begin, end, buckets)['x']
    # in order, each a value that there is at its own time
    assert (np.diff(found) > 0.0).all()
    places = np.searchsorted(times, found)
    np.testing.assert_array_equal(times[places], found)
    np.testing.assert_array_equal(values[places], shown)
    inside, chosen = (times >= begin) & (times <= end), (found >= begin) & (found <= end)
    assert inside.any() == chosen.any()
    if not inside.any():
        return
    # both ends, and both extremes
    assert found[chosen][0] == times[inside][0]
    assert found[chosen][-1] == times[inside][-1]
    finite = values[inside][np.isfinite(values[inside])]
    kept = shown[chosen][np.isfinite(shown[chosen])]
    assert finite.size == 0 or (finite.min(), finite.max()) == (kept.min(), kept.max())
    assert np.isnan(values[inside]).any() == np.isnan(shown[chosen]).any()
    assert len(found) <= 5 * buckets + 2
    # of any part of the window, a bucket's width apart from its edges
    lower, upper = max(begin, times[inside][0]), min(end, times[inside][-1])
    width = (upper - lower) / buckets
    for share in (0.0, 0.3, 0.6):
        at = lower + share * (upper - lower)
        part = (times >= at) & (times <= at + 0.3 * (upper - lower))
        wide = (found >= at - width * (1 + 1e-9)) & (
            found <= at + 0.3 * (upper - lower) + width * (1 + 1e-9)) & chosen
        finite = values[part & inside][np.isfinite(values[part & inside])]
        kept = shown[wide][np.isfinite(shown[wide])]
        assert finite.size == 0 or (kept.min() <= finite.min() and kept.max() >= finite.max())


@settings(max_examples=100, deadline=None)
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
    values = np.array([value for _, value in steps])
    times, places = np.unique(times, return_index=True)
    values = values[places]
    length = times[-1] - times[0] + 1.0
    begin = times[0] + start * length
    _check(times, values, begin, begin + width * length, buckets)


@pytest.mark.parametrize('values', [
    np.ones(5000), np.full(5000, NAN), np.arange(5000.0), -np.arange(5000.0),
    np.where(np.arange(5000) % 2 == 0, 1.0, NAN), np.where(np.arange(5000) == 1234, 1e9, 0.0),
    np.where(np.arange(5000) // 1000 % 2 == 0, NAN, np.arange(5000.0)),
    np.where(np.arange(5000) == 0, NAN, 1.0), np.where(np.arange(5000) == 4999, NAN, 1.0),
    np.where(np.arange(5000) == 1234, NAN, np.sin(np.arange(5000)))])
def test_shapes_that_are_easily_lost(values: Array) -> None:
    _check(1.7e9 + 0.1 * np.arange(5000), values, 1.7e9, 1.7e9 + 500.0, 50)


def test_a_spike_is_at_its_own_time_and_a_gap_between_its_neighbours() -> None:
    values = np.zeros(10_000)
    values[4321], values[7040:7050] = 5.0, NAN
    times, found = _trends(np.arange(10_000.0), values).window(['x'], 0.0, 1e4, 100)['x']
    assert times[found == 5.0].tolist() == [4321.0]
    gap = times[np.isnan(found)]
    assert gap.size
    assert all(7040.0 <= time < 7050.0 for time in gap)


def test_times_in_bursts_are_decimated_as_well() -> None:
    # nearly all in one bucket
    times = np.concatenate(([0.0], 500.0 + 1e-3 * np.arange(5000), [1000.0]))
    _check(times, np.sin(times), 0.0, 1000.0, 20)
    # and a window without a width
    trends = _trends(times, np.sin(times))
    assert len(trends.window(['x'], 500.0, 500.0)['x'][0]) == 3


@pytest.mark.parametrize(('time', 'value'), [(0.5, None), (1.0, 10.0), (1.9, 10.0), (2.0, 20.0),
                                             (99.0, 30.0), (math.inf, 30.0), (-math.inf, None),
                                             (NAN, None)])
def test_a_cursor_reads_the_last_value(time: float, value: float | None) -> None:
    trends = _trends([1.0, 2.0, 3.0], [10.0, 20.0, 30.0])
    assert trends.at(['x', 'unknown'], time) == ({} if value is None else {'x': value})


def test_a_cursor_in_a_gap_reads_none() -> None:
    assert math.isnan(_trends([1.0, 2.0], [1.0, NAN]).at(['x'], 2.5)['x'])


def test_marks_are_in_order_and_of_their_time() -> None:
    trends = Trends()
    for time, kind in [(3.0, 'mode'), (1.0, 'setpoint'), (2.0, 'mode'), (5.0, 'alarm')]:
        trends.mark(time, kind, f'at {time:g}')
    for time in (NAN, math.inf):
        trends.mark(time, 'mode', 'never')
    assert [(mark.time, mark.kind, mark.text) for mark in trends.marks(1.0, 3.0)] == [
        (1.0, 'setpoint', 'at 1'), (2.0, 'mode', 'at 2'), (3.0, 'mode', 'at 3')]
    assert trends.marks(3.5, 4.5) == trends.marks(NAN, NAN) == trends.marks(3.0, 1.0) == ()
    assert trends.latest is None


def test_a_flood_of_one_kind_leaves_the_other_marks() -> None:
    trends = Trends()
    trends.mark(0.0, 'model', 'new')
    for step in range(MAX_MARKS + 100):
        trends.mark(step, 'setpoint', '<script>' + 'x' * 10_000 + '\n')
    marks = trends.marks(-math.inf, math.inf)
    assert len(marks) == MAX_MARKS + 1
    assert marks[0].kind == 'model'
    assert marks[1].time == 100.0
    assert all(len(mark.text) <= 200 for mark in marks)


def test_kinds_of_marks_are_bounded() -> None:
    trends = Trends()
    for number in range(MAX_KINDS):
        trends.mark(0.0, str(number), '')
    with pytest.raises(ValueError, match='kinds of marks'):
        trends.mark(0.0, 'one more', '')
    trends.mark(0.0, '0', '')
    assert len(trends.marks(0.0, 0.0)) == MAX_KINDS + 1


def test_a_reset_drops_what_is_later() -> None:
    trends = _trends([1.0, 2.0, 3.0], [1.0, 2.0, 3.0])
    trends.add('y', 2.5, 0.0)
    for time in (1.0, 2.0, 3.0):
        trends.mark(time, 'mode', '')
    trends.rewind(NAN)
    trends.rewind(2.0)
    assert _held(trends) == [(1.0, 1.0), (2.0, 2.0)]
    assert _held(trends, 'y') == []
    assert [mark.time for mark in trends.marks(0.0, 9.0)] == [1.0, 2.0]
    assert trends.latest == 2.0
    # and the past before the new beginning may be filled in again
    trends.add('y', 2.2, 1.0)
    trends.extend('y', [1.0, 2.4], [5.0, 6.0])
    assert _held(trends, 'y') == [(1.0, 5.0), (2.2, 1.0)]
    # up to what comes next, also where that is later
    trends.rewind(1.5)
    trends.add('y', 8.0, 1.0)
    trends.extend('y', [6.0], [7.0])
    assert _held(trends, 'y') == [(1.0, 5.0), (6.0, 7.0), (8.0, 1.0)]


def test_a_jump_back_copies_only_what_somebody_looks_at() -> None:
    trends = _trends(np.arange(100.0), np.arange(100.0))
    _held(trends)
    trends.add('x', 50.0, 0.0)
    times = trends._pens['x']._times
    trends.add('x', 40.0, 0.0)
    assert trends._pens['x']._times is times


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(['add', 'add', 'add', 'extend', 'look', 'rewind']),
                          st.integers(0, 30)), max_size=60))
def test_times_rise_whatever_is_done(steps: list[tuple[str, int]]) -> None:
    trends = Trends(points=20)
    live: list[int] = []
    for act, time in steps:
        if act == 'add':
            trends.add('x', time, time)
            live = [*(held for held in live if held < time), time]
        elif act == 'extend':
            trends.extend('x', [time, time + 1, time - 1, time + 3], [0, 0, -1, -1])
        elif act == 'rewind':
            trends.rewind(time)
            live = [held for held in live if held <= time]
        held = _held(trends)
        assert all(after[0] > before[0] for before, after in pairwise(held))
        assert len(held) <= 20
        # what is live is never replaced
        assert [one for one in held if live and one[0] >= live[0]] == [
            (one, one) for one in live][-20:]


def test_threads_read_while_others_add() -> None:
    trends, failed, done = Trends(points=2000), [], threading.Event()

    def read() -> None:
        try:
            while not done.is_set():
                times, values = trends.window(['x'], -math.inf, math.inf, 50)['x']
                assert (np.diff(times) > 0.0).all()
                np.testing.assert_array_equal(times, values)
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=read) for _ in range(2)]
    for thread in threads:
        thread.start()
    for step in range(5000):
        time = float(step if step % 500 else step - 200)
        trends.add('x', time, time)
    done.set()
    for thread in threads:
        thread.join()
    assert not failed
