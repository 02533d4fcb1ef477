# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""By how much the rate of a learned drift may be wrong, where its data are."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from koopman_ros.core.arrays import Array, frozen, short_repr

MAX_BAND_POINTS = 256


@dataclass(frozen=True)
class RateBand:
    """
    Rates of a drift along each state, with the band of the plants that a record allows.

    Along a state, the other signals follow their linear regression on it, so that the points are
    where the data are. All values are in scaled deviations and per time unit of the model.

    :raises ValueError: naming the array that does not fit.
    """

    error: Array  #: (n_x,) by which the rate may be wrong at any sample of the record
    values: Array  #: (P, n_x) of each state
    rates: Array  #: (P, n_x) of the estimated drift there
    lower: Array  #: (P, n_x) end of the band
    upper: Array  #: (P, n_x) its upper end

    __repr__ = short_repr

    def __post_init__(self) -> None:
        n, points = np.size(self.error), len(np.atleast_1d(self.values))
        if points > MAX_BAND_POINTS:
            raise ValueError(f'the band of the rate has {points} points, the maximum is '
                             f'{MAX_BAND_POINTS}')
        for one in fields(self):
            shape = (n,) if one.name == 'error' else (points, n)
            object.__setattr__(self, one.name, frozen(
                getattr(self, one.name), f'rate_band.{one.name}', shape))

    @property
    def n_x(self) -> int:
        """Number of states."""
        return len(self.error)
