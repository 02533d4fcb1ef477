# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drift of a plant some of whose states were never measured, in coordinates found with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import itertools

import numpy as np

from koopman_ros.identification.drift import DriftModel, longest_step, Segments
from koopman_ros.identification.identify import (
    Identified,
    Score,
    segments_of,
    split,
    Stopped,
    Watch,
)
from koopman_ros.identification.innovations import Predictor, raised, SETTLING, standardised
from koopman_ros.identification.output_error import innovations_form, output_error
from koopman_ros.identification.regression import noise_level, regress
from koopman_ros.lifting import Box
from koopman_ros.plant_data import Array, cut, Episode, Plant

METHOD = 'innovations form'
HIGHEST_DEGREE = 3
UNIT = '1'  # of a state that is not measured: any other scale would do as well
# Gains of filters to begin with, of outputs, of their rates and of what moves these, over powers
# of the interval between samples (alpha, beta and gamma of tracking filters).
_GAINS = ((0.5, 0.1, 0.01), (0.2, 0.02, 0.001), (0.8, 0.4, 0.1))
_SAMPLES = 20  # between samples, in which rates are counted at first
# A larger model must err less by so many standard errors of the difference.
_SIGMAS = 2.0
# Roll-outs of an unstable plant grow by at most this exponent.
_GROWTH, _SHORTEST = 2.0, 20


@dataclass(frozen=True)
class _Candidate:
    """A predictor, and how it foresees the segments to choose by."""

    predictor: Predictor
    hidden: int
    innovations: Array  #: (N, n_y) there, in deviations

    @property
    def degree(self) -> int:
        return self.predictor.drift.degree

    @property
    def method(self) -> str:
        count = self.hidden
        return f'{METHOD}, {count} {"state" if count == 1 else "states"} not measured'


def identify_hidden(plant: Plant, episodes: Sequence[Episode], hidden: int, *,
                    highest_degree: int = HIGHEST_DEGREE, seed: int = 0,
                    watch: Watch = lambda *_: False) -> Identified:
    """
    Estimate dx/dt = f(x) + B u where only the first n_y states are in the record.

    A polynomial drift, a filter's gain and the starts of all segments are refined until the next
    measurement is foreseen, see :func:`innovations_form`; first linear models, from filters that
    know nothing of the plant, then models of higher degree from those below. Of all numbers of
    states that are not measured and all degrees the smallest model is taken that foresees
    segments held out for the choice about as well as the best, and fitted to these, too. States
    that are not measured are what the filter makes of them: of the unit 1, from -1 to 1, and
    uncorrelated with the measurements; no record tells their own names and units.

    :param plant: names, units, and B where it is known, of what is measured.
    :param hidden: most states that are not measured, at least 1.
    :param highest_degree: of f.
    :param seed: of the split.
    :return: an estimate of the plant with these states, in the episodes as they were estimated.
    :raises ValueError: when the episodes are too short, or nothing fits.
    :raises Stopped: when `watch` asked for it.
    """
    record = _Record(plant, episodes, seed)
    total = hidden * highest_degree + 2
    steps = itertools.count()
    candidates = []

    def progress(text: str) -> Callable[..., bool]:
        number = next(steps)

        def monitor(*_: object) -> bool:
            if watch(number, total, text):
                raise Stopped
            return False

        monitor()
        return monitor

    for count in range(1, hidden + 1):
        found: Predictor | None = None
        for degree in range(1, highest_degree + 1):
            monitor = progress(f'drift of degree {degree} with {count} '
                               f'{"state" if count == 1 else "states"} not measured')
            try:
                found = record.linear(count, monitor) if found is None else record.refined(
                    record.fit, raised(found), monitor)
                candidates.append(_Candidate(found, count, record.foreseen(found)))
            except (ValueError, np.linalg.LinAlgError):
                break
    if not candidates:
        raise ValueError('no drift fits the episodes: record longer, with steps of the input')
    best = _plainest(candidates)
    monitor = progress(f'drift of degree {best.degree} on all episodes')
    everything = sorted([*record.fit, *record.choose])
    predictor = record.refined(everything, best.predictor, monitor)
    return record.identified(predictor, best, candidates, everything, progress('linear model'))


def _plainest(candidates: Sequence[_Candidate]) -> _Candidate:
    """Return the smallest whose squared innovations are not clearly above the least."""
    scale = np.min([np.mean(one.innovations ** 2, axis=0) for one in candidates], axis=0)
    squares = [np.mean(one.innovations ** 2 / scale, axis=1) for one in candidates]
    least = min(squares, key=np.mean)

    def worse(own: Array) -> bool:
        excess = own - least
        return bool(np.mean(excess) > _SIGMAS * np.std(excess) / np.sqrt(len(excess)))

    able = [one for one, own in zip(candidates, squares, strict=True) if not worse(own)]
    return min(able, key=lambda one: one.predictor.drift.coefficients.size)


class _Record:
    """Measurements, cut into segments, and predictors that are fitted to some of them."""

    def __init__(self, plant: Plant, episodes: Sequence[Episode], seed: int) -> None:
        if callable(plant.B) or plant.input_matrix_degree:
            raise ValueError('where states are not measured, B must not depend on them: set '
                             'input_matrix_degree to 0')
        self._plant, self._episodes = plant, episodes
        n_y, n_u = len(plant.state_names), len(plant.input_names)
        self._parts = segments_of(episodes, n_y + n_u)
        # which samples of all episodes each of them holds
        edges = np.cumsum([0, *map(len, episodes)]).tolist()
        numbered = [replace(episode, x=np.arange(*ends, dtype=np.float64)[:, None])
                    for episode, ends in zip(episodes, itertools.pairwise(edges), strict=True)]
        self._rows = [part.x[:, 0].astype(int) for part in segments_of(numbered, n_y + n_u)]
        # a filter that knows nothing at first knows more when an episode has lasted a while
        begins = {episode.time[0] for episode in episodes}
        self._settled = [i for i, part in enumerate(self._parts) if part.time[0] not in begins]
        fit, choose, held_out = split(self._parts, seed)
        self.fit = fit
        self.choose, self.held_out = (
            [i for i in share if i in self._settled] for share in (choose, held_out))
        if not (self.choose and self.held_out):
            raise ValueError('the episodes are too short for a filter to find what is not '
                             'measured: record longer without gaps')
        self._step = longest_step(self._parts)
        self._period = float(np.median(np.concatenate([np.diff(p.time) for p in self._parts])))
        self._deviation = np.ones(n_y)

    def linear(self, hidden: int, monitor: Callable[..., bool]) -> Predictor:
        """Return the best linear predictor."""
        tried = []
        for gains in _GAINS:
            found, cost = self._refined(self.fit, self._start(hidden, gains), monitor)
            tried.append((cost, found))
        return self.refined(self.fit, min(tried, key=lambda pair: pair[0])[1], monitor)

    def refined(self, parts: Sequence[int], start: Predictor, monitor: Callable[..., bool]
                ) -> Predictor:
        """Return a predictor that fits some segments better, its hidden states standardised."""
        found, _ = self._refined(parts, start, monitor)
        run = found.run(self._episodes, self._step)
        settled = np.concatenate([self._rows[i] for i in self._settled])
        self._deviation = np.std(run.innovations[settled], axis=0)
        return standardised(found, run.estimates[settled])

    def foreseen(self, predictor: Predictor) -> Array:
        """Return the innovations (N, n_y) over the segments to choose by."""
        found = predictor.run(self._episodes, self._step).innovations
        return found[np.concatenate([self._rows[i] for i in self.choose])]

    def identified(self, predictor: Predictor, best: _Candidate,
                   candidates: Sequence[_Candidate], fitted: Sequence[int],
                   monitor: Callable[..., bool]) -> Identified:
        """Return what was found in the form that a record of all states leads to."""
        drift, n_y = predictor.drift, predictor.gain.shape[1]
        hidden = drift.box.states.to_physical(
            predictor.run(self._episodes, self._step).estimates)[:, n_y:]
        known, held_out = (
            cut([replace(part, x=np.hstack([part.x, hidden[self._rows[i]]]))
                 for i, part in enumerate(self._parts) if i in share and i in self._settled],
                self._length(drift))
            for share in (fitted, self.held_out))
        linear = output_error(
            _linear(drift, known), Segments.of(known, self._step), monitor=monitor,
            learn_input_matrix=self._plant.B is None)
        scale = drift.box.states.scale[:n_y]
        scores = tuple(Score(
            one.method, one.degree, scale * np.sqrt(np.mean(one.innovations ** 2, axis=0)),
            float(np.mean(one.innovations ** 2))) for one in candidates)
        return Identified(drift, best.method, linear, scores, noise_level(known, drift),
                          tuple(known), tuple(held_out), len(drift.B) - n_y)

    def _refined(self, parts: Sequence[int], start: Predictor, monitor: Callable[..., bool]
                 ) -> tuple[Predictor, float]:
        segments = Segments.of([self._parts[i] for i in parts], self._step)
        foreseen = start.run(self._episodes, self._step).foreseen
        shortest = min(len(self._parts[i]) for i in parts)
        drift, gain, cost = innovations_form(
            start.drift, start.gain, segments, foreseen[[self._rows[i][0] for i in parts]],
            self._deviation, settling=min(SETTLING, shortest // 3),
            learn_input_matrix=self._plant.B is None, monitor=monitor)
        return Predictor(drift, gain), cost

    def _start(self, hidden: int, gains: Sequence[float]) -> Predictor:
        """Return a filter of outputs that move by themselves, each at a rate of its own."""
        plant = self._plant
        n_y, n_x = len(plant.state_names), len(plant.state_names) + hidden
        names = tuple(f'hidden_{i + 1}' for i in range(hidden))
        y = np.concatenate([part.x for part in self._parts])
        rows = np.linspace(-1.0, 1.0, len(y))[:, None] * np.ones(hidden)
        B = None if plant.B is None else np.vstack([np.asarray(plant.B), np.zeros((hidden, len(
            plant.input_names)))])
        whole = replace(plant, state_names=(*plant.state_names, *names),
                        state_units=(*plant.state_units, *[UNIT] * hidden),
                        nominal_state=np.concatenate((plant.nominal_state, np.zeros(hidden))), B=B)
        box = Box.of(whole, np.hstack([y, rows]), np.concatenate([p.u for p in self._parts]),
                     nominal=False)
        shape = DriftModel(box, 1, np.zeros((1 + n_x, n_x)), np.zeros((n_x, len(box.inputs))) if (
            B is None) else box.input_matrix(B))
        gain = np.zeros((n_x, n_y))
        for i in range(n_x):
            layer = min(i // n_y, len(gains) - 1)
            gain[i, i % n_y] = gains[layer] * _SAMPLES ** layer
            if i >= n_y:
                shape.coefficients[1 + i, i - n_y] = 1.0 / (_SAMPLES * self._period)
        return Predictor(shape, gain)

    def _length(self, drift: DriftModel) -> int:
        """Return samples over which roll-outs of a plant, be it unstable, stay where it is."""
        fastest = float(np.max(np.linalg.eigvals(drift.slope(drift.box.states.center)).real))
        longest = max(len(part) for part in self._parts)
        if fastest * self._period * longest <= _GROWTH:
            return longest
        return max(_SHORTEST, int(_GROWTH / (fastest * self._period)))


def _linear(drift: DriftModel, episodes: Sequence[Episode]) -> DriftModel:
    """Return the linear drift closest to another one over the states of episodes."""
    xi = drift.box.states.to_deviation(np.concatenate([episode.x for episode in episodes]))
    first = DriftModel(drift.box, 1, np.empty(0), drift.B)
    return regress(drift.box, 1, first.features(xi), np.zeros((len(xi), len(drift.box.inputs))),
                   drift.features(xi) @ drift.coefficients, drift.B)
