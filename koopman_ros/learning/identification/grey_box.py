# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The constants of a plant whose equations are known, from a record of some of its states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import contextlib
from dataclasses import replace
from typing import Any

import numpy as np

from koopman_ros.core.datasets import Array, Episode, PlantDescription
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.learning.identification.data_split import SplitRecord
from koopman_ros.learning.identification.equations import Equations
from koopman_ros.learning.identification.identify import (
    EstimatedConstant,
    EstimateStatus,
    Identified,
    INNOVATIONS_FORM,
    OUTPUT_ERROR,
    Score,
    stage_monitor,
    Watch,
)
from koopman_ros.learning.identification.innovations_form import Predictor, spanned
from koopman_ros.learning.identification.output_error import innovations_form, Refined
from koopman_ros.plants import Constant, estimated_parameters_of

# How far disturbances, as filters assume them, move a state from sample to sample, over the noise
# of the measurements, in deviations.
_NOISES = (0.6, 0.2, 0.06, 0.02, 0.006)
# Exponents by which predictions of an unstable plant may grow over a segment: at first, to stay
# where the plant is, and in the end, as long ones tell more.
_GROWTHS = (3.0, 6.0)
_TOLERANCE = 1e-7  # relative decrease of the cost that ends a refinement
_EDGE = 1e-3  # of half a range: nearer to its end a constant counts as at it
# What is spread evenly over a range from -1 to 1 strays by this: a record that leaves more tells
# nothing.
_UNKNOWN = 1.0 / np.sqrt(3.0)
_SINGULAR = 1e-12  # a direction with so small a share of the information has none
_INVOLVED = 1e-3  # a constant with such a share of such a direction is undetermined


def estimate_parameters(plant: PlantDescription, episodes: Sequence[Episode], equations: Any,
                        ranges: Mapping[str, tuple[float, float] | None] | None = None, *,
                        seed: int = 0, watch: Watch = lambda *_: False) -> Identified:
    """
    Estimate constants of a plant's equations from a record of some of its states.

    Constants, the gain of a filter and the starts of all segments are refined for the best
    prediction of the next measurement: the innovations form (Ljung 1999, section 4.3), by
    Levenberg-Marquardt with the exact derivatives of the Runge-Kutta steps, of the equations by
    their Jacobian, and by the constants to ten digits by differences. The filter keeps the
    predictor stable where the plant is not, and finds states that are not measured, which have the
    names and units of the class. The search begins at the values of the class. Standard errors are
    those of least squares (Ljung 1999, section 9.4), outputs taken as uncorrelated.

    :param plant: names and units of the measured signals; B and the nominal point play no part.
    :param equations: a plant's class, see :func:`koopman_ros.plants.plant_class`.
    :param ranges: of the constants to be estimated, see :func:`estimated_parameters_of`.
    :param seed: of the split.
    :return: an estimate with `constants`; its first states are the measured ones.
    :raises ValueError: when names, units or ranges do not fit the class, the episodes are too
        short, or the equations follow none of them.
    :raises Stopped: when `watch` requested it.
    """
    plant = replace(plant, B=None, input_matrix_degree=0)
    estimated = estimated_parameters_of(equations, ranges or {})
    start = Equations.of(equations, estimated, plant,
                         np.concatenate([e.interpolated() for e in episodes]),
                         np.concatenate([e.u for e in episodes]))
    n_y = len(plant.state_names)
    record = SplitRecord(plant, episodes, seed, hidden=len(start.box.states) > n_y)
    predictor = _filter(record, start, n_y)
    predictor = spanned(predictor, record.estimates(predictor))
    predictor, refined = _refined(record, predictor, _stage(
        watch, 0, f'{len(estimated)} constants of {equations.__name__}'))
    method = INNOVATIONS_FORM if np.any(refined.gain) else OUTPUT_ERROR
    left = record.innovations(predictor, record.choose)
    scale = start.box.states.scale[:n_y]
    score = Score(method, None, scale * np.sqrt(np.mean(left ** 2, axis=0)),
                  float(np.mean(left ** 2)))
    refined = _fitted(record, predictor, refined.gain, sorted([*record.fit, *record.choose]),
                      _GROWTHS[1], _stage(watch, 1, 'constants on all episodes'))
    predictor = Predictor(refined.model, predictor.gain)
    predictor = spanned(predictor, record.estimates(predictor))
    found = record.identified(predictor, method, [score], _stage(watch, 2, 'linear model'))
    return replace(found, constants=_estimates(estimated, refined))


def _stage(watch: Watch, number: int, text: str) -> Callable[..., bool]:
    """Begin one of three stages, and return its monitor."""
    monitor = stage_monitor(watch, number, 3, text)
    monitor()
    return monitor


def _filter(record: SplitRecord, model: Equations, n_y: int) -> Predictor[Equations]:
    """
    Return the equations with the gain that predicts the next measurements of all episodes best.

    Of those of steady Kalman filters in the middle of the box, which are stable.
    """
    A = model.scaled_slope(np.zeros(len(model.box.states)))
    C, h = np.eye(n_y, len(A)), record.period
    tried = []
    for noise in _NOISES:
        # the filter's equation is the regulator's, transposed
        solution = solve_riccati(A.T, C.T, noise ** 2 / h * np.eye(len(A)), h * np.eye(n_y))
        if solution.solved:
            one = Predictor(model, h * solution.K.T)
            with contextlib.suppress(ValueError):  # it diverges
                tried.append((float(np.mean(record.innovations(one) ** 2)), noise, one))
    if not tried:
        raise ValueError(f'the {model.form} do not reproduce the episodes with the initial '
                         'constants: give ranges closer to the true values')
    return min(tried, key=lambda one: one[:2])[2]


def _refined(record: SplitRecord, start: Predictor[Equations], monitor: Callable[..., bool]
             ) -> tuple[Predictor[Equations], Refined[Equations]]:
    """
    Refine the constants on the segments to fit to, without a gain and with that of a filter.

    Without one the estimate is that of maximum likelihood where nothing but the sensors is noisy,
    and a gain would bias the estimate from closed-loop data. With one it follows a plant that is
    disturbed, too. The one that predicts the measurements better is taken.

    :return: the equations with the filter that goes through all episodes, and how they were found.
    """
    none = 0.0 * start.gain
    first = _fitted(record, start, none, record.fit, _GROWTHS[0], monitor)
    start = _filter(record, first.model, len(none.T))
    alone, filtered = (_fitted(record, start, gain, record.fit, _GROWTHS[1], monitor)
                       for gain in (none, start.gain))
    best = filtered if filtered.cost < alone.cost else alone
    return Predictor(best.model, start.gain), best


def _fitted(record: SplitRecord, start: Predictor[Equations], gain: Array, parts: Sequence[int],
            growth: float, monitor: Callable[..., bool]) -> Refined[Equations]:
    """
    Refine constants and the starts of segments.

    :param start: where to begin, with the filter that finds the first states of the segments.
    :param gain: with which the segments are predicted.
    :param growth: exponent by which predictions may grow, for which the segments are cut.
    """
    segments, starts = record.simulated(start, record.length(start.drift, growth), parts)
    # outputs weighed by the innovations of a filter
    deviation = np.std(start.along(segments, starts).innovations, axis=0)
    return innovations_form(start.drift, gain, segments, starts, deviation, smooth=True,
                            tolerance=_TOLERANCE, monitor=monitor)


def _estimates(estimated: Sequence[Constant], refined: Refined[Equations]
               ) -> tuple[EstimatedConstant, ...]:
    """Return values, standard errors and how they are to be taken."""
    shares, p = refined.model.shares, len(estimated)
    matrix = refined.information()
    inside = np.abs(shares) < 1.0 - _EDGE
    # one that its range holds is no parameter any more
    kept = np.concatenate((inside, np.ones(len(matrix) - p, dtype=bool)))
    # by the sine of an angle in place of the angle
    slopes = np.concatenate((np.cos(refined.model.theta), np.ones(len(matrix) - p)))[kept]
    covariance = _inverse(matrix[np.ix_(kept, kept)] / slopes / slopes[:, None])
    # the weights took the innovations for all of the noise, of which parameters took a part
    numbers = refined.count * refined.gain.shape[1]
    covariance *= 2.0 * refined.cost * refined.count / max(numbers - len(covariance), 1)
    deviations = np.full(p, np.nan)
    deviations[inside] = np.sqrt(np.diag(covariance)[:int(np.sum(inside))])
    found = []
    for one, share, deviation in zip(estimated, shares.tolist(), deviations.tolist(), strict=True):
        standing = EstimateStatus.ESTIMATED
        if np.isnan(deviation):
            standing = EstimateStatus.AT_LOWER_END if share < 0.0 else EstimateStatus.AT_UPPER_END
        elif not deviation < _UNKNOWN:
            standing = EstimateStatus.NOT_IDENTIFIABLE
        found.append(EstimatedConstant(
            one.name, one.unit, one.value(share), deviation * one.slope(share), one.lower,
            one.upper, standing))
    return tuple(found)


def _inverse(matrix: Array) -> Array:
    """Return the inverse of an information matrix, infinite where it holds none."""
    diagonal = np.diag(matrix)
    size = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(matrix / size / size[:, None])
    none = values < _SINGULAR * values[-1]
    inverse: Array = (vectors[:, ~none] / values[~none]) @ vectors[:, ~none].T
    lost = np.any(np.abs(vectors[:, none]) > _INVOLVED, axis=1)
    inverse[lost, lost] = np.inf
    return inverse / size / size[:, None]
