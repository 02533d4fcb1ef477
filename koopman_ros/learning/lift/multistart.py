# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The starts of a training on a backend, and their progress."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
from dataclasses import dataclass, replace
import math
import time

import numpy as np
import torch

from koopman_ros.execution import Backend, Notify
from koopman_ros.learning.lift.algorithm_1 import Algorithm1
from koopman_ros.learning.lift.incremental import IncrementalTraining, TrainedLift
from koopman_ros.learning.lift.levenberg_marquardt import MinimumStatus
from koopman_ros.learning.lift.neural_drift import NeuralDrift
from koopman_ros.learning.lift.residuals import ScaledSamples

Recipe = IncrementalTraining | Algorithm1 | NeuralDrift


@dataclass(frozen=True)
class MultistartProgress:
    """Progress of a training."""

    n_z: int  #: coordinates being learned
    finished: int  #: starts that finished, over all rounds
    total: int  #: starts in all
    iteration: int  #: step within a start that is under way, else 0
    residual: float  #: root mean square of the residuals there, else NaN
    rw: float  #: best validation figure so far, NaN before the first
    checked: float = 0.0  #: share that is done of the closed loops, which come last
    name: str = ''  #: of the class that is being learned, where several are compared

    @property
    def text(self) -> str:
        """The progress in words."""
        if self.checked:
            return f'{100.0 * self.checked:.0f} % of the closed loops'
        rw = '' if math.isnan(self.rw) else f', rw {self.rw:.1e}'
        return f'n_z {self.n_z}, start {min(self.finished + 1, self.total)} of {self.total}{rw}'


# Called after steps and starts, and again while others work; True ends the training with the best
# so far.
Watch = Callable[[MultistartProgress], bool]


class Tracker:
    """Reports progress to `watch`, and remembers whether it asked to stop."""

    def __init__(self, watch: Watch | None, total: int) -> None:
        self._watch, self._total = watch, total
        self.n_z, self.finished, self.steps, self.stop = 0, 0, 0, False
        self._rw = math.nan
        self._step = 0, math.nan

    def count(self, _: str, value: tuple[int, float] | None) -> bool:
        """Report the step and the cost of a start, or where they stood last."""
        if value is not None:
            self._step = value[0], math.sqrt(2.0 * value[1])
        return self._report(*self._step)

    def finish(self, rw: float) -> None:
        """Report a start that has finished, with the best figure so far."""
        self.finished, self._rw, self._step = self.finished + 1, rw, (0, math.nan)
        self._report(0, math.nan)

    def check(self, share: float) -> bool:
        """Report the share of closed loops that is done."""
        return self._report(0, math.nan, share)

    def _report(self, iteration: int, residual: float, checked: float = 0.0) -> bool:
        if self._watch is not None and not self.stop:
            self.stop = self._watch(MultistartProgress(
                self.n_z, self.finished, self._total, iteration, residual, self._rw, checked))
        return self.stop


@contextlib.contextmanager
def _one_thread() -> Generator[None]:
    """Run torch with one thread: the rounding of its sums depends on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def run_starts(backend: Backend, recipe: Recipe, data: ScaledSamples, n_z: int,
               parent: TrainedLift | None, seed: int, starts: int, tracker: Tracker,
               budget: float) -> Generator[tuple[str, TrainedLift | str]]:
    """
    Run one round; yield the result of each start in their order, or the reason of a failure.

    :param budget: of each start, in s of processor time.
    """
    seeds = [int(n) for n in np.random.SeedSequence([seed, n_z]).generate_state(starts)]
    items = {f'start {i + 1} with n_z = {n_z}': (
        recipe.of_start(i) if isinstance(recipe, IncrementalTraining) else recipe, number)
        for i, number in enumerate(seeds)}
    return backend.run(_start, items, shared=(data, n_z, parent, budget), watch=tracker.count)


def _start(shared: tuple[ScaledSamples, int, TrainedLift | None, float],
           item: tuple[Recipe, int], notify: Notify) -> TrainedLift | str:
    (data, n_z, parent, budget), (recipe, seed) = shared, item
    end, late = time.process_time() + budget, False

    def monitor(*step: float) -> bool:
        nonlocal late
        late = time.process_time() > end
        return notify(step) or late

    try:
        with _one_thread():
            grown = recipe.start(data, n_z, parent, seed, monitor)
        return replace(grown, status=MinimumStatus.OUT_OF_TIME) if late and (
            grown.status is MinimumStatus.INTERRUPTED) else grown
    except torch.linalg.LinAlgError as error:
        return f'a start is degenerate ({error}): check that all states move independently'
