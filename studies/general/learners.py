# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Model classes to compare; to add one, name it in POLYNOMIALS or TRAINED."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
import time
from typing import TypeAlias

from koopman_ros.core.datasets import DriftSamples, PlantDescription, split_by_episode
from koopman_ros.learning import Edmd, IncrementalTraining, NeuralDrift, train, TrainingFailed
from koopman_ros.learning.lift.multistart import Recipe
from koopman_ros.model import Box, LiftedModel

# Learns a model from samples and a seed, and rejects it if told to.
Learner: TypeAlias = Callable[[PlantDescription, DriftSamples, int, bool], LiftedModel]


@dataclass(frozen=True)
class Learned:
    """A model and the cost of its training."""

    model: LiftedModel
    seconds: float  #: of the processor, of a training that decides by itself
    rejected: str  #: why it was rejected, or ''


def learned(learn: Learner, plant: PlantDescription, samples: DriftSamples, seed: int) -> Learned:
    """Learn a model; one that is rejected is learned again, to judge the rejection."""
    begin, rejected = time.process_time(), ''
    try:
        model = learn(plant, samples, seed, True)
        seconds = time.process_time() - begin
    except TrainingFailed as error:
        rejected, seconds = str(error), time.process_time() - begin
        model = learn(plant, samples, seed, False)
    return Learned(model, seconds, rejected)


def polynomial(degree: int, plant: PlantDescription, samples: DriftSamples, seed: int,
               reject: bool) -> LiftedModel:
    """Fit a polynomial drift by least squares; it is never rejected."""
    known, box = split_by_episode(samples, 0)[0], Box.of(plant, samples.x, samples.u)
    return Edmd(degree).learn(plant, known, box)


def trained(recipe: Callable[[int], Recipe], plant: PlantDescription, samples: DriftSamples,
            seed: int, reject: bool) -> LiftedModel:
    """Train by a recipe that is made for a number of states."""
    return train(plant, samples, recipe(samples.x.shape[1]), seed=seed, starts=1,
                 reject=reject).model


_STEPS = 300  # of Levenberg-Marquardt, for each size
LIFTS: Mapping[str, Callable[[int], Recipe]] = {
    'identity lift': lambda n_x: IncrementalTraining(n_x + 3, hidden_first=16,
                                                     max_iterations=_STEPS),
    'free lift': lambda n_x: IncrementalTraining(
        n_x, identity=False, hidden_first=16, max_iterations=_STEPS),
}
POLYNOMIALS: Mapping[str, Learner] = {
    name: partial(polynomial, degree)
    for name, degree in (('linear', 1), ('EDMD-3', 3), ('EDMD-5', 5))}
LEARNERS: dict[str, Learner] = {**POLYNOMIALS, **{
    name: partial(trained, recipe) for name, recipe in {
        **LIFTS, 'neural drift': lambda n_x: NeuralDrift(16, max_iterations=_STEPS)}.items()}}
