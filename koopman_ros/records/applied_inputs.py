# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The applied input, from its commands or from measurements behind its actuator."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.records.segments import Clock, Entries, Times

# Delays below this share of the sample period are taken as none.
_NO_DELAY = 0.01
# An input that differs from its command by no more than this share of its own motion follows it
# without delay: the command tells better when it changed.
_FOLLOWS = 0.02

# (M,) times, (M,) values in the input's unit, whether it is linear between them
Applied = tuple[NDArray[Any], Array, bool]


def commanded(entries: Entries, clock: Clock, received: tuple[Times, Times], period: float
              ) -> tuple[Times, Array]:
    """
    Return the times [ns] at which commands began to act, each once, without dead time.

    :param received: the stamps of the measurements, rising, and when each was received.
    :param period: of the measurements, in ns.
    """
    order = np.argsort(entries.log_ns, kind='stable')
    # without a stamp it acts on receipt, which plant time may have to be asked for
    given = clock.on(entries.part(order), 0)
    times = given.stamp_ns
    stamps, logs = received
    if clock.wall and len(stamps):
        at = np.minimum(np.searchsorted(stamps, times), len(stamps) - 1)
        late = np.where(stamps[at] == times, given.log_ns - logs[at], 0)
        times = times + np.where(late > _NO_DELAY * period, late, 0)
    return last_per_timestamp(times, given.values)


def last_per_timestamp(times: Times, values: Array) -> tuple[Times, Array]:
    """Sort values by their times; of those for one time the last one counts."""
    found, last = np.unique(times[::-1], return_index=True)
    return found, values[::-1][last]


def changes(times: Times, values: Array) -> tuple[Times, Array]:
    """Return the changes of a held value alone."""
    new = np.ones(len(values), dtype=bool)
    new[1:] = values[1:] != values[:-1]
    return times[new], values[new]


def around(times: Times, values: Array, stamps: Times) -> tuple[Times, Array]:
    """Return the commands from the last one before the first stamp to the last stamp."""
    first = max(0, int(np.searchsorted(times, stamps[0], side='right')) - 1)
    part = slice(first, int(np.searchsorted(times, stamps[-1], side='right')) + 1)
    return times[part], values[part]


def span(applied: Applied) -> tuple[float, float]:
    """Return from when to when the applied input is known."""
    times, _, linear = applied
    if not len(times):
        return math.inf, math.inf
    return times[0], times[-1] if linear else math.inf


def follows_command(times: Times, held: Array, stamps: Times, measured: Array) -> bool:
    """Whether an input is its command wherever it was measured, before or after a change."""
    known = stamps > times[0] if len(times) else np.zeros(len(stamps), dtype=bool)
    if not np.any(known):
        return False
    apart = np.min([np.abs(held[np.searchsorted(times, stamps[known], side=side) - 1]
                           - measured[known]) for side in ('left', 'right')], axis=0)
    return bool(np.sqrt(np.mean(apart ** 2)) <= _FOLLOWS * np.std(measured[known]))
