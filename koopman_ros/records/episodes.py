# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A loop's measurements with the input that acted on them, cut from bags into episodes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math
import os

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import Conversion, conversion, NANOSECONDS
from koopman_ros.records import applied_inputs, segments
from koopman_ros.records.align import align_by_timestamp, AlignedSamples
from koopman_ros.records.applied_inputs import Applied
from koopman_ros.records.cutter import EpisodeCutter
from koopman_ros.records.decoding import BagMessage
from koopman_ros.records.import_spec import ImportReport, places_of, RecordedInput, RecordedState
from koopman_ros.records.mcap_file import BagReadError
from koopman_ros.records.reader import BagSummary, read_messages, summary
from koopman_ros.records.segments import Clock, NO_STAMP, Segment, Times
from koopman_ros.records.series import check_places, stamped_number

# An input without commands that mostly keeps its value from sample to sample moves in steps.
_AT_REST = 0.5
_CHECKED = 1000  # messages between two looks for a complete portion
# The plant's time, where it is simulated, and how far receipts may differ from it.
_CLOCK, _CLOCK_TYPE = '/clock', 'rosgraph_msgs/msg/Clock'
_SAME_PACE = 0.02
_SAME_PACE_SECONDS = 1.0


def stream_episodes(bags: Sequence[str | os.PathLike[str]], states: Sequence[RecordedState],
                    inputs: Sequence[RecordedInput], account: ImportReport, *,
                    tolerance_ns: int = 0,
                    least_jumps: Sequence[float] | None = None) -> Iterator[Episode]:
    """
    Yield the episodes of some bags: times in s since the first measurement of each.

    Nothing is resampled: the nearest stamps of the other states are put to each stamp of the one
    that is measured least; types without a stamp count at receipt.

    An input that was measured throughout an episode is linear between its measurements. Where it
    was not, or where it is no more than its command within the range that it reaches, it is held
    from the time on at which it was commanded. Without commands in the bag it is linear, or held
    if it mostly keeps its value. A command that answers a measurement carries its stamp; where
    the stamps are those of the wall clock, it acts later by the time between the two receipts. A
    command without a stamp acts when it is received.

    Episodes end at gaps, where time is set back, and where a state jumps to another level. A bag
    that was not closed or is damaged is read as far as it goes. Memory does not grow with the
    bags: of a long record some ten thousand measurements are put together at a time, at whose ends
    an episode ends, too.

    :param account: is added to as the episodes come.
    :param tolerance_ns: how far stamps of one sample of several states may lie apart.
    :param least_jumps: smallest change of each state, in its unit, that may be a spike or a jump;
        by default the one in the record.
    :raises BagReadError: for a bag that cannot be read, lacks a topic, or has another type there,
        and for states without stamps whose receipts run at another pace than /clock in the bag.
    """
    for bag in distinct(bags, account):
        imported = _BagImport(os.fspath(bag), states, inputs, account, tolerance_ns,
                              least_jumps or ())
        for segment in imported.segments():
            yield from imported.episodes(segment)
        imported.cutter.note_breaks()
    account.dropped = +account.dropped


def distinct(bags: Sequence[str | os.PathLike[str]], account: ImportReport
             ) -> Iterator[str | os.PathLike[str]]:
    """Yield each bag once, however it is named."""
    read: set[str] = set()
    for bag in bags:
        if (path := os.path.realpath(bag)) in read:
            account.note(f'{os.fspath(bag)} is listed twice: read once')
            continue
        read.add(path)
        yield bag


@dataclass
class _BagImport:
    """The import of one bag: its signals aligned, and cut into episodes."""

    bag: str
    states: Sequence[RecordedState]
    inputs: Sequence[RecordedInput]
    account: ImportReport
    tolerance_ns: int
    least_jumps: Sequence[float]

    def __post_init__(self) -> None:
        self.cutter = EpisodeCutter(
            self.bag, [state.name for state in self.states], [one.unit for one in self.states],
            self.account, NANOSECONDS, self.least_jumps)
        self.content: BagSummary = summary(self.bag)
        self.inputs = [self._without_missing(signal) for signal in self.inputs]
        #: conversions to the units of the signals, by place, those of the states first
        self.scales: dict[MessageField, Conversion] = {}
        self._ranges: dict[MessageField, tuple[float, float]] = {}
        signals: list[RecordedState | RecordedInput] = [*self.states, *self.inputs]
        for signal in signals:
            for place in places_of(signal):
                try:
                    self.scales[place] = conversion(place.unit, signal.unit)
                    self._ranges[place] = place.range
                except ValueError as error:
                    raise BagReadError(f'topic {place.topic!r} of bag {self.bag!r}: {error}; '
                                       'name another topic') from error
        check_places(self.bag, self.content, self.scales)

    def _without_missing(self, signal: RecordedInput) -> RecordedInput:
        """Return an input without its measurements or its commands if the bag lacks them."""
        if signal.measured is None or signal.command is None:
            return signal
        lacks = [found.topic not in self.content.types
                 for found in (signal.measured, signal.command)]
        if lacks == [True, False]:
            self.account.note(f'{self.bag} has no topic {signal.measured.topic!r}: the command is '
                              f'used as the applied {signal.name}')
            return replace(signal, measured=None)
        if lacks == [False, True]:
            self.account.note(f'{self.bag} has no topic {signal.command.topic!r}: {signal.name} '
                              'is taken from its measurements')
            return replace(signal, command=None)
        return signal

    def segments(self) -> Iterator[Segment]:
        """Yield the numbers between resets of time, long ones in portions."""
        if not self.content.complete:
            self.account.note(f'{self.bag} was not closed or is damaged: read up to the last '
                              'complete record')
        counts, n_x = self.content.counts, len({signal.place for signal in self.states})
        places = list(self.scales)
        topics: dict[str, list[tuple[int, MessageField, tuple[float, float]]]] = {}
        for number, place in enumerate(places):
            topics.setdefault(place.topic, []).append((number, place, self._ranges[place]))
        size = segments.portion(max(counts[place.topic] for place in places[:n_x]))
        segment, read = Segment(places, n_x), 0
        for message in read_messages(self.bag, topics, recover=True):
            read += 1
            for number, place, limits in topics[message.topic]:
                self.account.measurements += number < n_x
                if (accepted := self._accepted(message, place, *limits)) is None:
                    continue
                stamp_ns, value = accepted
                if back_ns := segment.set_back(number, stamp_ns):
                    back = back_ns / NANOSECONDS
                    self.cutter.breaks['time was set back by'].append((back, f'{back:.3f} s'))
                    yield segment
                    segment = Segment(places, n_x)
                segment.add(number, stamp_ns, message.log_time_ns, value)
            while read % _CHECKED == 0 and segment.is_complete(size):
                yield segment
                segment = segment.following()
        if left := sum(counts[topic] for topic in topics) - read:
            self.account.note(f'{self.bag} is damaged: {left} of its messages could not be read')
        yield segment

    def _accepted(self, message: BagMessage, place: MessageField, lowest: float, highest: float
                  ) -> tuple[int, float] | None:
        """Return stamp [ns] and number at a place; None, counted, for no valid number."""
        stamp_ns, value = stamped_number(self.bag, message, place)
        if value is None:
            self.account.dropped[f'without {place.field}'] += 1
            return None
        if not (lowest <= value <= highest and math.isfinite(value)):
            self.account.dropped[f'outside {lowest:g} to {highest:g} {place.unit}'] += 1
            return None
        if stamp_ns is None:
            self.account.note(f'{self.bag}: messages of {place.topic} ({place.type}) have no '
                              'stamp: the time of receipt is used')
            return NO_STAMP, value
        return stamp_ns, value

    def _check_pace(self, segment: Segment) -> None:
        """Raise BagReadError where receipts count that run differently from /clock in the bag."""
        if self.content.types.get(_CLOCK) != _CLOCK_TYPE or not segment.without_stamps():
            return
        times = np.fromiter((
            (message.message.clock.sec + message.message.clock.nanosec / NANOSECONDS,
             message.log_time_ns / NANOSECONDS)
            for message in read_messages(self.bag, [_CLOCK], recover=True)), np.dtype((float, 2)))
        steps = np.diff(times, axis=0)
        # without those of a simulation that was started again
        plant, receipt = np.sum(steps[np.all(steps >= 0.0, axis=1)], axis=0).tolist()
        if abs(plant - receipt) > max(_SAME_PACE * receipt, _SAME_PACE_SECONDS):
            raise BagReadError(
                f'bag {self.bag!r}: {self.states[0].name} has no stamps, and its times of receipt '
                f'are not plant time ({plant:.6g} s on /clock in {receipt:.6g} s): record with '
                "use_sim_time (of the trainer, or 'ros2 bag record --use-sim-time'), or use a "
                'message type with a header')

    def episodes(self, segment: Segment) -> Iterator[Episode]:
        """Align one segment and cut it at its gaps and jumps."""
        self._check_pace(segment)
        clock = segment.clock()
        samples = align_by_timestamp(segment, clock, self.states, self.tolerance_ns,
                                     self.account.dropped)
        x = np.column_stack([self.scales[signal.place](samples.x[:, j])
                             for j, signal in enumerate(self.states)])
        if not all(any(len(segment.of(place)) or place in segment.applied
                       for place in places_of(signal)) for signal in self.inputs):
            self.cutter.drop('without any input', x)
            return
        recorded: list[tuple[tuple[Times, Array], tuple[Times, Array]]] = []

        def inputs(times: Times, period: float) -> list[Applied]:
            if not recorded:
                recorded.extend((self._commands(segment, signal, samples, clock, period),
                                 self._measured(segment, signal, clock)) for signal in self.inputs)
            return [self._applied(signal.name, *both, times, period)
                    for signal, both in zip(self.inputs, recorded, strict=True)]

        yield from self.cutter.cut(samples.stamps, x, inputs)

    def _commands(self, segment: Segment, signal: RecordedInput, samples: AlignedSamples,
                  clock: Clock, period: float) -> tuple[Times, Array]:
        """Return the times at which commands began to act, and these, in the signal's unit."""
        if signal.command is None:
            return np.empty(0, dtype=np.int64), np.empty(0)
        times, values = applied_inputs.commanded(segment.of(signal.command), clock,
                                                 samples.received, period)
        if signal.command in segment.applied:
            # of one time that of this portion counts
            earlier = segment.applied[signal.command]
            times, values = applied_inputs.last_per_timestamp(
                np.concatenate((earlier[0], times)), np.concatenate((earlier[1], values)))
        delay_ns = round(signal.delay * NANOSECONDS)
        if segment.until_ns is not None:
            end = segment.until_ns - delay_ns
            first = max(0, int(np.searchsorted(times, end, side='right')) - 1)
            segment.applied[signal.command] = times[first:], values[first:]
        times, values = applied_inputs.changes(times, values)
        return times + delay_ns, self.scales[signal.command](values)

    def _measured(self, segment: Segment, signal: RecordedInput, clock: Clock
                  ) -> tuple[Times, Array]:
        """Return times and values of a measured input, in the signal's unit."""
        if signal.measured is None:
            return np.empty(0, dtype=np.int64), np.empty(0)
        found = clock.on(segment.of(signal.measured), 0).first_of_each()
        return found.stamp_ns, self.scales[signal.measured](found.values)

    def _applied(self, name: str, commands: tuple[Times, Array], measured: tuple[Times, Array],
                 stamps: Times, period: float) -> Applied:
        """Return the applied input over the time of some measurements."""
        usual = float(np.median(np.diff(measured[0]))) if len(measured[0]) > 1 else 0.0
        reach = self.cutter.rules.gap_periods * max(period, usual)
        near = (measured[0] >= stamps[0] - reach) & (measured[0] <= stamps[-1] + reach)
        times, values = measured[0][near], measured[1][near]
        if (len(times) < 2 or times[0] > stamps[0] + reach or times[-1] < stamps[-1] - reach
                or np.max(np.diff(times)) > reach):
            if len(measured[0]):
                self.account.note(f'{self.bag}: {name} was not always measured: the command is '
                                  'used in between' if len(commands[0]) else
                                  f'{self.bag}: {name} was not always measured, and has no '
                                  'commands')
            return *applied_inputs.around(*commands, stamps), False
        for held in (commands[1], np.clip(commands[1], values.min(), values.max())):
            if applied_inputs.follows_command(commands[0], held, times, values):
                return *applied_inputs.around(commands[0], held, stamps), False
        if not len(commands[0]) and np.mean(values[1:] == values[:-1]) > _AT_REST:
            return *applied_inputs.changes(times, values), False
        self.account.note(f'{self.bag}: {name} is the measured applied input')
        return times, values, True
