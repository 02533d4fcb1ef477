# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers that one source counts up, and what two sources or a cycling clock make of them."""

from itertools import count

import pytest

from koopman_ros.core.time_base import Advance, TimeBase
from koopman_ros.core.units import NANOSECONDS as SECOND

NEW, OLD, RESTARTED, TWO = Advance
WINDOW = 10.0  # s


def found(base, stamps, begin=0.0, every=1.0):
    """Take stamps in s that arrive so often; return what each is."""
    return [base.take(round(stamp * SECOND), begin + every * k, WINDOW)
            for k, stamp in enumerate(stamps)]


def test_only_a_number_that_is_larger_than_all_before_is_new():
    assert found(TimeBase(), (5.0, 6.0, 6.0, 5.5, 6.0, 6.2, 6.1)) == [
        NEW, NEW, OLD, OLD, OLD, NEW, OLD]


def test_a_clock_that_is_set_back_starts_again_once():
    base = TimeBase()
    assert found(base, (500.0, 501.0, 0.0, 1.0, 2.0)) == [NEW, NEW, RESTARTED, NEW, NEW]
    # and again after the window
    assert found(base, (0.0, 1.0), begin=20.0) == [RESTARTED, NEW]


@pytest.mark.parametrize('offset', [1.5, 7.3, 1000.0, 1e9])
def test_of_two_sources_in_turn_each_is_news_once(offset):
    base, stamps = TimeBase(), []
    for k in range(30):
        stamps += [2e9 + k, 2e9 + k - offset]
    ways = found(base, stamps, every=0.5)
    assert ways[:3] == [NEW, RESTARTED, NEW]
    assert set(ways[3:]) == {TWO}


@pytest.mark.parametrize('left', ['ahead', 'behind'])
def test_the_source_that_is_left_is_news_after_some_rounds(left):
    base = TimeBase()
    found(base, (1000.0, 0.0, 1001.0, 1.0, 1002.0, 2.0))
    begin = 1003.0 if left == 'ahead' else 3.0
    ways = found(base, (begin + k for k in range(20)), begin=6.0)
    # the last restart was at 5 s, the one before 2 s earlier
    assert ways == [TWO] * 6 + [NEW] * 14
    # and the other one is none as long as it comes back within the window
    assert base.take(0, 26.0, 25.0) is TWO


def test_numbers_of_messages_have_no_late_ones():
    base, number = TimeBase(late=-1), count(1)
    assert [base.take(next(number), float(k), WINDOW) for k in range(5)] == [NEW] * 5
    # another publisher takes over, as after a restart of the sensor
    assert [base.take(k, 5.0 + k, WINDOW) for k in (1, 2, 3)] == [RESTARTED, NEW, NEW]
    # two with the same count
    base = TimeBase(late=-1)
    assert [base.take(k // 2, 0.5 * k, WINDOW) for k in range(2, 8)] == [
        NEW, RESTARTED, NEW, TWO, TWO, TWO]
