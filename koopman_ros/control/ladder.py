# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The ladder of degradation: which law may act, why not a better one, and when it may again."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from koopman_ros.control.setpoint import NANOSECONDS

# A threshold that was crossed counts as left only below this share of it.
_HYSTERESIS = 0.5


class Rung(Enum):
    """Who determines the input in automatic mode, best first; the value is for the operator."""

    LEARNED = 'learned law'
    LINEAR = 'linear law'
    HOLD = 'hold'
    SAFE = 'safe input'

    @property
    def depth(self) -> int:
        """0 for the best."""
        return _ORDER.index(self)


_ORDER = list(Rung)


@dataclass(frozen=True)
class LadderSettings:
    """
    When to step down and up.

    :param validity_margin: distance outside the training box, in half widths, up to which the
        learned law acts.
    :param linear_margin: the same for the linear law; beyond, the safe input is commanded.
    :param hold_timeout: seconds without a law or a measurement, after which the safe input is
        commanded.
    :param recovery_time: seconds that a better rung must have been possible before it is taken.
    """

    validity_margin: float = 0.1
    linear_margin: float = 0.5
    hold_timeout: float = 60.0
    recovery_time: float = 10.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.validity_margin <= self.linear_margin:
            raise ValueError('validity_margin must be at least 0 and at most linear_margin, got '
                             f'{self.validity_margin} and {self.linear_margin}')
        for name in ('hold_timeout', 'recovery_time'):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f'{name} must be at least 0, got {getattr(self, name)}')

    @property
    def return_margin(self) -> float:
        """Distance up to which a law takes over from the safe input."""
        return _HYSTERESIS * self.linear_margin


@dataclass(frozen=True)
class Need:
    """
    The best rung that is possible now.

    :param rung: which.
    :param reason: why none above it, in words; empty for the best.
    :param passing: whether it is left as soon as the reason is gone, as when a measurement was
        missing: nothing was lost then.
    """

    rung: Rung
    reason: str = ''
    passing: bool = False


@dataclass(frozen=True)
class Standing:
    """
    Where on the ladder the controller stands.

    :param rung: in force.
    :param reason: why none above it.
    :param resumes: the rung that follows when a passing reason is gone, or None.
    :param bad_since_ns: since when no law could act, or None.
    :param better_since_ns: since when a better rung has been possible, or None.
    """

    rung: Rung = Rung.LEARNED
    reason: str = ''
    resumes: Rung | None = None
    bad_since_ns: int | None = None
    better_since_ns: int | None = None

    def allowed(self, settings: LadderSettings, outside: float, words: str) -> Need:
        """
        Return what the distance from the training data allows.

        :param outside: in half widths of the training box.
        :param words: what is outside, for the reason.
        """
        for rung, margin, name in (
                (Rung.SAFE, settings.linear_margin, 'the linear law'),
                (Rung.LINEAR, settings.validity_margin, 'the learned law')):
            entered = (self.resumes or self.rung).depth >= rung.depth
            if outside > (_HYSTERESIS * margin if entered else margin):
                return Need(rung, f'{words} by more than the {margin:g} half widths that {name} '
                                  'is allowed')
        return Need(Rung.LEARNED)

    def at(self, settings: LadderSettings, need: Need, time_ns: int) -> Standing:
        """
        Return the standing at a time: down at once, up when it was possible for long enough.

        :param need: the best rung possible; a hold becomes the safe input after its timeout.
        """
        bad_since = None
        if need.rung is Rung.HOLD:
            bad_since = time_ns if self.bad_since_ns is None else self.bad_since_ns
            held = (time_ns - bad_since) / NANOSECONDS
            # the safe input once commanded stays until there is a law again
            if held > settings.hold_timeout or (
                    self.rung is Rung.SAFE and self.bad_since_ns is not None):
                need = Need(Rung.SAFE, f'{need.reason}; held for longer than '
                                       f'{settings.hold_timeout:g} s')
        present = self.resumes or self.rung
        if need.passing and present.depth < need.rung.depth:
            return Standing(need.rung, need.reason, present, bad_since)
        if need.passing and present.depth > need.rung.depth:
            # on its way to the safe input, nothing is gained by a hold
            return Standing(present, need.reason, None, bad_since)
        if need.rung.depth >= present.depth:
            return Standing(need.rung, need.reason, None, bad_since)
        since = time_ns if self.better_since_ns is None else self.better_since_ns
        if (time_ns - since) / NANOSECONDS >= settings.recovery_time:
            return Standing(need.rung, need.reason, None, bad_since)
        reason = self.reason.removesuffix(_RECOVERING) + _RECOVERING
        return Standing(present, reason, None, self.bad_since_ns, since)


_RECOVERING = ' (over, waiting for it to stay so)'
