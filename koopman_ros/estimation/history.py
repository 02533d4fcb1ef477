# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The recent history of a filter, for corrections by late values."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation.base import Estimate, Estimator

_LONGEST = 300  # instants
Pieces: TypeAlias = tuple[tuple[float, Array], ...]


@dataclass(frozen=True, slots=True)
class Analysis:
    """A late value of one state."""

    index: int  #: of the state
    x: float  #: scaled deviation
    deviation: float  #: standard deviation of its noise, scaled


@dataclass(frozen=True, slots=True)
class Instant:
    """How the estimate came about at one time."""

    time_ns: int
    estimate: Estimate  #: after the correction
    inputs: Pieces  #: seconds and (n_u,) scaled deviations, since the instant before
    #: (n_x,) due to the measured disturbances since then, or None
    rate: Array | None = None
    x: Array | None = None  #: (n_x,) scaled deviation that corrected it, or None
    factor: Array | None = None  #: (n_y,) of the noise of its outputs; None for 1
    analysis: Analysis | None = None  #: that corrected it, or None

    def after(self, before: Estimate, estimator: Estimator) -> Instant | None:
        """Return the instant with the estimate that follows from the one before, or None."""
        estimate = estimator.predict_over(before, self.inputs, self.rate)
        if estimate is None:
            return None
        seconds = sum(seconds for seconds, _ in self.inputs)
        if self.x is not None:
            own = estimator if self.factor is None else estimator.with_noise(self.factor)
            estimate = own.correct(estimate, self.x, seconds)
        if self.analysis is not None:
            estimate = estimator.with_analysis(
                estimate, self.analysis.index, self.analysis.x, self.analysis.deviation)
        return replace(self, estimate=estimate)


@dataclass(frozen=True, slots=True)
class History:
    """Instants in the order of their times."""

    instants: tuple[Instant, ...] = ()

    def followed_by(self, instant: Instant, longest_ns: int) -> History:
        """Append an instant, and drop those before the longest delay."""
        instants = (*self.instants, instant)
        begin = bisect_right([one.time_ns for one in instants], instant.time_ns - longest_ns)
        return History(instants[max(begin - 1, len(instants) - _LONGEST, 0):])

    def corrected(self, time_ns: int, analysis: Analysis, estimator: Estimator) -> History | None:
        """Go back to a time, correct there and go forward again; None where it is too long ago."""
        at = bisect_right([one.time_ns for one in self.instants], time_ns)
        if at == 0:
            return None
        done, left = list(self.instants[:at]), list(self.instants[at:])
        first: Pieces = ()
        if left:
            first, rest = _split(left[0].inputs, (time_ns - done[-1].time_ns) / NANOSECONDS)
            left[0] = replace(left[0], inputs=rest)
        for instant in (Instant(time_ns if left else done[-1].time_ns, done[-1].estimate, first,
                                left[0].rate if left else None, analysis=analysis), *left):
            found = instant.after(done[-1].estimate, estimator)
            if found is None or not found.estimate.finite:
                return None
            done.append(found)
        return History(tuple(done))


def _split(pieces: Pieces, seconds: float) -> tuple[Pieces, Pieces]:
    """Divide pieces at a time from their start."""
    ends = np.cumsum([length for length, _ in pieces])
    first = tuple((min(length, seconds - (end - length)), u)
                  for (length, u), end in zip(pieces, ends, strict=True)
                  if end - length < seconds)
    return first, tuple((min(length, end - seconds), u)
                        for (length, u), end in zip(pieces, ends, strict=True) if end > seconds)
