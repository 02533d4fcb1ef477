# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Inputs from whose record B cannot be estimated are named."""

import itertools

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.learning.identification.excitation import check_inputs

NONE = np.full(4, np.nan)
SEEDS = range(4)
SAMPLES = 1200


def plant(count: int) -> PlantDescription:
    names = tuple(f'pump_{k + 1}' for k in range(count))
    return PlantDescription('tanks', ('level',), ('m',), names, ('V',) * count, 's', NONE[:1],
                            NONE[:count],
                            None)


def steps(seed: int, hold: int, count: int = 3) -> np.ndarray:
    """Return independent steps (N, count) of 1 V to 9 V."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(1.0, 9.0, (SAMPLES // hold + 1, count)), hold, axis=0)[:SAMPLES]


def record(u: np.ndarray, seed: int, noise: float, *, measured: bool = True,
           episodes: int = 3) -> list[Episode]:
    rng = np.random.default_rng([seed, 1])
    time, x = np.arange(len(u), dtype=float), rng.random((len(u), 1))
    read = u + noise * rng.standard_normal(u.shape)
    linear = (True,) * u.shape[1] if measured else ()
    return [Episode(time[part], x[part], time[part], read[part], linear)
            for part in np.array_split(np.arange(len(u)), episodes)]


@pytest.mark.parametrize('hold', [4, 12, 40])
@pytest.mark.parametrize('noise', [0.0, 0.05, 0.5])
@pytest.mark.parametrize('gain', [0.35, -2.0])
def test_inputs_that_moved_together_are_rejected_by_name_also_where_noise_hides_it(
        hold: int, noise: float, gain: float) -> None:
    """As with one pump in a fixed ratio to another."""
    for seed in SEEDS:
        u = steps(seed, hold)
        u[:, 2] = 5.0 + gain * u[:, 0]
        sign = '-' if gain < 0.0 else ''
        with pytest.raises(ValueError, match=(
                rf'^pump_1 and pump_3 moved together \(correlation {sign}(1|0.99\d*)\): .* step')):
            check_inputs(plant(3), record(u, seed, noise))


@pytest.mark.parametrize(('hold', 'noise', 'measured'), [
    (1, 0.0, False), *itertools.product((4, 12), (0.0, 0.05, 0.5), (True, False))])
def test_inputs_that_moved_by_themselves_are_not(hold: int, noise: float, measured: bool) -> None:
    for seed in SEEDS:
        assert check_inputs(plant(3), record(steps(seed, hold), seed, noise,
                                             measured=measured)) == ()


def test_measured_input_that_never_moved_is_named_in_spite_of_its_noise() -> None:
    for seed in SEEDS:
        u = steps(seed, 12)
        u[:, 1] = 3.0
        with pytest.raises(ValueError, match='more than white noise'):
            check_inputs(plant(3), record(u, seed, 0.05))
