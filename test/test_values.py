# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Records behave as frozen dataclasses do."""

from dataclasses import field, FrozenInstanceError, replace
import inspect
import pickle

from koopman_ros.values import amended, record
import pytest


@record
class Point:
    """A record with every kind of field."""

    x: float
    y: float = 2.0
    tags: list[str] = field(default_factory=list)


def test_a_record_is_made_compared_and_shown_as_a_frozen_dataclass() -> None:
    point = Point(1.0)
    assert (point.x, point.y, point.tags) == (1.0, 2.0, [])
    assert point == Point(x=1.0, y=2.0) != Point(1.0, 3.0)
    assert point.tags is not Point(1.0).tags
    assert repr(point) == 'Point(x=1.0, y=2.0, tags=[])'
    assert list(inspect.signature(Point).parameters) == ['x', 'y', 'tags']
    assert pickle.loads(pickle.dumps(point)) == point
    with pytest.raises(FrozenInstanceError):
        point.x = 3.0  # type: ignore[misc]
    with pytest.raises(TypeError, match='x'):
        Point(y=1.0)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match='z'):
        Point(1.0, z=1.0)  # type: ignore[call-arg]


def test_a_changed_copy_leaves_the_record_as_it_was() -> None:
    point = Point(1.0, 5.0, ['a'])
    for change in (amended, replace):
        moved = change(point, x=7.0)
        assert (moved.x, moved.y, moved.tags) == (7.0, 5.0, ['a'])
        assert point.x == 1.0
