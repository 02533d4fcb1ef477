# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Inputs under way: which of them act in an interval, for dead times of any length."""

import numpy as np
import pytest

from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.estimation import AppliedInputs

# Two inputs, the second one tenfold, once a second from 10 s on; 2.5 s and 0.3 s late.
LATE = (5 * SECOND // 2, 3 * SECOND // 10)


def commanded(dead_ns: tuple[int, ...] = LATE, count: int = 6) -> AppliedInputs:
    found = AppliedInputs()
    for k in range(count):
        found = found.followed_by((10 + k) * SECOND, np.array([k, 10.0 * k])[:len(dead_ns)],
                                  dead_ns)
    return found


@pytest.mark.parametrize(('begin', 'end', 'pieces'), [
    (15.0, 15.6, [(0.3, 2.0, 40.0), (0.2, 2.0, 50.0), (0.1, 3.0, 50.0)]),
    (15.1, 15.2, [(0.1, 2.0, 40.0)]), (15.0, 15.0, []),
    # later than the last one it is held
    (15.0, 18.0, [(0.3, 2.0, 40.0), (0.2, 2.0, 50.0), (1.0, 3.0, 50.0), (1.0, 4.0, 50.0),
                  (0.5, 5.0, 50.0)])])
def test_each_input_acts_after_its_own_dead_time(begin, end, pieces):
    found = commanded().pieces(round(begin * SECOND), round(end * SECOND), LATE)
    assert [(seconds, *u) for seconds, u in found] == pieces


@pytest.mark.parametrize(('dead', 'kept'), [((0.0,), 1), ((0.4,), 2), ((2.0, 0.0), 3),
                                            ((2.1, 0.0), 4), ((60.0,), 6)])
def test_inputs_past_the_dead_time_are_dropped(dead, kept):
    dead_ns = tuple(round(seconds * SECOND) for seconds in dead)
    found = commanded(dead_ns)
    assert len(found.times_ns) == len(found.values) == kept
    # of the last dead time nothing is lost
    whole = commanded((60 * SECOND,) * len(dead))
    for time in np.linspace(15.0, 20.0, 51):
        np.testing.assert_array_equal(found.acting(round(time * SECOND), dead_ns),
                                      whole.acting(round(time * SECOND), dead_ns))


def test_the_first_input_precedes_the_record_and_the_last_is_measured():
    found = AppliedInputs().corrected(np.array([7.0])).followed_by(
        10 * SECOND, np.array([1.0]), (4 * SECOND,))
    assert [found.acting(round(time * SECOND), (4 * SECOND,))[0] for time in (
        -5.0, 10.0, 13.9, 14.0)] == [7.0, 7.0, 7.0, 1.0]
    found = found.corrected(np.array([3.0]))
    assert found.acting(14 * SECOND, (4 * SECOND,))[0] == 3.0
    # what was applied before the first command acts on for a dead time
    for count, left in ((1, 4.0), (3, 2.0), (5, 0.0), (6, 0.0)):
        now_ns = (9 + count) * SECOND
        assert found.assumed(now_ns, (4 * SECOND,)) == left
        assert commanded((4 * SECOND,), count).assumed(now_ns, (4 * SECOND,)) == left
        assert found.assumed(now_ns, (0,)) == 0.0
    # a clock that was set back by 8 s, and a command at a time at which there was one
    found = found.shifted(-8 * SECOND).followed_by(2 * SECOND, np.array([5.0]), (4 * SECOND,))
    assert [found.acting(time * SECOND, (4 * SECOND,))[0] for time in (5, 6)] == [7.0, 5.0]
