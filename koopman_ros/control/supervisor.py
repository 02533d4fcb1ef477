# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The supervisor: which control level acts, why not a better one, and when it may again."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from koopman_ros.reasons import Code, Reason, reason
from koopman_ros.units import NANOSECONDS

# What follows when no law can act, in this order.
HOLD = 'hold'
SAFE = 'safe'
MANUAL = 'manual'  # who acts in manual mode; no level of the supervisor
# A threshold that was crossed counts as left only below this share of it.
_HYSTERESIS = 0.5


@dataclass(frozen=True)
class LevelSettings:
    """One control level."""

    law: str  #: its name in :data:`koopman_ros.control.laws.LAWS`, or module:class
    #: distance outside the training data, in half widths of their box, up to which it acts
    margin: float


@dataclass(frozen=True)
class SupervisorSettings:
    """When to fall back and when to recover."""

    #: best first; beyond the last one's margin the safe input is commanded
    levels: tuple[LevelSettings, ...] = (LevelSettings('sdre', 0.1), LevelSettings('linear', 0.5))
    #: seconds without a law or a measurement, after which the safe input is commanded
    hold_timeout: float = 60.0
    #: seconds that a better level must have been possible before it is taken
    recovery_time: float = 10.0

    def __post_init__(self) -> None:
        laws = [level.law for level in self.levels]
        if not laws or len(set(laws)) != len(laws):
            raise ValueError(f'levels must be one law or more, each once, got {laws}')
        margins = [level.margin for level in self.levels]
        if not (margins[0] >= 0.0 and margins == sorted(margins)):
            raise ValueError('the margins of the levels must be at least 0, and none below that '
                             f'of a better level, got {margins}')
        for name in ('hold_timeout', 'recovery_time'):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f'{name} must be at least 0, got {getattr(self, name)}')

    @cached_property
    def order(self) -> tuple[str, ...]:
        """The names of all levels, best first."""
        return (*(level.law for level in self.levels), HOLD, SAFE)

    def depth(self, level: str | None) -> int:
        """Return the place in the order; 0 for None, and for a level that there is no more."""
        return self._depths.get(level, 0)

    @cached_property
    def _depths(self) -> dict[str | None, int]:
        return {level: depth for depth, level in enumerate(self.order)}

    @property
    def largest_margin(self) -> float:
        """The distance beyond which no law acts."""
        return self.levels[-1].margin

    @property
    def return_margin(self) -> float:
        """The distance up to which a law takes over from the safe input."""
        return _HYSTERESIS * self.largest_margin


@dataclass(frozen=True)
class Requested:
    """The best level that is possible now."""

    level: str  #: which
    reason: Reason | None = None  #: why none above it; None for the best
    #: whether it is left as soon as the reason is gone, as when a measurement was missing: nothing
    #: was lost then
    passing: bool = False


@dataclass(frozen=True)
class Supervisor:
    """The state of the supervisor."""

    level: str | None = None  #: that acts; None before the first measurement
    reason: Reason | None = None  #: why none above it
    resumes: str | None = None  #: the level that follows when a passing reason is gone, or None
    bad_since_ns: int | None = None  #: since when no law could act, or None
    better_since_ns: int | None = None  #: since when a better level has been possible, or None

    @property
    def settled(self) -> str | None:
        """The level without regard to a passing reason."""
        return self.resumes or self.level

    def allowed(self, settings: SupervisorSettings, outside: float,
                ranges: tuple[tuple[str, float, float], ...]) -> Requested:
        """
        Return what the distance from the training data allows.

        :param outside: in half widths of the training box.
        :param ranges: (name, lower, upper) of the training box, for the reason.
        """
        levels = settings.levels
        for i in reversed(range(len(levels))):
            below = levels[i + 1].law if i + 1 < len(levels) else SAFE
            margin = levels[i].margin
            entered = settings.depth(self.settled) >= settings.depth(below)
            if outside > (_HYSTERESIS * margin if entered else margin):
                return Requested(below, reason(Code.OUTSIDE_TRAINING, ranges=ranges,
                                               margin=margin, level=levels[i].law))
        return Requested(levels[0].law)

    def at(self, settings: SupervisorSettings, requested: Requested, time_ns: int) -> Supervisor:
        """
        Fall back immediately; recover when it was possible for long enough.

        :param requested: the best level possible; a hold becomes the safe input after its
            timeout.
        """
        depth, bad_since, why = settings.depth, None, requested.reason
        if requested.level == HOLD:
            bad_since = time_ns if self.bad_since_ns is None else self.bad_since_ns
            held = (time_ns - bad_since) / NANOSECONDS
            # the safe input once commanded stays until there is a law again
            if held > settings.hold_timeout or (
                    self.level == SAFE and self.bad_since_ns is not None):
                assert why is not None
                why = reason(Code.HELD_TOO_LONG, cause=why, timeout=settings.hold_timeout)
                requested = Requested(SAFE, why)
        settled = settings.order[depth(self.settled)]
        if requested.passing and depth(settled) < depth(requested.level):
            return Supervisor(requested.level, why, settled, bad_since)
        if requested.passing and depth(settled) > depth(requested.level):
            # on its way to the safe input, nothing is gained by a hold
            return Supervisor(settled, why, None, bad_since)
        if depth(requested.level) >= depth(settled):
            return Supervisor(requested.level, why, None, bad_since)
        since = time_ns if self.better_since_ns is None else self.better_since_ns
        if (time_ns - since) / NANOSECONDS >= settings.recovery_time:
            return Supervisor(requested.level, why, None, bad_since)
        waiting = self.reason
        if waiting is not None and waiting.code is not Code.RECOVERING:
            waiting = reason(Code.RECOVERING, cause=waiting)
        return Supervisor(settled, waiting, None, self.bad_since_ns, since)
