# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drift of a plant some of whose states were never measured, in coordinates found with it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
import contextlib
from dataclasses import dataclass, replace
import itertools
import time
from typing import Any, TypeVar

import numpy as np

from koopman_ros.core.datasets import Array, cut, Episode, PlantDescription
from koopman_ros.execution import Backend, Serial, Tell
from koopman_ros.learning.identification.alternatives import in_coordinates_of
from koopman_ros.learning.identification.base import IdentificationMethod
from koopman_ros.learning.identification.characteristics import identify_with_characteristics
from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.dead_time import (
    LinearModels,
    LONGEST,
    Sampled,
    SHARE,
)
from koopman_ros.learning.identification.drift import (
    Drift,
    DriftModel,
    prediction_error,
    Segments,
)
from koopman_ros.learning.identification.episode_offsets import (
    MOST_EPISODES,
    with_episode_inputs,
    without_episode_inputs,
)
from koopman_ros.learning.identification.excitation import check_inputs
from koopman_ros.learning.identification.identify import (
    Identified,
    NEARLY,
    OUTPUT_ERROR,
    Score,
    Stopped,
    usual_degrees,
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
from koopman_ros.learning.identification.realisation import realised
from koopman_ros.model import Box, Coordinates

HIGHEST_DEGREE = 3
MOST_UNMEASURED = 3  # states that are tried where their number is not given
BUDGET = 600.0  # s of processor time of a search
UNIT = '1'  # of a state that is not measured: any other scale would do as well
# Gains of filters to begin with, of outputs, of their rates and of what moves these, over powers
# of the interval between samples (alpha, beta and gamma of tracking filters).
_GAINS = ((0.5, 0.1, 0.01), (0.2, 0.02, 0.001), (0.8, 0.4, 0.1))
_SAMPLES = 20  # between samples, in which rates are counted at first
# A larger model must err less by so many standard errors of the difference.
_SIGMAS = 2.0
_MOST = 2.0  # times the least squared error that a smaller model may have

_UNITS = (3, 8)  # hidden units of the networks that are tried
_STARTS = 4  # of each network, of which the best is taken
_RIDGE = 1e-4  # weight of its squared parameters beside the mean squared error
_ITERATIONS, _TOLERANCE = 200, 1e-5  # of simulations
_EXPLAINED = 1.2  # times the variance of what a filter does not foresee: nothing is left to learn
_SLIGHT = 0.01  # share of the motion, of which no state that is not measured is sought
_LOST = 10.0  # half-ranges from the measurement

_Polynomial = Predictor[DriftModel]
_Model = TypeVar('_Model', bound=Refinable)


@dataclass(frozen=True)
class _StructureCandidate:
    """A model, and how far its simulations are from measurements."""

    model: Refinable
    start: _Polynomial  #: where its search began, in the same coordinates
    hidden: int
    #: (N, n_y) in deviations, of simulations by models that were not fitted there, or from starts
    #: that are fitted to the first samples where those err more
    errors: Array
    starts: Array  #: of its simulations, in deviations of where its search began
    offsets: bool = False  #: whether each episode has a constant disturbance
    late: tuple[int, ...] = ()  #: dead times (n_u,) of the inputs in samples, where there are any

    @property
    def gain(self) -> Array:
        """Gain (n_x, n_y) of the filter with which it began, in deviations."""
        return self.start.gain

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

    @property
    def text(self) -> str:
        """Structure and error."""
        drift = self.model.drift
        form = 'linear drift' if isinstance(drift, DriftModel) and drift.degree == 1 else (
            drift.form)
        more = ', an offset of each episode' * self.offsets
        if self.late:
            more += f', dead times of {", ".join(map(str, self.late))} samples'
        return f'{form} with {_not_measured(self.hidden)}{more}: ' + ', '.join(
            f'{error:.4g} {unit}' for error, unit in zip(
                self.score.rmse, drift.box.states.units, strict=False))


def _not_measured(count: int) -> str:
    return f'{count} {"state" if count == 1 else "states"} not measured'


class _Choice:
    """
    The candidates so far, each compared with the best before it.

    :ivar steps: of the search, in words.
    """

    def __init__(self) -> None:
        self.candidates: list[_StructureCandidate] = []
        self.steps: list[str] = []

    def gains(self, one: _StructureCandidate | None) -> bool:
        """Add a candidate; return whether it errs less than those before, not by chance."""
        if one is None:
            return False
        before = self.candidates
        self.candidates = [*before, one]
        if not before:
            self.steps.append(one.text)
            return True
        best = _plainest(before)
        more, deviation = _excess(*_blocks([one, best]))
        self.steps.append(
            f'{one.text}; mean square {100.0 * abs(more):.3g} % '
            f'{"more" if more > 0.0 else "less"} than with the best before (standard error '
            f'{100.0 * deviation:.2g} %)')
        return more < -_SIGMAS * deviation

    def explained(self, square: float) -> bool:
        """Return whether a candidate errs by no more than this mean square."""
        return any(np.mean(one.errors ** 2) <= square for one in self.candidates)


    def ended(self, best: _StructureCandidate) -> tuple[str, ...]:
        """Return the steps with the result."""
        return (*self.steps, f'selected: {best.text}')


def identify_structure(plant: PlantDescription, episodes: Sequence[Episode], *,
                       given: Collection[str] = (),
                       methods: Mapping[str, IdentificationMethod] | None = None,
                       dead_times: bool = True, seed: int = 0, watch: Watch = lambda *_: False,
                       backend: Backend | None = None) -> Identified:
    """
    Estimate a drift with as many states as free runs of the record need.

    An estimate of measured states by :func:`identify_with_characteristics` is kept if its
    simulations of the whole record err by little more than noise, or by less than 1 % of the
    motion. Otherwise it competes with those of :func:`identify_unmeasured`.

    :param given: inputs whose characteristic the plant has already.
    :param methods: see :func:`identify`; other arguments as for :func:`identify_unmeasured`.
    """
    measured = identify_with_characteristics(
        plant, episodes, given=given, methods=methods, seed=seed, backend=backend,
        watch=lambda done, total, text: watch(done, 4 * total, text))
    plant = replace(plant, characteristics=measured.drift.box.inputs.characteristics)
    if callable(plant.B) or plant.input_matrix_degree or _explains(
            measured, plant, episodes):
        return measured
    return identify_unmeasured(
        plant, episodes, MOST_UNMEASURED, measured=measured, dead_times=dead_times, seed=seed,
        backend=backend,
        watch=lambda done, total, text: watch(total + 3 * done, 4 * total, text))


def _explains(found: Identified, plant: PlantDescription, episodes: Sequence[Episode]) -> bool:
    """Return whether simulations of the record err by noise alone."""
    drift = found.drift
    record = SplitRecord(plant, episodes, 0, hidden=False)
    data = Segments.of(cut(episodes, record.memory(drift)), record.step)
    squares = prediction_error(drift.rate, data, drift.box.states.scale) ** 2
    spread = np.nanvar(np.concatenate([episode.x for episode in episodes]), axis=0)
    return bool(np.all(squares <= np.fmax(
        _EXPLAINED * found.noise ** 2, _SLIGHT ** 2 * spread)))


def identify_unmeasured(plant: PlantDescription, episodes: Sequence[Episode], hidden: int, *,
                        measured: Identified | None = None, highest_degree: int = HIGHEST_DEGREE,
                        dead_times: bool = True, seed: int = 0, budget: float = BUDGET,
                        watch: Watch = lambda *_: False, backend: Backend | None = None
                        ) -> Identified:
    """
    Estimate dx/dt = f(x) + B u where only the first n_y states are in the record.

    Models are compared by simulations of the record at samples that are left out of the fit in
    turn, see :meth:`Refined.left_out`, and from starts that are fitted to its first samples,
    whichever err more. First linear models of rising order are simulated, from realisations of
    stable models of the outputs, otherwise from filters; the search ends with the order that
    lowers the mean squared error by no more than two standard errors, over blocks of the record. A
    constant disturbance of each of several episodes is kept by the same rule. Then polynomials of
    higher degree and small networks are added to the linear drift of the best order. The smallest
    model is taken that errs by no more than two standard errors above the least. At last the gain
    of its filter is fitted. Unmeasured states are those of the filter: dimensionless, from -1 to
    1, because no record gives their names and units.

    :param plant: names, units, and B where it is known, of the measured signals.
    :param hidden: most states that are not measured, at least 1.
    :param measured: an estimate without such states, which competes; without it there is at least
        one.
    :param highest_degree: of polynomials f.
    :param dead_times: whether a linear drift of the best order is tried with dead times, too.
    :param seed: of the split, and of networks.
    :param budget: processor time in s, after which the best so far is taken and the rest left out.
    :param backend: where networks are fitted; this process by default.
    :return: an estimate of the plant with these states, in the episodes as they were estimated.
    :raises ValueError: when the episodes are too short, their inputs do not determine B, or
        nothing fits.
    :raises Stopped: when `watch` requested it.
    """
    if callable(plant.B) or plant.input_matrix_degree:
        raise ValueError('B must not depend on unmeasured states: set input_matrix_degree to 0')
    record = SplitRecord(plant, episodes, seed, hidden=True)
    warnings = check_inputs(plant, episodes)
    least = 1 if measured is None else 0
    networks = {f'network of {units} units, start {start + 1}': (units, _STARTS * seed + start)
                for units in _UNITS for start in range(_STARTS)}
    total = hidden + 1 - least + highest_degree + len(networks) + 5
    end, choice = time.process_time() + budget, _Choice()
    begun = itertools.count()

    def stage(text: str, limit: float = end) -> Callable[..., bool]:
        number = min(next(begun), total - 1)

        def monitor(*_: object) -> bool:
            if watch(number, total, text):
                raise Stopped
            return time.process_time() > limit

        if monitor():
            choice.steps.append(f'left out after {budget:.0f} s: {text}')
        return monitor

    first, linear, n_y = _Search(record), None, len(plant.state_names)
    for count in range(least, hidden + 1):
        monitor = stage(f'drift of degree 1 with {_not_measured(count)}')
        if linear is not None and monitor():
            break
        found = first.linear(count, monitor)
        if found is not None and choice.gains(found):
            linear = found
        elif found is not None:
            break
    if linear is None:
        raise ValueError('no drift fits the episodes: record longer, with steps of the input')
    search = first
    records: dict[tuple[bool, tuple[int, ...]], SplitRecord] = {(False, ()): record}
    tried = list[_StructureCandidate]()
    monitor = stage('dead time')
    manipulated = [dead_times and name not in plant.disturbance_names
                   for name in plant.input_names]
    for late in _dead_times(record, linear, manipulated, monitor) if any(manipulated) else ():
        if monitor():
            break
        moved = _Search(SplitRecord(plant, [_moved(one, record.period * np.array(late))
                                            for one in episodes], seed, hidden=True))
        moved.samples, records[False, late] = first.samples, moved.record
        if (found := moved.linear(linear.hidden, monitor)) is not None:
            tried.append(replace(found, late=late))
    choice.gains(min(tried, key=lambda one: one.score.cost, default=None))
    if plant.B is None and 1 < len(episodes) <= MOST_EPISODES:
        monitor = stage('constant offset of each episode')
        more = _Search(SplitRecord(*with_episode_inputs(plant, episodes), seed, hidden=True))
        more.samples = first.samples
        offsets = more.simulated(more.extended(linear), linear.hidden, monitor)
        if choice.gains(offsets and replace(offsets, offsets=True)):
            search, linear = more, choice.candidates[-1]
        records[True, ()] = more.record
    kept = None
    if measured is not None and isinstance(measured.drift, DriftModel):
        kept = first.simulated(Predictor(measured.drift, np.zeros((n_y, n_y))), 0,
                                stage(measured.drift.form))
        choice.gains(kept)
    count = linear.hidden
    monitor = stage(f'filter with {_not_measured(count)}')
    last = begin = search.from_filters(count, monitor)
    explained = 0.0 if last is None else _EXPLAINED * float(np.mean(search.deviation ** 2))
    for degree in usual_degrees(n_y + count)[1:highest_degree] if count or not measured else ():
        if last is None or choice.explained(explained):
            break
        monitor = stage(f'drift of degree {degree} with {_not_measured(count)}')
        if not monitor():
            last = search.filtered(raised(last), monitor)
            found = None if last is None else search.simulated(last, count, monitor)
            choice.gains(None if found is None else replace(found, offsets=linear.offsets))
    if not choice.explained(explained):
        # in coordinates of a filter, whose hidden states have the range of those in the record
        base = None if begin is None else search.simulated(begin, count, monitor)
        linear = linear if base is None else replace(base, offsets=linear.offsets)
        data, starts = search.record.simulated(linear.start, search.samples)
        shared = _Shared(linear, (data, starts if base is None else base.starts),
                         search.learn_B, (end - time.process_time()) / len(networks))
        _add_networks(choice, shared, networks,
                      lambda text: stage(f'{text} with {_not_measured(count)}'),
                      backend or Serial())
    able = choice.candidates
    while True:
        best = _plainest(able)
        if best is kept:
            # the estimate without unmeasured states, as it is
            assert measured is not None
            return replace(measured, scores=tuple(one.score for one in choice.candidates),
                           steps=choice.ended(best), free_run=best.score.rmse)
        try:
            record = records[best.offsets, best.late]
            predictor = _with_gain(record, best, stage('gain of the filter', np.inf))
            break
        except ValueError:
            # its filter diverges
            able = [one for one in able if one is not best]
            if not able:
                raise
    result = record.identified(predictor, best.label, [one.score for one in choice.candidates],
                               stage('linear model', np.inf))
    if best.offsets:
        result = without_episode_inputs(result, len(plant.input_names))
    return replace(result, warnings=warnings, steps=choice.ended(best), free_run=best.score.rmse,
                   alternatives=() if best.offsets else in_coordinates_of(
                       predictor, _equals(best, able), record),
                   dead_time=record.period * np.array(best.late or np.zeros(
                       len(plant.input_names))))


def _dead_times(record: SplitRecord, linear: _StructureCandidate, manipulated: Sequence[bool],
                monitor: Callable[..., bool]) -> list[tuple[int, ...]]:
    """Return those, in samples, with which single outputs err least, and their neighbours."""
    n_y, episodes = linear.errors.shape[1], record.episodes
    longest = min(LONGEST, max(map(len, episodes)) // SHARE)
    data = [Sampled.of(one, record.period, longest) for one in episodes
            if len(one) > 2 * longest]
    if not data:
        return []
    best = LinearModels(data, -(-len(linear.gain) // n_y), n_y).best(
        tuple(longest * own for own in manipulated), monitor)
    beside = [tuple(np.add(best, sign * row).tolist())
              for row in np.eye(len(manipulated), dtype=int)[list(manipulated)]
              for sign in (1, -1)]
    return [late for late in (best, *beside) if any(late) and min(late) >= 0]


def _moved(episode: Episode, dead_time: Array) -> Episode:
    """Return an episode of the same length whose inputs act later, the first one before it."""
    begin = episode.input_time[0] - np.max(dead_time)
    late = replace(episode, input_time=np.append(begin, episode.input_time),
                   u=np.vstack((episode.u[:1], episode.u))).delayed(dead_time)
    assert late is not None
    return late


def _equals(best: _StructureCandidate, able: Sequence[_StructureCandidate]
            ) -> list[Predictor[Drift]]:
    """Return the others with as many states that err about as little as the best ones."""
    most = NEARLY * min(one.score.cost for one in able)
    return [Predictor(one.model.drift, one.gain) for one in able
            if one is not best and one.hidden == best.hidden and
            (one.offsets, one.late) == (best.offsets, best.late) and one.score.cost <= most]


def _plainest(candidates: Sequence[_StructureCandidate]) -> _StructureCandidate:
    """Return the smallest whose squared errors are not clearly above the least."""
    squares = _blocks(candidates)
    least = min(squares, key=np.mean)

    def worse(own: Array) -> bool:
        excess, deviation = _excess(own, least)
        # of a model that errs wildly in a few blocks the scatter says nothing
        return excess > min(_SIGMAS * deviation, _MOST - 1.0)

    able = [(len(one.model.theta), float(np.mean(own)), i) for i, (one, own) in enumerate(
        zip(candidates, squares, strict=True)) if not worse(own)]
    return candidates[min(able)[-1]]


def _blocks(candidates: Sequence[_StructureCandidate]) -> list[Array]:
    """Return the mean squared errors (k,) of candidates in blocks, all outputs alike."""
    scale = np.min([np.mean(one.errors ** 2, axis=0) for one in candidates], axis=0)
    # errors of a simulation last: in blocks they are independent
    return [np.array([np.mean(block ** 2 / scale) for block in np.array_split(
        one.errors, max(2, len(one.errors) // SETTLING))]) for one in candidates]


def _excess(own: Array, other: Array) -> tuple[float, float]:
    """Return by which share squared errors (k,) are above others, and its standard error."""
    excess = (own - other) / np.mean(other)
    return float(np.mean(excess)), float(np.std(excess) / np.sqrt(len(excess)))


@dataclass(frozen=True)
class _Shared:
    """The common data of all networks."""

    linear: _StructureCandidate  #: beside which they are
    data: tuple[Segments, Array]  #: pieces that are simulated, and where they start
    learn_input_matrix: bool
    budget: float  #: of each, in s of processor time

    def allowed(self, network: NetworkDrift) -> bool:
        """Return whether a network diverges far from the data only where the plant does."""
        return network.bounded or self.linear.model.drift.growth_rate >= 0.0

    def candidate(self, network: Refined[NetworkDrift]) -> _StructureCandidate | None:
        """Return the candidate of a network."""
        linear = self.linear
        found = _candidate(network, linear.start, self.data[0], linear.hidden)
        return found and replace(found, offsets=linear.offsets)


def _add_networks(choice: _Choice, shared: _Shared, items: Mapping[str, tuple[int, int]],
                  stage: Callable[[str], Callable[..., bool]], backend: Backend) -> None:
    """Add the best network of each size, of several starts."""
    monitors = dict[str, Callable[..., bool]]()

    def watch(name: str, _: object) -> bool:
        if name not in monitors:
            monitors[name] = stage(name)
        return monitors[name]() and False

    for units in _UNITS:
        own = {name: item for name, item in items.items() if item[0] == units}
        with contextlib.closing(backend.run(_network, own, shared=shared, watch=watch)) as results:
            fitted = [found for _, found in results if found is not None]
        best = min(fitted, key=lambda one: one.cost, default=None)
        choice.gains(None if best is None else shared.candidate(best))


def _network(shared: _Shared, item: tuple[int, int], tell: Tell
             ) -> Refined[NetworkDrift] | None:
    """Return a network that fits the record; None where it may diverge."""
    end = time.process_time() + shared.budget

    def monitor(*_: object) -> bool:
        tell(None)
        return time.process_time() > end

    monitor()
    (units, seed), drift = item, shared.linear.model.drift
    assert isinstance(drift, DriftModel)
    found = _simulated(
        NetworkDrift.beside(drift, units, seed, ridge=_RIDGE,
                            learn_input_matrix=shared.learn_input_matrix),
        shared.linear.gain, *shared.data, monitor)
    return found if shared.allowed(found.model) else None


def _simulated(model: _Model, gain: Array, data: Segments, starts: Array,
               monitor: Callable[..., bool]) -> Refined[_Model]:
    """Return a model whose simulations err least."""
    penalty = model.penalty if isinstance(model, NetworkDrift) else None
    return innovations_form(model, 0.0 * gain, data, starts, np.ones(gain.shape[1]), smooth=True,
                            tolerance=_TOLERANCE, penalty=penalty, iterations=_ITERATIONS,
                            monitor=monitor)


def _candidate(refined: Refined[Any], start: Predictor[DriftModel], data: Segments, hidden: int
               ) -> _StructureCandidate | None:
    """Return the candidate of a model; None where it diverges or hangs on a few samples."""
    if not np.isfinite(refined.cost):
        return None
    with np.errstate(all='ignore'):
        try:
            errors = refined.left_out(SETTLING)
        except np.linalg.LinAlgError:
            # a few samples decide alone about some direction of the parameters
            return None
        # a state that the first samples do not tell is of no use
        free = Predictor(refined.model.drift, 0.0 * start.gain)
        others = free.along(data, free.starts(data, refined.starts)).innovations
        errors = np.where(np.mean(errors ** 2, axis=0) > np.mean(others ** 2, axis=0),
                          errors, others)
    return _StructureCandidate(refined.model, start, hidden, errors, refined.starts) if np.all(
        np.abs(errors) < _LOST) else None


def _with_gain(record: SplitRecord, best: _StructureCandidate, monitor: Callable[..., bool]
               ) -> Predictor[Drift]:
    """Return the best candidate with a filter that is fitted to it."""
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
    Candidates of polynomial drifts.

    :ivar deviation: (n_y,) standard deviations of the innovations of the last filter.
    :ivar samples: longest piece that is simulated; 0 until a model tells the plant's memory.
    """

    def __init__(self, record: SplitRecord) -> None:
        self.record, self._plant = record, record.plant
        self.deviation = np.ones(len(self._plant.state_names))
        self.learn_B = self._plant.B is None
        self.samples = 0

    def linear(self, hidden: int, monitor: Callable[..., bool]) -> _StructureCandidate | None:
        """Return the linear model of an order; None where simulations diverge."""
        samples = self.samples
        for begin in (self._realised, self.from_filters):
            start = begin(hidden, monitor)
            found = None if start is None else self.simulated(start, hidden, monitor)
            # an unstable plant in a closed loop has no realisation of its own
            if found is not None and (begin == self.from_filters
                                      or found.model.drift.growth_rate < 0.0):
                return self._standardised(found) if hidden else found
            self.samples = samples
        return None

    def _standardised(self, found: _StructureCandidate) -> _StructureCandidate:
        """Return a linear model whose hidden states are between -1 and 1 in the record."""
        assert isinstance(found.model, PolynomialCoefficients)
        try:
            start = Predictor(found.model.drift, found.gain)
            start = standardised(start, self.record.estimates(start))
        except (ValueError, np.linalg.LinAlgError):
            return found
        return replace(found, model=replace(found.model, drift=start.drift), start=start)

    def simulated(self, start: _Polynomial, hidden: int, monitor: Callable[..., bool]
                  ) -> _StructureCandidate | None:
        """Return the candidate whose simulations err least; None where they diverge."""
        # a realisation or a filter may forget faster than the plant
        for _ in range(1 if self.samples else 2):
            samples = self.samples or self.record.memory(start.drift)
            try:
                data, starts = self.record.simulated(start, samples)
            except ValueError:
                return None
            refined = _simulated(PolynomialCoefficients(start.drift, self.learn_B), start.gain,
                                 data, starts, monitor)
            if not np.isfinite(refined.cost):
                return None
            if not self.samples:
                self.samples = self.record.memory(refined.model.drift)
                if self.samples == samples:
                    break
        return _candidate(refined, start, data, hidden)

    def extended(self, linear: _StructureCandidate) -> _Polynomial:
        """Return a linear model with further inputs of the record, which do nothing yet."""
        drift = linear.model.drift
        assert isinstance(drift, DriftModel)
        inputs = self._shape(0).box.inputs
        B = np.hstack((drift.B, np.zeros((len(drift.B), len(inputs) - drift.B.shape[1]))))
        return Predictor(replace(drift, B=B, box=replace(drift.box, inputs=inputs)), linear.gain)

    def filtered(self, start: _Polynomial, monitor: Callable[..., bool]) -> _Polynomial | None:
        """Return a filter that foresees the record better; None where there is none."""
        try:
            found, _ = self._refined(start, monitor)
            self.deviation = np.std(self.record.innovations(found), axis=0)
            return standardised(found, self.record.estimates(found))
        except (ValueError, np.linalg.LinAlgError):
            return None

    def _realised(self, hidden: int, monitor: Callable[..., bool]) -> _Polynomial | None:
        """Return a stable linear model of the outputs, with a filter that corrects nothing."""
        shape = self._shape(hidden)
        (states, inputs), n_y = (shape.box.states, shape.box.inputs), len(self.deviation)
        measured = states.only(states.names[:n_y])
        monitor()
        found = realised([replace(one, x=measured.to_deviation(one.x), u=inputs.to_deviation(
            one.u)) for one in self.record.episodes], self.record.period, n_y + hidden
            ) if self.learn_B else None
        if found is None:
            return None
        A, B, c = found
        start = Predictor(replace(shape, coefficients=np.vstack((c, A.T)), B=B),
                          np.zeros((n_y + hidden, n_y)))
        try:
            return standardised(start, self.record.estimates(start)) if hidden else start
        except (ValueError, np.linalg.LinAlgError):
            return None

    def from_filters(self, hidden: int, monitor: Callable[..., bool]) -> _Polynomial | None:
        """Return the best filter of a linear drift; it is stable where the plant is not."""
        try:
            tried = [self._refined(self._start(hidden, gains), monitor) for gains in _GAINS]
        except ValueError:
            return None
        return self.filtered(min(tried, key=lambda pair: pair[1])[0], monitor)

    def _refined(self, start: _Polynomial, monitor: Callable[..., bool]
                 ) -> tuple[_Polynomial, float]:
        record, parts = self.record, self.record.fit
        shortest = min(len(record.parts[i]) for i in parts)
        found = innovations_form(
            PolynomialCoefficients(start.drift, self.learn_B), start.gain,
            record.segments(parts), record.foreseen(start, parts), self.deviation,
            settling=min(SETTLING, shortest // 3), monitor=monitor)
        return Predictor(found.model.drift, found.gain), found.cost

    def _shape(self, hidden: int) -> DriftModel:
        """Return a linear drift of nothing, with the box of the record."""
        plant, parts = self._plant, self.record.parts
        n_x = len(plant.state_names) + hidden
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
        return DriftModel(box, 1, np.zeros((1 + n_x, n_x)), np.zeros((n_x, len(box.inputs))) if (
            B is None) else box.input_matrix(B))

    def _start(self, hidden: int, gains: Sequence[float]) -> _Polynomial:
        """Return a filter of outputs that move by themselves, each at a rate of its own."""
        shape = self._shape(hidden)
        n_y = len(self._plant.state_names)
        n_x = n_y + hidden
        gain = np.zeros((n_x, n_y))
        for i in range(n_x):
            layer = min(i // n_y, len(gains) - 1)
            gain[i, i % n_y] = gains[layer] * _SAMPLES ** layer
            if i >= n_y:
                shape.coefficients[1 + i, i - n_y] = 1.0 / (_SAMPLES * self.record.period)
        return Predictor(shape, gain)
