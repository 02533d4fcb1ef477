# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The supervisor: which control level acts, and when a better one may act again."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.core.units import NANOSECONDS

# The levels after the laws, in this order.
HOLD = 'hold'
SAFE = 'safe'
MANUAL = 'manual'  # in manual mode; no level of the supervisor
# A threshold that was crossed counts as left only below this share of it.
_HYSTERESIS = 0.5


@dataclass(frozen=True)
class FallbackOrder:
    """
    The control levels, the best first, and when to fall back and to recover.

    :raises ValueError: for margins that decrease.
    """

    laws: tuple[str, ...]  #: by name
    #: distance outside the training data, in half-ranges, up to which each acts; beyond the last
    #: one's the safe input is commanded
    margins: tuple[float, ...]
    #: seconds without a law or a measurement, after which the safe input is commanded
    hold_timeout: float = 60.0
    #: seconds that a better level must have been possible before it is taken
    recovery_time: float = 10.0
    safe_latch: bool = False  #: whether the safe input, once reached, stays until it is cleared

    def __post_init__(self) -> None:
        if list(self.margins) != sorted(self.margins):
            raise ValueError(f'fallback_order = {list(self.laws)}, learned_model_margin and '
                             'linear_model_margin: the margin of a level must be at least that of '
                             f'the better ones, got {list(self.margins)}')

    @cached_property
    def levels(self) -> tuple[str, ...]:
        """The names of all levels, best first."""
        return (*self.laws, HOLD, SAFE)

    def depth(self, level: str | None) -> int:
        """Return the place in the order; 0 for None, and for a level that there is no more."""
        return self.levels.index(level) if level in self.levels else 0

    def below(self, level: str) -> str:
        """Return the next level in the order."""
        return self.levels[self.depth(level) + 1]

    @property
    def return_margin(self) -> float:
        """The distance up to which a law takes over from the safe input."""
        return _HYSTERESIS * self.margins[-1]


class LevelRequest(NamedTuple):
    """The best level that is possible now."""

    level: str  #: which
    reason: Reason | None = None  #: why none above it; None for the best
    #: whether it is left as soon as the reason is gone, as when a measurement was missing: nothing
    #: was lost then
    passing: bool = False


@dataclass(frozen=True, slots=True)
class Supervisor:
    """The state of the supervisor."""

    level: str | None = None  #: that acts; None before the first measurement
    reason: Reason | None = None  #: why none above it
    resumes: str | None = None  #: the level that follows when a passing reason is gone, or None
    bad_since_ns: int | None = None  #: since when no law could act, or None
    better_since_ns: int | None = None  #: since when a better level has been possible, or None
    latched: bool = False  #: whether the safe input stays until an operator clears it

    @classmethod
    def latched_before(cls) -> Supervisor:
        """Return that of a controller whose predecessor had latched."""
        return cls(SAFE, reason(StatusCode.SAFE_LATCHED, cause=reason(
            StatusCode.LATCHED_BEFORE)), latched=True)

    @property
    def settled(self) -> str | None:
        """The level without regard to a passing reason."""
        return self.resumes or self.level

    def allowed(self, order: FallbackOrder, outside: float,
                ranges: tuple[tuple[str, float, float], ...]) -> LevelRequest:
        """
        Return the level that the distance from the training data, in half-ranges, allows.

        :param ranges: (name, lower, upper) of the trained range, for the reason.
        """
        if not outside > 0.0:
            return LevelRequest(order.laws[0])
        for law, margin in reversed(tuple(zip(order.laws, order.margins, strict=True))):
            below = order.below(law) if law != order.laws[-1] else SAFE
            entered = order.depth(self.settled) >= order.depth(below)
            least = _HYSTERESIS * margin if entered else margin
            if outside > least:
                return LevelRequest(below, reason(
                    StatusCode.OUTSIDE_TRAINING, ranges=ranges, margin=least, level=law))
        return LevelRequest(order.laws[0])

    def at(self, order: FallbackOrder, requested: LevelRequest, time_ns: int) -> Supervisor:
        """
        Fall back immediately; recover when it was possible for long enough.

        A hold becomes the safe input after its timeout, which may latch.
        """
        found = self._next(order, requested, time_ns)
        if not (order.safe_latch and (self.latched or found.level == SAFE)):
            return found
        possible, since, cause = requested.level in order.laws, None, found.reason
        if possible:
            since = time_ns if self.better_since_ns is None else self.better_since_ns
        if self.latched and self.reason is not None:
            cause = self.reason.cause if possible else requested.reason
        assert cause is not None
        ready = since is not None and (time_ns - since) / NANOSECONDS >= order.recovery_time
        return Supervisor(SAFE, reason(
            StatusCode.LATCH_CLEARABLE if ready else StatusCode.SAFE_LATCHED, cause=cause), None,
            found.bad_since_ns, since, latched=True)

    def _next(self, order: FallbackOrder, requested: LevelRequest, time_ns: int) -> Supervisor:
        """Return the same without a latch."""
        depth, bad_since, why = order.depth, None, requested.reason
        if requested.level == HOLD:
            bad_since = time_ns if self.bad_since_ns is None else self.bad_since_ns
            too_long = (time_ns - bad_since) / NANOSECONDS > order.hold_timeout
            if too_long:
                assert why is not None
                why = reason(StatusCode.HELD_TOO_LONG, cause=why, timeout=order.hold_timeout)
            # the safe input once commanded stays until there is a law again
            if too_long or (self.level == SAFE and self.bad_since_ns is not None):
                requested = LevelRequest(SAFE, why)
        settled = order.levels[depth(self.settled)]
        if requested.passing and depth(settled) < depth(requested.level):
            return Supervisor(requested.level, why, settled, bad_since)
        if requested.passing and requested.level == HOLD and depth(settled) > depth(HOLD):
            # on its way to the safe input, nothing is gained by a hold
            return Supervisor(settled, why, None, bad_since)
        if depth(requested.level) >= depth(settled):
            return Supervisor(requested.level, why, None, bad_since)
        since = time_ns if self.better_since_ns is None else self.better_since_ns
        if (time_ns - since) / NANOSECONDS >= order.recovery_time:
            return Supervisor(requested.level, why, None, bad_since)
        waiting = self.reason
        if waiting is not None and waiting.code is not StatusCode.RECOVERING:
            waiting = reason(StatusCode.RECOVERING, cause=waiting)
        return Supervisor(settled, waiting, None, self.bad_since_ns, since)
