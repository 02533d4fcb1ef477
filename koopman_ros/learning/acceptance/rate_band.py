# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The band of the drift: by how much its rate may be wrong where the data are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.learning.acceptance.corrections import PlausiblePlant
from koopman_ros.learning.acceptance.settings import DEFAULTS, Thresholds
from koopman_ros.learning.identification import Drift


@dataclass(frozen=True)
class RateBand:
    """
    Rates of the estimated drift along each state, with their band.

    Along a state, the other signals have their means of the samples near it, so that every point
    is where the data are.
    """

    #: (n_x,) largest error of the rate at all samples, at the confidence of the settings, in
    #: state units per time unit
    error: Array
    #: (P, n_x) values of each state, rising, in state units
    values: Array
    rates: Array  #: (P, n_x) of the estimated drift there, in state units per time unit
    lower: Array  #: (P, n_x) ends of the band, likewise
    upper: Array

    __repr__ = short_repr


def rate_band(drift: Drift, plants: Sequence[PlausiblePlant], x: Array, u: Array,
              settings: Thresholds = DEFAULTS) -> RateBand:
    """
    Return the band of a drift that plants span at samples of a record.

    :param x: (N, n_x) recorded states, and u: (N, n_u) the inputs then.
    """
    added = np.array([one.correction(x, u) for one in plants])
    error = np.quantile(np.abs(added).max(axis=1), settings.confidence, axis=0)
    tail = 0.5 * (1.0 - settings.confidence)
    columns = []
    for i in range(x.shape[1]):
        order = np.argsort(x[:, i], kind='stable')
        trim = int(settings.trimmed * len(order))
        groups = np.array_split(order[trim:len(order) - trim], settings.band_points)
        X, U = (np.array([np.mean(a[rows], axis=0) for rows in groups if len(rows)])
                for a in (x, u))
        rates = drift.rate(X, U)[:, i]
        low, high = np.quantile([one.correction(X, U)[:, i] for one in plants],
                                [tail, 1.0 - tail], axis=0)
        columns.append((X[:, i], rates, rates + low, rates + high))
    return RateBand(error, *(np.column_stack(some) for some in zip(*columns, strict=True)))
