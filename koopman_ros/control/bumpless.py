# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Saturation, rate limiting and bumpless transfer, between a law and its command."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.core.arrays import Array, change_within, differ
from koopman_ros.tuning import InputLimits

# In input units; a smaller remainder is below the resolution of any actuator.
_NEGLIGIBLE = 1e-9


def limit(limits: InputLimits, scale: Array, wanted: Array, previous: Array | None,
          seconds: float) -> tuple[Array, bool, bool]:
    """
    Bring a command within its range, and within its rate where a previous command is known.

    A previous command from outside the range, which was tightened since, is left at the rate.

    :param scale: (n_u,) of the inputs; a limit is active if it changes the command by more than
        rounding.
    :param wanted: (n_u,) the law's command.
    :param previous: (n_u,) command `seconds` ago, or None at the first.
    :return: the command (n_u,), and whether range and rate were active.
    """
    command = within = limits.within(wanted)
    if previous is not None:
        reach = change_within(limits.rate, seconds)
        command = np.minimum(np.maximum(within, previous - reach), previous + reach)
    command.setflags(write=False)
    return command, differ(within, wanted, scale), differ(command, within, scale)


@dataclass(frozen=True, slots=True)
class BumplessTransfer:
    """
    An offset to the command that fades with d (1 + t/T) exp(-t/T), flat at first.

    Steps add up: after a second change the rest of the first fades on.
    """

    offset: Array  #: (n_u,) now, in input units
    feed: Array  #: (n_u,) offset that it follows, which fades exponentially

    def after(self, seconds: float, time_constant: float) -> BumplessTransfer | None:
        """Return the rest of the transfer after seconds, or None; T = 0 s ends it at once."""
        if seconds > 100.0 * time_constant:
            return None
        share = seconds / time_constant if time_constant > 0.0 else 0.0
        fading = math.exp(-share)
        left = BumplessTransfer(fading * (self.offset + share * self.feed), fading * self.feed)
        size = np.abs(left.offset).max() + np.abs(left.feed).max()
        return left if size > _NEGLIGIBLE else None


def with_step(transfer: BumplessTransfer | None, by: Array) -> BumplessTransfer:
    """Return a transfer, or none, with a further step (n_u,)."""
    return BumplessTransfer(by, by) if transfer is None else BumplessTransfer(
        transfer.offset + by, transfer.feed + by)
