# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Messages in a bag that belong to a measurement: commands, set-points tracked, the coolant."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
import math

from koopman_ros.bags import BagMessage
from koopman_ros.nodes.messages import NANOSECONDS, stamp_nanoseconds
from koopman_ros.nodes.replaying.inputs import Input
from koopman_ros.nodes.translation import SAME_TIME_NS

# The set-point tracked among the controller's internals; changes alone are on a topic that keeps
# the last one, so that a busy recorder misses some.
TRACKED = 'setpoint [degC]'
# An answer that is recorded longer than this before or after its measurement belongs to another.
_NEAR_NS = 10 * NANOSECONDS


class Answers:
    """Messages that go with a measurement, by the stamp of that measurement."""

    def __init__(self) -> None:
        self.in_order: list[tuple[int, int, float]] = []
        self._by_stamp: dict[int, deque[int]] = {}
        self._heard = 0

    def add(self, entry: BagMessage) -> None:
        """Add a temperature."""
        self._add(entry, entry.message.temperature)

    def add_tracked(self, entry: BagMessage) -> None:
        """Add the set-point among the internals, which tell it with every measurement."""
        try:
            found = dict(zip(entry.message.name, entry.message.position, strict=True))
            celsius = float(found[TRACKED])
        except (AttributeError, KeyError, TypeError, ValueError):
            # of another program, or another version of ours
            return
        if math.isfinite(celsius):
            self._add(entry, celsius)

    def _add(self, entry: BagMessage, celsius: float) -> None:
        stamp_ns = stamp_nanoseconds(entry.message.header.stamp)
        self._by_stamp.setdefault(stamp_ns, deque()).append(len(self.in_order))
        self.in_order.append((stamp_ns, entry.log_time_ns, celsius))

    def take(self, entry: Input) -> int | None:
        """Return the place of the next answer to a measurement, each once, or None."""
        waiting = self._by_stamp.get(stamp_nanoseconds(entry.message.header.stamp), deque())
        while waiting and self.in_order[waiting[0]][1] < entry.time_ns - _NEAR_NS:
            waiting.popleft()
        if waiting and self.in_order[waiting[0]][1] <= entry.time_ns + _NEAR_NS:
            return waiting.popleft()
        return None

    def taken(self, entry: Input) -> float | None:
        """Return the next answer to a measurement in degrees Celsius, each once, or None."""
        place = self.take(entry)
        return None if place is None else self.in_order[place][2]

    def last(self, entry: Input) -> float | None:
        """Return what a measurement's own stamp tells, or else the last news, if it is timely."""
        own = self.taken(entry)
        self._heard = bisect_right(
            self.in_order, entry.time_ns, self._heard, key=lambda message: message[1])
        if own is not None or not self._heard:
            return own
        stamp_ns, _, celsius = self.in_order[self._heard - 1]
        away = abs(stamp_nanoseconds(entry.message.header.stamp) - stamp_ns)
        return celsius if away <= SAME_TIME_NS else None

    def before(self, first: Input) -> tuple[int, float] | None:
        """Return the last of those recorded first that answer no measurement of the bag."""
        first_ns = stamp_nanoseconds(first.message.header.stamp)
        found = None
        for stamp_ns, time_ns, celsius in self.in_order:
            # stamps go back where time was set back, and a latched one may come late
            if not (stamp_ns < first_ns or (stamp_ns > first_ns and time_ns < first.time_ns)):
                break
            found = stamp_ns, celsius
        return found
