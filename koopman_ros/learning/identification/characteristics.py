# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Static characteristics of inputs, found from a record."""

from __future__ import annotations

from collections.abc import Collection, Sequence
import contextlib
from dataclasses import replace
import math
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.datasets import Array, Episode, PlantDescription
from koopman_ros.identification_methods import WeakFormParameters
from koopman_ros.learning.identification.chance import block_gains, clearly_positive
from koopman_ros.learning.identification.drift import (
    DriftModel,
    longest_step,
    prediction_error,
    Segments,
)
from koopman_ros.learning.identification.identify import Identified, identify
from koopman_ros.learning.identification.innovations_form import SETTLING
from koopman_ros.learning.identification.input_functions import Hats, NonAffineDrift
from koopman_ros.learning.identification.output_error import (
    fitted_by_simulation,
    PolynomialCoefficients,
    Refined,
)
from koopman_ros.learning.identification.weak_form import weak_form

_POINTS, _FEW_POINTS = 21, 5  # of a characteristic, and of functions next to states
# Coefficients of products of states and functions. The 880 of ten states and two inputs take 2 s a
# step, and rarely does a record determine so many.
_MOST_PRODUCTS = 300
_SLIGHT = 0.02  # share of the range; a law does not feel a smaller deviation from a line
_FEW_STEPS, _MOST_STEPS, _TOLERANCE = 10, 40, 1e-4  # of refinements
_FALL = 0.1  # share of the range by which the effect of no characteristic falls
_STIFFNESS = np.geomspace(1e-8, 1e3, 89)  # weights of squared changes of slope that are tried


class NotMonotoneError(ValueError):
    """The effect of an input rises and falls."""


def identify_with_characteristics(plant: PlantDescription, episodes: Sequence[Episode], *,
                                  given: Collection[str] = (), **options: Any) -> Identified:
    """
    Estimate a drift as :func:`identify`, with a characteristic of each input that needs one.

    Functions of an input are added to the drift as further inputs, piecewise linear between the
    quantiles of the record. They are kept if they lower the errors at samples that are left out of
    the fit by more than two standard errors; the part that all states have in common is the
    characteristic. It is found again with the drift that was found with it, as the degree of a
    drift without it may be too low. At last products of such functions and states are tried in the
    same way, unless there are too many. A drift with them is not affine in the inputs, and
    competes as an alternative.

    :param plant: see :func:`identify`, like the options. Where it knows B nothing is tried.
    :param given: inputs whose characteristic the plant has already.
    :raises NotMonotoneError: for an input whose effect rises and falls.
    """
    found = identify(plant, episodes, **options)
    if plant.B is not None:
        return found
    for _ in range(2):
        before = found
        for name in plant.input_names:
            if name not in given and (one := characteristic_of(found, name)) is not None:
                plant = replace(plant, characteristics={**plant.characteristics, name: one})
                found = identify(plant, episodes, **options)
        if found is before:
            break
    functions = _hats(found, plant.input_names, _FEW_POINTS)
    if functions is None:
        return found
    n_x = len(plant.state_names)
    if (count := n_x * (1 + n_x) * len(functions.coordinates())) > _MOST_PRODUCTS:
        return replace(found, steps=(
            *found.steps, f'left out: {count} products of states and functions of the inputs, '
            f'above the limit of {_MOST_PRODUCTS}'))
    other = _not_affine(found, functions)
    return found if other is None else replace(
        found, alternatives=(other, *found.alternatives), warnings=(
            *found.warnings, f'a {other.form} explains the record better than static '
            f'characteristics do: if the model is rejected, {NonAffineDrift.remedy}'))


def identify_measured(plant: PlantDescription, episodes: Sequence[Episode], *,
                      given: Collection[str] = (), **options: Any
                      ) -> tuple[Identified, Collection[str]]:
    """
    Estimate a drift as :func:`identify_with_characteristics`, whatever the effect of an input.

    If the effect of one rises and falls, the inputs act linearly, with a warning.

    :return: the estimate, and the inputs that may have a characteristic: where a state is not
        measured, a rising effect may seem to fall.
    """
    try:
        found = identify_with_characteristics(plant, episodes, given=given, **options)
        return found, found.drift.characteristics.keys() - set(given)
    except NotMonotoneError as error:
        found = identify_with_characteristics(plant, episodes, given=plant.input_names, **options)
        return replace(found, warnings=(*found.warnings, str(error))), (
            set(plant.input_names) - set(given))


def characteristic_of(found: Identified, name: str) -> Characteristic | None:
    """
    Return the characteristic of an input; None where the record does not need one.

    :param found: a polynomial drift, with the estimates of states that are not measured.
    :raises NotMonotoneError: for an input whose effect rises and falls.
    """
    drift, inputs = found.drift, found.drift.box.inputs
    assert isinstance(drift, DriftModel)
    functions = _hats(found, (name,), _POINTS)
    better = functions and _better(found, functions, drift)
    if not functions or not better:
        return None
    u = functions.knots[name]
    v = np.tile(inputs.center, (len(u), 1))
    v[:, inputs.names.index(name)] = u
    effects = better.box.inputs.to_deviation(functions.appended(v)) @ (
        better.scaled_input_matrix(np.zeros(len(drift.box.states))).T)
    # the part that all states have in common
    effects -= effects[0]
    g = effects @ np.linalg.svd(effects)[2][0]
    g /= g[-1] if abs(g[-1]) > _FALL * np.max(np.abs(g)) else np.max(np.abs(g))
    if np.max(np.maximum.accumulate(g) - g) > _FALL:
        raise NotMonotoneError(
            f'the effect of {name} rises and falls between {u[0]:.6g} and {u[-1]:.6g} '
            f'{inputs.units[inputs.names.index(name)]}, so that no control law can invert it: '
            'record a range in which it only rises or only falls')
    one = Characteristic.of(u, smoothed(u, g))
    change = one.effects - inputs.characteristics.get(name, Characteristic.of(
        u[[0, -1]], u[[0, -1]])).effect(u)
    return one if np.max(np.abs(change)) > _SLIGHT * (u[-1] - u[0]) else None


def smoothed(u: Array, g: Array) -> Array:
    """
    Return rising effects near estimates g (K,) of those of inputs u (K,), which rise.

    Behind a lag their slope is one of the drift, and that of the estimates is mostly noise.
    Squared changes of slope are weighted as generalised cross-validation finds best: P. Craven,
    G. Wahba, Numerische Mathematik 31 (1979).
    """
    count = len(u)
    lengths = np.diff(u) * (count - 1) / (u[-1] - u[0])
    bend = np.diff(np.diff(np.eye(count), axis=0) / lengths[:, None], axis=0)
    values, vectors = np.linalg.eigh(bend.T @ bend)
    left = _STIFFNESS[:, None] * np.maximum(values, 0.0)
    left /= 1.0 + left
    errors = np.sum((left * (vectors.T @ g)) ** 2, axis=1) / np.sum(left, axis=1) ** 2
    weight = math.sqrt(_STIFFNESS[np.argmin(errors)])
    rises = np.tril(np.ones((count, count)))
    found = lsq_linear(
        np.vstack((rises, weight * bend @ rises)), np.append(g, np.zeros(count - 2)),
        (np.append(-np.inf, np.zeros(count - 1)), np.inf)).x
    # rounding may leave it a little below the bound
    return np.asarray(np.maximum.accumulate(rises @ found))


def _not_affine(found: Identified, functions: Hats) -> NonAffineDrift | None:
    """Return a drift with products of states and functions of the inputs, if it is better."""
    drift = found.drift
    assert isinstance(drift, DriftModel)
    products = drift if drift.varying_input_matrix else replace(drift, B=np.hstack(
        [drift.B] + [0.0 * drift.B] * len(drift.box.states)))
    better = _better(found, functions, products)
    return NonAffineDrift(drift.box, better, functions) if better else None


def _hats(found: Identified, names: Sequence[str], count: int) -> Hats | None:
    """Return functions of some inputs, knots at quantiles; None for inputs of two levels."""
    inputs = found.drift.box.inputs
    u = np.concatenate([one.inputs_at(one.time) for one in found.episodes])
    knots = {name: np.unique(np.quantile(u[:, inputs.names.index(name)], np.linspace(
        0.0, 1.0, count))) for name in names}
    knots = {name: own for name, own in knots.items() if len(own) > 2}
    return Hats(inputs, knots) if knots else None


def _better(found: Identified, functions: Hats, drift: DriftModel) -> DriftModel | None:
    """Return a drift with functions of inputs added; None if it does not err less."""
    try:
        return _clearly_better(found, functions, drift)
    except np.linalg.LinAlgError:
        # a simulation that is lost, of an unstable plant, shows no characteristic
        return None


def _clearly_better(found: Identified, functions: Hats, drift: DriftModel) -> DriftModel | None:
    episodes, step = found.episodes, longest_step(found.fitted)
    more = [functions.added(one) for one in episodes]
    box = replace(drift.box, inputs=functions.coordinates())
    n_x, n_u = len(box.states), len(drift.box.inputs)
    blocks = drift.B.reshape(n_x, -1, n_u)
    start = replace(drift, box=box, B=np.pad(
        blocks, ((0, 0), (0, 0), (0, len(box.inputs) - n_u))).reshape(n_x, -1))
    segments = Segments.of(more, step)
    without = _refined(drift, Segments.of(episodes, step)).left_out(SETTLING)

    def gains(one: Refined[PolynomialCoefficients]) -> bool:
        return clearly_positive(block_gains(
            one.left_out(SETTLING), without, max(2, len(without) // SETTLING)))

    # without a need for them nothing is left to gain after a few steps
    if not gains(_refined(start, segments, _FEW_STEPS)):
        return None
    starts = [start]
    with contextlib.suppress(ValueError, np.linalg.LinAlgError):
        # free of effects that the drift without them attributed to states
        starts += [weak_form([replace(one, x=one.interpolated()) for one in more], box,
                             drift.degree, None, int(window), drift.input_degree)
                   for window in WeakFormParameters().windows]
    better = _refined(min(starts, key=lambda one: float(np.sum((prediction_error(
        one.rate, segments, box.states.scale) / box.states.scale) ** 2))), segments)
    return better.model.drift if gains(better) else None


def _refined(drift: DriftModel, segments: Segments, steps: int = _MOST_STEPS
             ) -> Refined[PolynomialCoefficients]:
    return fitted_by_simulation(PolynomialCoefficients(drift, learn_input_matrix=True), segments,
                                tolerance=_TOLERANCE, iterations=steps)
