# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Signals of several messages put together by stamp."""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median_low

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.units import LATE_NANOSECONDS

_MOST_OPEN = 100  # samples that wait for a part
_LONGEST_WAIT = 10  # samples that are completed meanwhile
_REMEMBERED = 9  # messages of each signal, by which its usual interval is known


@dataclass
class SampleSynchronizer:
    """The parts that wait for others, and the counts of lost ones, by name of the signal."""

    names: Sequence[str]  #: (n,) of the signals, in the order of a sample
    #: how far stamps of one sample may be apart; None, for times of receipt: half the usual
    #: interval of the signal that comes most often
    tolerance_ns: int | None = 0
    late: Counter[str] = field(default_factory=Counter)  #: came after their sample was complete
    missing: Counter[str] = field(default_factory=Counter)  #: did not come before a later sample
    duplicated: Counter[str] = field(default_factory=Counter)  #: came twice; the later one counts
    _open: dict[int, dict[str, float]] = field(default_factory=dict)  # in order of arrival
    _opened: dict[int, int] = field(default_factory=dict)  # after how many completed samples
    _completed: int = 0
    _times: dict[str, deque[int]] = field(default_factory=dict)  # of the last messages
    _last_ns: int | None = None

    def take(self, stamp_ns: int, values: Mapping[str, float]) -> tuple[int, Array] | None:
        """
        Add the values of a message; return stamp and sample (n,) when it completes one.

        The stamp of a sample is that of its last part. A part whose stamp is ahead waits for at
        most ten other samples, so that it is never put together with parts of a later time.
        """
        if len(values) == len(self.names):
            self._last_ns = stamp_ns
            return stamp_ns, self._sample(values)
        if self._last_ns is not None and stamp_ns < self._last_ns - LATE_NANOSECONDS:
            # time was set back
            self._open.clear()
            self._opened.clear()
            self._times.clear()
            self._last_ns = None
        tolerance_ns = self.tolerance_ns
        if tolerance_ns is None:
            # a time of receipt is never late
            tolerance_ns = self._usual_tolerance(stamp_ns, values)
        elif self._last_ns is not None and stamp_ns <= self._last_ns + tolerance_ns:
            self.late.update(values.keys())
            return None
        near = [time for time in self._open if abs(time - stamp_ns) <= tolerance_ns]
        at = min(near, key=lambda time: abs(time - stamp_ns), default=stamp_ns)
        parts = self._open.setdefault(at, {})
        self._opened.setdefault(at, self._completed)
        self.duplicated.update(name for name in values if name in parts)
        parts.update(values)
        if len(parts) == len(self.names):
            del self._open[at], self._opened[at]
            self._completed += 1
            for time, opened in tuple(self._opened.items()):
                if time < at or self._completed - opened > _LONGEST_WAIT:
                    self._give_up(time)
            self._last_ns = max(at, stamp_ns)
            return self._last_ns, self._sample(parts)
        if len(self._open) > _MOST_OPEN:
            # the first to arrive, since a stamp may be wrong
            self._give_up(next(iter(self._open)))
        return None

    def _usual_tolerance(self, stamp_ns: int, values: Mapping[str, float]) -> int:
        for name in values:
            self._times.setdefault(name, deque(maxlen=_REMEMBERED)).append(stamp_ns)
        return min((median_low(after - before for before, after in pairwise(times)) // 2
                    for times in self._times.values() if len(times) > 1), default=0)

    def _give_up(self, time: int) -> None:
        del self._opened[time]
        self.missing.update(set(self.names) - set(self._open.pop(time)))

    def _sample(self, values: Mapping[str, float]) -> Array:
        return np.array([values[name] for name in self.names], dtype=np.float64)

    @property
    def awaited(self) -> str:
        """The signals that the oldest open sample waits for, or an empty string."""
        if not self._open:
            return ''
        return ', '.join(name for name in self.names if name not in self._open[min(self._open)])
