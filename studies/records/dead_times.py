# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Dead times of simulated plants, as training finds them."""

import numpy as np

from koopman_ros.core.datasets import Episode
from koopman_ros.learning.identification import find_dead_times
from studies.campaign import Metrics, Models

PLANTS = 20
_COUNT, _NOISE, _LONGEST = 800, 0.03, 20


def one_plant(seed: int) -> tuple[Metrics, Models]:
    """
    Find the dead times of a plant with one or two inputs, by turns.

    The inputs step at random and act 0 to 20 samples late on one or two lags of 5 to 20 samples;
    the noise is 3 % of the spread.

    :return: `largest_error` in samples, and whether it is `within_a_sample`.
    """
    from scipy.signal import lfilter
    rng = np.random.default_rng(seed)
    late = rng.integers(0, _LONGEST + 1, 1 + seed % 2)
    u = np.empty((_COUNT, len(late)))
    for column in u.T:
        changes = np.cumsum(rng.integers(5, 60, _COUNT))
        column[:] = rng.uniform(-1.0, 1.0, _COUNT)[
            np.searchsorted(changes, np.arange(_COUNT), 'right')]
    y = sum(gain * np.concatenate([np.full(d, column[0]), column[:_COUNT - d]])
            for gain, column, d in zip((1.0, -0.7), u.T, late, strict=False))
    for time_constant in rng.uniform(5.0, 20.0, rng.integers(1, 3)):
        pole = np.exp(-1.0 / time_constant)
        y = lfilter([0.0, 1.0 - pole], [1.0, -pole], y)
    y += _NOISE * np.std(y) * rng.standard_normal(_COUNT)
    time = np.arange(float(_COUNT))
    found = find_dead_times([Episode(time, y[:, None], time, u)]).samples
    error = int(np.max(np.abs(np.subtract(found, late))))
    return {'largest_error': error, 'within_a_sample': error <= 1}, {}
