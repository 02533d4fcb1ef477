# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Closed loops on plants that a record cannot tell from the estimated drift, and their bound."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.evaluation.closed_loop_settings import SETTINGS
from koopman_ros.evaluation.closed_loop_test import evaluate_closed_loops, Rate
from koopman_ros.execution import Backend, Serial
from koopman_ros.learning.acceptance.settings import DEFAULTS, Thresholds
from koopman_ros.learning.identification import Stopped
from koopman_ros.model import LiftedModel

#: share of failed loops on the plant that is counted on: the expected one, and its upper bound
Share = tuple[float, float]


@dataclass(frozen=True)
class LoopConditions:
    """Conditions of the closed loops, as the record had them."""

    interval: float  #: s between samples
    noise: Array  #: (n_x,) standard deviation of the measured states, in state units
    disturbances: Sequence[str] = ()  #: inputs that are measured and not manipulated


@dataclass(frozen=True)
class PlantTest:
    """Counts of closed loops on plants that a record cannot tell from the estimated one."""

    failed: NDArray[np.int64]  #: (M,) failed loops of each plant
    loops: NDArray[np.int64]  #: (M,) loops that count
    setpoints: Array  #: (N, n_x) of all loops, in state units
    settings: Thresholds

    __repr__ = short_repr

    @property
    def lost(self) -> int:
        """Number of plants of which too large a share of the loops failed."""
        return int(np.sum(self.failed > self.settings.lost_share * self.loops))

    @property
    def share(self) -> Share:
        """The expected share of failing loops on the plant, and its upper bound."""
        return share_bound(self.failed, self.loops, self.settings.confidence)

    @property
    def accepted(self) -> bool:
        """Whether the bound is low enough."""
        return (self.share[1] <= self.settings.most_failing
                and self.lost < self.settings.lost_plants)


def share_bound(failed: Sequence[int] | NDArray[np.int64], loops: Sequence[int] | NDArray[
        np.int64], confidence: float) -> Share:
    """
    Return the mean share of failed loops, and an upper bound of the share on one more plant.

    The shares of the plants have a beta distribution with the mean of all loops and the variance
    between the plants that the binomial variance of the loops leaves. The bound is its quantile,
    and at least that of C. Clopper and E. Pearson, Biometrika 26 (1934) 404, for all loops.

    :param failed: (M,) counts of the plants.
    :param loops: (M,) all loops of each, at least 1.
    """
    # in here: no node needs it
    from scipy.special import betaincinv

    failed, loops = np.asarray(failed, np.float64), np.asarray(loops, np.float64)
    total, count = float(failed.sum()), float(loops.sum())
    mean = total / count
    pooled = float(betaincinv(total + 1.0, count - total, confidence)) if total < count else 1.0
    between = 0.0 if len(loops) < 2 else float(
        np.var(failed / loops, ddof=1) - np.mean(mean * (1.0 - mean) / loops))
    if between <= 0.0:
        return mean, pooled
    # the sum of the two parameters of a beta distribution of this variance
    size = max(mean * (1.0 - mean) / between - 1.0, 1e-3)
    return mean, max(pooled, float(betaincinv(mean * size, (1.0 - mean) * size, confidence)))


def run_plants(model: LiftedModel, rates: Sequence[Rate], conditions: LoopConditions,
               settings: Thresholds = DEFAULTS, *,
               watch: Callable[[float], bool] = lambda _: False, backend: Backend | None = None
               ) -> PlantTest:
    """
    Close the loop of a model's law on each plant, until enough plants are lost.

    :param rates: dx/dt of the plants, see :func:`evaluate_closed_loops`.
    :param watch: called with the share that is done; True ends.
    :raises Stopped: when `watch` requested it.
    """
    items = {f'plant {k + 1}': (rate, k) for k, rate in enumerate(rates)}
    done = dict.fromkeys(items, 0.0)
    stopped = False

    def watching(name: str, share: float | None) -> bool:
        nonlocal stopped
        if share is not None:
            done[name] = share
        stopped = watch(sum(done.values()) / len(done)) or stopped
        return stopped

    failed: list[int] = []
    loops: list[int] = []
    setpoints = [np.zeros((0, model.n_x))]
    result = PlantTest(np.zeros(0, np.int64), np.zeros(0, np.int64), setpoints[0], settings)
    with contextlib.closing((backend or Serial()).run(
            _tested, items, shared=(model, conditions, settings), watch=watching)) as tests:
        for name, test in tests:
            if test is None:
                raise Stopped
            done[name] = 1.0
            failed.append(test[0])
            loops.append(test[1])
            setpoints.append(test[2])
            result = PlantTest(np.array(failed), np.array(loops), np.vstack(setpoints), settings)
            if result.lost >= settings.lost_plants:
                break
    if stopped:
        raise Stopped
    return result


def _tested(shared: tuple[LiftedModel, LoopConditions, Thresholds], item: tuple[Rate, int],
            notify: Callable[[float], bool]) -> tuple[int, int, Array] | None:
    """Return the failed loops of one plant, all loops, and their set-points; None if stopped."""
    (model, conditions, settings), (rate, seed) = shared, item
    try:
        # from starts of its own
        test = evaluate_closed_loops(
            model, rate, loops=settings.plant_loops, seed=1 + seed, watch=notify,
            interval=conditions.interval, noise=conditions.noise,
            disturbances=conditions.disturbances, settings=replace(
                SETTINGS, most_calls=settings.plant_calls, fewest_loops=settings.fewest_loops))
    except np.linalg.LinAlgError:
        # no law stabilises its linearisation
        return 1, 1, np.zeros((0, model.n_x))
    if test is None:
        return None
    # where no loop counts, the law has failed
    return (int(test.failed.sum()) if test.loops else 1), max(test.loops, 1), test.setpoints
