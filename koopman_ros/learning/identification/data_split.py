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
    :raises ValueError: when the episodes are too short.
    """

    def __init__(self, plant: PlantDescription, episodes: Sequence[Episode], seed: int, *,
                 hidden: bool
                 ) -> None:
        self.plant, self.episodes = plant, list(episodes)
        self._seed, self._hidden = seed, hidden
        signals = len(plant.state_names) + len(plant.input_names)
        self.parts = segments_of(episodes, signals)
        # which samples of all episodes each of them holds
        edges = np.cumsum([0, *map(len, episodes)]).tolist()
        self._numbered = [
            replace(episode, x=np.arange(*ends, dtype=np.float64)[:, None])
            for episode, ends in zip(episodes, itertools.pairwise(edges), strict=True)]
        self._rows = [part.x[:, 0].astype(int) for part in segments_of(self._numbered, signals)]
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
        """Return the record with its first inputs later by numbers of samples."""
        if not any(late):
            return self
        dead_time = np.zeros(len(self.plant.input_names))
        dead_time[:len(late)] = self.period * np.array(late)
        return SplitRecord(self.plant, [_moved(one, dead_time) for one in self.episodes],
                           self._seed, hidden=self._hidden)

    def segments(self, parts: Sequence[int], samples: int | None = None) -> Segments:
        """Return some segments on grids, cut into pieces of a largest number of samples."""
        return Segments.of(self._pieces([self.parts[i] for i in parts], samples), self.step)

    def foreseen(self, predictor: Predictor[Drift], parts: Sequence[int],
                 samples: int | None = None) -> Array:
        """Return the predicted states (M, n_x) of the first samples of these, in deviations."""
        run = self._run(predictor)
        pieces = self._pieces([replace(self.parts[i], x=self._rows[i][:, None].astype(float))
                               for i in parts], samples)
        return run.foreseen[[int(piece.x[0, 0]) for piece in pieces]]

    def simulated(self, predictor: Predictor[Drift], samples: int) -> tuple[Segments, Array]:
        """
        Return the whole record in pieces with at most a number of samples, for simulations.

        With them the predicted states (M, n_x) of their first samples, in deviations.
        """
        rows = [int(piece.x[0, 0]) for piece in cut(self._numbered, samples)]
        return self.pieces(samples), self._run(predictor).foreseen[rows]

    def pieces(self, samples: int) -> Segments:
        """Return the whole record on grids, cut into pieces of a largest number of samples."""
        return Segments.of(cut(self.episodes, samples), self.step)

    def innovations(self, predictor: Predictor[Drift], parts: Sequence[int] | None = None
                    ) -> Array:
        """Return the innovations, (N, n_y), over segments, all that settled by default."""
        return self._run(predictor).innovations[self._rows_of(parts)]

    def estimates(self, predictor: Predictor[Drift], parts: Sequence[int] | None = None) -> Array:
        """Return the estimated states (N, n_x) there, in deviations."""
        return self._run(predictor).estimates[self._rows_of(parts)]

    def identified(self, predictor: Predictor[Drift], method: str, scores: Sequence[Score],
                   monitor: Callable[..., bool]) -> Identified:
        """Return the result in the form of a record of all states."""
        drift, n_y = predictor.drift, predictor.gain.shape[1]
        hidden = drift.box.states.to_physical(self._run(predictor).estimates)[:, n_y:]
        known, held_out = (
            cut([replace(part, x=np.hstack([part.x, hidden[self._rows[i]]]))
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
        return np.concatenate([
            self._rows[i] for i in (self._settled if parts is None else parts)])

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

    @staticmethod
    def _pieces(episodes: list[Episode], samples: int | None) -> list[Episode]:
        return episodes if samples is None else cut(episodes, samples)


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
