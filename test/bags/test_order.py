# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The order of receipt, restored from the order in the file."""

import pytest

from koopman_ros.bags import BagMessage, in_log_order
from koopman_ros.units import NANOSECONDS as S


def _order(*seconds: float) -> list[float]:
    """Return the order of messages that were recorded with these times of receipt."""
    messages = [BagMessage('/x', '', round(time * S), place, None, b'')
                for place, time in enumerate(seconds)]
    found = list(in_log_order(messages))
    assert sorted(m.publish_time_ns for m in found) == list(range(len(seconds)))
    return [m.log_time_ns / S for m in found]


@pytest.mark.parametrize(('recorded', 'order'), [
    ((), []),
    ((1, 2, 3), [1, 2, 3]),
    # a recorder that fell behind wrote what waited topic by topic
    ((1, 4, 2, 3, 5), [1, 2, 3, 4, 5]),
    ((10, 5.5, 11, 6, 20), [5.5, 6, 10, 11, 20]),
    # the clock was set back: nothing of the later run goes ahead
    ((100, 101, 3, 4, 101, 102), [100, 101, 3, 4, 101, 102]),
    ((100, 99, 98, 1, 0.5, 2), [98, 99, 100, 0.5, 1, 2]),
    # and set forward
    ((1, 2, 1000, 1001), [1, 2, 1000, 1001]),
])
def test_order(recorded: tuple[float, ...], order: list[float]) -> None:
    assert _order(*recorded) == order


def test_messages_of_one_time_keep_their_order() -> None:
    messages = [BagMessage('/x', '', 7, place, None, b'') for place in range(5)]
    assert [m.publish_time_ns for m in in_log_order(messages)] == list(range(5))


def test_messages_are_handed_on_before_the_last_is_read() -> None:
    taken = []

    def recorded():
        for second in range(100):
            taken.append(second)
            yield BagMessage('/x', '', second * S, second, None, b'')

    first = next(in_log_order(recorded()))
    assert first.log_time_ns == 0
    assert len(taken) < 10
