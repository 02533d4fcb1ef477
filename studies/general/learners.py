# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Model classes to compare; to add one, name it in LEARNERS or RECIPES."""

from collections.abc import Callable
from dataclasses import dataclass
import time
from typing import TypeAlias

from koopman_ros.core.datasets import DriftSamples, PlantDescription, split_by_episode
from koopman_ros.learning import Edmd, IncrementalTraining, NeuralDrift, train, TrainingFailed
from koopman_ros.learning.lift.multistart import Recipe
from koopman_ros.model import Box, LiftedModel


@dataclass(frozen=True)
class Learned:
    """A model and the cost of its training."""

    model: LiftedModel
    seconds: float  #: of the processor, of a training that decides by itself
    rejected: str | None = None  #: why it was rejected, or ''; None for a class that never is


Learner: TypeAlias = Callable[[PlantDescription, DriftSamples, int], Learned]


def _polynomial(degree: int) -> Learner:
    def learn(plant: PlantDescription, samples: DriftSamples, seed: int) -> Learned:
        begin = time.process_time()
        known, box = split_by_episode(samples, 0)[0], Box.of(plant, samples.x, samples.u)
        model = Edmd(degree).learn(plant, known, box)
        return Learned(model, time.process_time() - begin)

    return learn


def _trained(recipe: Callable[[int], Recipe]) -> Learner:
    """Return the learner of a recipe that is made for a number of states."""
    def learn(plant: PlantDescription, samples: DriftSamples, seed: int) -> Learned:
        made = recipe(samples.x.shape[1])
        begin = time.process_time()
        try:
            rejected, model = '', train(plant, samples, made, seed=seed, starts=1).model
        except TrainingFailed as error:
            rejected = str(error)
        seconds = time.process_time() - begin
        if rejected:
            # the same once more, to see what the rejection is worth
            model = train(plant, samples, made, seed=seed, starts=1, reject=False).model
        return Learned(model, seconds, rejected)

    return learn


_STEPS = 300  # of Levenberg-Marquardt, for each size
# What is trained, made for a number of states.
RECIPES: dict[str, Callable[[int], Recipe]] = {
    'identity lift': lambda n_x: IncrementalTraining(n_x + 3, hidden_first=16,
                                                     max_iterations=_STEPS),
    'free lift': lambda n_x: IncrementalTraining(
        n_x, identity=False, hidden_first=16, max_iterations=_STEPS),
    'neural drift': lambda n_x: NeuralDrift(16, max_iterations=_STEPS),
}
LEARNERS: dict[str, Learner] = {
    'linear': _polynomial(1),
    'EDMD-3': _polynomial(3),
    'EDMD-5': _polynomial(5),
    **{label: _trained(recipe) for label, recipe in RECIPES.items()},
}
