# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The supervisor: the table of fallbacks, which level acts, and when a better one may again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import auto, Enum
from functools import cached_property
from typing import NamedTuple

from koopman_ros.core.status import Reason, reason, StatusCode, Value
from koopman_ros.core.units import NANOSECONDS

# The levels after the laws, in this order.
HOLD = 'hold'
SAFE = 'safe'
MANUAL = 'manual'  # in manual mode; no level of the supervisor
# Levels of a rule that depend on the law, or on the level that acts.
BELOW = 'the next one below the law'
SAME = 'the present one'


class Condition(Enum):
    """Why the best level does not act."""

    STATE_UNKNOWN = auto()  #: a measurement is missing or rejected, or the calculation failed
    LAW_FAILED = auto()  #: a law can never act, or gives no input
    LAW_MISSED = auto()  #: a law gives no input at this sample, e.g. not in time
    LAW_LOST = auto()  #: a law failed in the closed-loop test from a state like this
    OUTSIDE = auto()  #: the state is further from the training data than the margin of a law
    FAR_OUTSIDE = auto()  #: also further than the margin of the last law
    HELD_TOO_LONG = auto()  #: no law could act for `hold_timeout`
    RECOVERING = auto()  #: a better level is possible, but not yet for `recovery_time`
    LATCHED = auto()  #: the safe input was reached with `safe_latch`
    CLEARABLE = auto()  #: the same, and a law has been possible for `recovery_time`


class Rule(NamedTuple):
    """The consequence of a condition."""

    level: str  #: that acts
    code: StatusCode | None  #: its reason, with that of the condition as its cause; None: the same
    passing: bool = False  #: whether the level before acts again as soon as the condition ends
    latched: bool = False  #: whether it stays until an operator clears it


#: All fallbacks, and all conditions of each.
RULES: Mapping[Condition, Rule] = {
    Condition.STATE_UNKNOWN: Rule(HOLD, None, passing=True),
    Condition.LAW_FAILED: Rule(BELOW, StatusCode.LAW_FAILED),
    Condition.LAW_MISSED: Rule(BELOW, StatusCode.LAW_FAILED, passing=True),
    Condition.LAW_LOST: Rule(BELOW, StatusCode.LOST_HERE),
    Condition.OUTSIDE: Rule(BELOW, StatusCode.OUTSIDE_TRAINING),
    Condition.FAR_OUTSIDE: Rule(SAFE, StatusCode.OUTSIDE_TRAINING),
    Condition.HELD_TOO_LONG: Rule(SAFE, StatusCode.HELD_TOO_LONG),
    Condition.RECOVERING: Rule(SAME, StatusCode.RECOVERING),
    Condition.LATCHED: Rule(SAFE, StatusCode.SAFE_LATCHED, latched=True),
    Condition.CLEARABLE: Rule(SAFE, StatusCode.LATCH_CLEARABLE, latched=True),
}


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
    #: share of a margin below which the state must be for the law above to act again
    hysteresis: float = 0.5

    def __post_init__(self) -> None:
        if list(self.margins) != sorted(self.margins):
            raise ValueError(f'fallback_order = {list(self.laws)}, learned_model_margin and '
                             'linear_model_margin: the margin of a level must be at least that of '
                             f'the better ones, got {list(self.margins)}')

    @cached_property
    def levels(self) -> tuple[str, ...]:
        """The names of all levels, best first."""
        return (*self.laws, HOLD, SAFE)

    @cached_property
    def places(self) -> Mapping[str | None, int]:
        """The place of each level in the order."""
        return {level: place for place, level in enumerate(self.levels)}

    def below(self, level: str) -> str:
        """Return the next level in the order."""
        return self.levels[self.places.get(level, 0) + 1]

    def request(self, condition: Condition, law: str | None = None, **values: Value
                ) -> LevelRequest:
        """
        Return the level that follows from a condition, with its reason; see :data:`RULES`.

        :param law: to which the condition applies, if it does to one.
        :param values: of the reason.
        """
        rule, named = RULES[condition], {} if law is None else {'level': law}
        cause = values.get('cause')
        why = cause if rule.code is None else reason(rule.code, **values, **named)
        assert isinstance(why, Reason)
        return LevelRequest(self.below(law) if law is not None and rule.level == BELOW
                            else rule.level, why, rule.passing)

    @property
    def return_margin(self) -> float:
        """The distance up to which a law takes over from the safe input."""
        return self.hysteresis * self.margins[-1]


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
        if outside > 0.0:
            depth = order.places.get(self.settled, 0)
            for law, margin in reversed(tuple(zip(order.laws, order.margins, strict=True))):
                where = Condition.FAR_OUTSIDE if law == order.laws[-1] else Condition.OUTSIDE
                below = SAFE if where is Condition.FAR_OUTSIDE else order.below(law)
                least = order.hysteresis * margin if depth >= order.places[below] else margin
                if outside > least:
                    return order.request(where, law, ranges=ranges, margin=least)
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
        stays = order.request(
            Condition.CLEARABLE if ready else Condition.LATCHED, cause=cause)
        return Supervisor(stays.level, stays.reason, None, found.bad_since_ns, since, latched=True)

    def _next(self, order: FallbackOrder, requested: LevelRequest, time_ns: int) -> Supervisor:
        """Return the same without a latch."""
        places, bad_since = order.places, None
        if requested.level == HOLD:
            assert requested.reason is not None
            bad_since = time_ns if self.bad_since_ns is None else self.bad_since_ns
            if (time_ns - bad_since) / NANOSECONDS > order.hold_timeout:
                requested = order.request(
                    Condition.HELD_TOO_LONG, cause=requested.reason, timeout=order.hold_timeout)
            elif self.level == SAFE and self.bad_since_ns is not None:
                # the safe input once commanded stays until there is a law again
                requested = LevelRequest(SAFE, requested.reason)
        settled = order.levels[places.get(self.resumes or self.level, 0)]
        here, there, why = places[settled], places[requested.level], requested.reason
        if requested.passing and here < there:
            return Supervisor(requested.level, why, settled, bad_since)
        if requested.passing and requested.level == HOLD and here > there:
            # skip HOLD while the input goes to the safe one
            return Supervisor(settled, why, None, bad_since)
        if there >= here:
            return Supervisor(requested.level, why, None, bad_since)
        since = time_ns if self.better_since_ns is None else self.better_since_ns
        if (time_ns - since) / NANOSECONDS >= order.recovery_time:
            return Supervisor(requested.level, why, None, bad_since)
        waiting = self.reason
        if waiting is not None and waiting.code is not RULES[Condition.RECOVERING].code:
            waiting = order.request(Condition.RECOVERING, cause=waiting,
                                    recovery_time=order.recovery_time).reason
        return Supervisor(settled, waiting, None, self.bad_since_ns, since)
