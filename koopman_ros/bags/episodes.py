# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A loop's measurements with the input that acted on them, cut from bags into episodes."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
import os

import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags.limits import BagReadError
from koopman_ros.bags.reader import BagSummary, read_messages, summary
from koopman_ros.bags.series import carriers, Scalar, spikes_and_jumps, stamped_number
from koopman_ros.plant_data import Episode
from koopman_ros.units import Conversion, conversion, LATE_NANOSECONDS, NANOSECONDS

# A gap is longer than this many usual periods.
_GAP_PERIODS = 3.5
# A clock that differs from the recorder's by more is not the wall clock.
_SAME_CLOCK_NS = 5 * NANOSECONDS
# Delays below this share of the sample period are taken as none.
_NO_DELAY = 0.01
_SHORTEST = 10
# What happened where an episode ends, for the first and for the largest of several.
_ENDS = {'set back': ('time was set back by {}', 'at most by {}'),
         'gap': ('gap of {}', 'the longest of {}'),
         'jump': ('jump to {}', 'the highest to {}')}

# Stamp or 0 [ns], time of receipt [ns], number.
_Entry = tuple[int, int, float]


@dataclass
class Account:
    """What was made of some bags."""

    measurements: int = 0  #: number of measurements read
    used: int = 0  #: number of those in an episode
    dropped: Counter[str] = field(default_factory=Counter)  #: messages left out, by reason
    notes: list[str] = field(default_factory=list)  #: what else is worth knowing, in words

    def lines(self) -> list[str]:
        """Return the account in words."""
        return [f'{self.used} of {self.measurements} measurements used',
                *(f'{count} dropped: {why}' for why, count in sorted(self.dropped.items())),
                *self.notes]


def loop_episodes(bags: Sequence[str | os.PathLike[str]], measured: str, applied: str,
                  units: tuple[str, str], *, input_delay_ns: int = 0
                  ) -> tuple[list[Episode], Account]:
    """
    Read the episodes of some bags: times in s since the first measurement of each.

    Nothing is resampled: measurements keep their stamps, and the input is held from the time on
    at which it was commanded. A command that answers a measurement carries its stamp; where the
    stamps are those of the wall clock, it acts later by the time between the two receipts. A
    command without a stamp acts when it is received.

    Episodes end at gaps, where time is set back, and where the measured signal jumps to another
    level as after a reset. Spikes of a single sample are dropped, and so are measurements before
    the first command, since nobody knows what acted on them. A bag that was not closed or is
    damaged is read as far as it goes. The account tells all that.

    :param measured: topic of the measured signal, of a type in :data:`SCALARS`.
    :param applied: topic of the input that acts, likewise.
    :param units: of both in the episodes.
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
        content = summary(bag)
        by_topic = carriers(bag, content, (measured, applied))
        scales = [_scale(bag, topic, by_topic[topic].unit, unit)
                  for topic, unit in zip((measured, applied), units, strict=True)]
        for run in _runs(bag, content, measured, by_topic, account, cuts):
            episodes += [
                Episode(found.time, scales[0](found.x), found.input_time, scales[1](found.u))
                for found in _episodes(run, account, cuts, input_delay_ns)]
        account.notes += cuts.notes(os.fspath(bag))
    account.used = sum(map(len, episodes))
    account.dropped = +account.dropped
    return episodes, account


@dataclass
class _Run:
    """The messages between two resets of time, and how the measurements are carried."""

    carrier: Scalar
    measured: list[_Entry] = field(default_factory=list)
    commanded: list[_Entry] = field(default_factory=list)


@dataclass
class _Cuts:
    """Where episodes of a bag end: (amount in words, amount), by what happened there."""

    found: dict[str, list[tuple[str, float]]] = field(
        default_factory=lambda: {kind: [] for kind in _ENDS})

    def notes(self, bag: str) -> Iterator[str]:
        """Yield one sentence for each kind, however often it happened."""
        for kind, (first, most) in _ENDS.items():
            if not (cuts := self.found[kind]):
                continue
            happened = f'{bag}: {first.format(cuts[0][0])}'
            if len(cuts) == 1:
                yield f'{happened}, a new episode begins'
            else:
                largest = max(cuts, key=lambda cut: cut[1])[0]
                yield (f'{happened}, the first of {len(cuts)}, {most.format(largest)}; a new '
                       'episode begins at each')


def _scale(bag: str | os.PathLike[str], topic: str, unit: str, wanted: str) -> Conversion:
    try:
        return conversion(unit, wanted)
    except ValueError as error:
        raise BagReadError(f'topic {topic!r} of bag {os.fspath(bag)!r}: {error}; name another '
                           'topic') from error


def _runs(bag: str | os.PathLike[str], content: BagSummary, measured: str,
          by_topic: dict[str, Scalar], account: Account, cuts: _Cuts) -> Iterator[_Run]:
    """Yield what lies between resets of time."""
    if not content.complete:
        account.notes.append(f'{os.fspath(bag)} was not closed or is damaged: read up to its last '
                             'whole record')
    run = _Run(by_topic[measured])
    latest = -1
    left = sum(content.counts[topic] for topic in by_topic)
    for entry in read_messages(bag, by_topic, recover=True):
        left -= 1
        carrier = by_topic[entry.topic]
        stamp_ns, value = stamped_number(bag, entry, carrier)
        is_measured = entry.topic == measured
        account.measurements += is_measured
        if not carrier.lowest <= value <= carrier.highest:
            account.dropped[f'outside {carrier.lowest:g} to {carrier.highest:g} '
                            f'{carrier.unit}'] += 1
            continue
        if is_measured and stamp_ns < latest - LATE_NANOSECONDS:
            back = (latest - stamp_ns) / NANOSECONDS
            cuts.found['set back'].append((f'{back:.3f} s', back))
            yield run
            run, latest = _Run(by_topic[measured]), -1
        if is_measured:
            latest = max(latest, stamp_ns)
        (run.measured if is_measured else run.commanded).append(
            (stamp_ns, entry.log_time_ns, value))
    if left:
        account.notes.append(f'{os.fspath(bag)} is damaged: {left} messages that it counts could '
                             'not be read')
    yield run


def _episodes(run: _Run, account: Account, cuts: _Cuts, input_delay_ns: int) -> list[Episode]:
    """Sort one run by time and cut it at its gaps and jumps."""
    measured = _sorted(run.measured, account)
    if len(measured) < _SHORTEST or not run.commanded:
        account.dropped['too short, or without any input'] += len(measured)
        return []
    least = run.carrier.least_jump
    spike, _ = spikes_and_jumps(np.array([entry[2] for entry in measured]), least)
    account.dropped['spike of a single sample'] += int(np.sum(spike))
    measured = [entry for entry, odd in zip(measured, spike, strict=True) if not odd]
    x = np.array([entry[2] for entry in measured])
    _, jump = spikes_and_jumps(x, least)
    stamps = np.array([entry[0] for entry in measured])
    period = float(np.median(np.diff(stamps)))
    input_ns, values = _inputs(run, measured, period)
    input_ns = input_ns + input_delay_ns
    known = stamps >= input_ns[0]
    account.dropped['before the first input'] += int(np.sum(~known))
    gap = np.diff(stamps, prepend=stamps[0]) > _GAP_PERIODS * period
    ends = np.flatnonzero(gap | jump)
    for end in ends.tolist():
        at = f'at {stamps[end - 1] / NANOSECONDS:.3f} s'
        if gap[end]:
            seconds = (stamps[end] - stamps[end - 1]) / NANOSECONDS
            cuts.found['gap'].append((f'{seconds:.3f} s {at}', seconds))
        else:
            cuts.found['jump'].append((f'{x[end]:.2f} {run.carrier.unit} {at}', x[end]))
    found = []
    for rows in np.split(np.arange(len(stamps)), ends):
        rows = rows[known[rows]]
        if len(rows) < _SHORTEST:
            account.dropped[f'in a segment of fewer than {_SHORTEST}'] += len(rows)
            continue
        first = np.searchsorted(input_ns, stamps[rows[0]], side='right') - 1
        last = np.searchsorted(input_ns, stamps[rows[-1]], side='left')
        keep = slice(first, max(first + 1, last))
        origin = stamps[rows[0]]
        found.append(Episode((stamps[rows] - origin) / NANOSECONDS, x[rows, None],
                             (input_ns[keep] - origin) / NANOSECONDS, values[keep, None]))
    return found


def _sorted(entries: list[_Entry], account: Account) -> list[_Entry]:
    """Sort by stamp; of repeated stamps the first one received stays."""
    first: dict[int, _Entry] = {}
    for entry in entries:
        first.setdefault(entry[0], entry)
    account.dropped['measurement with a repeated stamp'] += len(entries) - len(first)
    return [first[stamp] for stamp in sorted(first)]


def _inputs(run: _Run, measured: list[_Entry], period: float
            ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return when which input began to act."""
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
