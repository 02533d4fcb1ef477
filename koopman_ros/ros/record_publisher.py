# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Records of what changes the controller, published as it happens; see docs/records.md."""

from collections.abc import Callable, Mapping
import secrets
import time
from typing import Any

from std_msgs.msg import String

from koopman_ros.control.events import Event, Outcome
from koopman_ros.replay.records import fields_of, Record, SNAPSHOT, START
from koopman_ros.ros import topics
from koopman_ros.ros.matching import Matching

_SNAPSHOT_PERIOD = 10.0  # s by the wall


class RecordPublisher:
    """
    Publish numbered records; the caller holds the lock of the controller's state meanwhile.

    A replay begins at a snapshot of that state. There is one at the start, one for each new
    subscriber, and one every ten seconds while something is recorded.

    :param snapshot: returns the fields of a snapshot, as :func:`records.snapshot` does.
    :param joined: called in the executor when there is another subscriber, to call
        :meth:`publish_snapshot` under the lock.
    """

    def __init__(self, matching: Matching, snapshot: Callable[[], Mapping[str, Any]],
                 joined: Callable[[], None]) -> None:
        self._snapshot = snapshot
        self._run = secrets.token_hex(8)
        self._number = 0
        self._due = 0.0
        self._publisher = matching.publish(
            topics.CONTROLLER_EVENTS,
            matched=lambda info: joined() if info.current_count_change > 0 else None)
        self.publish_snapshot(START)

    def publish_snapshot(self, event: str = SNAPSHOT) -> None:
        """Publish the state."""
        self._publish(event, self._snapshot())
        self._due = time.monotonic() + _SNAPSHOT_PERIOD

    def publish_event(self, event: Event, outcome: Outcome) -> None:
        """Publish an event and what it led to."""
        self.publish(*fields_of(event, outcome))

    def publish(self, event: str, fields: Mapping[str, Any]) -> None:
        """Publish an event by its name."""
        self._publish(event, fields)
        if time.monotonic() > self._due:
            self.publish_snapshot()

    def _publish(self, event: str, fields: Mapping[str, Any]) -> None:
        record = Record(self._run, self._number, event, fields)
        self._number += 1
        self._publisher.publish(String(data=record.text()))
