# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The supervisor: which control level acts, when a better one may again, and the way back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.lifting import LiftedModel
from koopman_ros.reasons import Code, Reason, reason
from koopman_ros.units import NANOSECONDS
from koopman_ros.values import record

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


@record
class Requested:
    """The best level that is possible now."""

    level: str  #: which
    reason: Reason | None = None  #: why none above it; None for the best
    #: whether it is left as soon as the reason is gone, as when a measurement was missing: nothing
    #: was lost then
    passing: bool = False


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

    @cached_property
    def best(self) -> Requested:
        """What is asked for where nothing is against the best level."""
        return Requested(self.order[0])

    def depth(self, level: str | None) -> int:
        """Return the place in the order; 0 for None, and for a level that there is no more."""
        return self._depths.get(level, 0)

    def below(self, level: str) -> str:
        """Return the next level in the order."""
        return self.order[self.depth(level) + 1]

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


@record
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
        Return what the distance from the training box, in half widths, allows.

        :param ranges: (name, lower, upper) of the box, for the reason.
        """
        if not outside > 0.0:
            return settings.best
        levels = settings.levels
        for i in reversed(range(len(levels))):
            below = levels[i + 1].law if i + 1 < len(levels) else SAFE
            margin = levels[i].margin
            entered = settings.depth(self.settled) >= settings.depth(below)
            if outside > (_HYSTERESIS * margin if entered else margin):
                return Requested(below, reason(Code.OUTSIDE_TRAINING, ranges=ranges,
                                               margin=margin, level=levels[i].law))
        return settings.best

    def at(self, settings: SupervisorSettings, requested: Requested, time_ns: int) -> Supervisor:
        """
        Fall back immediately; recover when it was possible for long enough.

        A hold becomes the safe input after its timeout.
        """
        depth, bad_since, why = settings.depth, None, requested.reason
        if (why is self.reason is self.resumes is self.bad_since_ns is self.better_since_ns is None
                and self.level == requested.level):
            return self
        if requested.level == HOLD:
            bad_since = time_ns if self.bad_since_ns is None else self.bad_since_ns
            held = (time_ns - bad_since) / NANOSECONDS
            too_long = held > settings.hold_timeout
            if too_long:
                assert why is not None
                why = reason(Code.HELD_TOO_LONG, cause=why, timeout=settings.hold_timeout)
            # the safe input once commanded stays until there is a law again
            if too_long or (self.level == SAFE and self.bad_since_ns is not None):
                requested = Requested(SAFE, why)
        settled = settings.order[depth(self.settled)]
        if requested.passing and depth(settled) < depth(requested.level):
            return Supervisor(requested.level, why, settled, bad_since)
        if requested.passing and requested.level == HOLD and depth(settled) > depth(HOLD):
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


# The input is ahead of the plant by this share of the way from the safe input to the nominal
# one; a sensor that stands still out there brings it no further.
_LEAD = 0.25
# Moved is what changes its distance from the middle of the training box by this share of it.
_MOVED = 0.03
# At rest is what has not moved for so many times as a better level is waited for.
_REST = 3.0
# A model is followed in steps of this share of its box and of the time in which its rate changes,
# until less than a share of the box is left of its way.
_STEP, _STEP_SHARE, _AT_REST = 0.02, 0.2, 1e-5
_MAX_STEPS = 500


@record
class WayBack:
    """
    How far a plant under the safe input has come back, by its distance from the training data.

    Where the safe input itself keeps the plant outside, no law may act, and waiting does not
    help. The input then moves towards the nominal one: by :data:`_LEAD`, and by the share of the
    distance that the plant has left behind already. No model is asked how the plant moves out
    there. One that does not follow, or a sensor that does not, stops the input where it is.
    """

    farthest: float  #: where it rested under the safe input, in half widths of the training box
    nearest: float  #: smallest distance since then
    since_ns: int  #: from when it has rested
    led: bool = False  #: whether the input has begun to move

    def moved(self, outside: float, time_ns: int, recovery_time: float) -> WayBack | None:
        """
        Take a distance in half widths into account; None where the safe input led it back.

        A plant that still moves under the safe input is waited for; one that moves further out
        than where the way began starts it again.
        """
        if not (outside > 0.0 or self.led):
            return None
        change, still = outside - self.farthest, _MOVED * (1.0 + self.farthest)
        if change > still or (change < -still and not self.led):
            return WayBack(outside, outside, time_ns)
        led = self.led or (time_ns - self.since_ns) / NANOSECONDS >= _REST * recovery_time
        return WayBack(self.farthest, min(self.nearest, outside), self.since_ns, led)

    @property
    def share(self) -> float:
        """The share of the nominal input in the command, from 0 to 1."""
        return min(1.0, _LEAD + 1.0 - self.nearest / self.farthest) if self.led else 0.0


def leads_home(model: LiftedModel, x: Array, safe: Array, nominal: Array) -> bool:
    """
    Tell whether the nominal input pushes a state towards the nominal one, beside the safe input.

    On the other side, as that of a runaway, it is the safe input that does. State (n_x,) and
    inputs (n_u,) are in their units.
    """
    difference = model.inputs.to_deviation(nominal) - model.inputs.to_deviation(safe)
    deviation = model.states.to_deviation(x)
    return bool(deviation @ model.forcing(deviation, difference) < 0.0)


@dataclass(frozen=True)
class Rest:
    """Where the safe input leads the plant, according to its model."""

    #: (n_x,) in state units; where it leaves what the model knows, a linear extrapolation from
    #: there, and NaN where that does not come to rest
    x: Array
    outside: float  #: its distance from the training data in half widths, NaN likewise
    #: (n_u,) input that would keep the plant where it leaves what the model knows, in input units;
    #: None where it comes to rest before
    holding: Array | None = None


def rest_under(model: LiftedModel, u: Array, known: float) -> Rest:
    """
    Follow the model from its nominal state under an input until it rests, or is too far out.

    :param u: (n_u,) in input units.
    :param known: distance outside the training data, in half widths, up to which it is followed.
    """
    try:
        with np.errstate(all='ignore'):
            return _followed(model, u, known)
    except np.linalg.LinAlgError:
        # a model that gives no numbers: what it is to do in the loop fails likewise
        return Rest(np.full(model.n_x, np.nan), np.nan)


def _followed(model: LiftedModel, u: Array, known: float) -> Rest:
    v = model.inputs.to_deviation(u)
    rate_at = model.rate_under(v)
    x = np.zeros(model.n_x)
    rate = rate_at(x)
    # of the deviations: steps of a fraction of the box, and of the time in which the rate changes
    width = float(np.min((model.states.upper - model.states.lower) / model.states.scale))
    time = np.inf
    for _ in range(_MAX_STEPS):
        speed = float(np.linalg.norm(rate))
        if speed == 0.0 or speed * time < _AT_REST * width:
            break
        before, rate_before = x, rate
        x = x + min(_STEP * width / speed, _STEP_SHARE * time) * rate
        rate = rate_at(x)
        if not model.distance(model.states.to_physical(x)) <= known:
            return _beyond(model, x, v, rate)
        change = float(np.linalg.norm(rate - rate_before))
        time = float(np.linalg.norm(x - before)) / change if change > 0.0 else np.inf
    place = model.states.to_physical(x)
    return Rest(place, model.distance(place))


def _beyond(model: LiftedModel, x: Array, u: Array, rate: Array) -> Rest:
    """Extrapolate from a state (n_x,) moving at a rate (n_x,) under (n_u,), all scaled."""
    slope = model.drift_jacobian(x) + model.forcing_jacobian(x, u)
    place, outside = np.full(model.n_x, np.nan), np.nan
    if np.all(np.isfinite(slope)) and np.all(np.linalg.eigvals(slope).real < 0.0):
        place = model.states.to_physical(x - np.linalg.solve(slope, rate))
        outside = model.distance(place)
    return Rest(place, outside, model.inputs.to_physical(
        -model.input_inverse(x) @ model.drift(x)))
