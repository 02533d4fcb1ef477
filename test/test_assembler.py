# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Signals of several messages become one measurement by stamp; what goes wrong is counted."""

from collections import Counter

import pytest

from koopman_ros.assembler import Assembler
from koopman_ros.units import NANOSECONDS

SECOND = NANOSECONDS


def assembler(tolerance: float = 0.0) -> Assembler:
    return Assembler(('level_1', 'level_2'), round(tolerance * SECOND))


def taken(found: object) -> tuple[int, list[float]] | None:
    return None if found is None else (found[0], found[1].tolist())  # type: ignore[index]


def test_a_message_with_all_is_whole_by_itself() -> None:
    parts = assembler()
    assert taken(parts.take(5, {'level_2': 2.0, 'level_1': 1.0})) == (5, [1.0, 2.0])
    assert parts.awaited == ''


@pytest.mark.parametrize('first', ['level_1', 'level_2'])
def test_parts_of_one_stamp_are_a_measurement_in_any_order(first: str) -> None:
    values = {'level_1': 1.0, 'level_2': 2.0}
    second = next(name for name in values if name != first)
    parts = assembler()
    assert parts.take(SECOND, {first: values[first]}) is None
    assert parts.awaited == second
    assert taken(parts.take(SECOND, {second: values[second]})) == (SECOND, [1.0, 2.0])
    assert parts.awaited == ''


@pytest.mark.parametrize(('apart', 'whole'), [(0.05, True), (0.06, False)])
def test_stamps_may_be_apart_by_the_tolerance_and_the_last_one_counts(
        apart: float, whole: bool) -> None:
    parts = assembler(tolerance=0.05)
    assert parts.take(SECOND, {'level_1': 1.0}) is None
    at = SECOND + round(apart * SECOND)
    assert taken(parts.take(at, {'level_2': 2.0})) == ((at, [1.0, 2.0]) if whole else None)


def test_what_is_missing_late_or_doubled_is_counted_for_its_signal() -> None:
    parts = assembler()
    parts.take(1 * SECOND, {'level_1': 1.0})  # whose other part does not come
    parts.take(2 * SECOND, {'level_1': 1.5})
    parts.take(2 * SECOND, {'level_1': 2.0})  # again: this one counts
    assert taken(parts.take(2 * SECOND, {'level_2': 3.0})) == (2 * SECOND, [2.0, 3.0])
    parts.take(round(1.5 * SECOND), {'level_2': 9.0})  # when its measurement is over
    assert parts.missing == Counter(level_2=1)
    assert parts.doubled == Counter(level_1=1)
    assert parts.late == Counter(level_2=1)


def test_time_that_is_set_back_begins_anew() -> None:
    parts = assembler()
    parts.take(100 * SECOND, {'level_1': 1.0})
    parts.take(100 * SECOND, {'level_2': 2.0})
    parts.take(101 * SECOND, {'level_1': 1.0})
    # more than a second back; what waited belongs to the time before
    assert parts.take(50 * SECOND, {'level_1': 3.0}) is None
    assert taken(parts.take(50 * SECOND, {'level_2': 4.0})) == (50 * SECOND, [3.0, 4.0])
    assert not parts.late


def test_what_never_becomes_whole_does_not_grow_without_end() -> None:
    parts = assembler()
    for k in range(1000):
        assert parts.take(k * SECOND, {'level_1': float(k)}) is None
    # a hundred are waited for
    assert parts.missing == Counter(level_2=900)
