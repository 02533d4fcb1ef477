# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Samples of the simulated plants, and what an experiment on them hands back."""

from collections.abc import Mapping
import contextlib
from typing import TypeAlias

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.lifting import LiftedModel
from koopman_ros.plant_data import Episode, Plant, Samples
from koopman_ros.plants import (
    ControlAffineSystem,
    ExcitationError,
    random_steps,
    RandomStepDesign,
    sample_derivatives,
)

# Figures by name; None where there is none, e.g. after a divergence.
Metrics: TypeAlias = dict[str, float | bool | dict[str, 'float | bool | None'] | None]
# Models by name, for the figures.
Models: TypeAlias = Mapping[str, LiftedModel]
# Share of the episodes that start in a corner of their box.
_AT_CORNERS = 0.2


def describe(system: ControlAffineSystem) -> Plant:
    """Return what training may know of a plant beside its data."""
    return Plant(system.name, system.state_names, system.state_units, system.input_names,
                 system.input_units, system.time_unit, system.nominal_state,
                 system.nominal_input, system.B)


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


def box_episodes(system: ControlAffineSystem, design: RandomStepDesign, episodes: int,
                 duration: float, seed: int, starts: tuple[Array, Array] | None = None) -> Samples:
    """
    Simulate short episodes of random input steps from random states within a box.

    A fifth of them starts in corners of the box, so that no part of it is left to extrapolation.

    :param duration: of each, in the plant's time unit.
    :param seed: of the initial states and of the steps.
    :param starts: corners of that box, each (n_x,); by default the box that they may not leave.
    """
    rng = np.random.default_rng(seed)
    lower, upper = (np.broadcast_to(bound, system.n_x) for bound in starts or (
        design.state_lower, design.state_upper))
    found: list[Episode] = []
    while len(found) < episodes:
        x0, step_seed = rng.uniform(lower, upper), int(rng.integers(2 ** 31))
        if rng.random() < _AT_CORNERS:
            x0 = np.where(rng.random(system.n_x) < 0.5, lower, upper)
        # no input within the bounds keeps some states inside the box
        with contextlib.suppress(ExcitationError):
            found.append(random_steps(system, design, duration, step_seed, x0=x0))
    return sample_derivatives(system, found)
