# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Whether a model errs less than another one, not by chance."""

import numpy as np

from koopman_ros.core.arrays import Array

SIGMAS = 2.0  #: standard errors of a clear difference


def block_gains(errors: Array, others: Array, blocks: int) -> Array:
    """Return by which share squared errors (N, n_y) are less than others, in blocks (blocks,)."""
    scale = np.mean(others ** 2, axis=0) + 1e-300
    return np.array([np.mean(block) for block in np.array_split(
        (others ** 2 - errors ** 2) / scale, blocks)])


def clearly_positive(gains: Array) -> bool:
    """Return whether the mean of independent gains (k,) is above 0 by two standard errors."""
    return bool(np.mean(gains) > SIGMAS * np.std(gains) / np.sqrt(len(gains)))
