# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The band of the drift: by how much its rate may be wrong where the data are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.learning.acceptance.corrections import PlausiblePlant
from koopman_ros.learning.acceptance.settings import DEFAULTS, Thresholds
from koopman_ros.learning.identification import Drift
from koopman_ros.model import Coordinates, RateBand


def rate_band(drift: Drift, plants: Sequence[PlausiblePlant], x: Array, u: Array,
              states: Coordinates, settings: Thresholds = DEFAULTS) -> RateBand:
    """
    Return the band of a drift that plants span at samples of a record.

    :param x: (N, n_x) recorded states, and u: (N, n_u) the inputs then.
    :param states: of the model, by which the band is scaled.
    """
    added = np.array([one.correction(x, u) for one in plants])
    error = np.quantile(np.abs(added).max(axis=1), settings.confidence, axis=0)
    tail = 0.5 * (1.0 - settings.confidence)
    columns = []
    for i in range(x.shape[1]):
        low, high = np.quantile(x[:, i], [settings.trimmed, 1.0 - settings.trimmed])
        path = np.vander(np.linspace(low, high, settings.band_points), 2)
        X, U = (path @ np.linalg.lstsq(np.vander(x[:, i], 2), a, rcond=None)[0] for a in (x, u))
        rates = drift.rate(X, U)[:, i]
        below, above = np.quantile([one.correction(X, U)[:, i] for one in plants],
                                   [tail, 1.0 - tail], axis=0)
        columns.append((X[:, i], rates, rates + below, rates + above))
    values, *bands = (np.column_stack(some) for some in zip(*columns, strict=True))
    return RateBand(error / states.scale, states.to_deviation(values),
                    *(one / states.scale for one in bands))
