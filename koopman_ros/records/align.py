# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Measurements of several states, aligned by their stamps."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.records.import_spec import RecordedState
from koopman_ros.records.segments import Clock, NO_STAMP, Segment, Times


@dataclass(frozen=True)
class AlignedSamples:
    """Measurements of all states at one time each."""

    stamps: Times  #: (N,) rising, in ns
    x: Array  #: (N, n_x) as they were sent
    #: the stamps of all their parts, rising, and the receipt of the last part of each [ns]
    received: tuple[Times, Times]


def align_by_timestamp(segment: Segment, clock: Clock, states: Sequence[RecordedState],
                       tolerance_ns: int, dropped: Counter[str]) -> AlignedSamples:
    """
    Align the measurements of a segment by stamp; count those without a partner.

    :param tolerance_ns: how far the stamps of one sample may be apart; with 0, for times of
        receipt, half the usual interval of the signal that comes most often.
    """
    parts = []
    for signal in states:
        entries = clock.on(segment.of(signal.place))
        if segment.until_ns is not None:
            entries = entries.part(entries.stamp_ns <= segment.until_ns)
        parts.append(entries.first_of_each())
        dropped[named(states, signal, 'measurement with a repeated stamp')] += (
            len(entries) - len(parts[-1]))
    times = [part.stamp_ns for part in parts]
    usual = min((float(np.median(np.diff(own))) for own in times if len(own) > 1), default=0.0)
    if not tolerance_ns and any(
            np.any(segment.of(signal.place).stamp_ns == NO_STAMP) for signal in states):
        # as in the running controller
        tolerance_ns = int(usual) // 2
    base = min(times, key=len)
    rows = [_nearest(own, base) for own in times]
    complete = np.ones(len(base), dtype=bool)
    for own, row in zip(times, rows, strict=True):
        # each the nearest of the other, so that none is taken twice
        complete &= ((np.abs(own[row] - base) <= tolerance_ns)
                     & (_nearest(base, own)[row] == np.arange(len(base))))
    rows = [row[complete] for row in rows]
    _count_others(states, times, rows, tolerance_ns, usual, dropped)
    x = np.column_stack([part.values[row] for part, row in zip(parts, rows, strict=True)])
    logs = np.max([part.log_ns[row] for part, row in zip(parts, rows, strict=True)], axis=0)
    every = np.column_stack([own[row] for own, row in zip(times, rows, strict=True)])
    stamps, last = np.unique(every.ravel()[::-1], return_index=True)
    return AlignedSamples(base[complete], x, (stamps, np.repeat(logs, len(states))[::-1][last]))


def named(states: Sequence[RecordedState], state: RecordedState, text: str) -> str:
    """Add the name of a state to a text, where there are several."""
    return text if len(states) == 1 else f'{text} ({state.name})'


def _count_others(states: Sequence[RecordedState], times: Sequence[Times], rows: Sequence[Times],
                  tolerance_ns: int, usual: float, dropped: Counter[str]) -> None:
    """Count the measurements of each state that are in no sample, by the reason."""
    seconds = f'{tolerance_ns / NANOSECONDS:g} s'
    for signal, own, row in zip(states, times, rows, strict=True):
        left = np.delete(own, row)
        for other, another in zip(times, states, strict=True):
            if other is own:
                continue
            apart = (np.abs(other[_nearest(other, left)] - left).astype(np.float64)
                     if len(other) else np.full(len(left), np.inf))
            late = (apart > tolerance_ns) & (apart <= 0.5 * usual)
            dropped[f'measurement without {another.name}'] += int(
                np.sum((apart > tolerance_ns) & ~late))
            dropped[f'measurement with {another.name} more than {seconds} apart'] += int(
                np.sum(late))
            left = left[apart <= tolerance_ns]
        dropped[named(states, signal, f'one of several within {seconds}')] += len(left)


def _nearest(times: Times, wanted: Times) -> NDArray[np.int64]:
    """Return which of some rising times is nearest to each wanted one; -1 where there is none."""
    after = np.searchsorted(times, wanted)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(times) - 1)
    if not len(times):
        return np.full(len(wanted), -1)
    return np.where(wanted - times[before] <= times[after] - wanted, before, after)
