# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""A loop's measurements with the coolant that acted on them, cut from bags into episodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
import math
import os

import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags.errors import BagReadError
from koopman_ros.bags.jumps import spikes_and_jumps
from koopman_ros.bags.reader import read_messages, summary
from koopman_ros.plant_data import Episode

EPISODE_UNIT = 'degC'  # of states and inputs alike
_TEMPERATURE = 'sensor_msgs/msg/Temperature'
_NS = 1_000_000_000
# A stamp earlier by more than this means that time was set back, e.g. by a restart of the plant.
_SET_BACK_NS = _NS
# A gap is longer than this many usual periods.
_GAP_PERIODS = 3.5
# A clock that differs from the recorder's by more is not the wall clock.
_SAME_CLOCK_NS = 5 * _NS
# Delays below this share of the sample period are taken as none.
_NO_DELAY = 0.01
_SHORTEST = 10
_COLDEST, _HOTTEST = -273.15, 1e4  # degC; anything else is no measurement


@dataclass
class Account:
    """
    What was made of some bags.

    :param measurements: number of measurements read.
    :param used: number of those in an episode.
    :param dropped: number of messages left out, by reason.
    :param notes: what else is worth knowing, in words.
    """

    measurements: int = 0
    used: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """Return the account in words."""
        said = [f'{self.used} of {self.measurements} measurements used']
        said += [f'{count} dropped: {reason}' for reason, count in sorted(self.dropped.items())]
        return said + self.notes


def loop_episodes(bags: Sequence[str | os.PathLike[str]], temperature: str, coolant: str, *,
                  input_delay_ns: int = 0) -> tuple[list[Episode], Account]:
    """
    Read the episodes of some bags: times in s since the first measurement of each.

    Nothing is resampled: measurements keep their stamps, and the coolant is held from the time
    on at which it was commanded. A command that answers a measurement carries its stamp; where
    the stamps are those of the wall clock, it acts later by the time between the two receipts. A
    command without a stamp acts when it is received.

    Episodes end at gaps, where time is set back, and where the temperature jumps to another level
    as after a reset. Spikes of a single sample are dropped, and so are measurements before the
    first command, since nobody knows what acted on them. A bag that was not closed or is damaged
    is read as far as it goes. The account tells all that.

    :param bags: files or folders.
    :param temperature: topic of the measurements, sensor_msgs/Temperature in `EPISODE_UNIT`.
    :param coolant: topic of the coolant temperature that acts, likewise.
    :param input_delay_ns: dead time of the actuator, after which a command begins to act.
    :raises BagReadError: for a bag that cannot be read, lacks a topic, or has another type there.
    """
    episodes: list[Episode] = []
    account = Account()
    read: set[str] = set()
    for bag in bags:
        if (path := os.path.realpath(bag)) in read:
            account.notes.append(f'{os.fspath(bag)} is named twice: read once')
            continue
        read.add(path)
        cuts = _Cuts()
        for run in _runs(bag, temperature, coolant, account, cuts):
            episodes += _episodes(run, account, cuts, input_delay_ns)
        account.notes += cuts.notes(os.fspath(bag))
    account.used = sum(map(len, episodes))
    account.dropped = +account.dropped
    return episodes, account


@dataclass
class _Run:
    """Messages between two resets of time: (stamp or 0, time of receipt, value)."""

    measured: list[tuple[int, int, float]] = field(default_factory=list)
    commanded: list[tuple[int, int, float]] = field(default_factory=list)


@dataclass
class _Cuts:
    """Where episodes of a bag end: (what happened, by how much in words, how much), by kind."""

    set_back: list[tuple[str, float]] = field(default_factory=list)
    gaps: list[tuple[str, float]] = field(default_factory=list)
    jumps: list[tuple[str, float]] = field(default_factory=list)

    def notes(self, bag: str) -> Iterator[str]:
        """Yield one sentence for each kind, however often it happened."""
        for cuts, first, most in (
                (self.set_back, 'time was set back by {}', 'at most by {}'),
                (self.gaps, 'gap of {}', 'the longest of {}'),
                (self.jumps, 'jump to {}', 'the highest to {}')):
            if cuts:
                said = first.format(cuts[0][0])
                if len(cuts) == 1:
                    yield f'{bag}: {said}, a new episode begins'
                else:
                    largest = max(cuts, key=lambda cut: cut[1])[0]
                    yield (f'{bag}: {said}, the first of {len(cuts)}, {most.format(largest)}; '
                           'a new episode begins at each')


def _runs(bag: str | os.PathLike[str], temperature: str, coolant: str, account: Account,
          cuts: _Cuts) -> Iterator[_Run]:
    """Yield what lies between resets of time."""
    content = summary(bag)
    for topic in (temperature, coolant):
        if topic not in content.types:
            known = ', '.join(sorted(content.types)) or 'no topic at all'
            raise BagReadError(f'bag {os.fspath(bag)!r} has no topic {topic!r}, it has {known}: '
                               'name the right topics, or record them')
        if content.types[topic] != _TEMPERATURE:
            raise BagReadError(f'topic {topic!r} of bag {os.fspath(bag)!r} is '
                               f'{content.types[topic]}, not {_TEMPERATURE}: name another topic')
    if not content.complete:
        account.notes.append(f'{os.fspath(bag)} was not closed or is damaged: read up to its last '
                             'whole record')
    run = _Run()
    latest = -1
    left = content.counts[temperature] + content.counts[coolant]
    for entry in read_messages(bag, [temperature, coolant], recover=True):
        left -= 1
        stamp = entry.message.header.stamp
        stamp_ns = stamp.sec * _NS + stamp.nanosec
        value = float(entry.message.temperature)
        measured = entry.topic == temperature
        account.measurements += measured
        if not (math.isfinite(value) and _COLDEST <= value <= _HOTTEST):
            account.dropped['not a temperature'] += 1
            continue
        if measured and stamp_ns < latest - _SET_BACK_NS:
            back = (latest - stamp_ns) / _NS
            cuts.set_back.append((f'{back:.3f} s', back))
            yield run
            run, latest = _Run(), -1
        if measured:
            latest = max(latest, stamp_ns)
        (run.measured if measured else run.commanded).append((stamp_ns, entry.log_time_ns, value))
    if left:
        account.notes.append(f'{os.fspath(bag)} is damaged: {left} messages that it counts could '
                             'not be read')
    yield run


def _episodes(run: _Run, account: Account, cuts: _Cuts, input_delay_ns: int) -> list[Episode]:
    """Sort one run by time and cut it at its gaps and jumps."""
    measured = _sorted(run.measured, account, 'measurement with a repeated stamp')
    if len(measured) < _SHORTEST or not run.commanded:
        account.dropped['too short, or without any coolant'] += len(measured)
        return []
    spike, _ = spikes_and_jumps(np.array([entry[2] for entry in measured]))
    account.dropped['spike of a single sample'] += int(np.sum(spike))
    measured = [entry for entry, odd in zip(measured, spike, strict=True) if not odd]
    _, jump = spikes_and_jumps(np.array([entry[2] for entry in measured]))
    stamps = np.array([entry[0] for entry in measured])
    period = float(np.median(np.diff(stamps)))
    input_ns, values = _inputs(run, measured, period)
    input_ns = input_ns + input_delay_ns
    known = stamps >= input_ns[0]
    account.dropped['before the first coolant'] += int(np.sum(~known))
    gap = np.diff(stamps, prepend=stamps[0]) > _GAP_PERIODS * period
    ends = np.flatnonzero(gap | jump)
    for end in ends.tolist():
        amount = (stamps[end] - stamps[end - 1]) / _NS if gap[end] else measured[end][2]
        unit = 's' if gap[end] else 'degC'
        (cuts.gaps if gap[end] else cuts.jumps).append((
            f'{amount:.{3 if gap[end] else 2}f} {unit} at {stamps[end - 1] / _NS:.3f} s', amount))
    found = []
    for rows in np.split(np.arange(len(stamps)), ends):
        rows = rows[known[rows]]
        if len(rows) < _SHORTEST:
            account.dropped[f'in a stretch of fewer than {_SHORTEST}'] += len(rows)
            continue
        first = np.searchsorted(input_ns, stamps[rows[0]], side='right') - 1
        last = np.searchsorted(input_ns, stamps[rows[-1]], side='left')
        keep = slice(first, max(first + 1, last))
        origin = stamps[rows[0]]
        found.append(Episode((stamps[rows] - origin) / _NS,
                             np.array([[measured[i][2]] for i in rows]),
                             (input_ns[keep] - origin) / _NS, values[keep, None]))
    return found


def _sorted(entries: list[tuple[int, int, float]], account: Account, repeated: str
            ) -> list[tuple[int, int, float]]:
    """Sort by stamp; of repeated stamps the first one received stays."""
    kept: list[tuple[int, int, float]] = []
    for entry in sorted(entries, key=lambda entry: entry[0]):
        if kept and kept[-1][0] == entry[0]:
            account.dropped[repeated] += 1
        else:
            kept.append(entry)
    return kept


def _inputs(run: _Run, measured: list[tuple[int, int, float]], period: float
            ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return when which coolant began to act."""
    received = {stamp: log for stamp, log, _ in measured}
    wall = float(np.median([abs(log - stamp) for stamp, log, _ in measured])) < _SAME_CLOCK_NS
    logs, stamps = np.array(sorted(received.values())), np.array(list(received))
    times: dict[int, float] = {}
    for given, log, value in sorted(run.commanded, key=lambda entry: entry[1]):
        # without a stamp it acts on receipt, which plant time may have to be asked for
        stamp = given or (log if wall else int(np.interp(log, logs, stamps)))
        delay = log - received[stamp] if wall and stamp in received else 0
        # the last word counts
        times[stamp + (delay if delay > _NO_DELAY * period else 0)] = value
    order = sorted(times)
    changes = [t for i, t in enumerate(order) if i == 0 or times[t] != times[order[i - 1]]]
    return np.array(changes), np.array([times[t] for t in changes])
