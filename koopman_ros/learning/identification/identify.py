# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Choice of a drift model among all methods and degrees, by held-out segments."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import contextlib
from dataclasses import dataclass, field, replace
from enum import Enum
import math
from typing import Any

import numpy as np

from koopman_ros.core.arrays import expect, short_repr
from koopman_ros.core.datasets import Array, cut, Episode, PlantDescription
from koopman_ros.core.plugins import contained
from koopman_ros.core.solvers import decaying
from koopman_ros.execution import Backend, Notify, Serial
from koopman_ros.identification_methods import METHODS
from koopman_ros.learning.identification.base import (
    DriftProblem,
    IdentificationMethod,
    methods_of,
)
from koopman_ros.learning.identification.degree_choice import (
    following,
    information,
    NEARLY,
    nearly_best,
)
from koopman_ros.learning.identification.drift import (
    autocorrelation,
    box_of,
    chooses_terms,
    Drift,
    DriftModel,
    longest_step,
    prediction_error,
    Segments,
)
from koopman_ros.learning.identification.excitation import check_inputs
from koopman_ros.learning.identification.output_error import output_error
from koopman_ros.learning.identification.total_variation import noise_level
from koopman_ros.learning.lift.input_model import InputModel
from koopman_ros.model import Box

DEGREES = (1, 2, 3, 4, 5, 6)
# Highest degree, and most monomials, of a drift whose terms are chosen.
_DEGREE, _MOST_MONOMIALS = 3, 500
OUTPUT_ERROR = 'output error'
INNOVATIONS_FORM = 'innovations form'

_SEGMENT_SAMPLES = (20, 240)
_SEGMENTS = 15
_FITTED = 0.6  # share of them that are fitted; they hold the extremes of all signals
# For two states and an input, six of them may hold the extremes.
_FEWEST = 8
_RUN = 2000  # samples of a simulation of the record
_COLOUR = 0.95  # highest autocorrelation of errors that counts

# Called with (steps done, steps in all, current step); True ends the estimation.
Watch = Callable[[int, int, str], bool]


class Stopped(Exception):  # noqa: N818
    """The `watch` callback asked to stop."""


def stage_monitor(watch: Watch, number: int, total: int, text: str) -> Callable[..., bool]:
    """Return a monitor that reports a stage, and raises Stopped when `watch` asks to stop."""
    def monitor(*_: object) -> bool:
        if watch(number, total, text):
            raise Stopped
        return False

    return monitor


@dataclass(frozen=True)
class Score:
    """Prediction error of one estimate on the segments held out for the choice."""

    method: str  #: its name, e.g. ``'weak form, 40 samples'``
    degree: int | None  #: of the drift, None where it is no polynomial
    rmse: Array  #: (n_x,) root mean square error, in state units; infinite when it diverges
    cost: float  #: mean squared error in units of the states' scale, by which estimates compare


class EstimateStatus(Enum):
    """Reliability of the estimate of a constant; the value is the sentence for the user."""

    ESTIMATED = ''
    AT_LOWER_END = ('at the lower end of its range: widen the range, or check the equations')
    AT_UPPER_END = ('at the upper end of its range: widen the range, or check the equations')
    NOT_IDENTIFIABLE = ('not identifiable from the record: fix its value, or that of another '
                        'constant with the same effect, or record more')


@dataclass(frozen=True)
class EstimatedConstant:
    """A constant of a plant's equations, as estimated from a record."""

    name: str  #: of the field of the plant's class
    unit: str  #: of SI, as the plant node has it
    value: float  #: the estimate, in `unit`
    #: standard deviation of the estimate, in `unit` (K for a temperature); NaN at an end of the
    #: range, infinite where the record tells nothing of it
    standard_error: float
    lower: float  #: lowest value that was looked at
    upper: float  #: highest value
    standing: EstimateStatus

    def __str__(self) -> str:
        error = '' if self.standing is not EstimateStatus.ESTIMATED else (
            f' +- {self.standard_error:.2g}')
        suffix = f' ({self.standing.value})' if self.standing.value else ''
        return f'{self.value:.6g}{error} {self.unit}{suffix}'


@dataclass(frozen=True)
class Identified:
    """An estimated drift with the scores of all candidates."""

    drift: Drift  #: the estimate
    method: str  #: how it was found
    linear: Drift  #: the best linear model of the same episodes, by output error
    scores: tuple[Score, ...]  #: of all estimates, in the order of their making
    #: (n_x,) standard deviation of the measurement noise, from sample to sample; NaN of a state
    #: that is measured too rarely
    noise: Array
    fitted: tuple[Episode, ...]  #: the segments that it was fitted to
    #: segments that neither fit nor choice has seen; those of a drift with unmeasured states are
    #: part of its fit, whose scores are of samples left out in turn
    held_out: tuple[Episode, ...]
    #: unmeasured states, the last ones: the segments hold a filter's estimates of them
    hidden: int = 0
    #: those that were estimated, where it is the equations of a plant's class
    constants: tuple[EstimatedConstant, ...] = ()
    warnings: tuple[str, ...] = ()  #: about the inputs of the record, for the user
    #: other drifts that explain the samples left out of their fit about as well
    alternatives: tuple[Drift, ...] = ()
    #: (n_u,) by which the inputs of the segments are later than those of the record, in time
    #: units; or one for all
    dead_time: Array = field(default_factory=lambda: np.zeros(()))
    disturbances: tuple[str, ...] = ()  #: inputs that are measured disturbances
    steps: tuple[str, ...] = ()  #: of the search for the structure, in words
    searched: tuple[str, ...] = ()  #: parameters of the training whose values it has compared
    #: (n_y,) root mean square errors of free runs of the record, in state units, where they were
    #: compared
    free_run: Array = field(default_factory=lambda: np.zeros(0))
    #: (E, n_x) constant disturbances of the rates in the episodes of the record, whose mean is 0,
    #: in state units per time unit; no row where they are not needed. The drift has none.
    offsets: Array = field(default_factory=lambda: np.zeros((0, 0)))

    __repr__ = short_repr

    def __post_init__(self) -> None:
        object.__setattr__(self, 'dead_time', np.broadcast_to(
            self.dead_time, len(self.drift.box.inputs)))

    @property
    def episodes(self) -> list[Episode]:
        """All segments."""
        return [*self.fitted, *self.held_out]

    @property
    def shifts(self) -> Array:
        """
        Shifts (E, n_y) of the measured steady states by the offsets, in state units.

        In the middle of the range; infinite where an offset makes the plant drift away.
        """
        slope = self.drift.slope(self.drift.box.states.center)
        count = len(slope) - self.hidden
        if not decaying(np.linalg.eigvals(slope)).all():
            return np.full((len(self.offsets), count), np.inf)
        return np.asarray(-np.linalg.solve(slope, self.offsets.T).T[:, :count])

    def mapped(self, drift: Callable[[Any], Any], episode: Callable[[Episode], Episode],
               **changes: Any) -> Identified:
        """Return the same with functions of its drifts and segments, and other changes."""
        fitted, held_out = (tuple(map(episode, some)) for some in (self.fitted, self.held_out))
        return replace(self, **{
            'drift': drift(self.drift), 'linear': drift(self.linear), 'fitted': fitted,
            'held_out': held_out, 'alternatives': tuple(map(drift, self.alternatives)),
            **changes})


def identify(plant: PlantDescription, episodes: Sequence[Episode], *,
             degrees: Sequence[int] | None = None,
             methods: Mapping[str, IdentificationMethod] | None = None, seed: int = 0,
             watch: Watch = lambda *_: False, backend: Backend | None = None) -> Identified:
    """
    Estimate dx/dt = f(x) + B(x) u from sampled, noisy measurements.

    For each degree of f every method gives an estimate; the best on segments held out for the
    choice is refined by output error, where that pays. Degrees whose simulations of the record
    diverge are left out, unless the drift is unstable. Of the degrees that predict about as well
    as the best, the one with the least Bayesian information criterion (Schwarz 1978) over the
    fitted segments is taken, which reach further than the others, and refitted to all but those
    held out for good.

    :param plant: names, units, and B where it is known, or the degree of the B(x) to learn.
    :param degrees: of f that are tried, rising, the first one 1; by default those whose drift has
        few enough coefficients for the number of states.
    :param methods: by name, in the order in which they pass a rough B on; all of ``METHODS`` by
        default.
    :param seed: of the split.
    :param backend: where the degrees are estimated, each by itself; this process by default.
    :raises ValueError: when the episodes are too short, their inputs do not determine B, or
        nothing fits.
    :raises Stopped: when `watch` requested it.
    """
    expect(plant=(plant, PlantDescription))
    n_x, n_u = len(plant.state_names), len(plant.input_names)
    degrees = degrees or usual_degrees(n_x, chosen=True)
    parts = segments_of(episodes, n_x + n_u)
    box = box_of(plant, parts)
    warnings = check_inputs(plant, episodes)
    fit, choose, held_out = ([parts[i] for i in share] for share in split(parts, seed))
    step = longest_step(parts)
    chooser, fitter = Segments.of(choose, step), Segments.of(fit, step)
    inputs = InputModel.of(plant, box, np.concatenate([part.interpolated() for part in parts]))
    known = inputs.weights
    if methods is None:
        methods = methods_of(tuple(METHODS), {})
    scores: list[Score] = []
    failures: dict[str, None] = {}
    best: dict[int, tuple[DriftModel, Score]] = {}
    done, words = 0, {f'drift of degree {degree}': degree for degree in degrees}

    def progress(name: str, _: object) -> bool:
        return stage_monitor(watch, done, len(degrees) + 1, name or [*words, ''][done])()

    with contextlib.closing((backend or Serial()).run(
            _candidate, words, watch=progress, shared=_Given(
                [replace(part, x=part.interpolated()) for part in fit], fitter, chooser, box,
                known, inputs.degree, methods))) as candidates:
        for name, candidate in candidates:
            done += 1
            failures |= dict.fromkeys(candidate.failures)
            scores += candidate.scores
            if candidate.best is not None:
                best[words[name]] = candidate.best
    able = [d for d, (_, score) in best.items() if math.isfinite(score.cost)]
    if not able:
        raise ValueError('; '.join(['no drift fits the episodes: record longer, with steps of the '
                                    'input', *failures]))
    record, costs = Segments.of(cut(episodes, _RUN), step), {d: best[d][1].cost for d in able}
    left = following({d: best[d][0] for d in able}, costs, record)
    everything = Segments.of([*fit, *choose], step)
    finished: dict[int, DriftModel] = {}

    def finish(d: int) -> DriftModel:
        def monitor(*_: object) -> bool:
            return progress(f'drift of degree {degree} on all episodes', None)

        monitor()
        model, score = best[d]
        finished[d] = output_error(model, everything, learn_input_matrix=known is None,
                                   monitor=monitor) if OUTPUT_ERROR in score.method else model
        return finished[d]

    likeliest = min(left, key=lambda d: costs[d])
    colour = np.clip(autocorrelation(best[likeliest][0], fitter), 0.0, _COLOUR)
    while True:
        good = nearly_best(left, costs)
        degree = min(good, key=lambda d: information(best[d][0], fitter, known is None, colour))
        models = {**{d: best[d][0] for d in left}, degree: finish(degree)}
        if len(left) == 1 or degree in following(models, costs, record):
            break
        left.remove(degree)
    if degrees[0] in best and degrees[0] not in finished:
        finish(degrees[0])
    # an input matrix that depends on the state is no part of a linear model
    linear = finished[min(finished)] if not plant.input_matrix_degree else identify(
        replace(plant, input_matrix_degree=0), episodes, degrees=degrees[:1], methods=methods,
        seed=seed, watch=lambda *_: watch(done, len(degrees) + 1, 'linear model')).drift
    return Identified(finished[degree], best[degree][1].method, linear,
                      tuple(scores), noise_level(parts, finished[degree]),
                      (*fit, *choose), tuple(held_out), warnings=(*warnings, *failures),
                      alternatives=tuple(best[d][0] for d in good if d != degree),
                      disturbances=plant.disturbance_names)


def usual_degrees(n_x: int, *, chosen: bool = False) -> tuple[int, ...]:
    """
    Return the degrees of a drift with few enough coefficients for a number of states.

    :param chosen: also those of which an estimate chooses the terms.
    """
    def suits(degree: int) -> bool:
        count = math.comb(n_x + degree, degree)
        return not chooses_terms(degree, n_x * count) or (
            chosen and degree <= _DEGREE and count <= _MOST_MONOMIALS)

    return tuple(filter(suits, DEGREES))


@dataclass(frozen=True)
class _Given:
    """The data of the estimates of all degrees."""

    fit: Sequence[Episode]  # with lines between measurements
    fitter: Segments  # the same, by measurements alone
    chooser: Segments
    box: Box
    known: Array | None  # B as DriftModel has it
    input_degree: int  # of the B(x) to estimate
    methods: Mapping[str, IdentificationMethod]


@dataclass(frozen=True)
class _DegreeCandidate:
    """The best estimate of a degree, with the scores of all of them that were refined."""

    best: tuple[DriftModel, Score] | None
    scores: tuple[Score, ...]
    failures: tuple[str, ...]  # reasons of methods that raised unexpectedly


def _candidate(given: _Given, degree: int, notify: Notify) -> _DegreeCandidate:
    """Estimate a drift of a degree by every method, and refine the best."""
    def monitor(*_: object) -> bool:
        return notify(None)

    monitor()
    estimates, failures = _estimates(given, degree)
    rated = [(model, _score(model, given.chooser, method)) for method, model in estimates]
    model, score = min(rated, key=lambda pair: pair[1].cost, default=(None, None))
    if model is None or score is None:
        return _DegreeCandidate(None, (), failures)
    if not math.isfinite(score.cost):
        return _DegreeCandidate((model, score), (), failures)
    refined = output_error(model, given.fitter, learn_input_matrix=given.known is None,
                           monitor=monitor)
    polished = _score(refined, given.chooser, f'{OUTPUT_ERROR} from {score.method}')
    # the better estimate in theory needs no proof, only that it does no harm
    best = (refined, polished) if polished.cost <= NEARLY * score.cost else (model, score)
    return _DegreeCandidate(best, (*(score for _, score in rated), polished), failures)


def segments_of(episodes: Sequence[Episode], signals: int) -> list[Episode]:
    """Cut into segments, of which three fifths may hold the extremes of the signals."""
    low, high = _SEGMENT_SAMPLES
    count = max(_SEGMENTS, math.ceil(2 * signals / _FITTED))
    total = sum(len(episode) for episode in episodes)
    if total < _FEWEST * low:
        raise ValueError(f'{total} samples are too few for training and testing: record at least '
                         f'{_FEWEST * low}, better several thousand')
    parts = cut(episodes, min(high, max(low, total // count)))
    kept = [part for part in parts if len(part) >= low // 2]
    if len(kept) < _FEWEST:
        raise ValueError(f'the episodes have {len(kept)} uninterrupted segments of {low // 2} '
                         f'samples, at least {_FEWEST} are needed: record longer without gaps')
    return kept


def split(parts: Sequence[Episode], seed: int) -> tuple[list[int], list[int], list[int]]:
    """
    Return which segments to fit to, to choose by and to hold out: three, one and one fifth.

    Those that reach furthest are fitted to: the range should be known, not extrapolated to.
    """
    lows, highs = (np.array([np.concatenate((of.reduce(part.x), of.reduce(part.u)))
                             for part in parts]) for of in (np.fmin, np.fmax))
    furthest = {*np.nanargmin(lows, axis=0).tolist(), *np.nanargmax(highs, axis=0).tolist()}
    free = [i for i in np.random.default_rng(seed).permutation(len(parts)).tolist()
            if i not in furthest]
    if len(free) < 2:
        raise ValueError(f'all but {len(free)} of {len(parts)} segments contain the lowest or '
                         'highest value of a signal, so none can be held out: record longer')
    fifth = min(max(1, len(parts) // 5), len(free) // 2)
    choose, held_out = free[:fifth], free[fifth:2 * fifth]
    fit = furthest.union(free[2 * fifth:])
    return sorted(fit), sorted(choose), sorted(held_out)


def _estimates(given: _Given, degree: int
               ) -> tuple[list[tuple[str, DriftModel]], tuple[str, ...]]:
    """Return the estimates of all methods by name, and why methods failed unexpectedly."""
    found: list[tuple[str, DriftModel]] = []
    failures = []
    for name, method in given.methods.items():
        rough = found[-1][1].B if found else given.known
        try:
            for estimate in method.estimate(DriftProblem(
                    given.fit, given.box, degree, given.known, rough, given.input_degree)):
                words = [name.replace('_', ' '), estimate.variant]
                if not np.all(np.isfinite(estimate.model.coefficients)):
                    raise ValueError('its coefficients are not finite')
                found.append((', '.join(filter(None, words)), estimate.model))
        except (ValueError, np.linalg.LinAlgError):
            # as on short segments
            continue
        except Exception as error:
            failures.append(f'the method {name} failed: {contained(error)}')
    return found, tuple(failures)


def _score(model: DriftModel, segments: Segments, method: str) -> Score:
    scale = model.box.states.scale
    rmse = prediction_error(model.rate, segments, scale)
    return Score(method, model.degree, rmse, float(np.mean((rmse / scale) ** 2)))
