# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recorded and replayed commands side by side, in numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from koopman_ros.lifting import Coordinates
from koopman_ros.nodes.messages import NANOSECONDS, to_celsius
from koopman_ros.nodes.replaying.record import ControlRecord
from koopman_ros.nodes.replaying.steps import Replay

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Comparison:
    """
    How commands differ from the recorded ones.

    :param difference: (n,) command minus recorded command in K; NaN where nothing was recorded
        or the command was given.
    :param identical: number of commands that are the same to the bit.
    :param tolerance: in K.
    """

    difference: Array
    identical: int
    tolerance: float

    @property
    def compared(self) -> int:
        """The number of commands that have a recorded one to be compared with."""
        return int(np.count_nonzero(np.isfinite(self.difference)))

    @property
    def beyond(self) -> NDArray[np.bool_]:
        """(n,) where the difference exceeds the tolerance."""
        return np.abs(self.difference) > self.tolerance

    @property
    def worst(self) -> int | None:
        """The place of the largest difference, or None when nothing differs."""
        if not np.nanmax(np.abs(self.difference), initial=0.0) > 0.0:
            return None
        return int(np.nanargmax(np.abs(self.difference)))


@dataclass(frozen=True)
class ReplayedBag:
    """
    A bag with what was made of it, temperatures in degrees Celsius.

    :param path: of the bag.
    :param record: what it holds.
    :param trained: range of the recorded model's training, in K.
    :param replayed: the run by the model of its time.
    :param check: its commands beside the recorded ones.
    :param new_commands: (n,) those of the new model, or None without one.
    :param new: these beside the recorded ones, or None.
    :param new_range: of the new model's training, or None.
    """

    path: str
    record: ControlRecord
    trained: Coordinates
    replayed: Replay
    check: Comparison
    new_commands: Array | None = None
    new: Comparison | None = None
    new_range: Coordinates | None = None

    @cached_property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(n,) stamps of the measurements."""
        return np.array([sample.stamp_ns for sample in self.replayed.samples], dtype=np.int64)

    @property
    def seconds(self) -> Array:
        """(n,) stamps since the first measurement in s."""
        return (self.stamps_ns - self.stamps_ns[0]) / NANOSECONDS

    @cached_property
    def temperature(self) -> Array:
        """(n,) measured."""
        return np.array([sample.message.temperature for sample in self.replayed.samples],
                        dtype=np.float64)

    @cached_property
    def setpoint(self) -> Array:
        """(n,) tracked; NaN for none."""
        return np.array([to_celsius(sample.active) for sample in self.replayed.samples])

    @cached_property
    def recorded(self) -> Array:
        """(n,) commanded then; NaN where nothing was recorded."""
        return np.array([sample.recorded for sample in self.replayed.samples], dtype=np.float64)

    @cached_property
    def commands(self) -> Array:
        """(n,) commanded by the replay."""
        return np.array([sample.replayed for sample in self.replayed.samples], dtype=np.float64)

    @property
    def outside(self) -> int:
        """At how many measurements the new model would have refused the tracked set-point."""
        if self.new_range is None:
            return 0
        active = np.array([sample.active for sample in self.replayed.samples])
        return int(np.count_nonzero(
            (active < self.new_range.lower[0]) | (active > self.new_range.upper[0])))

    @property
    def unanswered(self) -> int:
        """The number of measurements without a recorded command."""
        return int(np.count_nonzero(np.isnan(self.recorded)))


def compare(replayed: Replay, commands: Array, tolerance: float) -> Comparison:
    """
    Compare commands with those that were recorded.

    :param replayed: the run.
    :param commands: (n,) in degrees Celsius.
    :param tolerance: in K.
    """
    recorded = np.array([sample.recorded for sample in replayed.samples], dtype=np.float64)
    compared = np.isfinite(recorded) & np.array([not s.given for s in replayed.samples])
    same = commands.view(np.uint64) == recorded.view(np.uint64)
    return Comparison(np.where(compared, commands - recorded, np.nan),
                      int(np.count_nonzero(same & compared)), tolerance)
