# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Tests of what a sensor adds to the truth."""

import math

import numpy as np
import pytest

from koopman_ros.plants import in_steps, sensor_noise


def test_noise_repeats_by_seed_and_sample() -> None:
    values = [sensor_noise(0.1, 7, n) for n in range(4000)]
    assert values == [sensor_noise(0.1, 7, n) for n in range(4000)]
    assert values[:5] != [sensor_noise(0.1, 8, n) for n in range(5)]
    # 4000 samples determine the standard deviation to about 1.1 % (one sigma)
    assert math.isclose(np.std(values), 0.1, rel_tol=0.05)
    assert abs(np.mean(values)) < 5 * 0.1 / math.sqrt(4000)


def test_no_deviation_is_no_noise() -> None:
    assert sensor_noise(0.0, 7, 3) == 0.0


@pytest.mark.parametrize(('value', 'resolution', 'shown'), [
    (25.34, 0.1, 25.3),
    (25.36, 0.1, 25.4),
    (-0.3, 0.25, -0.25),
    (7.0, 10.0, 10.0),
    (3.0, 10.0, 0.0),
    (51.3, 5e-324, 51.3),
])
def test_a_sensor_shows_multiples_of_its_resolution(
        value: float, resolution: float, shown: float) -> None:
    assert in_steps(value, resolution) == pytest.approx(shown, abs=1e-14)


def test_without_a_resolution_everything_is_shown() -> None:
    assert in_steps(1.0 / 3.0, 0.0) == 1.0 / 3.0
