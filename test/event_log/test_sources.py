# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The end of a bag's records, as a replay of the last seconds needs it."""

from collections.abc import Iterator
import itertools

import pytest

from koopman_ros.event_log.records import EventRecord
from koopman_ros.event_log.sources import lately


def _records() -> Iterator[EventRecord]:
    """Give a start, and a snapshot each ten of a hundred measurements, one a second."""
    number = itertools.count()
    for second in range(100):
        if second % 10 == 0:
            yield EventRecord('run', next(number), 'snapshot' if second else 'start', {})
        yield EventRecord('run', next(number), 'measurement', {'stamp_ns': second * 10 ** 9})


RECORDS = list(_records())


@pytest.mark.parametrize(('seconds', 'first'), [
    (1e6, 0.0), (99.5, 0.0), (30.5, 60.0), (25.0, 70.0), (5.0, 90.0), (0.5, 90.0)])
def test_it_begins_with_the_snapshot_before(seconds: float, first: float) -> None:
    found = list(lately(iter(RECORDS), seconds))
    assert found == RECORDS[len(RECORDS) - len(found):]
    assert found[0].event in ('start', 'snapshot')
    assert found[1].stamp_ns == first * 10 ** 9


def test_nothing_of_nothing() -> None:
    assert list(lately(iter(()), 1.0)) == []
