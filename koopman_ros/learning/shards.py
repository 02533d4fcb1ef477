# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A drift of bags that stay with the workers that read them: sums over them come back."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
from dataclasses import dataclass, replace
import math

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.bags import Account, loop_episodes
from koopman_ros.bags.episodes import distinct
from koopman_ros.jobs.backends import Backend
from koopman_ros.learning.drift_samples import drift_samples
from koopman_ros.learning.identification.drift import (
    DriftModel,
    longest_step,
    prediction_error,
    Segments,
)
from koopman_ros.learning.identification.weak_form import regress, weak_rows
from koopman_ros.learning.lift.shards import Shard
from koopman_ros.learning.record import Source
from koopman_ros.lifting import Box
from koopman_ros.plant_data import cut, Episode, Plant, Samples
from koopman_ros.units import SECONDS_PER_TIME_UNIT

_SEGMENT = 240  # samples
_CHOOSING = 5  # each so many-th segment of a bag chooses the degree
# Mean squared errors so close count as equal.
_NEARLY = 1.1


@dataclass(frozen=True)
class DriftOfBags:
    """A drift that was estimated where the bags are."""

    drift: DriftModel  #: the estimate
    #: (n_x,) root mean square error of predictions by degree, over the segments that chose
    rmse: dict[int, Array]
    samples: int  #: in all bags
    shards: tuple[Shard, ...]  #: samples of the drift along each bag, to :func:`train` a lift of


def identify_bags(plant: Plant, source: Source, backend: Backend, *,
                  degrees: Sequence[int] = (1, 2, 3, 4), window: int = 40) -> DriftOfBags:
    """
    Estimate dx/dt = f(x) + B u from bags that workers open, each its own.

    By the weak form (:func:`~koopman_ros.learning.identification.weak_form.weak_form`), without the other
    methods and the refinement of :func:`identify`: what comes from a bag is its range, a triangle
    of the QR decomposition of its equations, and sums of squared errors, whatever its length. Of
    the degrees the lowest is taken that predicts about as well as the best, and fitted to all.

    :param plant: names, units, time unit, and B where it is known and constant.
    :param source: the bags, which the workers see under these paths.
    :param window: samples of a window of the weak form.
    :raises BagReadError: for bags that cannot be used.
    :raises ValueError: when the bags do not determine a drift.
    """
    bags = [str(bag) for bag in distinct(source.bags, Account())]
    seconds = SECONDS_PER_TIME_UNIT[plant.time_unit]
    with contextlib.closing(backend.keep(_Bag, {
            bag: (source, bag, seconds) for bag in bags})) as kept:
        extents = [found for found in kept.run(_extent, None) if found is not None]
        if not extents:
            raise ValueError('the bags hold no usable segment of measurements: record longer, '
                             'without gaps')
        lows, highs, counts = zip(*extents, strict=True)
        n_x = len(plant.state_names)
        corners = np.stack([np.min(lows, axis=0), np.max(highs, axis=0)])
        box = Box.of(plant, corners[:, :n_x], corners[:, n_x:], nominal=False)
        B = None if plant.B is None else box.input_matrix(plant.input_matrix(box.states.center))

        def fitted(degree: int, choosing: bool) -> DriftModel:
            rows = np.concatenate([found for found in kept.run(_triangle, (
                box, degree, B, window, choosing)) if found is not None])
            m = rows.shape[1] - n_x - (len(box.inputs) if B is None else B.shape[1])
            return regress(box, degree, rows[:, :m], rows[:, m:-n_x], rows[:, -n_x:], B)

        rmse: dict[int, Array] = {}
        for degree in degrees:
            with contextlib.suppress(ValueError, np.linalg.LinAlgError):
                model = fitted(degree, choosing=True)
                squares, of = map(sum, zip(*kept.run(_errors, model), strict=True))
                rmse[degree] = np.sqrt(squares / of)
        costs = {degree: float(np.mean((error / box.states.scale) ** 2))
                 for degree, error in rmse.items()}
        least = min(costs.values(), default=math.inf)
        if not math.isfinite(least):
            raise ValueError('no drift fits the bags: record longer, with steps of the input')
        drift = fitted(min(d for d in costs if costs[d] <= _NEARLY * least), choosing=False)
    return DriftOfBags(drift, rmse, sum(counts), tuple(
        Shard(bag, samples_of_bag, (source, bag, seconds, drift)) for bag in bags))


def samples_of_bag(source: Source, bag: str, seconds: float, drift: DriftModel) -> Samples:
    """Sample a drift along a bag's episodes; `seconds` are those of its time unit."""
    return drift_samples(drift, tuple(_Bag((source, bag, seconds)).parts))


class _Bag:
    """The segments of a bag, where it was read."""

    def __init__(self, item: tuple[Source, str, float]) -> None:
        source, bag, seconds = item
        episodes, _ = loop_episodes(
            [bag], source.states, source.inputs, tolerance_ns=source.tolerance_ns,
            least_jumps=source.least_jumps)
        self.count = sum(map(len, episodes))
        self.parts = cut([replace(one, time=one.time / seconds,
                                  input_time=one.input_time / seconds) for one in episodes],
                         _SEGMENT)

    @property
    def nbytes(self) -> int:
        """Their size in bytes."""
        return sum(part.x.nbytes + part.u.nbytes for part in self.parts)

    def share(self, choosing: bool) -> list[Episode]:
        """Return the segments that choose, or the others."""
        return [part for i, part in enumerate(self.parts)
                if (i % _CHOOSING == _CHOOSING - 1) == choosing]


def _extent(own: _Bag, _: None) -> tuple[Array, Array, int] | None:
    """Return the lowest and highest states and inputs, and the number of samples."""
    if not own.parts:
        return None
    x, u = (np.concatenate([getattr(part, name) for part in own.parts]) for name in 'xu')
    return (np.concatenate([x.min(axis=0), u.min(axis=0)]),
            np.concatenate([x.max(axis=0), u.max(axis=0)]), own.count)


def _triangle(own: _Bag, call: tuple[Box, int, Array | None, int, bool]) -> Array | None:
    """Return the triangle of a bag's equations, of all segments or without those that choose."""
    box, degree, B, window, choosing = call
    parts = [part for part in (own.share(False) if choosing else own.parts)
             if len(part) >= window]
    if not parts:
        return None
    triangle: Array = np.linalg.qr(np.hstack(weak_rows(parts, box, degree, B, window))).R
    return triangle


def _errors(own: _Bag, drift: DriftModel) -> tuple[Array, int]:
    """Return sums of squared errors (n_x,) over the segments that choose, and of how many."""
    parts = own.share(True)
    if not parts:
        return np.zeros(len(drift.box.states)), 0
    segments = Segments.of(parts, longest_step(parts))
    count = sum(map(len, parts))
    return count * prediction_error(drift.rate, segments, drift.box.states.scale) ** 2, count
