# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drift of a plant some of whose states were never measured, in coordinates found with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from koopman_ros.core.datasets import Array, Episode, PlantDescription
from koopman_ros.execution import Backend, Serial, Tell
from koopman_ros.learning.identification.alternatives import in_coordinates_of
from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.drift import Drift, DriftModel, Segments
from koopman_ros.learning.identification.excitation import check_inputs
from koopman_ros.learning.identification.identify import (
    Identified,
    NEARLY,
    OUTPUT_ERROR,
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
from koopman_ros.learning.identification.network_drift import NetworkDrift
from koopman_ros.learning.identification.output_error import (
    innovations_form,
    PolynomialCoefficients,
    Refinable,
    Refined,
)
from koopman_ros.model import Box, Coordinates

HIGHEST_DEGREE = 3
UNIT = '1'  # of a state that is not measured: any other scale would do as well
# Gains of filters to begin with, of outputs, of their rates and of what moves these, over powers
# of the interval between samples (alpha, beta and gamma of tracking filters).
_GAINS = ((0.5, 0.1, 0.01), (0.2, 0.02, 0.001), (0.8, 0.4, 0.1))
_SAMPLES = 20  # between samples, in which rates are counted at first
# A larger model must err less by so many standard errors of the difference.
_SIGMAS = 2.0
_MOST = 2.0  # times the least squared error that a smaller model may have

_UNITS = (3, 8)  # hidden units of the networks that are tried
_STARTS = 4  # of each network, of which the one that fits best is judged
_RIDGE = 1e-4  # weight of its squared parameters beside the mean squared error
_ITERATIONS, _TOLERANCE = 200, 1e-5  # of simulations
_EXPLAINED = 1.2  # times the variance of what a filter does not foresee: nothing is left to learn
_LOST = 10.0  # half-ranges from the measurement

_Polynomial = Predictor[DriftModel]
_Model = TypeVar('_Model', bound=Refinable)


@dataclass(frozen=True)
class _StructureCandidate:
    """A model with the gain of a filter, and how far its simulations are from measurements."""

    model: Refinable
    gain: Array  #: (n_x, n_y) of the filter, in deviations
    hidden: int
    errors: Array  #: (N, n_y) of simulations by models that were not fitted there, in deviations

    @property
    def label(self) -> str:
        drift = self.model.drift
        network = f' of a {drift.form}' if isinstance(drift, NetworkDrift) else ''
        return f'{OUTPUT_ERROR}{network}, {_not_measured(self.hidden)}'

    @property
    def score(self) -> Score:
        drift = self.model.drift
        scale = drift.box.states.scale[:self.errors.shape[1]]
        squares = np.mean(self.errors ** 2, axis=0)
        return Score(self.label, drift.degree if isinstance(drift, DriftModel) else None,
                     scale * np.sqrt(squares), float(np.mean(squares)))


def _not_measured(count: int) -> str:
    return f'{count} {"state" if count == 1 else "states"} not measured'


def identify_unmeasured(plant: PlantDescription, episodes: Sequence[Episode], hidden: int, *,
                        highest_degree: int = HIGHEST_DEGREE, seed: int = 0,
                        watch: Watch = lambda *_: False, backend: Backend | None = None
                        ) -> Identified:
    """
    Estimate dx/dt = f(x) + B u where only the first n_y states are in the record.

    First a filter predicts the next measurement, see :func:`innovations_form`: linear models, from
    filters that know nothing of the plant, then polynomials of higher degree. From each of them
    simulations of the record are refined (output error), also with a small network added to a
    linear drift. Of all numbers of states that are not measured and all drifts the smallest model
    is taken whose simulations err about as little as the best, at samples that were left out of
    the fit, see :meth:`Refined.left_out`. It is fitted to the whole record. At last the gain of
    its filter is fitted. Unmeasured states are those of the filter: dimensionless, from -1 to 1,
    because no record gives their names and units.

    :param plant: names, units, and B where it is known, of the measured signals.
    :param hidden: most states that are not measured, at least 1.
    :param highest_degree: of polynomials f.
    :param seed: of the split, and of networks.
    :param backend: where each number of states is tried; this process by default.
    :return: an estimate of the plant with these states, in the episodes as they were estimated.
    :raises ValueError: when the episodes are too short, their inputs do not determine B, or
        nothing fits.
    :raises Stopped: when `watch` requested it.
    """
    if callable(plant.B) or plant.input_matrix_degree:
        raise ValueError('B must not depend on unmeasured states: set input_matrix_degree to 0')
    record = SplitRecord(plant, episodes, seed, hidden=True)
    warnings = check_inputs(plant, episodes)
    kinds = highest_degree + len(_UNITS)
    total = hidden * kinds + 2
    words = {_not_measured(count): count for count in range(1, hidden + 1)}
    candidates: list[_StructureCandidate] = []
    under_way = dict.fromkeys(words, 0)  # kinds of drift that were tried

    def progress(name: str, kind: int | None) -> bool:
        if kind is not None:
            under_way[name] = kind - 1
        text = 'drift' if not kind else (
            f'drift of degree {kind} with {name}' if kind <= highest_degree else
            f'network of {_UNITS[kind - highest_degree - 1]} units with {name}')
        if watch(sum(under_way.values()), total, text):
            raise Stopped
        return False

    first = _Search(record)
    linear = first.linear(1, lambda *_: progress(next(iter(words)), 1))
    shared = _Shared(record, highest_degree, seed, linear, first.deviation,
                     _piece_length(record, linear, first.learn_B))
    with contextlib.closing((backend or Serial()).run(
            _tried, words, shared=shared, watch=progress)) as results:
        for name, found in results:
            under_way[name] = kinds
            candidates += found
    stage = stage_by_stage(watch, total, hidden * kinds)
    if not candidates:
        raise ValueError('no drift fits the episodes: record longer, with steps of the input')
    monitor, able = stage('gain of the filter'), candidates
    while True:
        best = _plainest(able)
        try:
            predictor = _with_gain(shared, best, monitor)
            break
        except ValueError:
            # its filter diverges
            able = [one for one in able if one is not best]
            if not able:
                raise
    return replace(record.identified(
        predictor, best.label, [one.score for one in candidates], stage('linear model')),
        warnings=warnings, alternatives=in_coordinates_of(predictor, _equals(best, able), record))


def _equals(best: _StructureCandidate, able: Sequence[_StructureCandidate]
            ) -> list[Predictor[Drift]]:
    """Return the others with as many states that err about as little as the best ones."""
    most = NEARLY * min(one.score.cost for one in able)
    return [Predictor(one.model.drift, one.gain) for one in able
            if one is not best and one.hidden == best.hidden and one.score.cost <= most]


def _plainest(candidates: Sequence[_StructureCandidate]) -> _StructureCandidate:
    """Return the smallest whose squared errors are not clearly above the least."""
    scale = np.min([np.mean(one.errors ** 2, axis=0) for one in candidates], axis=0)
    # errors of a simulation last: in blocks they are independent
    squares = [np.array([np.mean(block ** 2 / scale) for block in np.array_split(
        one.errors, max(2, len(one.errors) // SETTLING))]) for one in candidates]
    least = min(squares, key=np.mean)

    def worse(own: Array) -> bool:
        excess = own - least
        # of a model that errs wildly in a few blocks the scatter says nothing
        return bool(np.mean(excess) > min(
            _SIGMAS * np.std(excess) / np.sqrt(len(excess)), (_MOST - 1.0) * np.mean(least)))

    able = [(len(one.model.theta), float(np.mean(own)), i) for i, (one, own) in enumerate(
        zip(candidates, squares, strict=True)) if not worse(own)]
    return candidates[min(able)[-1]]


@dataclass(frozen=True)
class _Shared:
    """The common data of all candidates."""

    record: SplitRecord
    highest_degree: int
    seed: int
    linear: _Polynomial  #: the linear predictor with one state that is not measured
    deviation: Array  #: of its innovations
    samples: int  #: longest piece that is simulated


def _piece_length(record: SplitRecord, linear: _Polynomial, learn_B: bool) -> int:
    """Return the memory of the plant in samples, by simulations of a linear model."""
    length = record.memory(linear.drift)
    found = _simulated(PolynomialCoefficients(linear.drift, learn_B), linear.gain,
                       *record.simulated(linear, length), lambda *_: False)
    # a filter's own model forgets as fast as the filter does
    return record.memory(found.model.drift) if np.isfinite(found.cost) else length


def _tried(shared: _Shared, count: int, tell: Tell) -> list[_StructureCandidate]:
    """Return candidates with a number of hidden states: polynomials of rising degree, networks."""
    record, found = shared.record, list[_StructureCandidate]()
    last = shared.linear if count == 1 else None
    search = _Search(record, None if last is None else shared.deviation)
    linear: Refined[PolynomialCoefficients] | None = None

    def begin(kind: int) -> Callable[..., bool]:
        tell(kind)
        return lambda *_: tell(kind)

    for degree in range(1, shared.highest_degree + 1):
        monitor = begin(degree)
        try:
            if last is None:
                last = search.linear(count, monitor)
            elif degree > 1:
                last = search.refined(record.fit, raised(last), monitor)
            data, starts = record.simulated(last, shared.samples)
            refined = _simulated(
                PolynomialCoefficients(last.drift, search.learn_B), last.gain, data, starts,
                monitor)
        except (ValueError, np.linalg.LinAlgError):
            break
        found += _candidate(refined, last.gain, count)
        if linear is None:
            linear, simulated = refined, (last.gain, data, refined.starts)
    explained = _EXPLAINED * float(np.mean(search.deviation ** 2))
    if linear is None:
        return found
    for kind, units in enumerate(_UNITS, shared.highest_degree + 1):
        if any(np.mean(one.errors ** 2) <= explained for one in found):
            break
        monitor = begin(kind)
        networks = [_simulated(NetworkDrift.beside(
            linear.model.drift, units, _STARTS * shared.seed + start, ridge=_RIDGE,
            learn_input_matrix=search.learn_B), *simulated, monitor) for start in range(_STARTS)]
        # far from the data a network is constant, and the rest must not diverge there
        unstable = linear.model.drift.growth_rate >= 0.0
        bounded = [one for one in networks if unstable or one.model.bounded]
        if bounded:
            found += _candidate(min(bounded, key=lambda one: one.cost), simulated[0], count)
    return found


def _simulated(model: _Model, gain: Array, data: Segments, starts: Array,
               monitor: Callable[..., bool]) -> Refined[_Model]:
    """Return a model whose simulations err least."""
    penalty = model.penalty if isinstance(model, NetworkDrift) else None
    return innovations_form(model, 0.0 * gain, data, starts, np.ones(gain.shape[1]), smooth=True,
                            tolerance=_TOLERANCE, penalty=penalty, iterations=_ITERATIONS,
                            monitor=monitor)


def _candidate(refined: Refined[Any], gain: Array, hidden: int) -> list[_StructureCandidate]:
    """Return the candidate of a model, or none where its simulations diverge."""
    if not np.isfinite(refined.cost):
        return []
    errors = refined.left_out(SETTLING)
    return [_StructureCandidate(refined.model, gain, hidden, errors)] * bool(
        np.all(np.abs(errors) < _LOST))


def _with_gain(shared: _Shared, best: _StructureCandidate, monitor: Callable[..., bool]
               ) -> Predictor[Drift]:
    """Return the best candidate with a filter that is fitted to it."""
    record = shared.record
    parts = sorted([*record.fit, *record.choose])
    start = Predictor(best.model.drift, best.gain)
    found = innovations_form(
        _Known(start.drift), best.gain, record.segments(parts), record.foreseen(start, parts),
        np.std(record.innovations(start), axis=0),
        settling=min(SETTLING, min(len(record.parts[i]) for i in parts) // 3), monitor=monitor)
    predictor = Predictor(start.drift, found.gain)
    estimates = record.estimates(predictor)
    if isinstance(start.drift, DriftModel):
        return standardised(Predictor(start.drift, found.gain), estimates)
    assert isinstance(start.drift, NetworkDrift)
    return _spanned(Predictor(start.drift, found.gain), estimates)


def _spanned(predictor: Predictor[NetworkDrift], xi: Array) -> Predictor[NetworkDrift]:
    """Return the same with hidden states from -1 to 1, where they were estimated at xi."""
    old, n_y = predictor.drift.box.states, predictor.gain.shape[1]
    low, high = old.to_physical(xi.min(axis=0)), old.to_physical(xi.max(axis=0))
    low[:n_y], high[:n_y] = old.lower[:n_y], old.upper[:n_y]
    new = Coordinates.spanning(old.names, old.units, low, high)
    return Predictor(predictor.drift.moved(new),
                     predictor.gain * old.scale[:, None] / new.scale[:, None] * (
                         new.scale[:n_y] / old.scale[:n_y]))


@dataclass(frozen=True)
class _Known:
    """A drift that is not refined, with a gain that is."""

    drift: Drift

    @property
    def theta(self) -> Array:
        return np.empty(0)

    def at(self, theta: Array) -> _Known:
        return self

    def rates(self, xi: Array, v: Array, S: Array) -> tuple[Array, Array]:
        return self.drift.scaled_rate(xi, v), self.drift.scaled_slope(xi, v) @ S


class _Search:
    """
    Predictors of polynomial drifts that are fitted to segments of a record.

    :ivar deviation: (n_y,) standard deviations of the innovations of the last one.
    """

    def __init__(self, record: SplitRecord, deviation: Array | None = None) -> None:
        self.record, self._plant = record, record.plant
        self.deviation = np.ones(len(self._plant.state_names)) if deviation is None else deviation
        self.learn_B = self._plant.B is None

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
            PolynomialCoefficients(start.drift, self.learn_B), start.gain,
            record.segments(parts), record.foreseen(start, parts), self.deviation,
            settling=min(SETTLING, shortest // 3), monitor=monitor)
        return Predictor(found.model.drift, found.gain), found.cost

    def _start(self, hidden: int, gains: Sequence[float]) -> _Polynomial:
        """Return a filter of outputs that move by themselves, each at a rate of its own."""
        plant, parts = self._plant, self.record.parts
        n_y, n_x = len(plant.state_names), len(plant.state_names) + hidden
        names = tuple(f'hidden_{i + 1}' for i in range(hidden))
        y = np.concatenate([part.interpolated() for part in parts])
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
