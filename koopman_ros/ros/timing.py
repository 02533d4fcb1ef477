# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Times of measurements: progress of their stamps, silence, age, time that a rate may count."""

import math
import time

from rclpy.node import Node

from koopman_ros.core.time_base import Advance, TimeBase
from koopman_ros.core.units import NANOSECONDS

# Stamps further from the node's clock than this come from another clock.
_SAME_CLOCK = 3600.0  # s
_JITTER = 1.0  # s by which messages of one clock may come early or late
PAUSED = 10.0  # s by the steady clock after which a stopped clock is reported
_CLOCK_PATIENCE = 1.0  # s from the start until the time should be published


class Timing:
    """
    Progress of the measurements' stamps, and the silence since the last.

    Only a stamp that advances, or that begins a time base, ends a silence. It is timed on /clock
    where there is one, else by the steady clock.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._simulated = bool(node.get_parameter('use_sim_time').value)
        self._wall = self._start = time.monotonic()
        self._ticked = (0, self._start)  # last time on /clock, and when it came by the steady one
        self._sim = self._sim_now()
        self._base = TimeBase()
        self._spacing = 0.0  # s by the steady clock, between the last two stamps that advanced
        self._noted = False
        # time of the last measurement, if it was no news, by both clocks, and why
        self._ignored: tuple[float, int, Advance] | None = None
        self._spare = _JITTER  # s that the rate limit may count beyond those that have passed
        self._counted = -math.inf  # s by the clock of the stamps, when it counted some last
        self.age = math.nan  # s, of the last measurement at its arrival
        self.answer_seconds = math.nan  # from its arrival to its command
        self.busy = False  # whether messages since then wait for the node itself

    def now(self) -> tuple[float, int, int]:
        """Return the time by the steady clock in s, on /clock, or 0, and the node's, in ns."""
        simulated = self._sim_now()
        # without /clock the node's time is the system's, which Python reads itself
        return time.monotonic(), simulated, simulated if self._simulated else time.time_ns()

    def arrive(self, stamp_ns: int, at: tuple[float, int, int], window: float,
               two_sources: bool = False) -> Advance:
        """
        Note the receipt of a measurement; return the relation of its stamp to the last.

        :param window: shortest time between two restarts of the stamps, in s; 0 for any.
        :param two_sources: whether two are known otherwise.
        """
        found = self._base.take(stamp_ns, at[0], window)
        if two_sources:
            found = Advance.TWO_SOURCES
        self._ignored = None
        if found in (Advance.OLD, Advance.TWO_SOURCES):
            self.ignore(at, found)
        return found

    def ignore(self, at: tuple[float, int, int], why: Advance = Advance.OLD) -> None:
        """Take down that a measurement, or a part of one, came and is not new."""
        self._ignored = (*at[:2], why)

    def note(self, stamp_ns: int, at: tuple[float, int, int]) -> None:
        """Take down that a measurement with news that arrived at a time is answered."""
        self._spacing, self._noted = at[0] - self._wall if self._noted else 0.0, True
        self._wall, self._sim, _ = at
        self.age = self._age(stamp_ns, at)

    @staticmethod
    def _age(stamp_ns: int, at: tuple[float, int, int]) -> float:
        age = (at[2] - stamp_ns) / NANOSECONDS
        # at time zero the clock has not begun
        return age if at[2] and abs(age) < _SAME_CLOCK else math.nan

    def countable(self, seconds: float, stamp_ns: int, at: tuple[float, int, int]
                  ) -> float | None:
        """
        Return how many of the seconds since the last stamp the rate limit may count, or None.

        They are those of the steady clock, where stamps are of the time of the node's clock, or of
        /clock where the node follows it. Of those that it does not count, one is kept, since
        messages come early and late.
        """
        known = not math.isnan(self._age(stamp_ns, at))
        # /clock may be published less often than measurements
        now = self._passing(at, stamp_ns if known else 0)
        if now < self._counted - _JITTER:
            self._counted = now  # /clock was set back
        passed = max(0.0, now - self._counted)
        self._counted = max(self._counted, now)
        if not known:
            return None
        counted = max(0.0, min(seconds, passed + self._spare))
        self._spare = min(passed + self._spare - counted, _JITTER)
        return counted

    def commanded(self) -> None:
        """Take down that a command without a measurement has counted the time until now."""
        self._counted = max(self._counted, self._passing(self.now()))

    def _passing(self, at: tuple[float, int, int], stamp_ns: int = 0) -> float:
        """Return the time in s by which the rate limit counts."""
        return max(at[1], stamp_ns) / NANOSECONDS if self._simulated else at[0]

    def answered(self) -> None:
        """Take down that its command is out."""
        self.answer_seconds = time.monotonic() - self._wall

    @property
    def without_clock(self) -> bool:
        """Whether `use_sim_time` is set and /clock is not published."""
        waited = time.monotonic() - self._start
        return self._simulated and self._sim_now() == 0 and waited > _CLOCK_PATIENCE

    def silence_cause(self, within: float) -> Advance | None:
        """Return why the last measurement was not newer, if it was received within `seconds`."""
        if self._ignored is None or self._since(*self._ignored[:2]) > within:
            return None
        return self._ignored[2]

    @property
    def paused(self) -> bool:
        """Whether /clock has not advanced for much longer than between two measurements."""
        return self._ticked[0] > 0 and time.monotonic() - self._ticked[1] > max(
            PAUSED, 3.0 * self._spacing)

    def busy_silence(self, seconds: float) -> float:
        """Return the silence of a node that was busy for a time, in which /clock was not read."""
        return max(self.silence, seconds if self._simulated else 0.0)

    @property
    def wall_silence(self) -> float:
        """Seconds since the last measurement by the steady clock."""
        return time.monotonic() - self._wall

    @property
    def silence(self) -> float:
        """Seconds since the last measurement, in the plant's time where it is known."""
        if (now := self._sim_now()) and not 0 < self._sim <= now:
            # a clock that was set back says nothing yet
            self._sim = now
        return self._since(self._wall, self._sim)

    def _since(self, wall: float, simulated: int) -> float:
        now = self._sim_now()
        if now and simulated:
            return max(0.0, (now - simulated) / NANOSECONDS)
        return time.monotonic() - wall

    def _sim_now(self) -> int:
        now = self._node.get_clock().now().nanoseconds if self._simulated else 0
        if now != self._ticked[0]:
            self._ticked = (now, time.monotonic())
        return now
