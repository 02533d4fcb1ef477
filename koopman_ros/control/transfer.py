# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bumpless transfer: an offset that makes up for a change of command, and fades away smoothly."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.arrays import Array

# In input units; what is left then is below the resolution of any actuator.
_NEGLIGIBLE = 1e-9


@dataclass(frozen=True)
class Transfer:
    """
    An offset to the command that fades with d (1 + t/T) exp(-t/T), flat at first.

    Steps add up: after a second change the rest of the first fades on.
    """

    offset: Array  #: (n_u,) now, in input units
    feed: Array  #: (n_u,) what it follows, which fades exponentially

    def shifted(self, by: Array) -> Transfer:
        """Return the transfer with a further step (n_u,)."""
        return Transfer(self.offset + by, self.feed + by)

    def after(self, seconds: float, time_constant: float) -> Transfer | None:
        """
        Return what is left later, None for nothing.

        :param seconds: how much later.
        :param time_constant: T in seconds; 0 ends it at once.
        """
        if seconds > 100.0 * time_constant:
            return None
        share = seconds / time_constant if time_constant > 0.0 else 0.0
        fading = math.exp(-share)
        left = Transfer(fading * (self.offset + share * self.feed), fading * self.feed)
        size = np.max(np.abs(left.offset)) + np.max(np.abs(left.feed))
        return left if size > _NEGLIGIBLE else None
