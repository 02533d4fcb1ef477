# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Measurements cut into episodes: spikes are dropped, gaps and jumps end an episode."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.core.units import quantity_text
from koopman_ros.records.applied_inputs import Applied, span
from koopman_ros.records.import_spec import ImportReport


@dataclass(frozen=True)
class CuttingRules:
    """Limits of a plant's motion in a record; larger changes are spikes, jumps or gaps."""

    gap_periods: float = 3.5  #: a longer time without a measurement, in usual periods, is a gap
    shortest: int = 10  #: samples of an episode
    enough: int = 50  #: fewer samples do not show the usual change
    neighbours: int = 3  #: samples on each side whose median a spike leaves
    #: a spike or jump is larger than so many usual changes, or steps of the sensor's resolution,
    times_usual: float = 10.0
    #: than this share of the range in which the signal mostly is,
    share_of_range: float = 0.2
    mostly: tuple[float, float] = (1.0, 99.0)  #: percentiles of that range
    usual: float = 90.0  #: percentile of the changes, all but the largest ones
    #: and a spike than so many median deviations of its neighbours, which it does not continue
    times_local: float = 6.0
    #: so many changes by the smallest difference of two values make it the resolution
    fewest_steps: int = 3
    #: searches for spikes; some show once others are dropped
    passes: int = 5


RULES = CuttingRules()


def spikes_and_jumps(values: Array, least: float = 0.0, rules: CuttingRules = RULES
                     ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """
    Find changes that no plant makes: samples that leap away and back, and jumps to another level.

    A spike leaves the median of its neighbours (Hampel's identifier, by the median deviation of
    the record and of the neighbours), so that it is found whatever share of the record others
    have. A jump is a large change between two samples neither of which is a spike.

    :param values: (n,) in the order of their times.
    :param least: no smaller change is one of them.
    :return: whether each sample is a spike (n,), and whether the signal jumps to it (n,).
    """
    spike, jump = np.zeros(len(values), dtype=bool), np.zeros(len(values), dtype=bool)
    if len(values) < rules.enough:
        return spike, jump
    least = max(least, rules.times_usual * _resolution(values, rules))
    for _ in range(rules.passes):
        kept = np.flatnonzero(~spike)
        found = _far_from_neighbours(values[kept], least, rules)
        if not found.any():
            # a single one on a ramp, whose neighbours differ: it leaps away and back
            large = _large_changes(values[kept], least, rules)
            found[1:-1] = large[:-1] * large[1:] < 0
        spike[kept[found]] = True
        if not found.any():
            break
    kept = np.flatnonzero(~spike)
    jump[kept[1:]] = _large_changes(values[kept], least, rules) != 0
    return spike, jump


def _large_changes(values: Array, least: float, rules: CuttingRules) -> NDArray[np.int64]:
    """Return the signs of changes too large for a motion, 0 for others."""
    change = np.diff(values)
    limit = max(rules.times_usual * float(np.percentile(np.abs(change), rules.usual)),
                rules.share_of_range * _range(values, rules), least)
    return np.where(np.abs(change) > limit, np.sign(change), 0.0).astype(np.int64)


def _far_from_neighbours(values: Array, least: float, rules: CuttingRules) -> NDArray[np.bool_]:
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * rules.neighbours + 1)
    # at both ends the neighbours are on one side
    around = windows[np.clip(np.arange(len(values)) - rules.neighbours, 0, len(windows) - 1)]
    middle = np.median(around, axis=1)
    local = np.median(np.abs(around - middle[:, None]), axis=1)
    away = np.abs(values - middle)
    return away > np.maximum(rules.times_local * local, max(
        rules.times_usual * float(np.median(away)),
        rules.share_of_range * _range(values, rules), least))


def _range(values: Array, rules: CuttingRules) -> float:
    low, high = np.percentile(values, rules.mostly)
    return float(high - low)


def _resolution(values: Array, rules: CuttingRules) -> float:
    """Return the step of a sensor, 0 where its values show none."""
    levels = np.unique(values)
    apart = np.diff(levels)
    apart = apart[apart > 1e-9 * (levels[-1] - levels[0])]
    if not len(apart):
        return 0.0
    step = float(np.min(apart))
    steps = np.sum(np.isclose(np.abs(np.diff(values)), step, rtol=1e-6, atol=0.0))
    return step if steps >= rules.fewest_steps else 0.0


@dataclass
class EpisodeCutter:
    """Cuts the measurements of a table or of a bag into episodes."""

    label: str  #: of the source
    names: Sequence[str]  #: of the states
    units: Sequence[str]  #: of x
    report: ImportReport
    per_second: int = 1  #: units of the times in a second: 1, or a billion for whole ns
    least_jumps: Sequence[float] = ()  #: smallest spike or jump of each state, in its unit
    rules: CuttingRules = RULES
    #: ends of episodes by reason: amount, and this in words
    breaks: defaultdict[str, list[tuple[float, str]]] = field(
        default_factory=lambda: defaultdict(list))

    def cut(self, times: NDArray[Any], x: Array,
            inputs: Callable[[NDArray[Any], float], Sequence[Applied]]
            ) -> Iterator[Episode]:
        """
        Yield the episodes of measurements between two resets of time.

        :param times: (N,) rising.
        :param x: (N, n_x), NaN where a state was not measured.
        :param inputs: returns the applied inputs over some times, given the usual period.
        """
        x, jumps = self._without_spikes(x)
        rows = np.flatnonzero(np.isfinite(x).any(axis=1))
        times, x, jumps = times[rows], x[rows], jumps[rows]
        if len(times) < self.rules.shortest:
            self.drop(f'in a segment of fewer than {self.rules.shortest}', x)
            return
        period = float(np.median(np.diff(times)))
        for rows in np.split(np.arange(len(times)), self._ends(times, x, jumps, period)):
            applied = inputs(times[rows], period)
            begins, ends = zip(*map(span, applied), strict=True)
            started, within = times[rows] >= max(begins), times[rows] <= min(ends)
            self.drop('before the first input', x[rows[~started]])
            self.drop('after the last input', x[rows[~within]])
            rows = rows[started & within]
            if len(rows) < self.rules.shortest:
                self.drop(f'in a segment of fewer than {self.rules.shortest}', x[rows])
                continue
            self.report.used += int(np.sum(np.isfinite(x[rows])))
            yield self._episode(times[rows], x[rows], applied)

    def drop(self, reason: str, x: Array) -> None:
        """Count the measurements in some rows as dropped."""
        self.report.dropped[reason] += int(np.sum(np.isfinite(x)))

    def _without_spikes(self, x: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return x with NaN for spikes, and the state that jumps in each row, -1 for none."""
        x, jumps = x.copy(), np.full(len(x), -1)
        for j, (name, least) in enumerate(zip(
                self.names, self.least_jumps or [0.0] * len(self.names), strict=True)):
            rows = np.flatnonzero(np.isfinite(x[:, j]))
            spike, jump = spikes_and_jumps(x[rows, j], least, self.rules)
            self.drop(f'spike ({name})', x[rows[spike], j])
            self.report.spikes[name] += int(np.sum(spike))
            self.report.checked[name] += len(rows)
            x[rows[spike], j] = np.nan
            jumps[rows[jump]] = j
        return x, jumps

    def _ends(self, times: NDArray[Any], x: Array, jumps: NDArray[np.int64], period: float
              ) -> NDArray[np.int64]:
        """Return where episodes begin, after gaps and at jumps, and note these."""
        step = np.diff(times, prepend=times[:1])
        gap = step > self.rules.gap_periods * period
        ends = np.flatnonzero(gap | (jumps >= 0))
        ends = ends[ends > 0]
        for end in ends.tolist():
            at = f'at {times[end - 1] / self.per_second:.3f} s'
            if gap[end]:
                seconds = float(step[end]) / self.per_second
                self.breaks['gap of'].append((seconds, f'{seconds:.3f} s {at}'))
            else:
                j = int(jumps[end])
                level = f'{quantity_text(x[end, j], self.units[j])} ({self.names[j]})'
                self.breaks['jump to'].append((abs(float(x[end, j])), f'{level} {at}'))
        return ends

    def _episode(self, times: NDArray[Any], x: Array, applied: Sequence[Applied]
                 ) -> Episode:
        origin = times[0]
        changes = np.unique(np.concatenate([own for own, _, _ in applied]))
        changes = changes[changes >= max(own[0] for own, _, _ in applied)]
        u = np.column_stack([
            np.interp(changes - origin, own - origin, values) if linear
            else values[np.searchsorted(own, changes, side='right') - 1]
            for own, values, linear in applied])
        linear = tuple(linear for _, _, linear in applied)
        return Episode((times - origin) / self.per_second, x,
                       (changes - origin) / self.per_second, u,
                       linear if any(linear) else ()).part(0, len(times))

    def note_breaks(self) -> None:
        """Note the ends of episodes, one sentence for each reason."""
        for reason, found in self.breaks.items():
            first, (_, largest) = found[0][1], max(found, key=itemgetter(0))
            self.report.note(f'{self.label}: {reason} {first}, ' + (
                'a new episode begins' if len(found) == 1 else f'the first of {len(found)}, the '
                f'largest {largest}; a new episode begins at each'))
