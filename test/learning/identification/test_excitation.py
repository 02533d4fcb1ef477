# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Inputs from whose record B cannot be estimated are named."""

from dataclasses import replace
import itertools

import numpy as np
import pytest

from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.learning.identification import identify, identify_unmeasured
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


def test_inputs_that_moved_nearly_together_are_warned_of() -> None:
    for seed in SEEDS:
        u = steps(seed, 12)
        u[:, 1] = u[:, 0] + 0.2 * u[:, 1]
        (warning,) = check_inputs(plant(3), record(u, seed, 0.05))
        assert warning.startswith('pump_1 and pump_2 moved together (correlation 0.9')


@pytest.mark.parametrize('noise', [0.1, 0.5])
def test_noise_of_inputs_that_count_as_held_does_not_hide_that_they_moved_together(noise) -> None:
    """As in a table whose inputs were measured, and are not given as linear."""
    for seed in SEEDS:
        u = steps(seed, 12)
        u[:, 1] = 0.35 * u[:, 0]
        try:
            (said,) = check_inputs(plant(3), record(u, seed, noise, measured=False))
        except ValueError as error:
            said = str(error)
        assert said.startswith('pump_1 and pump_2 moved together (correlation 0.9')


def test_three_inputs_of_which_no_two_moved_together() -> None:
    for seed in SEEDS:
        u = steps(seed, 12, 4)
        u[:, 2] = u[:, 0] + u[:, 1]
        with pytest.raises(ValueError, match=(
                r'^pump_1, pump_2 and pump_3 moved together \(condition index')):
            check_inputs(plant(4), record(u, seed, 0.01))


def test_measured_input_that_never_moved_is_named_in_spite_of_its_noise() -> None:
    for seed in SEEDS:
        u = steps(seed, 12)
        u[:, 1] = 3.0
        with pytest.raises(ValueError, match='more than white noise'):
            check_inputs(plant(3), record(u, seed, 0.05))


def test_no_collinearity_warning_for_known_effects_or_one_input() -> None:
    u = steps(0, 12)
    u[:, 1] = u[:, 0]
    known = replace(plant(3), B=np.ones((1, 3)))
    assert check_inputs(known, record(u, 0, 0.0)) == ()
    assert check_inputs(plant(1), record(u[:, :1], 0, 0.0)) == ()
    # too short to tell
    assert check_inputs(plant(3), record(u[:12], 0, 0.0)) == ()


@pytest.mark.parametrize('estimate', [identify, lambda *given: identify_unmeasured(*given, 1)])
def test_estimates_are_rejected_before_they_are_made(estimate) -> None:
    u = steps(0, 12)
    u[:, 1] = 0.5 * u[:, 0]
    with pytest.raises(ValueError, match='pump_1 and pump_2 moved together'):
        estimate(plant(3), record(u, 0, 0.02))
