# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Samples that are put together from messages by stamp."""

import pytest

from koopman_ros.core.synchronizer import SampleSynchronizer
from koopman_ros.core.units import NANOSECONDS as SECOND

NAMES = ('level', 'flow')


def taken(assembler, *parts):
    """Take parts (stamp in ns, name, value); return what was completed, as stamp and values."""
    found = [assembler.take(stamp, {name: value}) for stamp, name, value in parts]
    return [(sample[0], sample[1].tolist()) for sample in found if sample is not None]


def counts(assembler):
    return dict(assembler.late), dict(assembler.missing), dict(assembler.duplicated)


def test_message_with_all_signals_is_a_sample_whatever_its_stamp():
    assembler = SampleSynchronizer(NAMES)
    for stamp in (5, 5, 3, -SECOND):
        found = assembler.take(stamp, {'flow': 2.0, 'level': 1.0})
        assert (found[0], found[1].tolist()) == (stamp, [1.0, 2.0])
    assert counts(assembler) == ({}, {}, {})


def test_parts_of_one_stamp_are_a_sample_in_any_order():
    assembler = SampleSynchronizer(NAMES)
    assert taken(assembler, (1, 'level', 1.0), (1, 'flow', 2.0), (2, 'flow', 4.0),
                 (2, 'level', 3.0)) == [(1, [1.0, 2.0]), (2, [3.0, 4.0])]
    # of several that are open, too
    assert taken(assembler, (3, 'level', 5.0), (4, 'level', 7.0), (3, 'flow', 6.0),
                 (4, 'flow', 8.0)) == [(3, [5.0, 6.0]), (4, [7.0, 8.0])]
    assert counts(assembler) == ({}, {}, {})
    assert assembler.awaited == ''


@pytest.mark.parametrize(('apart', 'found'), [
    (0, [(100, [1.0, 2.0])]), (10, [(110, [1.0, 2.0])]), (-10, [(100, [1.0, 2.0])]),
    (11, []), (-11, [])])
def test_stamps_may_be_apart_by_the_tolerance(apart, found):
    """The stamp of the sample is the last of its parts."""
    assembler = SampleSynchronizer(NAMES, tolerance_ns=10)
    assert taken(assembler, (100, 'level', 1.0), (100 + apart, 'flow', 2.0)) == found


@pytest.mark.parametrize('lag', [0.0, 0.02, 0.3, 0.48, 0.7, 0.95])
def test_times_of_receipt_are_half_an_interval_apart_at_most(lag):
    """Whatever the phase of the second sensor, and where a machine delays some by a little."""
    assembler = SampleSynchronizer(NAMES, tolerance_ns=None)
    times = sorted((SECOND * (k + lag * (name == 'flow') + 0.01 * (k * 7919 % 5)), name, k)
                   for k in range(40) for name in NAMES)
    found = taken(assembler, *((round(at), name, float(k)) for at, name, k in times))
    assert len(found) >= 36
    # the same pair each time, the nearer one
    shift = 1.0 if lag > 0.5 else 0.0
    assert [level - flow for _, (level, flow) in found[2:]] == [shift] * len(found[2:])


def test_times_of_receipt_of_a_slow_and_a_quick_sensor():
    assembler = SampleSynchronizer(NAMES, tolerance_ns=None)
    parts = sorted([(SECOND * k, 'level', float(k)) for k in range(10)]
                   + [(SECOND * k // 10 + 3, 'flow', k / 10) for k in range(100)])
    found = taken(assembler, *parts)
    assert [values for _, values in found[1:]] == [[float(k), float(k)] for k in range(2, 10)]


def test_a_part_joins_the_nearest_incomplete_sample():
    assembler = SampleSynchronizer(('level', 'flow', 'heat'), tolerance_ns=10)
    assert not taken(assembler, (100, 'level', 1.0), (115, 'level', 2.0), (109, 'flow', 3.0))
    assert taken(assembler, (116, 'heat', 4.0)) == [(116, [2.0, 3.0, 4.0])]


def test_a_message_after_its_sample_is_late():
    assembler = SampleSynchronizer(NAMES, tolerance_ns=10)
    assert taken(assembler, (100, 'level', 1.0), (100, 'flow', 2.0)) == [(100, [1.0, 2.0])]
    assert not taken(assembler, (100, 'level', 9.0), (90, 'flow', 9.0), (110, 'flow', 9.0))
    assert counts(assembler) == ({'level': 1, 'flow': 2}, {}, {})
    assert assembler.awaited == ''


def test_a_message_not_received_before_a_later_sample_is_missing():
    assembler = SampleSynchronizer(NAMES)
    assert taken(assembler, (1, 'level', 1.0), (2, 'level', 2.0), (3, 'flow', 3.0)) == []
    assert assembler.awaited == 'flow'
    assert taken(assembler, (3, 'level', 4.0)) == [(3, [4.0, 3.0])]
    assert counts(assembler) == ({}, {'flow': 2}, {})
    # and late, if it comes nevertheless
    assert not taken(assembler, (2, 'flow', 5.0))
    assert counts(assembler) == ({'flow': 1}, {'flow': 2}, {})


def test_the_later_of_two_messages_with_one_stamp_counts():
    assembler = SampleSynchronizer(NAMES)
    assert taken(assembler, (1, 'level', 1.0), (1, 'level', 2.0), (1, 'flow', 3.0)) == [
        (1, [2.0, 3.0])]
    assert counts(assembler) == ({}, {}, {'level': 1})


def test_time_that_is_set_back_begins_afresh():
    assembler = SampleSynchronizer(NAMES)
    late = 100 * SECOND
    assert taken(assembler, (late, 'level', 1.0), (late, 'flow', 2.0), (late + 1, 'level', 3.0)
                 ) == [(late, [1.0, 2.0])]
    # by a second at most it is out of order
    assert not taken(assembler, (late - SECOND, 'level', 4.0), (late - SECOND, 'flow', 5.0))
    assert counts(assembler) == ({'level': 1, 'flow': 1}, {}, {})
    assert taken(assembler, (SECOND, 'level', 6.0), (SECOND, 'flow', 7.0)) == [
        (SECOND, [6.0, 7.0])]
    # what waited belonged to the other time: neither completed nor missing
    assert not taken(assembler, (late + 1, 'flow', 8.0))
    assert counts(assembler) == ({'level': 1, 'flow': 1}, {}, {})


def test_the_queue_is_bounded():
    assembler = SampleSynchronizer(NAMES)
    assert not taken(assembler, *((stamp, 'level', 1.0) for stamp in range(1000)))
    assert len(assembler._open) == 100
    assert counts(assembler) == ({}, {'flow': 900}, {})
    # the oldest were given up
    assert taken(assembler, (900, 'flow', 2.0)) == [(900, [1.0, 2.0])]


@pytest.mark.parametrize('samples', [9, 50, 100, 101, 150])
@pytest.mark.parametrize('ahead', [3600 * SECOND, -3600 * SECOND])
def test_a_clock_that_was_wrong_for_a_while_costs_those_samples_alone(samples, ahead):
    assembler = SampleSynchronizer(NAMES)
    assert len(taken(assembler, *((k * SECOND, name, 1.0) for k in range(10)
                                  for name in NAMES))) == 10
    for k in range(10, 10 + samples):
        assert not taken(assembler, (k * SECOND + ahead, 'level', 1.0), (k * SECOND, 'flow', 1.0))
    good = range(10 + samples, 200 + samples)
    assert [stamp for stamp, _ in taken(assembler, *(
        (k * SECOND, name, 1.0) for k in good for name in NAMES))] == [k * SECOND for k in good]


def test_a_part_with_a_stamp_ahead_is_not_put_together_with_parts_of_that_time():
    assembler = SampleSynchronizer(NAMES)
    assert not taken(assembler, (60 * SECOND, 'level', 9.0))
    for k in range(59):
        assert taken(assembler, (k * SECOND, 'level', 1.0), (k * SECOND, 'flow', 2.0))
    # of that time, the other signal comes first
    assert not taken(assembler, (60 * SECOND, 'flow', 2.0))
    assert taken(assembler, (60 * SECOND, 'level', 1.0)) == [(60 * SECOND, [1.0, 2.0])]
    assert counts(assembler) == ({}, {'flow': 1}, {})
