# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""When measurements arrive: how long ago, how old, and by which clock."""

import math
import time
from typing import NamedTuple

from rclpy.node import Node

from koopman_ros.units import NANOSECONDS

# Stamps further from the node's clock than this come from another clock.
_SAME_CLOCK = 3600.0  # s
_CLOCK_PATIENCE = 1.0  # s from the start until somebody should publish the time


class Moment(NamedTuple):
    """A time by the steady clock, in s, on /clock (0 where it does not count) and the node's."""

    wall: float
    sim_ns: int
    node_ns: int


class Timing:
    """
    The time of the last measurement that brought news, by the plant's time where it is known.

    With `use_sim_time` that is the time on /clock, as long as there is one; otherwise the steady
    clock, which no correction of the system's time upsets.

    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._simulated = bool(node.get_parameter('use_sim_time').value)
        self._wall = time.monotonic()
        self._sim = self._sim_now()
        self._begun = self._wall
        self.age = math.nan  # s, of the last measurement at its arrival
        self.answer_seconds = math.nan  # from its arrival to its command
        self.busy = False  # whether what has arrived since then waits for the node itself

    def now(self) -> Moment:
        """Return the present time."""
        return Moment(time.monotonic(), self._sim_now(),
                      self._node.get_clock().now().nanoseconds)

    def note(self, stamp_ns: int, at: Moment) -> None:
        """Take down that a measurement with a new stamp has arrived at a time."""
        self._wall, self._sim = at.wall, at.sim_ns
        age = (at.node_ns - stamp_ns) / NANOSECONDS
        # at time zero the clock has not begun
        self.age = age if at.node_ns and abs(age) < _SAME_CLOCK else math.nan

    def answered(self) -> None:
        """Take down that its command is out."""
        self.answer_seconds = time.monotonic() - self._wall

    @property
    def without_clock(self) -> bool:
        """Whether `use_sim_time` is set and nobody publishes the time."""
        waited = time.monotonic() - self._begun
        return self._simulated and self._sim_now() == 0 and waited > _CLOCK_PATIENCE

    def busy_silence(self, seconds: float) -> float:
        """
        Return the silence while the node has been busy for so many seconds.

        Nobody takes the time from /clock then, and the steady clock stands in for it.
        """
        return max(self.silence, seconds if self._simulated else 0.0)

    @property
    def wall_silence(self) -> float:
        """Seconds since the last measurement by the steady clock."""
        return time.monotonic() - self._wall

    @property
    def silence(self) -> float:
        """Seconds since the last measurement, in the plant's time where it is known."""
        now = self._sim_now()
        if now:
            # a clock that was set back says nothing yet
            self._sim = min(self._sim or now, now)
            return (now - self._sim) / NANOSECONDS
        return self.wall_silence

    def _sim_now(self) -> int:
        return self._node.get_clock().now().nanoseconds if self._simulated else 0
