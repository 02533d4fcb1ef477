# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Changes of a signal that no plant makes: single spikes, and jumps to another level."""

import numpy as np
from numpy.typing import NDArray

# Fewer samples do not tell what is usual.
_ENOUGH = 50
# A change is no motion when it is larger than so many times all but the largest changes, ...
_TIMES_USUAL = 10.0
_USUAL = 90.0  # percentile
# ... and than this share of the range in which it mostly is.
_SHARE_OF_RANGE = 0.2
_MOSTLY = (1.0, 99.0)  # percentiles


def spikes_and_jumps(values: NDArray[np.float64], least: float
                     ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """
    Find samples that leap away and back, and those that begin at another level.

    :param values: (n,) in the order of their times.
    :param least: no smaller change is one of them.
    :return: whether each sample is a spike (n,), and whether the signal jumps to it (n,).
    """
    spike, jump = np.zeros(len(values), dtype=bool), np.zeros(len(values), dtype=bool)
    if len(values) < _ENOUGH:
        return spike, jump
    change = np.diff(values)
    low, high = np.percentile(values, _MOSTLY)
    limit = max(_TIMES_USUAL * float(np.percentile(np.abs(change), _USUAL)),
                _SHARE_OF_RANGE * float(high - low), least)
    large = np.abs(change) > limit
    spike[1:-1] = large[:-1] & large[1:] & (change[:-1] * change[1:] < 0.0)
    # two changes belong to each spike
    jump[1:] = large & ~spike[1:] & ~spike[:-1]
    return spike, jump
