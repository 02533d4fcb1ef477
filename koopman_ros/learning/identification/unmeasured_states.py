# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drift of a plant some of whose states were never measured, in coordinates found with it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
import itertools
import time
from typing import Any

import numpy as np

from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.datasets import Array, cut, Episode, PlantDescription
from koopman_ros.execution import Backend, Serial
from koopman_ros.learning.identification.alternatives import in_coordinates_of
from koopman_ros.learning.identification.base import IdentificationMethod
from koopman_ros.learning.identification.characteristics import (
    characteristic_of,
    identify_with_characteristics,
    NotMonotoneError,
)
from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.degree_choice import NEARLY
from koopman_ros.learning.identification.drift import (
    Drift,
    DriftModel,
    fitted_starts,
    longest_step,
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
    MOST_COEFFICIENTS,
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
from koopman_ros.learning.identification.late_candidates import late_as_suits, late_linear
from koopman_ros.learning.identification.network_candidates import (
    add_networks,
    best_units,
    network_starts,
    Shared,
)
from koopman_ros.learning.identification.network_drift import NetworkDrift
from koopman_ros.learning.identification.output_error import innovations_form
from koopman_ros.learning.identification.polynomial_candidates import PolynomialSearch
from koopman_ros.learning.identification.structure_candidates import (
    Choice,
    compared,
    equals,
    not_measured,
    smallest_adequate,
    StructureCandidate,
)
from koopman_ros.model import Coordinates

HIGHEST_DEGREE = 3
MOST_UNMEASURED = 3  # states that are tried where their number is not given
BUDGET = 300.0  # s of processor time of a search
_ROUNDS = 2  # of linear drifts with whose states characteristics are found
_EXPLAINED = 1.2  # times the innovation variance of a filter: nothing is left to learn
_SLIGHT = 0.01  # share of the motion, of which no state that is not measured is sought


def identify_structure(plant: PlantDescription, episodes: Sequence[Episode], *,
                       given: Collection[str] = (),
                       methods: Mapping[str, IdentificationMethod] | None = None,
                       dead_times: bool = True, seed: int = 0, watch: Watch = lambda *_: False,
                       backend: Backend | None = None) -> Identified:
    """
    Estimate a drift with as many states as free runs of the record need.

    An estimate of measured states by :func:`identify_with_characteristics` is kept if its
    simulations of the whole record err by little more than noise. Otherwise B(x) of degree 1 is
    tried, unless it has too many coefficients, and taken where free runs of the segments held out
    err less, and those of all by more than two standard errors. If the simulations then err by
    more than noise and than 1 % of the motion, the estimate competes with those of
    :func:`identify_unmeasured`.

    A characteristic that the measured states show is found again with the estimates of the others.

    :param given: inputs whose characteristic the plant has already.
    :param methods: see :func:`identify`; other arguments as for :func:`identify_unmeasured`.
    """
    def estimate(plant: PlantDescription, given: Collection[str], before: int) -> Identified:
        return identify_with_characteristics(
            plant, episodes, given=given, methods=methods, seed=seed, backend=backend,
            watch=lambda done, total, text: watch(before * total + done, 5 * total, text))

    end = time.process_time() + BUDGET
    try:
        measured = estimate(plant, given, 0)
        sought = measured.drift.characteristics.keys() - set(given)
    except NotMonotoneError:
        # so it may seem where a state between input and measurement is not measured
        measured = estimate(plant, plant.input_names, 0)
        sought = set(plant.input_names) - set(given)
    plant = replace(plant, characteristics=measured.drift.box.inputs.characteristics)
    if callable(plant.B) or plant.input_matrix_degree or _explains(
            measured, plant, episodes, 0.0):
        return measured
    n_x, n_u = len(plant.state_names), len(plant.input_names)
    if plant.B is None and not plant.disturbance_names and (
            n_x * (1 + n_x) * (1 + n_u) <= MOST_COEFFICIENTS):
        varying = estimate(replace(plant, input_matrix_degree=1), plant.input_names, 1)
        (own, held_out), (other, others) = map(free_run_errors, (varying, measured))
        better, words = compared(own, other)
        better &= bool(np.mean(held_out ** 2) < np.mean(others ** 2))
        steps = measured.drift.form, f'{varying.drift.form}: {words}'
        measured = replace(varying if better else measured, linear=measured.linear, steps=steps,
                           searched=('input_matrix_degree',))
    if _explains(measured, plant, episodes, _SLIGHT):
        return measured
    if sought:
        plant = _with_characteristics(plant, episodes, sought, seed=seed, dead_times=dead_times,
                                      backend=backend)
    return identify_unmeasured(
        plant, episodes, MOST_UNMEASURED, measured=measured, dead_times=dead_times, seed=seed,
        backend=backend, budget=max(0.0, end - time.process_time()),
        watch=lambda done, total, text: watch(2 * total + 3 * done, 5 * total, text))


def _with_characteristics(plant: PlantDescription, episodes: Sequence[Episode],
                          names: Collection[str], **options: Any) -> PlantDescription:
    """Return the plant with characteristics that linear drifts with unmeasured states show."""
    for _ in range(_ROUNDS):
        rough = identify_unmeasured(plant, episodes, MOST_UNMEASURED, highest_degree=1,
                                    networks=False, **options)
        found = dict[str, Characteristic]()
        for name in names if isinstance(rough.drift, DriftModel) else ():
            try:
                if (one := characteristic_of(rough, name)) is not None:
                    found[name] = one
            except NotMonotoneError:
                # one that was found before is kept
                if name not in plant.characteristics:
                    raise
        if not found:
            break
        plant = replace(plant, characteristics={**plant.characteristics, **found})
    return plant


def _explains(found: Identified, plant: PlantDescription, episodes: Sequence[Episode],
              slight: float) -> bool:
    """Return whether simulations of the record err by noise alone, or a share of the motion."""
    drift = found.drift
    record = SplitRecord(plant, episodes, 0, hidden=False)
    data = Segments.of(cut(episodes, record.memory(drift)), record.step)
    squares = prediction_error(drift.rate, data, drift.box.states.scale) ** 2
    spread = np.nanvar(np.concatenate([episode.x for episode in episodes]), axis=0)
    return bool(np.all(squares <= np.fmax(
        _EXPLAINED * found.noise ** 2, slight ** 2 * spread)))


def free_run_errors(found: Identified) -> tuple[Array, Array]:
    """Return the errors (N, n_x) of free runs of all segments, and of those held out, scaled."""
    rate, scale = found.drift.rate, found.drift.box.states.scale
    data = Segments.of([*found.fitted, *found.held_out], longest_step(found.fitted))
    errors = data.errors(rate, fitted_starts(rate, data, scale)[0]).swapaxes(0, 1) / scale
    # one segment after the other
    sampled, first = data.sampled.T, len(found.fitted)
    return errors[sampled], errors[first:][sampled[first:]]


def identify_unmeasured(plant: PlantDescription, episodes: Sequence[Episode], hidden: int, *,
                        measured: Identified | None = None, highest_degree: int = HIGHEST_DEGREE,
                        networks: bool = True, dead_times: bool = True, seed: int = 0,
                        budget: float = BUDGET, watch: Watch = lambda *_: False,
                        backend: Backend | None = None) -> Identified:
    """
    Estimate dx/dt = f(x) + B u where only the first n_y states are in the record.

    Models are compared by simulations of the record at samples that are left out of the fit in
    turn, see :meth:`Refined.left_out`, and from starts that are fitted to its first samples,
    whichever err more. First linear models of rising order are simulated, from realisations of
    stable models of the outputs, otherwise from filters; the search ends with the order that
    lowers the mean squared error by no more than two standard errors, over blocks of the record.
    Dead times, with which the order is found again, and a constant disturbance of each of several
    episodes are kept by the same rule. Then polynomials of higher degree and small networks are
    added to the linear drift of the best order, and networks to that with a state less or more if
    it errs about as little; other dead times are tried with the best of them. The smallest model
    is taken that errs by no more than two standard errors above the least. At last the gain of
    its filter is fitted. Unmeasured states are those of the filter: dimensionless, from -1 to
    1, because no record gives their names and units.

    :param plant: names, units, and B where it is known, of the measured signals.
    :param hidden: most states that are not measured, at least 1.
    :param measured: an estimate without such states, which competes; without it there is at least
        one.
    :param highest_degree: of polynomials f.
    :param networks: whether networks are tried, too.
    :param dead_times: whether dead times are tried, too.
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
    sizes = network_starts(seed) if networks else {}
    total = hidden + 1 - least + highest_degree + len(sizes) + 6
    end, choice = time.process_time() + budget, Choice(() if measured is None else measured.steps)
    begun = itertools.count()

    def stage(text: str, limit: float = end) -> Callable[..., bool]:
        number = min(next(begun), total - 1)

        def monitor(*_: object) -> bool:
            if watch(number, total, text):
                raise Stopped
            return time.process_time() > limit

        if monitor():
            choice.steps.append(f'stopped after {budget:.0f} s: {text}')
        return monitor

    n_y, search = len(plant.state_names), PolynomialSearch(record)
    manipulated = [dead_times and name not in plant.disturbance_names
                   for name in plant.input_names]
    rising = search.rising(range(least, hidden + 1), choice, stage)
    if not rising:
        raise ValueError('no drift fits the episodes: record longer, with steps of the input')
    linear, first = smallest_adequate(rising), search
    late = least_late = None
    if any(manipulated):
        late = late_linear(search, linear, manipulated, stage('dead time'))
        # states may stand for a dead time that a nonlinear drift shows
        least_late = late_linear(search, rising[0], manipulated, stage('dead time')) if (
            rising[0] is not linear) else None
    if least_late is not None and compared(least_late.errors, rising[0].errors)[0]:
        choice.gains(least_late)
    else:
        least_late = None
    if choice.gains(late):
        # without the dead time some of the states may have stood for it
        assert late is not None
        search = PolynomialSearch(late.record, first.samples, late=late.late)
        rising = [*search.rising(range(least, late.hidden), choice, stage), late]
        linear = smallest_adequate(rising)
    extended = record
    if plant.B is None and 1 < len(episodes) <= MOST_EPISODES:
        monitor = stage('constant offset of each episode')
        extended = SplitRecord(*with_episode_inputs(plant, episodes), seed, hidden=True)
        more = PolynomialSearch(
            extended.later(search.late), first.samples, offsets=True, late=search.late)
        if choice.gains(more.simulated(more.extended(linear), linear.hidden, monitor),
                        'constant offset of each episode'):
            search, linear = more, choice.candidates[-1]
    kept = None
    if measured is not None and isinstance(measured.drift, DriftModel):
        kept = first.simulated(Predictor(measured.drift, np.zeros((n_y, n_y))), 0,
                                stage(measured.drift.form))
        choice.gains(kept, measured.drift.form)
    count = linear.hidden
    monitor = stage(f'filter with {not_measured(count)}')
    last = begin = search.from_filters(count, monitor)
    # the filter of a linear drift foresees less of a nonlinear plant than its noise allows
    noise = np.full(n_y, np.inf) if measured is None else (
        measured.noise / measured.drift.box.states.scale)

    def explained() -> bool:
        return begin is not None and choice.explained(
            _EXPLAINED * float(np.mean(np.fmin(search.deviation, noise) ** 2)))

    for degree in usual_degrees(n_y + count)[1:highest_degree] if (
            count or search.late or not measured) else ():
        if last is None or explained():
            break
        name = f'drift of degree {degree} with {not_measured(count)}'
        monitor = stage(name)
        if not monitor():
            last = search.filtered(raised(last), monitor)
            choice.gains(None if last is None else search.simulated(last, count, monitor), name)
    if sizes and not explained():
        # in coordinates of a filter, whose hidden states have the range of those in the record
        base = None if begin is None else search.simulated(begin, count, monitor)
        linear = base or linear

        def shared(one: StructureCandidate, begun: StructureCandidate | None = None) -> Shared:
            data, starts = one.record.simulated(one.start, search.samples)
            return Shared(one, (data, starts if begun is None else begun.starts), search.learn_B,
                          max(0.0, end - time.process_time()) / len(sizes))

        def stage_with(count: int) -> Callable[[str], Callable[..., bool]]:
            return lambda text: stage(f'{text} with {not_measured(count)}')

        add_networks(choice, shared(linear, base), sizes, stage_with(count),
                     backend or Serial())
        others = [] if linear.offsets else [
            *([] if least_late is None else [least_late]), *_nearly_equal(linear, rising)]
        for other in others:
            if stage(f'networks with {not_measured(other.hidden)}')():
                break
            units = best_units(choice)
            add_networks(choice, shared(other), {
                name: item for name, item in sizes.items() if item[0] == (units or item[0])},
                stage_with(other.hidden), backend or Serial())
        best = smallest_adequate(choice.candidates)
        if any(manipulated) and not (
                isinstance(best.model.drift, DriftModel) and best.model.drift.linear):
            choice.gains(late_as_suits(
                best, extended if best.offsets else record, manipulated, search.samples,
                stage(f'dead time of the {best.model.drift.form}')))
    # with as many as are allowed, more may be better
    searched = ('input_matrix_degree', *['unmeasured_states'] * (linear.hidden < hidden))
    able = choice.candidates
    while True:
        best = smallest_adequate(able)
        if best is kept:
            # the estimate without unmeasured states, as it is
            assert measured is not None
            return replace(measured, scores=tuple(one.score for one in choice.candidates),
                           steps=choice.ended(best), free_run=best.score.rmse,
                           searched=searched)
        try:
            predictor = _with_gain(best, stage('gain of the filter', np.inf))
            result = best.record.identified(
                predictor, best.label, [one.score for one in choice.candidates],
                stage('linear model', np.inf))
            break
        except ValueError:
            # its filter diverges
            able = [one for one in able if one is not best]
            if not able:
                raise
    result = replace(result, alternatives=in_coordinates_of(
        predictor, equals(best, able), best.record))
    if best.offsets:
        result = without_episode_inputs(result, len(plant.input_names))
    return replace(
        result, warnings=warnings, searched=searched, steps=choice.ended(best),
        free_run=best.score.rmse,
        dead_time=record.period * np.resize(best.late or 0, len(plant.input_names)))


def _nearly_equal(linear: StructureCandidate, others: Sequence[StructureCandidate]
                  ) -> list[StructureCandidate]:
    """Return those with a state less or more that err about as little."""
    return [one for one in others if abs(one.hidden - linear.hidden) == 1 and (
        one.score.cost <= NEARLY * linear.score.cost
        or not compared(linear.errors, one.errors)[0])]


def _with_gain(best: StructureCandidate, monitor: Callable[..., bool]) -> Predictor[Drift]:
    """Return the best candidate with a filter that is fitted to it."""
    record = best.record
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
