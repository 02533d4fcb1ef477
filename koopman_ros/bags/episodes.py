# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A loop's measurements with the input that acted on them, cut from bags into episodes."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
import math
import os

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.bags.limits import BagReadError
from koopman_ros.bags.reader import BagSummary, read_messages, summary
from koopman_ros.bags.series import check_places, spikes_and_jumps, stamped_number
from koopman_ros.plant_data import Episode
from koopman_ros.units import Conversion, conversion, LATE_NANOSECONDS, NANOSECONDS
from koopman_ros.wire import Place

# A gap is longer than this many usual periods.
_GAP_PERIODS = 3.5
# A clock that differs from the recorder's by more is not the wall clock.
_SAME_CLOCK_NS = 5 * NANOSECONDS
# Delays below this share of the sample period are taken as none.
_NO_DELAY = 0.01
_SHORTEST = 10
# An input that differs from its command by no more than this share of its own motion follows at
# once: the command tells better when it changed.
_AT_ONCE = 0.02
# What happened where an episode ends, for the first and for the largest of several.
_ENDS = {'set back': ('time was set back by {}', 'at most by {}'),
         'gap': ('gap of {}', 'the longest of {}'),
         'jump': ('jump to {}', 'the highest to {}')}

Times = NDArray[np.int64]

# Stamp [ns], None for a type without one and 0 where it was left open; receipt [ns]; number.
_Entry = tuple[int | None, int, float]
_Stamped = tuple[int, int, float]


@dataclass(frozen=True)
class RecordedState:
    """A measured state in bags."""

    name: str  #: of the signal
    unit: str  #: in the episodes
    place: Place  #: where its measurements are


@dataclass(frozen=True)
class RecordedInput:
    """An input in bags."""

    name: str  #: of the signal
    unit: str  #: in the episodes
    command: Place  #: where it is commanded
    measured: Place | None = None  #: where it is measured behind its actuator, if it is
    delay: float = 0.0  #: dead time of the actuator, after which a command begins to act, in s


@dataclass
class Account:
    """What was made of some bags."""

    measurements: int = 0  #: number of measurements read, of all states
    used: int = 0  #: number of those in an episode
    dropped: Counter[str] = field(default_factory=Counter)  #: messages left out, by reason
    notes: list[str] = field(default_factory=list)  #: what else is worth knowing, in words

    def lines(self) -> list[str]:
        """Return the account in words."""
        return [f'{self.used} of {self.measurements} measurements used',
                *(f'{count} dropped: {why}' for why, count in sorted(self.dropped.items())),
                *self.notes]


def loop_episodes(bags: Sequence[str | os.PathLike[str]], states: Sequence[RecordedState],
                  inputs: Sequence[RecordedInput], *, tolerance_ns: int = 0,
                  least_jumps: Sequence[float] | None = None) -> tuple[list[Episode], Account]:
    """
    Read the episodes of some bags: times in s since the first measurement of each.

    Nothing is resampled: measurements keep their stamps. Where there are several states, the
    nearest stamps of the others are put to each stamp of the one that is measured least; types
    without a stamp count at receipt.

    An input that was measured throughout an episode is linear between its measurements. Where it
    was not, or where it is no more than its command within the range that it reaches, it is held
    from the time on at which it was commanded. A command that answers a measurement carries its
    stamp; where the stamps are those of the wall clock, it acts later by the time between the two
    receipts. A command without a stamp acts when it is received.

    Episodes end at gaps, where time is set back, and where a state jumps to another level as
    after a reset. Spikes of a single sample are dropped, and so are measurements before the first
    input, since nobody knows what acted on them. A bag that was not closed or is damaged is read
    as far as it goes. The account tells all that.

    :param tolerance_ns: how far stamps of one sample of several states may lie apart.
    :param least_jumps: smallest change of each state, in its unit, that may be a spike or a jump;
        by default the record alone tells.
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
        loop = _Loop(bag, states, _recorded(bag, content, inputs, account), account, cuts,
                     tolerance_ns, least_jumps or [0.0] * len(states))
        check_places(bag, content, loop.scales)
        for run in loop.runs(content):
            episodes += loop.episodes(run)
        account.notes += [*cuts.notes(os.fspath(bag)), *dict.fromkeys(loop.notes)]
    account.used = len(states) * sum(map(len, episodes))
    account.dropped = +account.dropped
    return episodes, account


def _recorded(bag: str | os.PathLike[str], content: BagSummary, inputs: Sequence[RecordedInput],
              account: Account) -> list[RecordedInput]:
    """Return the inputs without the measured ones that a bag lacks."""
    found = []
    for signal in inputs:
        if signal.measured is not None and signal.measured.topic not in content.types:
            account.notes.append(f'{os.fspath(bag)} has no topic {signal.measured.topic!r}: '
                                 f'{signal.name} is taken from its command')
            signal = replace(signal, measured=None)
        found.append(signal)
    return found


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


@dataclass
class _Run:
    """The messages between two resets of time."""

    #: of each place, in the order of receipt
    entries: dict[Place, list[_Entry]] = field(default_factory=lambda: defaultdict(list))


@dataclass
class _Clock:
    """How the time of receipt tells that of the stamps."""

    wall: bool  #: whether stamps are those of the recorder's clock
    logs: Times  #: (n,) times of receipt, rising
    stamps: Times  #: (n,) stamps, rising

    @classmethod
    def of(cls, entries: Sequence[_Stamped]) -> '_Clock':
        """Compare stamps with their receipts; without any, receipts are stamps."""
        apart = [abs(log - stamp) for stamp, log, _ in entries]
        return cls(not apart or float(np.median(apart)) < _SAME_CLOCK_NS,
                   np.array(sorted(log for _, log, _ in entries)),
                   np.array(sorted(stamp for stamp, _, _ in entries)))

    def at(self, log: int) -> int:
        """Return the stamp [ns] of a receipt."""
        return log if self.wall else int(np.interp(log, self.logs, self.stamps))


@dataclass(frozen=True)
class _Samples:
    """Measurements that were put together."""

    stamps: Times  #: (N,) rising, in ns
    x: Array  #: (N, n_x) as they were sent
    received: dict[int, int]  #: receipt of the last part [ns], by the stamps of all parts
    clock: _Clock


# (M,) times in ns, (M,) values in the input's unit, whether it is linear between them
_Acting = tuple[Times, Array, bool]


@dataclass
class _Loop:
    """One bag with the signals of a loop."""

    bag: str | os.PathLike[str]
    states: Sequence[RecordedState]
    inputs: Sequence[RecordedInput]
    account: Account
    cuts: _Cuts
    tolerance_ns: int
    least_jumps: Sequence[float]
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        signals: list[RecordedState | RecordedInput] = [*self.states, *self.inputs]
        self.scales: dict[Place, Conversion] = {}
        self._ranges: dict[Place, tuple[float, float]] = {}
        for signal in signals:
            for place in _places(signal):
                try:
                    self._ranges[place] = place.range
                    self.scales[place] = conversion(place.unit, signal.unit)
                except ValueError as error:
                    raise BagReadError(f'topic {place.topic!r} of bag {os.fspath(self.bag)!r}: '
                                       f'{error}; name another topic') from error

    def runs(self, content: BagSummary) -> Iterator[_Run]:
        """Yield what lies between resets of time."""
        bag, account = os.fspath(self.bag), self.account
        if not content.complete:
            account.notes.append(f'{bag} was not closed or is damaged: read up to its last whole '
                                 'record')
        by_topic: dict[str, list[Place]] = defaultdict(list)
        for place in self.scales:
            by_topic[place.topic].append(place)
        names = {signal.place: signal.name for signal in self.states}
        run = _Run()
        latest: dict[Place, int] = {}
        left = sum(content.counts[topic] for topic in by_topic)
        for entry in read_messages(self.bag, by_topic, recover=True):
            left -= 1
            for place in by_topic[entry.topic]:
                stamp_ns, value = stamped_number(self.bag, entry, place)
                account.measurements += place in names
                if value is None:
                    account.dropped[f'without {place.field}'] += 1
                    continue
                lowest, highest = self._ranges[place]
                if not (lowest <= value <= highest and math.isfinite(value)):
                    account.dropped[f'outside {lowest:g} to {highest:g} {place.unit}'] += 1
                    continue
                if stamp_ns is None:
                    self.notes.append(f'{bag}: messages of {place.topic} ({place.type}) have no '
                                      'stamp: their receipt counts')
                elif place in names:
                    if stamp_ns < latest.get(place, -1) - LATE_NANOSECONDS:
                        back = (latest[place] - stamp_ns) / NANOSECONDS
                        self.cuts.found['set back'].append((f'{back:.3f} s', back))
                        yield run
                        run, latest = _Run(), {}
                    latest[place] = max(latest.get(place, -1), stamp_ns)
                run.entries[place].append((stamp_ns, entry.log_time_ns, value))
        if left:
            account.notes.append(f'{bag} is damaged: {left} messages that it counts could not be '
                                 'read')
        yield run


    def episodes(self, run: _Run) -> Iterator[Episode]:
        """Put one run together and cut it at its gaps and jumps."""
        dropped, n_x = self.account.dropped, len(self.states)
        samples = self._samples(run)
        stamps, x = samples.stamps, samples.x
        heard = all(any(run.entries[place] for place in _places(signal)) for signal in self.inputs)
        if len(stamps) < _SHORTEST or not heard:
            dropped['too short, or without any input'] += x.size
            return
        spike = self._leaps(x)[0]
        odd = spike.any(axis=1)
        for j in range(n_x):
            dropped[self._named(j, 'spike of a single sample')] += int(np.sum(spike[:, j]))
        dropped['beside a spike'] += n_x * int(np.sum(odd)) - int(np.sum(spike))
        stamps, x = stamps[~odd], x[~odd]
        jump = self._leaps(x)[1]
        period = float(np.median(np.diff(stamps)))
        gap = np.diff(stamps, prepend=stamps[0]) > _GAP_PERIODS * period
        ends = np.flatnonzero(gap | jump.any(axis=1))
        for end in ends.tolist():
            at = f'at {stamps[end - 1] / NANOSECONDS:.3f} s'
            if gap[end]:
                seconds = (stamps[end] - stamps[end - 1]) / NANOSECONDS
                self.cuts.found['gap'].append((f'{seconds:.3f} s {at}', seconds))
            else:
                j = int(np.argmax(jump[end]))
                level = self._named(j, f'{x[end, j]:.6g} {self.states[j].place.unit}')
                self.cuts.found['jump'].append((f'{level} {at}', x[end, j]))
        recorded = [(self._commands(run, signal, samples, period), self._measured(
            run, signal, samples.clock)) for signal in self.inputs]
        for rows in np.split(np.arange(len(stamps)), ends):
            times = stamps[rows]
            acting = [self._acting(signal.name, *both, times, period)
                      for signal, both in zip(self.inputs, recorded, strict=True)]
            known = times >= max(start for start, _ in map(_span, acting))
            within = times <= min(end for _, end in map(_span, acting))
            dropped['before the first input'] += n_x * int(np.sum(~known))
            dropped['after the last input'] += n_x * int(np.sum(~within))
            rows = rows[known & within]
            if len(rows) < _SHORTEST:
                dropped[f'in a segment of fewer than {_SHORTEST}'] += n_x * len(rows)
                continue
            yield self._episode(stamps[rows], x[rows], acting)

    def _episode(self, stamps: Times, x: Array, acting: Sequence[_Acting]) -> Episode:
        """Put measurements and what acted on them together, in the signals' units."""
        origin = stamps[0]
        changes = np.unique(np.concatenate([times for times, _, _ in acting]))
        changes = changes[changes >= max(times[0] for times, _, _ in acting)]
        u = np.column_stack([
            np.interp(changes - origin, times - origin, values) if linear
            else values[np.searchsorted(times, changes, side='right') - 1]
            for times, values, linear in acting])
        scaled = [self.scales[signal.place](x[:, j]) for j, signal in enumerate(self.states)]
        linear = tuple(linear for _, _, linear in acting)
        return Episode((stamps - origin) / NANOSECONDS, np.column_stack(scaled),
                       (changes - origin) / NANOSECONDS, u,
                       linear if any(linear) else ()).part(0, len(stamps))

    def _named(self, j: int, what: str) -> str:
        """Say of which state something is, where there are several."""
        return what if len(self.states) == 1 else f'{what} ({self.states[j].name})'

    def _leaps(self, x: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return where each state (N, n_x) has a spike, and where it jumps."""
        found = [spikes_and_jumps(x[:, j], least / self.scales[signal.place].factor)
                 for j, (signal, least) in enumerate(
                     zip(self.states, self.least_jumps, strict=True))]
        spikes, jumps = zip(*found, strict=True)
        return np.column_stack(spikes), np.column_stack(jumps)

    def _samples(self, run: _Run) -> _Samples:
        """Put measurements together by stamp; say of the others what they lack."""
        dropped, tolerance_ns = self.account.dropped, self.tolerance_ns
        heard = [run.entries[signal.place] for signal in self.states]
        stamped: list[list[_Stamped]] = [
            _first_of_each((stamp, log, value) for stamp, log, value in entries
                           if stamp is not None) for entries in heard]
        clock = _Clock.of(next(filter(None, stamped), []))
        parts = [_on(clock, entries) for entries in heard]
        for j, (entries, part) in enumerate(zip(heard, parts, strict=True)):
            dropped[self._named(j, 'measurement with a repeated stamp')] += (
                len(entries) - len(part))
        times = [np.array([stamp for stamp, _, _ in part], dtype=np.int64) for part in parts]
        base = min(times, key=len)
        rows = [_nearest(own, base) for own in times]
        whole = np.ones(len(base), dtype=bool)
        for own, row in zip(times, rows, strict=True):
            # each the nearest of the other, so that none is taken twice
            whole &= ((np.abs(own[row] - base) <= tolerance_ns)
                      & (_nearest(base, own)[row] == np.arange(len(base))))
        rows = [row[whole] for row in rows]
        usual = min((float(np.median(np.diff(own))) for own in times if len(own) > 1),
                    default=0.0)
        seconds = f'{tolerance_ns / NANOSECONDS:g} s'
        for j, own in enumerate(times):
            left = np.delete(own, rows[j])
            for other, signal in zip(times, self.states, strict=True):
                if other is own:
                    continue
                apart = (np.abs(other[_nearest(other, left)] - left).astype(np.float64)
                         if len(other) else np.full(len(left), np.inf))
                late = (apart > tolerance_ns) & (apart <= 0.5 * usual)
                dropped[f'measurement without {signal.name}'] += int(
                    np.sum((apart > tolerance_ns) & ~late))
                dropped[f'measurement with {signal.name} more than {seconds} apart'] += int(
                    np.sum(late))
                left = left[apart <= tolerance_ns]
            dropped[self._named(j, f'one of several within {seconds}')] += len(left)
        received: dict[int, int] = {}
        for at in zip(*(row.tolist() for row in rows), strict=True):
            found = [part[k] for part, k in zip(parts, at, strict=True)]
            latest = max(log for _, log, _ in found)
            received.update((stamp, latest) for stamp, _, _ in found)
        x = np.column_stack([np.array([value for _, _, value in part])[row]
                             if len(row) else np.empty(0)
                             for part, row in zip(parts, rows, strict=True)])
        return _Samples(base[whole], x, received, clock)

    def _commands(self, run: _Run, signal: RecordedInput, samples: _Samples, period: float
                  ) -> tuple[Times, Array]:
        """Return when which command began to act, in the signal's unit."""
        clock, received = samples.clock, samples.received
        times: dict[int, float] = {}
        for given, log, value in sorted(run.entries[signal.command], key=lambda entry: entry[1]):
            # without a stamp it acts on receipt, which plant time may have to be asked for
            stamp = given or clock.at(log)
            late = log - received[stamp] if clock.wall and stamp in received else 0
            # the last word counts
            times[stamp + (late if late > _NO_DELAY * period else 0)] = value
        order = sorted(times)
        changes = [t for i, t in enumerate(order) if i == 0 or times[t] != times[order[i - 1]]]
        values = np.array([times[t] for t in changes], dtype=np.float64)
        return (np.array(changes, dtype=np.int64) + round(signal.delay * NANOSECONDS),
                self.scales[signal.command](values))

    def _measured(self, run: _Run, signal: RecordedInput, clock: _Clock) -> tuple[Times, Array]:
        """Return when an input was measured, in the signal's unit."""
        if signal.measured is None:
            return np.empty(0, dtype=np.int64), np.empty(0)
        found = _on(clock, [(stamp or None, log, value)
                            for stamp, log, value in run.entries[signal.measured]])
        return (np.array([stamp for stamp, _, _ in found], dtype=np.int64),
                self.scales[signal.measured](np.array([value for _, _, value in found])))

    def _acting(self, name: str, commands: tuple[Times, Array], measured: tuple[Times, Array],
                stamps: Times, period: float) -> _Acting:
        """Return what acted while some measurements were taken."""
        usual = float(np.median(np.diff(measured[0]))) if len(measured[0]) > 1 else 0.0
        reach = _GAP_PERIODS * max(period, usual)
        near = (measured[0] >= stamps[0] - reach) & (measured[0] <= stamps[-1] + reach)
        times, values = measured[0][near], measured[1][near]
        if (len(times) < 2 or times[0] > stamps[0] + reach or times[-1] < stamps[-1] - reach
                or np.max(np.diff(times)) > reach):
            if len(measured[0]):
                self.notes.append(f'{os.fspath(self.bag)}: {name} was not measured throughout, '
                                  'and is taken from its command there')
            return *commands, False
        for held in (commands[1], np.clip(commands[1], values.min(), values.max())):
            if _at_once(commands[0], held, times, values):
                return commands[0], held, False
        self.notes.append(f'{os.fspath(self.bag)}: {name} is taken as it was measured')
        return times, values, True


def _places(signal: RecordedState | RecordedInput) -> list[Place]:
    """Return where a signal is."""
    if isinstance(signal, RecordedState):
        return [signal.place]
    return [signal.command] if signal.measured is None else [signal.command, signal.measured]


def _first_of_each(entries: Iterable[_Stamped]) -> list[_Stamped]:
    """Sort by stamp; of repeated stamps the first one received stays."""
    first: dict[int, _Stamped] = {}
    for entry in entries:
        first.setdefault(entry[0], entry)
    return [first[stamp] for stamp in sorted(first)]


def _on(clock: _Clock, entries: Iterable[_Entry]) -> list[_Stamped]:
    """Return the entries on a clock, sorted, each stamp once."""
    return _first_of_each((clock.at(log) if stamp is None else stamp, log, value)
                          for stamp, log, value in entries)


def _nearest(times: Times, wanted: Times) -> NDArray[np.int64]:
    """Return which of some rising times is nearest to each wanted one; -1 where there is none."""
    after = np.searchsorted(times, wanted)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(times) - 1)
    if not len(times):
        return np.full(len(wanted), -1)
    return np.where(wanted - times[before] <= times[after] - wanted, before, after)


def _span(acting: _Acting) -> tuple[float, float]:
    """Return from when to when it is known what acted."""
    times, _, linear = acting
    if not len(times):
        return math.inf, math.inf
    return times[0], times[-1] if linear else math.inf


def _at_once(times: Times, held: Array, stamps: Times, measured: Array) -> bool:
    """Tell whether an input is its command wherever it was measured, before or after a change."""
    known = stamps > times[0] if len(times) else np.zeros(len(stamps), dtype=bool)
    if not np.any(known):
        return False
    apart = np.min([np.abs(held[np.searchsorted(times, stamps[known], side=side) - 1]
                           - measured[known]) for side in ('left', 'right')], axis=0)
    return bool(np.sqrt(np.mean(apart ** 2)) <= _AT_ONCE * np.std(measured[known]))
