# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Samples of the simulated plants, and what an experiment on them hands back."""

from collections.abc import Mapping
from typing import TypeAlias

from koopman_ros.lifting import LiftedModel
from koopman_ros.plant_data import Samples
from koopman_ros.plants import (
    ControlAffineSystem,
    random_steps,
    RandomStepDesign,
    sample_derivatives,
)

# Figures by name; None where there is none, e.g. after a divergence.
Metrics: TypeAlias = dict[str, float | bool | dict[str, 'float | bool | None'] | None]
# Models by name, for the figures.
Models: TypeAlias = Mapping[str, LiftedModel]


def random_step_episodes(system: ControlAffineSystem, design: RandomStepDesign, episodes: int,
                         duration: float, seed: int) -> Samples:
    """
    Simulate episodes of random input steps from the nominal state, with exact derivatives.

    :param duration: of each, in the plant's time unit.
    :param seed: of the first; episode n uses `seed` + n.
    """
    return sample_derivatives(system, [
        random_steps(system, design, duration, seed + number)
        for number in range(episodes)])
