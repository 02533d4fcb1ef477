# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Between a law and its command: range, rate, and what makes a change of law bumpless."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np

from koopman_ros.arrays import Array, as_arrays
from koopman_ros.signals import per_signal
from koopman_ros.values import record


@dataclass(frozen=True)
class InputLimits:
    """Range and rate limits of the inputs, in physical units."""

    lower: Array  #: (n_u,) smallest command
    upper: Array  #: (n_u,) largest command
    rate: Array  #: (n_u,) largest change per second; infinity for none

    def __post_init__(self) -> None:
        as_arrays(self, 'lower', 'upper', 'rate')
        if not np.all(self.lower < self.upper):
            raise ValueError(f'input limits must be lower < upper, got {self.lower.tolist()} and '
                             f'{self.upper.tolist()}')
        if not np.all(self.rate > 0.0):
            raise ValueError(f'input rate must be above 0, got {self.rate.tolist()}')

    def check(self, names: Sequence[str]) -> None:
        """Check that there is one number for each input (n_u,); a ValueError names which not."""
        for name in ('lower', 'upper', 'rate'):
            per_signal(f'input {name}', getattr(self, name), names)

    @cached_property
    def each(self) -> list[tuple[float, float, float]]:
        """Smallest and largest command and rate of each input, as plain numbers."""
        return list(zip(self.lower.tolist(), self.upper.tolist(), self.rate.tolist(),
                        strict=True))

    def within(self, u: Array) -> Array:
        """Return the input (n_u,) of the range that is nearest."""
        # several times faster than clip
        return np.minimum(np.maximum(u, self.lower), self.upper)


def finite(value: Array) -> bool:
    """Tell whether all of a few numbers are finite, in a fifth of the time of numpy."""
    return all(map(math.isfinite, value.tolist()))


@record
class LimitedInput:
    """A command within its limits."""

    u: Array  #: (n_u,) command
    at_range: bool  #: whether the range was active
    at_rate: bool  #: whether the rate was active


def limit(limits: InputLimits, wanted: Array, previous: Array | None, seconds: float
          ) -> LimitedInput:
    """
    Bring a command within its range, and within its rate where a previous command is known.

    A previous command from outside the range, which was tightened since, is left at the rate.

    :param wanted: (n_u,) the law's command.
    :param previous: (n_u,) command `seconds` ago, or None at the first.
    """
    asked = wanted.tolist()
    # in plain numbers: of so few, numpy takes three times as long
    within = [_between(u, lower, upper)
              for u, (lower, upper, _) in zip(asked, limits.each, strict=True)]
    reached = within
    if previous is not None:
        reached = []
        for u, before, (_, _, rate) in zip(within, previous.tolist(), limits.each, strict=True):
            # 0 s times infinity is no number
            reach = rate * seconds if seconds > 0.0 else rate if math.isinf(rate) else 0.0
            reached.append(_between(u, before - reach, before + reach))
    command = np.array(reached)
    command.setflags(write=False)
    return LimitedInput(command, within != asked, reached != within)


def _between(u: float, lower: float, upper: float) -> float:
    return lower if u < lower else upper if u > upper else u


# In input units; what is left then is below the resolution of any actuator.
_NEGLIGIBLE = 1e-9


@record
class Transfer:
    """
    An offset to the command that fades with d (1 + t/T) exp(-t/T), flat at first.

    Steps add up: after a second change the rest of the first fades on.
    """

    offset: Array  #: (n_u,) now, in input units
    feed: Array  #: (n_u,) what it follows, which fades exponentially

    def after(self, seconds: float, time_constant: float) -> Transfer | None:
        """Return what is left after seconds, None for nothing; T = 0 s ends it at once."""
        if seconds > 100.0 * time_constant:
            return None
        share = seconds / time_constant if time_constant > 0.0 else 0.0
        fading = math.exp(-share)
        left = Transfer(fading * (self.offset + share * self.feed), fading * self.feed)
        size = np.max(np.abs(left.offset)) + np.max(np.abs(left.feed))
        return left if size > _NEGLIGIBLE else None


def shifted(transfer: Transfer | None, by: Array) -> Transfer:
    """Return a transfer, or none, with a further step (n_u,)."""
    return Transfer(by, by) if transfer is None else Transfer(
        transfer.offset + by, transfer.feed + by)
