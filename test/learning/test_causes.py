# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The causes that errors of a drift point to: plants with one each, which the drift lacks."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import Episode
from koopman_ros.learning.causes import likely_causes
from koopman_ros.learning.identification import DriftModel, Identified
from support.known_plants import box

BOX = box([-2.0], [2.0], [-1.0], [1.0])
PERIOD, HELD, COUNT, FINE = 0.1, 10, 100, 10
# dx/dt of a plant with the state x, h not measured, under inputs now and 0.4 s ago, and noise d
Plant = Callable[[float, float, float, float, float], tuple[float, float]]


def record(plant: Plant, seed: int) -> Episode:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, COUNT // HELD), HELD * FINE)
    slow = np.convolve(rng.standard_normal(len(u) + 500), np.ones(500) / 22.0, 'valid')
    x, h, h_fine, path = rng.uniform(-1.0, 1.0), 0.0, PERIOD / FINE, []
    for k in range(len(u)):
        path.append(x)
        dx, dh = plant(x, h, u[k], u[max(0, k - 4 * FINE)], slow[k])
        x, h = x + h_fine * dx, h + h_fine * dh
    time = PERIOD * np.arange(COUNT)
    noise: Array = 0.01 * rng.standard_normal(COUNT)
    return Episode(time, (np.array(path)[::FINE] + noise)[:, None], time, u[::FINE][:, None])


@pytest.mark.parametrize(('plant', 'first'), [
    (lambda x, h, u, late, d: (-x + late, 0.0), 'dead_time of u1'),
    (lambda x, h, u, late, d: (-x + u + 0.5 * x * u, 0.0), 'input_matrix_degree'),
    (lambda x, h, u, late, d: (-x + u + 0.5 * h, u - 0.3 * h), 'unmeasured_states'),
    # nothing of the record tells it
    (lambda x, h, u, late, d: (-x + u + 0.5 * d, 0.0), '')])
def test_the_likeliest_cause_is_that_of_the_plant(plant: Plant, first: str) -> None:
    drift = DriftModel(BOX, 1, np.array([[0.0], [-1.0]]), np.array([[0.5]]))
    episodes = [record(plant, seed) for seed in range(8)]
    found = Identified(drift, 'known', drift, (), np.full(1, 0.01), tuple(episodes[:6]),
                       tuple(episodes[6:]))
    causes = likely_causes(found, 0)
    assert [name for _, name in causes][:1] == [first] * bool(first), causes
    assert not first or causes[0][0] > 0.6
    # nothing is advised that the search has tried
    tried = likely_causes(replace(found, searched=(first,)), 0)
    assert first.startswith('dead_time') or first not in [name for _, name in tried]


def test_an_input_that_was_not_held_between_samples_is_named() -> None:
    drift = DriftModel(BOX, 1, np.array([[0.0], [-1.0]]), np.array([[0.5]]))

    def analogue(seed: int) -> Episode:
        """Return dx/dt = -x + u, u linear from sample to sample, exactly but for noise."""
        rng = np.random.default_rng(seed)
        u = np.convolve(rng.standard_normal(COUNT + 2), np.full(3, 0.3), 'valid')
        decay, x = np.exp(-PERIOD), [rng.uniform(-1.0, 1.0)]
        gain = 1.0 - (1.0 - decay) / PERIOD
        for before, after in pairwise(u):
            x.append(decay * x[-1] + (1.0 - decay) * before + gain * (after - before))
        time = PERIOD * np.arange(COUNT)
        noise: Array = 2e-3 * rng.standard_normal(COUNT)
        return Episode(time, (np.array(x) + noise)[:, None], time, u[:, None])

    episodes = [analogue(seed) for seed in range(8)]
    found = Identified(drift, 'known', drift, (), np.full(1, 2e-3), tuple(episodes[:6]),
                       tuple(episodes[6:]))
    (share, name), *_ = likely_causes(found, 0)
    assert name == 'linear for u1'
    assert share > 0.9
    lines = [replace(one, linear=(True,)) for one in episodes]
    # in some episodes it may have been measured
    mixed = replace(found, fitted=(lines[0], *episodes[1:6]))
    assert [name for _, name in likely_causes(mixed, 0)][:1] == ['linear for u1']
    assert not likely_causes(replace(found, fitted=tuple(lines[:6]), held_out=tuple(lines[6:])), 0)
