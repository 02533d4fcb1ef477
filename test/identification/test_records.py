# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Records: what acted when, its integrals, and how they are cut."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from koopman_ros.identification import cut, Record


def irregular(n=40, seed=0):
    """Return a record with irregular times, and inputs that change between the samples."""
    rng = np.random.default_rng(seed)
    time = 5.0 + np.cumsum(rng.uniform(0.01, 0.3, n))
    input_time = np.concatenate(([4.0], np.sort(rng.uniform(5.0, time[-1] + 1.0, 15))))
    return Record(time, rng.standard_normal((n, 2)), input_time, rng.standard_normal((16, 2)))


def held(record, t):
    """Return the input at a time by going through all changes."""
    return next(u for start, u in zip(record.input_time[::-1], record.u[::-1], strict=True)
                if start <= t)


def test_inputs_hold_from_their_own_time_on():
    record = Record(np.array([1.0, 2.0, 3.0]), np.zeros((3, 1)), np.array([0.5, 2.0, 2.5]),
                    np.array([[10.0], [20.0], [30.0]]))
    times = np.array([1.0, 1.999, 2.0, 2.25, 2.5, 9.0])
    assert record.inputs_at(times)[:, 0].tolist() == [10.0, 10.0, 20.0, 20.0, 30.0, 30.0]


def test_inputs_between_irregular_samples():
    record = irregular()
    times = np.random.default_rng(1).uniform(record.time[0], record.time[-1], 50)
    assert np.array_equal(record.inputs_at(times), [held(record, t) for t in times])


def test_input_integral_against_quadrature():
    record = irregular()
    changes = record.input_time[1:]
    for t, found in zip(record.time, record.input_integral(record.time), strict=True):
        edges = [record.time[0], *changes[(changes > record.time[0]) & (changes < t)], t]
        expected = [sum(quad(lambda s, j=j: held(record, s)[j], a, b)[0]
                        for a, b in pairwise(edges)) for j in (0, 1)]
        # quad is exact on the constant pieces, but for rounding
        assert found == pytest.approx(expected, abs=1e-12)


def test_input_integral_by_hand():
    record = Record(np.array([1.0, 3.0]), np.zeros((2, 1)), np.array([0.0, 1.5, 2.0]),
                    np.array([[2.0], [-4.0], [8.0]]))
    times = np.array([1.0, 1.25, 1.5, 2.0, 3.0])
    assert record.input_integral(times)[:, 0].tolist() == [0.0, 0.5, 1.0, -1.0, 7.0]


def test_part_keeps_what_acted():
    record = irregular()
    part = record.part(7, 21)
    assert np.array_equal(part.time, record.time[7:21])
    assert np.array_equal(part.x, record.x[7:21])
    assert part.input_time[0] <= part.time[0] < part.input_time[1]
    times = np.linspace(part.time[0], part.time[-1], 500, endpoint=False)
    assert np.array_equal(part.inputs_at(times), record.inputs_at(times))
    whole = record.input_integral(part.time)
    assert part.input_integral(part.time) == pytest.approx(whole - whole[0], abs=1e-12)


def test_cut_leaves_no_interval_out():
    records = [irregular(40, 0), irregular(23, 1)]
    parts = cut(records, 8)
    assert max(map(len, parts)) <= 8
    # each begins where the last one ends, so that the steps add up
    for record, own in zip(records, (parts[:6], parts[6:]), strict=True):
        assert [p.time[0] for p in own[1:]] == [p.time[-1] for p in own[:-1]]
        assert (own[0].time[0], own[-1].time[-1]) == (record.time[0], record.time[-1])
    assert sum(len(p) - 1 for p in parts) == 39 + 22
    lengths = [len(p) for p in parts[:6]]
    assert max(lengths) - min(lengths) <= 1


def test_cut_leaves_short_records_whole():
    assert [len(p) for p in cut([irregular(8)], 8)] == [8]
    assert [len(p) for p in cut([irregular(9)], 8)] == [5, 5]
    assert cut([irregular(9).part(0, 1)], 8) == []
    with pytest.raises(ValueError, match='at least 2 samples, got 1'):
        cut([irregular()], 1)


@pytest.mark.parametrize(('changes', 'words'), [
    ({'time': [0.0, 1.0]}, r'incompatible time and x: .* got \(2,\) and \(3, 1\)'),
    ({'u': [1.0, 2.0]}, 'incompatible input_time and u'),
    ({'time': [], 'x': np.zeros((0, 1))}, 'with n > 0'),
    ({'x': [[1.0], [np.nan], [2.0]]}, 'not finite: drop them'),
    ({'input_time': [0.0, np.inf]}, 'not finite: drop them'),
    ({'time': [0.0, 1.0, 1.0]}, 'time must rise: sort the samples'),
    ({'input_time': [0.0, 0.0]}, 'input_time must rise'),
    ({'input_time': [0.1, 0.2]}, 'the input at the first measurement is not known'),
])
def test_refuses_what_is_no_record(changes, words):
    good = {'time': [0.0, 1.0, 2.0], 'x': np.zeros((3, 1)), 'input_time': [0.0, 1.0],
            'u': np.zeros((2, 1))}
    with pytest.raises(ValueError, match=words):
        Record(**{name: np.array(value) for name, value in {**good, **changes}.items()})
