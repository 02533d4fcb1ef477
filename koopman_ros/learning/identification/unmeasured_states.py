# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Drift of a plant some of whose states were never measured, in coordinates found with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import itertools
import time

import numpy as np

from koopman_ros.core.datasets import Array, Episode, PlantDescription
from koopman_ros.execution import Backend, Serial
from koopman_ros.learning.identification.alternatives import in_coordinates_of
from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.degree_choice import NEARLY
from koopman_ros.learning.identification.drift import (
    Drift,
    DriftModel,
)
from koopman_ros.learning.identification.episode_offsets import (
    MOST_EPISODES,
    with_episode_inputs,
    without_episode_inputs,
)
from koopman_ros.learning.identification.excitation import check_inputs
from koopman_ros.learning.identification.identify import (
    Identified,
    stage_monitor,
    usual_degrees,
    Watch,
)
from koopman_ros.learning.identification.innovations_form import (
    Predictor,
    raised,
    SETTLING,
    spanned,
    standardised,
)
from koopman_ros.learning.identification.late_candidates import late_as_suits, late_linear
from koopman_ros.learning.identification.network_candidates import (
    add_networks,
    best_units,
    network_starts,
    Shared,
)
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

HIGHEST_DEGREE = 3
BUDGET = 300.0  # s of processor time of a search
_NONLINEAR = 0.5  # share of the time that linear models leave to others
EXPLAINED = 1.2  # times the innovation variance of a filter: nothing is left to learn


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
    episodes, with as many states or fewer, are kept by the same rule. Then polynomials of higher
    degree and small networks are added to the linear drift of the best order, and networks to that
    with a state less or more if it errs about as little; other dead times are tried with the best
    of them. The smallest model is taken that errs by no more than two standard errors above the
    least. At last the gain of its filter is fitted. Unmeasured states are those of the filter:
    dimensionless, from -1 to 1, because no record gives their names and units.

    :param plant: names, units, and B where it is known, of the measured signals.
    :param hidden: most states that are not measured, at least 1.
    :param measured: an estimate without such states, which competes; without it there is at least
        one.
    :param highest_degree: of polynomials f.
    :param networks: whether networks are tried, too.
    :param dead_times: whether dead times are tried, too.
    :param seed: of the split, and of networks.
    :param budget: processor time in s, after which the best so far is taken and the rest left out;
        linear models take no more than half of it.
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
    now, choice = time.process_time(), Choice(() if measured is None else measured.steps)
    end = now + budget
    begun = itertools.count()

    def stage(text: str, limit: float = end) -> Callable[..., bool]:
        cancelled = stage_monitor(watch, min(next(begun), total - 1), total, text)

        def monitor(*_: object) -> bool:
            return cancelled() or time.process_time() > limit

        if monitor():
            choice.steps.append(f'stopped after {limit - now:.0f} s: {text}')
        return monitor

    def linear_stage(text: str) -> Callable[..., bool]:
        return stage(text, end - _NONLINEAR * budget)

    n_y, search = len(plant.state_names), PolynomialSearch(record)
    manipulated = [dead_times and name not in plant.disturbance_names
                   for name in plant.input_names]
    rising = search.rising(range(least, hidden + 1), choice, linear_stage)
    if not rising:
        raise ValueError('no drift fits the episodes: record longer, with steps of the input')
    linear, first = smallest_adequate(rising), search
    late = least_late = None
    if any(manipulated):
        late = late_linear(search, linear, manipulated, linear_stage('dead time'))
        # states may stand for a dead time that a nonlinear drift shows
        least_late = late_linear(search, rising[0], manipulated, linear_stage('dead time')) if (
            rising[0] is not linear) else None
    if least_late is not None and compared(least_late.errors, rising[0].errors)[0]:
        choice.gains(least_late)
    else:
        least_late = None
    if choice.gains(late):
        # without the dead time some of the states may have stood for it
        assert late is not None
        search = PolynomialSearch(late.record, first.samples)
        rising = [*search.rising(range(least, late.hidden), choice, linear_stage), late]
        linear = smallest_adequate(rising)
    if plant.B is None and 1 < len(episodes) <= MOST_EPISODES:
        monitor = linear_stage('constant offset of each episode')
        extended = SplitRecord(
            *with_episode_inputs(plant, episodes), seed, hidden=True, offsets=True)
        more = PolynomialSearch(extended.later(search.record.late), first.samples)
        # of models with fewer states, too: some of the states may have stood for the offsets
        for one in rising:
            if one.hidden <= linear.hidden:
                choice.gains(more.simulated(more.extended(one), monitor),
                             'constant offset of each episode')
        best = smallest_adequate(choice.candidates)
        if best.record.offsets:
            search, linear = more, best
    kept = None
    if measured is not None and isinstance(measured.drift, DriftModel):
        kept = first.simulated(Predictor(measured.drift, np.zeros((n_y, n_y))),
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
            EXPLAINED * float(np.mean(np.fmin(search.deviation, noise) ** 2)))

    for degree in usual_degrees(n_y + count)[1:highest_degree] if (
            count or search.record.late or not measured) else ():
        # of a linear drift the errors of its filter do not say what noise alone would leave
        if last is None or (degree > 2 and explained()):
            break
        name = f'drift of degree {degree} with {not_measured(count)}'
        monitor = stage(name)
        if not monitor():
            last = search.filtered(raised(last), monitor)
            choice.gains(None if last is None else search.simulated(last, monitor), name)
    if sizes and not explained():
        # in coordinates of a filter, whose hidden states have the range of those in the record
        base = None if begin is None else search.simulated(begin, monitor)
        linear = base or linear

        def shared(one: StructureCandidate, begun: StructureCandidate | None = None) -> Shared:
            data, starts = one.record.simulated(one.start, search.samples)
            return Shared(one, (data, starts if begun is None else begun.starts), search.learn_B,
                          max(0.0, end - time.process_time()) / len(sizes))

        def stage_with(count: int) -> Callable[[str], Callable[..., bool]]:
            return lambda text: stage(f'{text} with {not_measured(count)}')

        add_networks(choice, shared(linear, base), sizes, stage_with(count),
                     backend or Serial())
        others = [] if linear.record.offsets else [
            *([] if least_late is None else [least_late]), *_nearly_equal(linear, rising)]
        for other in others:
            if stage(f'networks with {not_measured(other.hidden)}')():
                break
            units = best_units(choice)
            add_networks(choice, shared(other), {
                name: item for name, item in sizes.items() if item[0] == (units or item[0])},
                stage_with(other.hidden), backend or Serial())
    best = smallest_adequate(choice.candidates)
    # a linear model may need a dead time to stand for what is not linear
    if any(manipulated) and (best.late or not explained()) and not (
            isinstance(best.model.drift, DriftModel) and best.model.drift.linear):
        choice.gains(late_as_suits(best, manipulated, search.samples, stage(
            f'dead time of the {best.model.drift.form}')))
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
            predictor, result = _identified(best, choice, stage)
            break
        except ValueError as error:
            choice.steps.append(f'{best.text}: left out, {error}')
            able = [one for one in able if one is not best]
            if not able:
                raise
    result = replace(result, alternatives=in_coordinates_of(
        predictor, equals(best, able), best.record))
    if best.record.offsets:
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


def _identified(best: StructureCandidate, choice: Choice,
                stage: Callable[..., Callable[..., bool]]
                ) -> tuple[Predictor[Drift], Identified]:
    """
    Return the best candidate with its states, as a filter estimates them, or its simulation.

    :raises ValueError: when its simulation of the record diverges.
    """
    def result(predictor: Predictor[Drift]) -> tuple[Predictor[Drift], Identified]:
        return predictor, best.record.identified(
            predictor, best.label, [one.score for one in choice.candidates],
            stage('linear model', np.inf))

    try:
        return result(_with_gain(best, stage('gain of the filter', np.inf)))
    except ValueError:
        # of a model that forgets its start the simulation shows the states, too
        return result(Predictor(best.model.drift, np.zeros_like(best.gain)))


def _with_gain(best: StructureCandidate, monitor: Callable[..., bool]) -> Predictor[Drift]:
    """Return the best candidate with a filter that is fitted to it."""
    record = best.record
    parts = sorted([*record.fit, *record.choose])
    start = Predictor(best.model.drift, best.gain)
    found = innovations_form(
        _Known(start.drift), best.gain, *record.simulated(start, parts=parts),
        np.std(record.innovations(start), axis=0),
        settling=min(SETTLING, min(len(record.parts[i]) for i in parts) // 3), monitor=monitor)
    predictor = Predictor(start.drift, found.gain)
    estimates = record.estimates(predictor)
    return standardised(Predictor(start.drift, found.gain), estimates) if (
        isinstance(start.drift, DriftModel)) else spanned(predictor, estimates)


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
