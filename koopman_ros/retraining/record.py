# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Reading of bags for a retraining, of a long record in memory that does not grow with it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any, Protocol

import numpy as np

from koopman_ros.bags import (
    Account,
    loop_episodes,
    RecordedInput,
    RecordedState,
    stream_episodes,
    summary,
)
from koopman_ros.bags.episodes import distinct
from koopman_ros.plant_data import Episode
from koopman_ros.retraining.selection import SEGMENT, Selection, Survey

# Segments of a record with states that are not measured are longer by this: a filter has to find
# these first.
_LONGER = 4

# Called with the samples that were read; it may raise to end the reading.
Tick = Callable[[int], None]


class Each(Protocol):
    """Calls a function for each of some bags, as `map` does, here or in other processes."""

    def __call__(self, function: Callable[[Any], Any], bags: Iterable[Any], /) -> Iterable[Any]:
        """Return the results in the order of the bags."""


@dataclass(frozen=True)
class Source:
    """Bags, and what is looked for in them."""

    bags: tuple[str, ...]
    states: Sequence[RecordedState]
    inputs: Sequence[RecordedInput]
    tolerance_ns: int
    least_jumps: Sequence[float] | None

    def size(self) -> int:
        """Return about how many samples there are, as the bags count their messages."""
        contents = [summary(bag).counts for bag in distinct(self.bags, Account())]
        return min(sum(counts.get(state.place.topic, 0) for counts in contents)
                   for state in self.states)


@dataclass(frozen=True)
class Reduction:
    """What of a long record was learned from."""

    samples: int  #: in the record
    group: int  #: samples that were averaged, 1 for none
    segments: int  #: of the record
    chosen: int  #: segments that were learned from, or judged by
    used: int  #: samples in these

    def text(self) -> str:
        """Say it in words."""
        means = (f'means of {self.group} samples each, over which the motion is straight but for '
                 'the noise, ' if self.group > 1 else '')
        return (f'a long record: {means}{self.chosen} of {self.segments} segments are learned '
                f'from and judged by ({self.used} of {self.samples} samples), drawn so that they '
                'visit the cells of the range evenly')


@dataclass(frozen=True)
class Record:
    """Episodes to learn from and to judge by."""

    episodes: list[Episode]
    account: Account
    reduction: Reduction | None = None  #: None where they are all that there are


def read_record(source: Source, most: int, seed: int, *, hidden: bool = False,
                tick: Tick | None = None, each: Each = map) -> Record:
    """
    Read the episodes of some bags: all of them, or what stands for them where they are many.

    A record of more than `most` samples is read twice. The first reading tells its range, and
    over how many samples the motion is a straight line but for the noise: so many are averaged,
    which loses nothing. The second one chooses segments, see :class:`Selection`.

    :param hidden: whether states are to be found that are not measured.
    :param each: calls a function for each bag; other processes may do that.
    :raises BagReadError: for bags that cannot be used.
    """
    if source.size() <= most:
        return Record(*loop_episodes(source.bags, source.states, source.inputs,
                                     tolerance_ns=source.tolerance_ns,
                                     least_jumps=source.least_jumps))
    account = Account()
    bags = list(enumerate(distinct(source.bags, account)))
    n_x, n_u = len(source.states), len(source.inputs)
    call: dict[str, Any] = {} if tick is None or each is not map else {'tick': tick}
    survey = Survey.empty(n_x, n_u)
    for part, own in each(partial(_surveyed, source, **call), bags):
        survey = survey.merged(part)
        account.add(own)
    if not survey.count:
        return Record([], account)
    start = Selection(survey.lower, survey.upper, survey.group(most), most,
                      SEGMENT * (_LONGER if hidden else 1))
    found = reduce(Selection.merged, each(partial(_selected, source, start, seed, **call), bags))
    episodes = found.episodes()
    return Record(episodes, account, Reduction(
        survey.count, start.group, found.offered, len(episodes),
        start.group * sum(map(len, episodes))))


def _untold(_: int) -> None:
    """Tell nobody."""


def _streamed(source: Source, bag: str, account: Account, tick: Tick) -> Iterable[Episode]:
    for episode in stream_episodes([bag], source.states, source.inputs, account,
                                   tolerance_ns=source.tolerance_ns,
                                   least_jumps=source.least_jumps):
        tick(len(episode))
        yield episode


def _surveyed(source: Source, numbered: tuple[int, str], tick: Tick = _untold
              ) -> tuple[Survey, Account]:
    """Look through one bag."""
    account, survey = Account(), Survey.empty(len(source.states), len(source.inputs))
    for episode in _streamed(source, numbered[1], account, tick):
        survey.add(episode)
    return survey, account


def _selected(source: Source, start: Selection, seed: int, numbered: tuple[int, str],
              tick: Tick = _untold) -> Selection:
    """Choose segments of one bag."""
    number, bag = numbered
    rng = np.random.default_rng([seed, number])
    selection = start.empty()
    for episode in _streamed(source, bag, Account(), tick):
        selection.offer(number, episode, rng)
    return selection
