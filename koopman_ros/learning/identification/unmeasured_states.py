# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drift of a plant some of whose states were never measured, in coordinates found with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from dataclasses import dataclass, replace

import numpy as np

from koopman_ros.core.datasets import Array, Episode, PlantDescription
from koopman_ros.execution import Backend, Serial, Tell
from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.drift import DriftModel
from koopman_ros.learning.identification.excitation import check_inputs
from koopman_ros.learning.identification.identify import (
    Identified,
    INNOVATIONS_FORM,
    Score,
    stage_by_stage,
    Stopped,
    Watch,
)
from koopman_ros.learning.identification.innovations_form import (
    Predictor,
    raised,
    SETTLING,
    standardised,
)
from koopman_ros.learning.identification.output_error import (
    innovations_form,
    PolynomialCoefficients,
)
from koopman_ros.model import Box

HIGHEST_DEGREE = 3
UNIT = '1'  # of a state that is not measured: any other scale would do as well
# Gains of filters to begin with, of outputs, of their rates and of what moves these, over powers
# of the interval between samples (alpha, beta and gamma of tracking filters).
_GAINS = ((0.5, 0.1, 0.01), (0.2, 0.02, 0.001), (0.8, 0.4, 0.1))
_SAMPLES = 20  # between samples, in which rates are counted at first
# A larger model must err less by so many standard errors of the difference.
_SIGMAS = 2.0

_Polynomial = Predictor[DriftModel]


@dataclass(frozen=True)
class _StructureCandidate:
    """A predictor, and how it foresees the segments to choose by."""

    predictor: _Polynomial
    hidden: int
    innovations: Array  #: (N, n_y) there, in deviations
    deviation: Array  #: (n_y,) standard deviations of the innovations over all segments

    @property
    def degree(self) -> int:
        return self.predictor.drift.degree

    @property
    def method(self) -> str:
        count = self.hidden
        return f'{INNOVATIONS_FORM}, {count} {"state" if count == 1 else "states"} not measured'


def identify_unmeasured(plant: PlantDescription, episodes: Sequence[Episode], hidden: int, *,
                        highest_degree: int = HIGHEST_DEGREE, seed: int = 0,
                        watch: Watch = lambda *_: False, backend: Backend | None = None
                    ) -> Identified:
    """
    Estimate dx/dt = f(x) + B u where only the first n_y states are in the record.

    A polynomial drift, a filter's gain and the starts of all segments are refined until the next
    measurement is foreseen, see :func:`innovations_form`; first linear models, from filters that
    know nothing of the plant, then models of higher degree from those below. Of all numbers of
    states that are not measured and all degrees the smallest model is taken that foresees
    segments held out for the choice about as well as the best, and fitted to these, too. States
    that are not measured are what the filter makes of them: of the unit 1, from -1 to 1, and
    uncorrelated with the measurements; no record tells their own names and units.

    :param plant: names, units, and B where it is known, of the measured signals.
    :param hidden: most states that are not measured, at least 1.
    :param highest_degree: of f.
    :param seed: of the split.
    :param backend: where each number of states is tried; this process by default.
    :return: an estimate of the plant with these states, in the episodes as they were estimated.
    :raises ValueError: when the episodes are too short, their inputs do not determine B, or
        nothing fits.
    :raises Stopped: when `watch` asked for it.
    """
    if callable(plant.B) or plant.input_matrix_degree:
        raise ValueError('where states are not measured, B must not depend on them: set '
                         'input_matrix_degree to 0')
    record = SplitRecord(plant, episodes, seed, hidden=True)
    warnings = check_inputs(plant, episodes)
    total = hidden * highest_degree + 2
    words = {f'{count} {"state" if count == 1 else "states"} not measured': count
             for count in range(1, hidden + 1)}
    candidates: list[_StructureCandidate] = []
    under_way = dict.fromkeys(words, 0)  # degrees that were tried

    def told(name: str, degree: int | None) -> bool:
        if degree is not None:
            under_way[name] = degree - 1
        text = f'drift of degree {degree} with {name}' if degree else 'drift'
        if watch(sum(under_way.values()), total, text):
            raise Stopped
        return False

    with contextlib.closing((backend or Serial()).run(
            _tried, words, shared=(record, highest_degree), watch=told)) as results:
        for name, found in results:
            under_way[name] = highest_degree
            candidates += found
    progress = stage_by_stage(watch, total, hidden * highest_degree)
    if not candidates:
        raise ValueError('no drift fits the episodes: record longer, with steps of the input')
    best = _plainest(candidates)
    monitor = progress(f'drift of degree {best.degree} on all episodes')
    predictor = _Search(record, best.deviation).refined(
        sorted([*record.fit, *record.choose]), best.predictor, monitor)
    scale = predictor.drift.box.states.scale[:len(plant.state_names)]
    return replace(record.identified(predictor, best.method, [
        Score(one.method, one.degree, scale * np.sqrt(np.mean(one.innovations ** 2, axis=0)),
              float(np.mean(one.innovations ** 2))) for one in candidates],
        progress('linear model')), warnings=warnings)


def _plainest(candidates: Sequence[_StructureCandidate]) -> _StructureCandidate:
    """Return the smallest whose squared innovations are not clearly above the least."""
    scale = np.min([np.mean(one.innovations ** 2, axis=0) for one in candidates], axis=0)
    squares = [np.mean(one.innovations ** 2 / scale, axis=1) for one in candidates]
    least = min(squares, key=np.mean)

    def worse(own: Array) -> bool:
        excess = own - least
        return bool(np.mean(excess) > _SIGMAS * np.std(excess) / np.sqrt(len(excess)))

    able = [one for one, own in zip(candidates, squares, strict=True) if not worse(own)]
    return min(able, key=lambda one: one.predictor.drift.coefficients.size)


def _tried(shared: tuple[SplitRecord, int], count: int, tell: Tell) -> list[_StructureCandidate]:
    """Return predictors with so many hidden states, of rising degree, until none is found."""
    record, highest_degree = shared
    search, candidates = _Search(record), list[_StructureCandidate]()
    for degree in range(1, highest_degree + 1):
        def monitor(*_: object, degree: int = degree) -> bool:
            return tell(degree)

        monitor()
        try:
            found = search.refined(record.fit, raised(candidates[-1].predictor), monitor) if (
                candidates) else search.linear(count, monitor)
            candidates.append(_StructureCandidate(
                found, count, record.innovations(found, record.choose), search.deviation))
        except (ValueError, np.linalg.LinAlgError):
            break
    return candidates


class _Search:
    """
    Predictors of polynomial drifts that are fitted to segments of a record.

    :ivar deviation: (n_y,) standard deviations of the innovations of the last one.
    """

    def __init__(self, record: SplitRecord, deviation: Array | None = None) -> None:
        self.record, self._plant = record, record.plant
        self.deviation = np.ones(len(self._plant.state_names)) if deviation is None else deviation

    def linear(self, hidden: int, monitor: Callable[..., bool]) -> _Polynomial:
        """Return the best linear predictor."""
        tried = []
        for gains in _GAINS:
            found, cost = self._refined(self.record.fit, self._start(hidden, gains), monitor)
            tried.append((cost, found))
        return self.refined(self.record.fit, min(tried, key=lambda pair: pair[0])[1], monitor)

    def refined(self, parts: Sequence[int], start: _Polynomial, monitor: Callable[..., bool]
                ) -> _Polynomial:
        """Return a predictor that fits some segments better, its hidden states standardised."""
        found, _ = self._refined(parts, start, monitor)
        self.deviation = np.std(self.record.innovations(found), axis=0)
        return standardised(found, self.record.estimates(found))

    def _refined(self, parts: Sequence[int], start: _Polynomial, monitor: Callable[..., bool]
                 ) -> tuple[_Polynomial, float]:
        record = self.record
        shortest = min(len(record.parts[i]) for i in parts)
        found = innovations_form(
            PolynomialCoefficients(start.drift, self._plant.B is None), start.gain,
            record.segments(parts), record.foreseen(start, parts), self.deviation,
            settling=min(SETTLING, shortest // 3), monitor=monitor)
        return Predictor(found.model.drift, found.gain), found.cost

    def _start(self, hidden: int, gains: Sequence[float]) -> _Polynomial:
        """Return a filter of outputs that move by themselves, each at a rate of its own."""
        plant, parts = self._plant, self.record.parts
        n_y, n_x = len(plant.state_names), len(plant.state_names) + hidden
        names = tuple(f'hidden_{i + 1}' for i in range(hidden))
        y = np.concatenate([part.x for part in parts])
        rows = np.linspace(-1.0, 1.0, len(y))[:, None] * np.ones(hidden)
        B = None if plant.B is None else np.vstack([np.asarray(plant.B), np.zeros((hidden, len(
            plant.input_names)))])
        whole = replace(plant, state_names=(*plant.state_names, *names),
                        state_units=(*plant.state_units, *[UNIT] * hidden),
                        nominal_state=np.concatenate((plant.nominal_state, np.zeros(hidden))), B=B)
        box = Box.of(whole, np.hstack([y, rows]), np.concatenate([p.u for p in parts]),
                     nominal=False)
        shape = DriftModel(box, 1, np.zeros((1 + n_x, n_x)), np.zeros((n_x, len(box.inputs))) if (
            B is None) else box.input_matrix(B))
        gain = np.zeros((n_x, n_y))
        for i in range(n_x):
            layer = min(i // n_y, len(gains) - 1)
            gain[i, i % n_y] = gains[layer] * _SAMPLES ** layer
            if i >= n_y:
                shape.coefficients[1 + i, i - n_y] = 1.0 / (_SAMPLES * self.record.period)
        return Predictor(shape, gain)
