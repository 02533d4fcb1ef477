# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Progress of a number that only one source counts up: stamps, or numbers of messages."""

from dataclasses import dataclass
from enum import Enum
import math

from koopman_ros.core.units import LATE_NANOSECONDS

# Without a restart for so long one source is left.
_ROUNDS, _PAUSE = 3.0, 0.2  # times the last round, and s


class Advance(Enum):
    """The relation of a number to those before it."""

    NEW = 'new'  #: larger than all before it
    OLD = 'old'  #: repeated, or late by less than is tolerated
    RESTARTED = 'restarted'  #: smaller by so far that the count restarts from it
    TWO_SOURCES = 'two sources'  #: one of a count that starts again and again


@dataclass
class TimeBase:
    """
    The largest number since the count last started again.

    A count may start again once, as that of a simulation does. Where it does so twice within a
    window, two sources alternate, or a clock cycles: every number is then
    :attr:`Advance.TWO_SOURCES`, until the count has grown for three times as long as it last did,
    and a fifth of a second, or for the whole window. Two sources that take turns go back at every
    second number, so that at most one more of each is taken for news.
    """

    late: int = LATE_NANOSECONDS  #: how much smaller a number may be without a restart
    newest: int | None = None
    conflict: bool = False  #: whether two sources count
    _restarted: float = -math.inf  # s, by the steady clock
    _round: float = 0.0  # s, from one restart to the next, where two sources count

    def take(self, number: int, now: float, window: float) -> Advance:
        """
        Take a number.

        :param now: its arrival by the steady clock, in s.
        :param window: shortest time between two restarts of one source, in s; 0 for any.
        """
        since, before = now - self._restarted, self.newest
        if before is not None and number < before - self.late:
            self.newest, self._restarted = number, now
            self.conflict, self._round = since < window, since
            return Advance.TWO_SOURCES if self.conflict else Advance.RESTARTED
        if not since < min(window, _ROUNDS * self._round + _PAUSE):
            self.conflict = False
        if before is None or number > before:
            self.newest = number
            return Advance.TWO_SOURCES if self.conflict else Advance.NEW
        return Advance.TWO_SOURCES if self.conflict else Advance.OLD
