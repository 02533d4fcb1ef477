# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A constant disturbance of each episode, e.g. of days with different ambient temperatures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.learning.identification.alternatives import TransformedDrift
from koopman_ros.learning.identification.drift import Drift, DriftModel
from koopman_ros.learning.identification.identify import Identified
from koopman_ros.learning.identification.network_drift import NetworkDrift

MOST_EPISODES = 10  # whose disturbances are fitted


def with_episode_inputs(plant: PlantDescription, episodes: Sequence[Episode]
                        ) -> tuple[PlantDescription, list[Episode]]:
    """
    Return a plant and its episodes with inputs that are constant in each episode.

    Their effects on a drift are its offsets in the episodes, whose sum is zero.
    """
    levels = _levels(len(episodes))
    more = levels.shape[1]
    return replace(
        plant, input_names=(*plant.input_names, *(f'episode_{i + 1}' for i in range(more))),
        input_units=(*plant.input_units, *['1'] * more),
        nominal_input=np.append(plant.nominal_input, np.zeros(more)),
    ), [replace(one, u=np.hstack((one.u, np.tile(own, (len(one.u), 1)))),
                linear=(*one.linear, *[False] * (more if one.linear else 0)))
        for one, own in zip(episodes, levels, strict=True)]


def without_episode_inputs(found: Identified, n_u: int) -> Identified:
    """Return an estimate of such a plant with its first n_u inputs, and the offsets."""
    drift = found.drift
    levels = _levels(1 + len(drift.box.inputs) - n_u)
    offsets = levels @ drift.input_matrix[:, n_u:].T

    def first(one: Drift) -> Drift:
        inputs = one.box.inputs
        box = replace(one.box, inputs=inputs.only(inputs.names[:n_u]))
        if isinstance(one, TransformedDrift):
            return replace(one, drift=first(one.drift), box=box)
        assert isinstance(one, DriftModel | NetworkDrift)
        return replace(one, B=one.B[:, :n_u], box=box)

    def under_offset(one: Episode) -> Episode:
        return replace(one, u=one.u[:, :n_u], linear=one.linear[:n_u],
                       disturbance=drift.input_matrix[:, n_u:] @ one.u[0, n_u:])

    return found.mapped(first, under_offset, offsets=offsets, dead_time=found.dead_time[:n_u])


def _levels(episodes: int) -> Array:
    """Return the inputs (E, E - 1), each 1 in one episode and -1 in the last."""
    return np.vstack((np.eye(episodes - 1), -np.ones(episodes - 1)))
