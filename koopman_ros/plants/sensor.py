# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Sensor noise and resolution."""

import math

import numpy as np


def sensor_noise(deviation: float, seed: int, sample: int) -> float:
    """
    Return the noise of one sample, the same for the same seed and number.

    :param deviation: standard deviation, in state units.
    :param seed: seed of the run, not negative.
    :param sample: number of the sample, not negative.
    """
    if deviation == 0.0:
        return 0.0
    return deviation * float(np.random.default_rng((seed, sample)).standard_normal())


def in_steps(value: float, resolution: float) -> float:
    """
    Return the nearest value that a sensor of finite resolution can show.

    :param resolution: distance between two such values, the multiples of it; 0 shows all.
    """
    return value if resolution == 0.0 else value - math.remainder(value, resolution)
