# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The clock that runs with a solver and stands still while its iterates are judged.

It counts the processor time of the solver's one thread, which on an idle machine is the time on
the wall, and which other programs on the same machine disturb less; the time on the wall is noted
beside it.
"""

from collections.abc import Callable
import time
from typing import Any

from torch import Tensor

from validation.benchmarks.training.problems import Case, invariant_residual

# Iterates are noted when rw has fallen by this factor, or passes a target.
_NOTED = 0.9

Tell = Callable[[dict[str, Any]], None]


class Finished(Exception):  # noqa: N818 - an end, not an error
    """All targets are met, or the time is up."""


class Trace:
    """
    What a solver has reached at which time.

    :param case: the problem, for rw.
    :param targets: values of rw at which the time is wanted.
    :param limit: processor time after which to stop, s.
    :param tell: takes what is noted.
    """

    def __init__(self, case: Case, targets: list[float], limit: float, tell: Tell) -> None:
        self._case, self._limit, self._tell = case, limit, tell
        self._targets = sorted(targets)
        self._best = self._told = float('inf')
        self._start: tuple[float, ...] = (0.0, 0.0)
        self._judging: tuple[float, ...] = (0.0, 0.0)
        self._looks, self._build, self._done = 0, False, False

    def built(self, seconds: float) -> None:
        """Note the time that it took to build what is solved."""
        self._build = True
        self._tell({'built': seconds})

    def start(self) -> None:
        """Note the start, and let the clock run from now on."""
        if not self._build:
            self.built(0.0)
        self._judge(self._case.theta, 0.0, 0.0)
        self._start = _now()

    def look(self, theta: Tensor) -> bool:
        """Judge an iterate (p,); True ends the solver."""
        now = _now()
        seconds, wall = (here - start - judging for here, start, judging in zip(
            now, self._start, self._judging, strict=True))
        self._looks += 1
        in_time = seconds <= self._limit
        if in_time:
            self._judge(theta, seconds, wall)
        if not in_time or self._best <= self._targets[0]:
            self._done = True
            self._tell({'end': '' if in_time else f'stopped after {self._limit:g} s',
                        'ended': min(seconds, self._limit), 'iterates': self._looks})
        self._judging = tuple(
            judging + then - here for judging, then, here in zip(
                self._judging, _now(), now, strict=True))
        return self._done

    def close(self, reason: str) -> None:
        """Note why a solver ended by itself."""
        if not self._done:
            self._tell({'end': reason, 'iterates': self._looks})

    def _judge(self, theta: Tensor, seconds: float, wall: float) -> None:
        rw = invariant_residual(self._case.layout, self._case.data, theta)
        passes = any(rw <= target < self._best for target in self._targets)
        self._best = min(self._best, rw)
        if passes or rw < _NOTED * self._told:
            self._told = rw
            self._tell({'seconds': seconds, 'wall': wall, 'rw': rw})


def _now() -> tuple[float, float]:
    """Return processor time and time on the wall, s."""
    return time.process_time(), time.perf_counter()
