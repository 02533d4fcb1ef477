# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""Records of a plant's motion: measurements with the inputs that acted, and how they are cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import itertools

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Record:
    """
    An uninterrupted stretch of measurements, with inputs held between their changes.

    :param time: (N,) times of the measurements, rising, in time units.
    :param x: (N, n_x) measured states, in state units, with their noise.
    :param input_time: (M,) times from which each input was held, rising, the first not later
        than the first measurement.
    :param u: (M, n_u) those inputs, in input units.
    :raises ValueError: on unequal lengths, times that do not rise, values that are not finite,
        or an input that is not known at the first measurement.
    """

    time: Array
    x: Array
    input_time: Array
    u: Array

    def __post_init__(self) -> None:
        for times, values in (('time', 'x'), ('input_time', 'u')):
            t = np.ascontiguousarray(getattr(self, times), dtype=np.float64)
            v = np.ascontiguousarray(getattr(self, values), dtype=np.float64)
            if t.ndim != 1 or v.ndim != 2 or len(t) != len(v) or len(t) == 0:
                raise ValueError(f'incompatible {times} and {values}: expected (n,) and (n, m) '
                                 f'with n > 0, got {t.shape} and {v.shape}')
            if not (np.all(np.isfinite(t)) and np.all(np.isfinite(v))):
                raise ValueError(f'{times} or {values} hold values that are not finite: drop them')
            if not np.all(np.diff(t) > 0.0):
                raise ValueError(f'{times} must rise: sort the samples and drop repeated ones')
            object.__setattr__(self, times, t)
            object.__setattr__(self, values, v)
        if self.input_time[0] > self.time[0]:
            raise ValueError('the input at the first measurement is not known: begin the record '
                             'with the first measurement after an input')

    def __len__(self) -> int:
        return len(self.time)

    def inputs_at(self, times: Array) -> Array:
        """Return the inputs (n, n_u) that hold from `times` (n,) on."""
        return self.u[np.searchsorted(self.input_time, times, side='right') - 1]

    def input_integral(self, times: Array) -> Array:
        """Return the integral of u (n, n_u) from the first measurement to `times` (n,)."""
        knots = np.concatenate((self.time[:1], self.input_time[self.input_time > self.time[0]]))
        held = self.inputs_at(knots)
        areas = np.vstack((np.zeros((1, held.shape[1])),
                           np.cumsum(np.diff(knots)[:, None] * held[:-1], axis=0)))
        last = np.maximum(np.searchsorted(knots, times, side='right') - 1, 0)
        return areas[last] + (times - knots[last])[:, None] * held[last]

    def part(self, start: int, stop: int) -> Record:
        """Return the measurements `start` to `stop` with the inputs that acted on them."""
        time = self.time[start:stop]
        first = np.searchsorted(self.input_time, time[0], side='right') - 1
        last = np.searchsorted(self.input_time, time[-1], side='left')
        keep = slice(first, max(first + 1, last))
        return Record(time, self.x[start:stop], self.input_time[keep], self.u[keep])


def cut(records: Sequence[Record], samples: int) -> list[Record]:
    """
    Cut records into stretches of nearly equal length, each beginning where the last one ends.

    :param records: what was recorded.
    :param samples: most measurements of a stretch, at least 2.
    """
    if samples < 2:
        raise ValueError(f'a stretch needs at least 2 samples, got {samples}')
    parts = []
    for record in records:
        count = max(1, -(-(len(record) - 1) // (samples - 1)))
        edges = np.round(np.linspace(0, len(record) - 1, count + 1)).astype(int)
        parts += [record.part(a, b + 1) for a, b in itertools.pairwise(edges) if b > a]
    return parts
