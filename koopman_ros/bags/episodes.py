# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A loop's measurements with the input that acted on them, cut from bags into episodes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
import os

import numpy as np
from numpy.typing import NDArray

from koopman_ros.arrays import Array
from koopman_ros.bags import acting, runs
from koopman_ros.bags.columns import Column, columns, NO_STAMP, Times
from koopman_ros.bags.limits import BagReadError
from koopman_ros.bags.reader import BagSummary, summary
from koopman_ros.bags.recorded import Account, Cuts, places_of, RecordedInput, RecordedState
from koopman_ros.bags.runs import Clock, Entries, Run
from koopman_ros.bags.samples import named, put_together, Samples
from koopman_ros.bags.series import check_places, spikes_and_jumps
from koopman_ros.plant_data import Episode
from koopman_ros.units import Conversion, conversion, NANOSECONDS
from koopman_ros.wire import Place

# A gap is longer than this many usual periods.
_GAP_PERIODS = 3.5
_SHORTEST = 10
# The plant's time, where it is simulated, and how far receipts may differ from it.
_CLOCK = Place('/clock', 'rosgraph_msgs/msg/Clock', 'clock.sec', 's')
_SAME_PACE = 0.02
_SAME_PACE_SECONDS = 1.0


def loop_episodes(bags: Sequence[str | os.PathLike[str]], states: Sequence[RecordedState],
                  inputs: Sequence[RecordedInput], *, tolerance_ns: int = 0,
                  least_jumps: Sequence[float] | None = None) -> tuple[list[Episode], Account]:
    """
    Return all episodes of some bags, see :func:`stream_episodes`, and what was made of the bags.

    :raises BagReadError: as it does.
    """
    account = Account()
    return list(stream_episodes(bags, states, inputs, account, tolerance_ns=tolerance_ns,
                                least_jumps=least_jumps)), account


def stream_episodes(bags: Sequence[str | os.PathLike[str]], states: Sequence[RecordedState],
                    inputs: Sequence[RecordedInput], account: Account, *, tolerance_ns: int = 0,
                    least_jumps: Sequence[float] | None = None) -> Iterator[Episode]:
    """
    Yield the episodes of some bags: times in s since the first measurement of each.

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

    Memory does not grow with the bags: of a long record some ten thousand measurements are
    put together at a time, at whose ends an episode ends, too.

    :param account: is added to as the episodes come.
    :param tolerance_ns: how far stamps of one sample of several states may lie apart.
    :param least_jumps: smallest change of each state, in its unit, that may be a spike or a jump;
        by default the record alone tells.
    :raises BagReadError: for a bag that cannot be read, lacks a topic, or has another type there,
        and for states without stamps whose receipts run at another pace than /clock in the bag.
    """
    for bag in distinct(bags, account):
        cuts = Cuts()
        content = summary(bag)
        loop = _Loop(bag, states, _recorded(bag, content, inputs, account), account, cuts,
                     tolerance_ns, least_jumps or [0.0] * len(states))
        check_places(bag, content, loop.scales)
        for run in loop.runs(content):
            if content.types.get(_CLOCK.topic) == _CLOCK.type and run.without_stamps():
                loop.refuse_other_clock()
            for episode in loop.episodes(run):
                account.used += len(states) * len(episode)
                yield episode
        account.notes += [*cuts.notes(os.fspath(bag)), *loop.notes]
    account.dropped = +account.dropped


def distinct(bags: Sequence[str | os.PathLike[str]], account: Account
             ) -> Iterator[str | os.PathLike[str]]:
    """Yield each bag once, however it is named."""
    read: set[str] = set()
    for bag in bags:
        if (path := os.path.realpath(bag)) in read:
            account.notes.append(f'{os.fspath(bag)} is named twice: read once')
            continue
        read.add(path)
        yield bag


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
class _Loop:
    """One bag with the signals of a loop."""

    bag: str | os.PathLike[str]
    states: Sequence[RecordedState]
    inputs: Sequence[RecordedInput]
    account: Account
    cuts: Cuts
    tolerance_ns: int
    least_jumps: Sequence[float]
    notes: dict[str, None] = field(default_factory=dict)  #: each once, in their order

    def __post_init__(self) -> None:
        signals: list[RecordedState | RecordedInput] = [*self.states, *self.inputs]
        self.scales: dict[Place, Conversion] = {}
        self._ranges: dict[Place, tuple[float, float]] = {}
        for signal in signals:
            for place in places_of(signal):
                try:
                    self._ranges[place] = place.range
                    self.scales[place] = conversion(place.unit, signal.unit)
                except ValueError as error:
                    raise BagReadError(f'topic {place.topic!r} of bag {os.fspath(self.bag)!r}: '
                                       f'{error}; name another topic') from error

    def runs(self, content: BagSummary) -> Iterator[Run]:
        """Yield what lies between resets of time, long ones in portions."""
        bag, account = os.fspath(self.bag), self.account
        if not content.complete:
            account.notes.append(f'{bag} was not closed or is damaged: read up to its last whole '
                                 'record')
        states = [signal.place for signal in self.states]
        left = sum(content.counts[topic] for topic in {place.topic for place in self.scales})
        size = runs.portion(max(content.counts[place.topic] for place in states))
        run = Run(states)
        for block in columns(self.bag, list(self.scales)):
            rows = [column.row for column in block.values()]
            left -= len(np.unique(np.concatenate(rows))) if rows else 0
            heard = {place: self._accepted(place, column) for place, column in block.items()}
            while (found := self._set_back(run, heard)) is not None:
                at, back_ns = found
                run.add({place: entries for place, (_, entries) in runs.by_place(heard, 0, at)})
                back = back_ns / NANOSECONDS
                self.cuts.add('set back', f'{back:.3f} s', back)
                yield run
                run = Run(states)
                heard = dict(runs.by_place(heard, at, np.iinfo(np.int64).max))
            run.add({place: entries for place, (_, entries) in heard.items()})
            while run.is_ready(size):
                yield run
                run = run.rest()
        if left:
            account.notes.append(f'{bag} is damaged: {left} messages that it counts could not be '
                                 'read')
        yield run

    def _accepted(self, place: Place, column: Column) -> tuple[NDArray[np.int64], Entries]:
        """Return the rows of a block with a number that can be, and these; count the others."""
        is_state = any(signal.place == place for signal in self.states)
        self.account.measurements += is_state * len(column.row)
        lowest, highest = self._ranges[place]
        good = runs.accepted(column, (lowest, highest))
        dropped = self.account.dropped
        dropped[f'without {place.field}'] += int(np.sum(~column.present))
        dropped[f'outside {lowest:g} to {highest:g} {place.unit}'] += int(
            np.sum(column.present & ~good))
        if np.any(column.stamp_ns[good] == NO_STAMP):
            self.notes[f'{os.fspath(self.bag)}: messages of {place.topic} ({place.type}) have no '
                       'stamp: their receipt counts'] = None
        return column.row[good], Entries(column.stamp_ns[good], column.log_ns[good],
                                         column.values[good])

    def refuse_other_clock(self) -> None:
        """Raise BagReadError where the times of receipt run differently from /clock in the bag."""
        begin: tuple[float, float] | None = None
        plant = receipt = 0.0
        nanosec = replace(_CLOCK, field='clock.nanosec')
        for block in columns(self.bag, [_CLOCK, nanosec]):
            if not block or not len(block[_CLOCK].values):
                continue
            now = block[_CLOCK].values + block[nanosec].values / NANOSECONDS
            log = block[_CLOCK].log_ns / NANOSECONDS
            begin = begin or (now[0], log[0])
            steps, logged = np.diff(now, prepend=begin[0]), np.diff(log, prepend=begin[1])
            # neither counts where a simulation was started again
            forward = (steps >= 0.0) & (logged >= 0.0)
            plant, receipt = (total + float(np.sum(part[forward])) for total, part in (
                (plant, steps), (receipt, logged)))
            begin = now[-1], log[-1]
        if abs(plant - receipt) > max(_SAME_PACE * receipt, _SAME_PACE_SECONDS):
            raise BagReadError(
                f'bag {os.fspath(self.bag)!r}: {self.states[0].name} has no stamps, and '
                f'{plant:.6g} s passed on /clock in {receipt:.6g} s of its receipts, which are no '
                "plant time: record with use_sim_time (that of the trainer, or 'ros2 bag record "
                "--use-sim-time'), or use a type with a header")

    def _set_back(self, run: Run, heard: Mapping[Place, tuple[NDArray[np.int64], Entries]]
                  ) -> tuple[int, int] | None:
        """Return the row of a block at which time was first set back, and by how many ns."""
        found = []
        for signal in self.states:
            rows, entries = heard.get(signal.place, (None, None))
            if rows is not None and entries is not None and (
                    back := run.set_back(signal.place, entries.stamp_ns)) is not None:
                found.append((int(rows[back[0]]), back[1]))
        return min(found, default=None)

    def episodes(self, run: Run) -> Iterator[Episode]:
        """Put one run together and cut it at its gaps and jumps."""
        dropped, n_x = self.account.dropped, len(self.states)
        clock = run.clock()
        samples = put_together(run, clock, self.states, self.tolerance_ns, dropped)
        stamps, x = samples.stamps, samples.x
        heard = all(any(len(run.of(place)) or place in run.acted for place in places_of(signal))
                    for signal in self.inputs)
        if len(stamps) < _SHORTEST or not heard:
            dropped['too short, or without any input'] += x.size
            return
        spike = self._leaps(x)[0]
        odd = spike.any(axis=1)
        for j in range(n_x):
            dropped[self._named(j, 'spike of a single sample')] += int(np.sum(spike[:, j]))
        dropped['beside a spike'] += n_x * int(np.sum(odd)) - int(np.sum(spike))
        stamps, x = stamps[~odd], x[~odd]
        period = float(np.median(np.diff(stamps)))
        ends = self._ends(stamps, x, period)
        recorded = [(self._commands(run, signal, samples, clock, period),
                     self._measured(run, signal, clock)) for signal in self.inputs]
        for rows in np.split(np.arange(len(stamps)), ends):
            times = stamps[rows]
            acted = [self._acting(signal.name, *both, times, period)
                     for signal, both in zip(self.inputs, recorded, strict=True)]
            known = times >= max(start for start, _ in map(acting.span, acted))
            within = times <= min(end for _, end in map(acting.span, acted))
            dropped['before the first input'] += n_x * int(np.sum(~known))
            dropped['after the last input'] += n_x * int(np.sum(~within))
            rows = rows[known & within]
            if len(rows) < _SHORTEST:
                dropped[f'in a segment of fewer than {_SHORTEST}'] += n_x * len(rows)
                continue
            yield self._episode(stamps[rows], x[rows], acted)

    def _ends(self, stamps: Times, x: Array, period: float) -> NDArray[np.int64]:
        """Return where episodes end, at gaps and jumps, and note these."""
        jump = self._leaps(x)[1]
        gap = np.diff(stamps, prepend=stamps[0]) > _GAP_PERIODS * period
        ends = np.flatnonzero(gap | jump.any(axis=1))
        for end in ends.tolist():
            at = f'at {stamps[end - 1] / NANOSECONDS:.3f} s'
            if gap[end]:
                seconds = (stamps[end] - stamps[end - 1]) / NANOSECONDS
                self.cuts.add('gap', f'{seconds:.3f} s {at}', seconds)
            else:
                j = int(np.argmax(jump[end]))
                level = self._named(j, f'{x[end, j]:.6g} {self.states[j].place.unit}')
                self.cuts.add('jump', f'{level} {at}', float(x[end, j]))
        return ends

    def _episode(self, stamps: Times, x: Array, acted: Sequence[acting.Acting]) -> Episode:
        """Put measurements and what acted on them together, in the signals' units."""
        origin = stamps[0]
        changes = np.unique(np.concatenate([times for times, _, _ in acted]))
        changes = changes[changes >= max(times[0] for times, _, _ in acted)]
        u = np.column_stack([
            np.interp(changes - origin, times - origin, values) if linear
            else values[np.searchsorted(times, changes, side='right') - 1]
            for times, values, linear in acted])
        scaled = [self.scales[signal.place](x[:, j]) for j, signal in enumerate(self.states)]
        linear = tuple(linear for _, _, linear in acted)
        return Episode((stamps - origin) / NANOSECONDS, np.column_stack(scaled),
                       (changes - origin) / NANOSECONDS, u,
                       linear if any(linear) else ()).part(0, len(stamps))

    def _named(self, j: int, what: str) -> str:
        return named(self.states, self.states[j], what)

    def _leaps(self, x: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return where each state (N, n_x) has a spike, and where it jumps."""
        found = [spikes_and_jumps(x[:, j], least / self.scales[signal.place].factor)
                 for j, (signal, least) in enumerate(
                     zip(self.states, self.least_jumps, strict=True))]
        spikes, jumps = zip(*found, strict=True)
        return np.column_stack(spikes), np.column_stack(jumps)

    def _commands(self, run: Run, signal: RecordedInput, samples: Samples, clock: Clock,
                  period: float) -> tuple[Times, Array]:
        """Return when which command began to act, in the signal's unit."""
        times, values = acting.commanded(run.of(signal.command), clock, samples.received, period)
        if signal.command in run.acted:
            # the last word counts, of this portion
            earlier = run.acted[signal.command]
            times, values = acting.last_words(np.concatenate((earlier[0], times)),
                                              np.concatenate((earlier[1], values)))
        delay_ns = round(signal.delay * NANOSECONDS)
        if run.until_ns is not None:
            first = max(0, int(np.searchsorted(times, run.until_ns - delay_ns, side='right')) - 1)
            run.acted[signal.command] = times[first:], values[first:]
        times, values = acting.changes(times, values)
        return times + delay_ns, self.scales[signal.command](values)

    def _measured(self, run: Run, signal: RecordedInput, clock: Clock) -> tuple[Times, Array]:
        """Return when an input was measured, in the signal's unit."""
        if signal.measured is None:
            return np.empty(0, dtype=np.int64), np.empty(0)
        found = clock.on(run.of(signal.measured), 0).first_of_each()
        return found.stamp_ns, self.scales[signal.measured](found.values)

    def _acting(self, name: str, commands: tuple[Times, Array], measured: tuple[Times, Array],
                stamps: Times, period: float) -> acting.Acting:
        """Return what acted while some measurements were taken."""
        usual = float(np.median(np.diff(measured[0]))) if len(measured[0]) > 1 else 0.0
        reach = _GAP_PERIODS * max(period, usual)
        near = (measured[0] >= stamps[0] - reach) & (measured[0] <= stamps[-1] + reach)
        times, values = measured[0][near], measured[1][near]
        if (len(times) < 2 or times[0] > stamps[0] + reach or times[-1] < stamps[-1] - reach
                or np.max(np.diff(times)) > reach):
            if len(measured[0]):
                self._note(f'{name} was not measured throughout, and is taken from its command '
                           'there')
            return *acting.around(*commands, stamps), False
        for held in (commands[1], np.clip(commands[1], values.min(), values.max())):
            if acting.at_once(commands[0], held, times, values):
                return *acting.around(commands[0], held, stamps), False
        self._note(f'{name} is taken as it was measured')
        return times, values, True

    def _note(self, words: str) -> None:
        self.notes[f'{os.fspath(self.bag)}: {words}'] = None
