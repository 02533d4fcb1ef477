# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recorded and replayed commands side by side, in numbers."""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from koopman_ros.lifting import Coordinates
from koopman_ros.replay.bag import command_key
from koopman_ros.replay.loop import Replay
from koopman_ros.units import conversion

Array = NDArray[np.float64]

_CELSIUS = conversion('K', 'degC')


@dataclass(frozen=True)
class Comparison:
    """How commands differ from the recorded ones."""

    #: (n, n_u) command minus recorded command in input units; NaN where there is none to be
    #: compared
    difference: Array
    identical: int  #: number of commands that are bit-identical
    tolerance: float  #: in input units

    @property
    def compared(self) -> int:
        """The number of commands that are compared."""
        return int(np.count_nonzero(np.isfinite(self.difference).all(axis=1)))

    @property
    def beyond(self) -> NDArray[np.bool_]:
        """(n,) where the difference exceeds the tolerance."""
        return np.any(np.abs(self.difference) > self.tolerance, axis=1)

    @property
    def worst(self) -> int | None:
        """The place of the largest difference, or None when nothing differs."""
        if not np.nanmax(np.abs(self.difference), initial=0.0) > 0.0:
            return None
        return int(np.nanargmax(np.abs(self.difference))) // self.difference.shape[1]


@dataclass(frozen=True)
class ReplayedBag:
    """A bag with what was made of it."""

    path: str  #: of the bag
    complete: bool  #: whether its recorder closed it
    found: Replay  #: what came of the replay
    #: commands on their topic by stamp and value, as :func:`command_counts` has them; empty where
    #: the bag has none
    published: Counter[tuple[int, bytes]]
    tolerance: float  #: difference in input units from which on a command is counted
    new_range: Coordinates | None = None  #: of the new model's training, or None without one

    @cached_property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(n,) stamps of the commands."""
        return np.array([sample.stamp_ns for sample in self.found.samples], dtype=np.int64)

    @property
    def seconds(self) -> Array:
        """(n,) stamps since the first one in s."""
        return (self.stamps_ns - self.stamps_ns[0]) / 1e9

    @cached_property
    def measured(self) -> Array:
        """(n, n_y) measured; NaN in silence."""
        return _rows([sample.measured for sample in self.found.samples])

    @cached_property
    def setpoint(self) -> Array:
        """(n, n_x) tracked; NaN for none."""
        return _rows([sample.setpoint for sample in self.found.samples])

    @cached_property
    def recorded(self) -> Array:
        """(n, n_u) commanded then."""
        return _rows([sample.recorded for sample in self.found.samples])

    @cached_property
    def commands(self) -> Array:
        """(n, n_u) commanded by the replay; NaN where it knows no state."""
        return _rows([sample.replayed for sample in self.found.samples], self.recorded)

    @cached_property
    def new_commands(self) -> Array:
        """(n, n_u) commanded by the new model, NaN likewise."""
        return _rows([sample.alternative for sample in self.found.samples], self.recorded)

    @cached_property
    def check(self) -> Comparison:
        """The replay beside the record."""
        return self._compared(self.commands)

    @cached_property
    def new(self) -> Comparison | None:
        """The new model beside the record, or None without one."""
        return None if self.new_range is None else self._compared(self.new_commands)

    @property
    def measurements(self) -> int:
        """The number of measurements answered."""
        return sum(sample.measured is not None for sample in self.found.samples)

    @property
    def outside(self) -> int:
        """At how many commands the new model would have refused the tracked set-point."""
        if self.new_range is None:
            return 0
        return int(np.count_nonzero(((self.setpoint < self.new_range.lower)
                                     | (self.setpoint > self.new_range.upper)).any(axis=1)))

    @cached_property
    def unexplained(self) -> int:
        """The number of commands on the topic of which there is no record with their bits."""
        recorded = Counter(command_key(sample.stamp_ns, _CELSIUS(float(sample.recorded[0])))
                           for sample in self.found.samples)
        return (self.published - recorded).total()

    def _compared(self, commands: Array) -> Comparison:
        """Compare commands (n, n_u) with those recorded."""
        same = (commands.view(np.uint64) == self.recorded.view(np.uint64)).all(axis=1)
        return Comparison(commands - self.recorded, int(np.count_nonzero(same)), self.tolerance)


def _rows(values: list[Array | None], like: Array | None = None) -> Array:
    """Return (n, m) with NaN for None; m from the first one there is, or as another array has."""
    width = next((len(value) for value in values if value is not None),
                 1 if like is None else like.shape[1])
    return np.array([np.full(width, np.nan) if value is None else value for value in values],
                    dtype=np.float64).reshape(len(values), width)
