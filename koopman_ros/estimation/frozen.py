# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The check for frozen sensors: a value that stays bit-identical while the model moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.units import NANOSECONDS


@dataclass(frozen=True)
class FrozenCheck:
    """Since when each signal has stood still, and how far the model says that it has moved."""

    #: (n_y,) stamps of the first of the measurements that are bit-identical
    since_ns: tuple[int, ...]
    travel: Array  #: (n_y,) predicted since then, in the signals' units
    #: (n_x,) disturbance that was estimated when all signals last changed: what an observer makes
    #: of a sensor that does not move is no disturbance
    w: Array

    @classmethod
    def started(cls, y: Array, time_ns: int, w: Array) -> FrozenCheck:
        """Begin with a first measurement (n_y,)."""
        return cls((time_ns,) * len(y), np.zeros_like(y), w)

    def after(self, still: NDArray[np.bool_], time_ns: int, w: Array,
              travel: Callable[[FrozenCheck], Array]) -> FrozenCheck:
        """
        Take a measurement into account.

        :param still: (n_y,) which signals are bit-identical to the last ones.
        :param time_ns: its stamp.
        :param w: (n_x,) disturbance that is estimated now.
        :param travel: predicts how far (n_y,) the signals have moved since the last measurement.
        """
        if not still.any():
            return FrozenCheck((time_ns,) * len(still), np.zeros_like(self.travel), w)
        return FrozenCheck(
            tuple(since if same else time_ns
                  for since, same in zip(self.since_ns, still.tolist(), strict=True)),
            np.where(still, self.travel + travel(self), 0.0), self.w)

    def longest(self, time_ns: int, still: NDArray[np.bool_], significant: Array
                ) -> tuple[int, float]:
        """
        Return which signal has stood still for longest although it should have moved.

        :param significant: (n_y,) predicted travel above which it should have.
        :return: its place, and for how many seconds; 0 when there is none.
        """
        place, stood = 0, 0.0
        for i in np.flatnonzero(still & (np.abs(self.travel) > significant)).tolist():
            seconds = (time_ns - self.since_ns[i]) / NANOSECONDS
            if seconds > stood:
                place, stood = i, seconds
        return place, stood
