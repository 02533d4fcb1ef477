# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training of models on an estimated drift."""

from collections.abc import Callable
import contextlib
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array, expect
from koopman_ros.core.datasets import DriftSamples, Episode, PlantDescription
from koopman_ros.evaluation.closed_loop_test import LOOPS
from koopman_ros.execution import Backend
from koopman_ros.learning.acceptance import HeldOut, Thresholds
from koopman_ros.learning.identification import (
    Drift,
    DriftModel,
    fitted_starts,
    Identified,
    LaggedDrift,
    longest_step,
)
from koopman_ros.learning.identification.alternatives import TransformedDrift
from koopman_ros.learning.identification.drift import Segments, steady_point
from koopman_ros.learning.lift.edmd import Edmd
from koopman_ros.learning.lift.incremental import IncrementalTraining
from koopman_ros.learning.lift.metrics import ROUNDING
from koopman_ros.learning.lift.multistart import Watch
from koopman_ros.learning.lift.training import train, Trained
from koopman_ros.learning.model_selection import (
    ClassComparison,
    compare,
    Judge,
    ModelCandidate,
    usual_recipes,
)
from koopman_ros.model import LiftedModel, model_file
from koopman_ros.model_classes import BEST, IDENTITY_LIFT, LINEAR

# More samples of a smooth drift tell nothing new.
_MAX_SAMPLES = 2000
# Cells a state by which samples are spread over the range; fewer where there were too many.
_CELLS = 20
# Parts among which the samples are dealt out.
_SHARES = 10
BUDGET = 180.0  # s of processor time for the networks of all classes together


def drift_samples(drift: Drift, episodes: tuple[Episode, ...]) -> DriftSamples:
    """
    Sample a drift along the paths that it predicts for some episodes, free of their noise.

    They are values of one smooth function, free of noise, so that training, choice and figures
    may share the range among them; the plant's own held-out segments judge the lift. Episodes
    that the drift does not follow are left out; ValueError when it follows none.
    """
    segments = Segments.of(episodes, longest_step(episodes))
    x0, squares = fitted_starts(drift.rate, segments, drift.box.states.scale)
    followed = np.all(squares < drift.box.states.scale ** 2, axis=1)
    if not np.any(followed):
        raise ValueError('the estimated drift reproduces none of the episodes: record longer, '
                         'with steps of the input')
    path = segments.path(drift.rate, x0)[:-1]
    # not at the pulses that move a command which is a state
    inputs = drift.box.inputs
    usual = np.all((segments.u >= inputs.lower) & (segments.u <= inputs.upper), axis=2)
    inside = (segments.steps > 0.0) & followed & usual
    # segment by segment, each in the order of its times
    x, u = (np.swapaxes(a, 0, 1)[inside.T] for a in (path, segments.u))
    kept = _spread(drift.box.states.to_deviation(x))
    x, u = x[kept], u[kept]
    return DriftSamples(x, drift.rate(x, u), u, np.arange(len(x)) % _SHARES)


def _spread(xi: Array) -> NDArray[np.int64]:
    """
    Choose samples (N, n_x) that fill the range as evenly as they can; return rising numbers.

    A plant dwells around some states; a lift trained on all samples would fit those best, and
    distinguish its coordinates by the few others.
    """
    low, high = xi.min(axis=0), xi.max(axis=0)
    share = (xi - low) / (high - low)
    for count in range(_CELLS, 0, -1):
        cells = np.minimum((count * share).astype(int), count - 1)
        visited, cell = np.unique(cells, axis=0, return_inverse=True)
        if len(visited) <= _MAX_SAMPLES:
            break
    cell = cell.ravel()
    # the rank of each sample within its cell, taken evenly along the episode
    order = np.argsort(cell, kind='stable')
    sizes = np.bincount(cell)
    quota = _quota(sizes, _MAX_SAMPLES)
    chosen = []
    for rows in np.split(order, np.cumsum(sizes)[:-1]):
        take = min(len(rows), quota)
        chosen.append(rows[np.linspace(0, len(rows) - 1, take).round().astype(int)])
    return np.sort(np.concatenate(chosen))


def _quota(sizes: NDArray[np.int64], total: int) -> int:
    """Return the largest number a cell may give so that all together give at most `total`."""
    low, high = 1, int(np.max(sizes))
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if np.sum(np.minimum(sizes, middle)) <= total else (
            low, middle - 1)
    return low


def learn_lift(found: Identified, plant: PlantDescription, n_z: int, *, seed: int, starts: int,
               watch: Watch | None = None) -> Trained:
    """
    Learn a lift of an estimated drift; the arguments are those of :func:`learning.train`.

    :param plant: names, units and the nominal point, as given to the identification: unmeasured
        states are added. Where the nominal point is not known, or the episodes do not surround
        it, a steady state in the middle of their range is taken.
    :raises TrainingFailed: when no lift is better than a linear model.
    :raises ValueError: when the episodes hold no steady state.
    """
    expect(found=(found, Identified), plant=(plant, PlantDescription))
    known, samples = _estimated(found, plant)
    return train(known, samples, IncrementalTraining(n_z), seed=seed, starts=starts, watch=watch,
                 loops=0)


def _estimated(found: Identified, plant: PlantDescription) -> tuple[PlantDescription,
                                                                    DriftSamples]:
    """Return the plant with its estimated nominal point and B, and samples of the drift."""
    samples = drift_samples(found.drift, found.fitted)
    states = found.drift.box.states
    lower, upper = samples.x.min(axis=0), samples.x.max(axis=0)
    # a plant of the measured states has nothing to say of the others
    nominal = np.append(plant.nominal_state, np.full(len(states) - len(plant.state_names), np.nan))
    within = (nominal > lower) & (nominal < upper)
    x, u = steady_point(found.drift, np.where(within, nominal, 0.5 * (lower + upper)),
                        np.where(np.isfinite(plant.nominal_input), plant.nominal_input,
                                 found.drift.box.inputs.center),
                        len(states) - found.hidden)
    drift = found.drift
    return replace(plant, state_names=states.names, state_units=states.units,
                   nominal_state=x, nominal_input=u, input_matrix_degree=0,
                   characteristics=drift.box.inputs.characteristics,
                   B=drift.input_matrix_at if drift.varying_input_matrix else (
                       drift.input_matrix)), samples


def alternative_models(found: Identified, plant: PlantDescription, dead_time: Array
                       ) -> list[LiftedModel]:
    """
    Return models of the alternative polynomial drifts of an identification.

    :param plant: as for :func:`learn_lift`.
    :param dead_time: (n_u,) of the inputs, in s.
    """
    models = []
    for drift in found.alternatives:
        own = drift
        while isinstance(own, LaggedDrift | TransformedDrift):
            own = own.drift
        # one that holds no steady state, does not follow the record or fits no file is no model
        with contextlib.suppress(ValueError, np.linalg.LinAlgError):
            if isinstance(own, DriftModel):
                known, samples = _estimated(replace(found, drift=drift), plant)
                model = replace(Edmd(own.degree).learn(known, samples), dead_time=dead_time
                                ).with_disturbances(plant.disturbance_names)
                model_file.check(model)
                models.append(model)
    return models


def compare_classes(found: Identified, plant: PlantDescription, thresholds: Thresholds, *,
                    model_class: str = BEST, n_z: int, seed: int, starts: int, loops: int = LOOPS,
                    watch: Watch | None = None,
                    judging: Callable[[str, float], bool] = lambda *_: False,
                    device: str = 'cpu', backend: Backend | None = None,
                    begin: LiftedModel | None = None,
                    on_class: Callable[[ClassComparison], None] = lambda _: None
                    ) -> ClassComparison:
    """
    Learn models of an estimated drift as :func:`learning.compare` does, judged by the record.

    The rule is the same, its error another: the mean square by which predictions of the
    measurements that were held out err beyond their noise. Differences within the chance variation
    of the noise count as equal. Classes that the acceptance test would reject for their law, their
    coordinates or a linear model that is as good are rejected.

    :param model_class: the name of a class, which alone is learned then, or ``'best'`` for all of
        them and the rule; of a linear drift for the linear one.
    :param n_z: coordinates of the identity lift; other arguments as for :func:`learn_lift`.
    :param judging: called with the class whose law is being tried and the share that is done.
    :param device: as for :func:`learning.train`, like `begin`, and `backend`, where closed loops
        run, too.
    :param on_class: as for :func:`learning.compare`.
    :raises TrainingFailed: when no model of the requested class was learned, or none at all.
    :raises ValueError: when the episodes hold no steady state, and for an unknown class.
    :raises Stopped: when `judging` ended it.
    """
    held_out = HeldOut(found, thresholds, model_class == BEST)
    noise = np.fmin(found.noise, held_out.rmse(found.drift.rate)) / held_out.scale

    def judged(one: ModelCandidate) -> ModelCandidate:
        assert one.model is not None
        assert one.figures is not None
        rmse = held_out.rmse_of(one.model)
        law_check = held_out.law_check(one.model, loops, lambda share: judging(one.name, share),
                                       backend)
        reasons = held_out.reasons(one.model, rmse, one.figures, law_check,
                                   one.name == LINEAR)
        return replace(one, figures=replace(one.figures, rollout_rmse=rmse), law_check=law_check,
                       excess=float(np.mean(np.maximum(
                           (rmse / held_out.scale) ** 2 - noise ** 2, 0.0))),
                       rejection='; '.join(reasons))

    known, samples = _estimated(found, plant)
    # the mean square of so many white errors strays by this share
    chance = float(np.mean(noise ** 2)) * np.sqrt(2.0 / held_out.count)
    drift = found.drift
    if model_class == BEST and isinstance(drift, DriftModel) and drift.linear:
        # which is that drift itself
        model_class, begin = LINEAR, None
    alone = model_class != BEST
    recipes = {**usual_recipes(len(noise)), IDENTITY_LIFT: IncrementalTraining(n_z)}
    return compare(known, samples, recipes, budget=BUDGET / (1 if alone else len(recipes)),
                   choose=model_class if alone else None, alone=alone, seed=seed, starts=starts,
                   watch=watch, judge=Judge(judged, max(chance, ROUNDING)), device=device,
                   backend=backend, begin=begin, on_class=on_class)
