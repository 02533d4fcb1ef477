# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Choice of the degree of a polynomial drift among those that predict about equally well."""

from collections.abc import Collection, Mapping
import math

import numpy as np

from koopman_ros.core.datasets import Array
from koopman_ros.learning.identification.drift import DriftModel, prediction_error, Segments

# Mean squared errors this close count as equal: on a few segments that hold one estimate against
# another, chance alone makes such a difference.
NEARLY = 1.1
LOST = 10.0  # half-ranges from the measurement, at which a simulation has left the record


def nearly_best(degrees: Collection[int], costs: Mapping[int, float]) -> list[int]:
    """Return the degrees whose errors count as equal to the least."""
    least = min(costs[d] for d in degrees)
    return [d for d in degrees if costs[d] <= NEARLY * least]


def following(drifts: Mapping[int, DriftModel], costs: Mapping[int, float], record: Segments
              ) -> list[int]:
    """
    Return the degrees whose drifts follow the record in a simulation; all where none does.

    Those of an unstable plant may leave it, unless one that is as good follows.

    :param costs: mean squared errors of predictions by degree.
    """
    leaving = {d for d, drift in drifts.items() if _leaves(drift, record)}
    if leaving.issuperset(nearly_best(drifts, costs)):
        leaving -= {d for d in leaving if drifts[d].growth_rate > 0.0}
    return [d for d in drifts if d not in leaving] or list(drifts)


def _leaves(drift: DriftModel, record: Segments) -> bool:
    with np.errstate(all='ignore'):
        errors = record.errors(drift.rate, record.x[0]) / drift.box.states.scale
    return not np.all(np.abs(errors) < LOST)


def information(model: DriftModel, segments: Segments, learned_B: bool, colour: Array) -> float:
    """
    Return the Bayesian information criterion, but for a constant.

    :param colour: autocorrelation (n_x,) of the errors from one sample to the next; they are
        equivalent to fewer white ones.
    """
    scale = model.box.states.scale
    # an error below rounding tells nothing
    rmse = np.maximum(prediction_error(model.rate, segments, scale) / scale, 1e-12)
    count = np.sum(segments.sampled) * (1.0 - colour) / (1.0 + colour)
    size = np.count_nonzero(model.free) + learned_B * model.B.size
    return 2.0 * float(np.sum(count * np.log(rmse))) + size * math.log(np.mean(count))
