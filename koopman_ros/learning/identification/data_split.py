# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A record of some states, cut into segments that are fitted, chosen by and held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
import itertools

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.datasets import Array, cut, Episode, PlantDescription, sample_interval
from koopman_ros.learning.identification.drift import Drift, DriftModel, longest_step, Segments
from koopman_ros.learning.identification.identify import Identified, Score, segments_of, split
from koopman_ros.learning.identification.innovations_form import FilterRun, Predictor
from koopman_ros.learning.identification.output_error import output_error
from koopman_ros.learning.identification.total_variation import noise_level
from koopman_ros.learning.identification.weak_form import regress

_GROWTH = 2.0  # exponent by which roll-outs that judge an unstable plant may grow
_MEMORIES = 30.0  # slowest time constants of a simulation
_SHORTEST = 20  # samples of a segment, whatever grows


class SplitRecord:
    """
    The measurements of the first states of a plant, and their predictions.

    :param plant: names and units of the measured signals, and B where it is known.
    :param hidden: whether the plant has other states, which a filter finds after a while.
    :param offsets: whether the last inputs are constant disturbances of the episodes.
    :ivar late: dead times (n_u,) by which its inputs are later, in samples, where there are any.
    :raises ValueError: when the episodes are too short.
    """

    def __init__(self, plant: PlantDescription, episodes: Sequence[Episode], seed: int, *,
                 hidden: bool, offsets: bool = False) -> None:
        self.plant, self.episodes = plant, list(episodes)
        self._seed, self._hidden, self.offsets = seed, hidden, offsets
        self.late, self._unmoved = tuple[int, ...](), self
        signals = len(plant.state_names) + len(plant.input_names)
        # with the numbers of samples in place of measurements
        edges = np.cumsum([0, *map(len, episodes)]).tolist()
        self._numbered = [
            replace(episode, x=np.arange(*ends)[:, None])
            for episode, ends in zip(episodes, itertools.pairwise(edges), strict=True)]
        self._numbered_parts = segments_of(self._numbered, signals)
        self._measured = np.concatenate([episode.x for episode in episodes])
        self.parts = [replace(part, x=self._measured[_rows(part)])
                      for part in self._numbered_parts]
        # a filter that knows nothing at first knows more when an episode has lasted a while
        begins = {episode.time[0] for episode in episodes} if hidden else set()
        self._settled = [i for i, part in enumerate(self.parts) if part.time[0] not in begins]
        fit, choose, held_out = split(self.parts, seed)
        self.fit = fit  #: numbers of the segments to fit to
        #: those of the segments to choose by, and to hold out
        self.choose, self.held_out = (
            [i for i in share if i in self._settled] for share in (choose, held_out))
        if not (self.choose and self.held_out):
            raise ValueError('the episodes are too short for a filter to estimate unmeasured '
                             'states: record longer without gaps')
        self.step = longest_step(self.parts)  #: longest of a roll-out
        self._last: tuple[Predictor[Drift], FilterRun] | None = None
        #: usual time between samples
        self.period = sample_interval(self.parts)

    def later(self, late: Sequence[int]) -> SplitRecord:
        """Return the record as it was given, with its first inputs later by numbers of samples."""
        given = self._unmoved
        if not any(late):
            return given
        dead_time = np.zeros(len(self.plant.input_names))
        dead_time[:len(late)] = given.period * np.array(late)
        moved = SplitRecord(self.plant, [_moved(one, dead_time) for one in given.episodes],
                            self._seed, hidden=self._hidden, offsets=self.offsets)
        moved.late, moved._unmoved = tuple(late), given
        return moved

    def simulated(self, predictor: Predictor[Drift], samples: int | None = None,
                  parts: Sequence[int] | None = None) -> tuple[Segments, Array]:
        """
        Return segments, of the whole record by default, and where simulations of them start.

        :param samples: most of a piece, into which they are cut.
        :return: with the predicted states (M, n_x) of their first samples, in deviations.
        """
        pieces = self._numbered if parts is None else [self._numbered_parts[i] for i in parts]
        pieces = pieces if samples is None else cut(pieces, samples)
        return (Segments.of([replace(one, x=self._measured[_rows(one)]) for one in pieces],
                            self.step),
                self._run(predictor).foreseen[[int(one.x[0, 0]) for one in pieces]])

    def pieces(self, samples: int) -> Segments:
        """Return the whole record on grids, cut into pieces of a largest number of samples."""
        return Segments.of(cut(self.episodes, samples), self.step)

    def innovations(self, predictor: Predictor[Drift], parts: Sequence[int] | None = None
                    ) -> Array:
        """Return the innovations, (N, n_y), over segments, all that settled by default."""
        return self._run(predictor).innovations[self._rows_of(parts)]

    def estimates(self, predictor: Predictor[Drift]) -> Array:
        """Return the estimated states (N, n_x) over those that settled, in deviations."""
        return self._run(predictor).estimates[self._rows_of(None)]

    def identified(self, predictor: Predictor[Drift], method: str, scores: Sequence[Score],
                   monitor: Callable[..., bool]) -> Identified:
        """Return the result in the form of a record of all states."""
        drift, n_y = predictor.drift, predictor.gain.shape[1]
        hidden = drift.box.states.to_physical(self._run(predictor).estimates)[:, n_y:]
        known, held_out = (
            cut([replace(part, x=np.hstack([part.x, hidden[_rows(self._numbered_parts[i])]]))
                 for i, part in enumerate(self.parts) if i in share and i in self._settled],
                self.length(drift, _GROWTH))
            for share in ((*self.fit, *self.choose), self.held_out))
        linear = drift if isinstance(drift, DriftModel) and drift.degree == 1 else output_error(
            _linear(drift, known), Segments.of(known, self.step), monitor=monitor,
            learn_input_matrix=self.plant.B is None)
        return Identified(drift, method, linear, tuple(scores), noise_level(known, drift),
                          tuple(known), tuple(held_out), len(drift.box.states) - n_y)

    def _run(self, predictor: Predictor[Drift]) -> FilterRun:
        """Filter all episodes; the result of the last predictor is kept."""
        if self._last is None or self._last[0] is not predictor:
            self._last = predictor, predictor.run(self.episodes, self.step)
        return self._last[1]

    def _rows_of(self, parts: Sequence[int] | None) -> NDArray[np.int64]:
        return np.concatenate([_rows(self._numbered_parts[i])
                               for i in (self._settled if parts is None else parts)])

    def length(self, drift: Drift, growth: float) -> int:
        """Return samples over which roll-outs of a plant, be it unstable, grow e^growth-fold."""
        fastest = drift.growth_rate
        longest = max(len(part) for part in self.parts)
        if fastest * self.period * longest <= growth:
            return longest
        return max(_SHORTEST, int(growth / (fastest * self.period)))

    def memory(self, drift: Drift) -> int:
        """Return samples over which a plant forgets its start, or an unstable one goes far."""
        fastest = drift.growth_rate
        shortest = max(len(part) for part in self.parts)
        if fastest * self.period * shortest > _GROWTH:
            return self.length(drift, _GROWTH)
        longest = max(len(episode) for episode in self.episodes)
        return int(min(longest, max(shortest, _MEMORIES / max(-fastest * self.period, 1e-9))))


def _rows(numbered: Episode) -> NDArray[np.int64]:
    """Return the numbers of the samples (N,) of a part of the record."""
    return numbered.x[:, 0].astype(np.int64)


def _moved(episode: Episode, dead_time: Array) -> Episode:
    """Return an episode of the same length whose inputs act later, the first one before it."""
    begin = episode.input_time[0] - np.max(dead_time)
    late = replace(episode, input_time=np.append(begin, episode.input_time),
                   u=np.vstack((episode.u[:1], episode.u))).delayed(dead_time)
    assert late is not None
    return late


def _linear(drift: Drift, episodes: Sequence[Episode]) -> DriftModel:
    """Return the linear drift closest to another one over the states of episodes."""
    xi = drift.box.states.to_deviation(
        np.concatenate([episode.interpolated() for episode in episodes]))
    none = np.zeros((len(xi), len(drift.box.inputs)))
    B = drift.scaled_input_matrix(np.zeros(xi.shape[1]))
    first = DriftModel(drift.box, 1, np.empty(0), B)
    return regress(drift.box, 1, first.features(xi), none, drift.scaled_rate(xi, none), B)
