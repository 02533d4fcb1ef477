# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Reading of a record for a retraining; of long bags in memory that does not grow with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import contextlib
from dataclasses import dataclass
from functools import reduce
from typing import Any, TypeAlias

import numpy as np

from koopman_ros.core.datasets import Episode
from koopman_ros.execution import Backend, Notify, Serial
from koopman_ros.learning.downsampling import RecordStatistics, SEGMENT, Selection
from koopman_ros.records import (
    ImportReport,
    Record,
    RecordedInput,
    RecordedState,
    stream_episodes,
    summary,
)
from koopman_ros.records.episodes import distinct

# Segments of a record with states that are not measured are longer by this: a filter has to find
# these first.
_LONGER = 4

_Numbered: TypeAlias = tuple[int, str]  # a bag, with its number in the record
# Called with the samples that were read; it may raise to end the reading.
Tick = Callable[[int], None]
_Reader = Callable[[Any, _Numbered, Notify], Any]


@dataclass(frozen=True)
class RecordSource:
    """Bags, and the signals to read from them."""

    bags: tuple[str, ...]
    states: Sequence[RecordedState]
    inputs: Sequence[RecordedInput]
    tolerance_ns: int
    least_jumps: Sequence[float] | None

    def size(self) -> int:
        """Return about how many samples there are, as the bags count their messages."""
        contents = [summary(bag).counts for bag in distinct(self.bags, ImportReport())]
        return min(sum(counts.get(state.place.topic, 0) for counts in contents)
                   for state in self.states)


@dataclass(frozen=True)
class Reduction:
    """The part of a long record that is used."""

    samples: int  #: in the record
    group: int  #: samples that were averaged, 1 for none
    segments: int  #: of the record
    chosen: int  #: segments that were learned from, or judged by
    used: int  #: samples in these

    def text(self) -> str:
        """Say it in words."""
        means = (f'means of {self.group} samples each, over which the motion is linear except for '
                 'noise, ' if self.group > 1 else '')
        return (f'a long record: {means}{self.chosen} of {self.segments} segments are used '
                f'({self.used} of {self.samples} samples), selected to cover the range evenly')


@dataclass(frozen=True)
class TrainingRecord:
    """Episodes to learn from and to judge by."""

    episodes: list[Episode]
    account: ImportReport
    reduction: Reduction | None = None  #: None where they are all that there are


def read_record(source: RecordSource, most: int, seed: int, *, hidden: bool = False,
                tick: Tick = lambda _: None, backend: Backend | None = None) -> TrainingRecord:
    """
    Read the episodes of some bags: all of them, or a selection where they are many.

    A record of more than `most` samples is read twice. The first reading finds its range, and over
    how many samples the motion is linear except for noise: these are averaged, which loses
    nothing. The second one chooses segments, see :class:`Selection`.

    :param hidden: whether states are to be found that are not measured.
    :param tick: called with the samples of a long record as they are read.
    :param backend: where long records are read, a bag a task; this process by default.
    :raises BagReadError: for bags that cannot be used.
    """
    account = ImportReport()
    if source.size() <= most:
        return TrainingRecord(list(stream_episodes(
            source.bags, source.states, source.inputs, account, tolerance_ns=source.tolerance_ns,
            least_jumps=source.least_jumps)), account)
    bags = {str(bag): (number, str(bag))
            for number, bag in enumerate(distinct(source.bags, account))}

    def each(function: _Reader, given: Any) -> Iterator[Any]:
        done, under_way = 0, dict.fromkeys(bags, 0)

        def watch(name: str, read: int | None) -> bool:
            nonlocal done
            if read is not None:
                under_way[name] = read
            # a bag that is read again counts from where it was
            now = max(done, sum(under_way.values()))
            tick(now - done)
            done = now
            return False

        with contextlib.closing((backend or Serial()).run(
                function, bags, shared=given, watch=watch)) as results:
            for _, result in results:
                yield result

    survey = RecordStatistics.empty(len(source.states), len(source.inputs))
    for part, own in each(_surveyed, source):
        survey = survey.merged(part)
        account.add(own)
    if not survey.count:
        return TrainingRecord([], account)
    found = reduce(Selection.merged, each(_selected, (
        source, _selection(survey, most, hidden), seed)))
    return _chosen(survey, found, account)


def reduced(record: Record, most: int, seed: int, *, hidden: bool = False) -> TrainingRecord:
    """Return the episodes of a record in memory, selected as by :func:`read_record`."""
    episodes, about = list(record.episodes), record.plant
    if sum(map(len, episodes)) <= most:
        return TrainingRecord(episodes, record.report)
    survey = RecordStatistics.empty(len(about.state_names), len(about.input_names))
    for episode in episodes:
        survey.add(episode)
    selection = _selection(survey, most, hidden)
    rng = np.random.default_rng([seed, 0])
    for episode in episodes:
        selection.offer(0, episode, rng)
    return _chosen(survey, selection, record.report)


def _selection(survey: RecordStatistics, most: int, hidden: bool) -> Selection:
    return Selection(survey.lower, survey.upper, survey.group(most), most,
                     SEGMENT * (_LONGER if hidden else 1))


def _chosen(survey: RecordStatistics, found: Selection, account: ImportReport) -> TrainingRecord:
    episodes = found.episodes()
    return TrainingRecord(episodes, account, Reduction(
        survey.count, found.group, found.offered, len(episodes),
        found.group * sum(map(len, episodes))))


def _streamed(source: RecordSource, bag: str, account: ImportReport, notify: Notify
              ) -> Iterator[Episode]:
    """Yield the episodes of a bag, and report the samples so far."""
    read = 0
    for episode in stream_episodes([bag], source.states, source.inputs, account,
                                   tolerance_ns=source.tolerance_ns,
                                   least_jumps=source.least_jumps):
        read += len(episode)
        notify(read)
        yield episode


def _surveyed(source: RecordSource, numbered: _Numbered, notify: Notify
              ) -> tuple[RecordStatistics, ImportReport]:
    account = ImportReport()
    survey = RecordStatistics.empty(len(source.states), len(source.inputs))
    for episode in _streamed(source, numbered[1], account, notify):
        survey.add(episode)
    return survey, account


def _selected(given: tuple[RecordSource, Selection, int], numbered: _Numbered, notify: Notify
              ) -> Selection:
    (source, start, seed), (number, bag) = given, numbered
    rng = np.random.default_rng([seed, number])
    selection = start.empty()
    for episode in _streamed(source, bag, ImportReport(), notify):
        selection.offer(number, episode, rng)
    return selection
