# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The settings of a plan, its time grid, and the transfer of a plan from one grid to the next."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np

from koopman_ros.core.arrays import Array, frozen
from koopman_ros.core.integration import StepRule


@dataclass(frozen=True)
class PlanningSettings:
    """The horizon of a plan, its integration, and when it has converged and may be used."""

    fewest: int = 3  #: intervals
    most: int = 30  #: intervals
    horizon: float = 6.0  #: in time constants of the slowest mode of the closed loop
    #: in time constants of the fastest growing mode of the plant, at most: over more of them the
    #: effect of an input is too large to compute with
    unstable: float = 8.0
    #: longer steps than those of a filter: a plan is corrected at the next sample
    rule: StepRule = field(default_factory=partial(StepRule, time_constants=0.7, most=32))
    steps: int = 6  #: of integration at the nominal point, to which an interval grows
    #: distance from the training data in half-ranges, from which on a simulated plan is of no use
    diverged: float = 2.0
    iterations: int = 12  #: quadratic programs at a sample, at most
    converged: float = 1e-4  #: largest change of a scaled input of a plan that has converged
    usable: float = 0.05  #: the same of one that may be used
    #: nodes from one whose distance from the training data is checked to the next; the last, too
    checked: int = 3
    rounding: float = 1e-9  #: error of that distance, in half-ranges
    at_input: float = 1e-9  #: distance from a limit of a scaled input at which it is active
    #: the same of a state, which follows from all inputs
    at_state: float = 1e-6


@dataclass(frozen=True)
class HorizonGrid:
    """Intervals from the present on, each with one input that is held."""

    lengths: Array  #: (N,) in the model's time unit
    first: float = 0.0  #: time from a sample to the next; 0 for the first interval

    @property
    def sample(self) -> float:
        """Time from a sample to the next."""
        return self.first or float(self.lengths[0])

    @classmethod
    def growing(cls, horizon: float, first: float, count: int, longest: float) -> HorizonGrid:
        """
        Return intervals that grow by a constant factor until they reach a horizon.

        :param horizon: their sum, unless `longest` cuts them.
        :param first: length of the first one, and the least of all.
        :param count: their number.
        :param longest: length that none exceeds.
        """
        powers, total, factor = np.arange(count), horizon / first, 1.0
        # near 1 the sum does not determine the factor
        if count > 1 and total > count * (1.0 + 1e-9):
            from scipy.optimize import brentq  # slow to import

            factor = brentq(lambda g: np.sum(g ** powers) - total, 1.0, total, xtol=1e-14)
        return cls(frozen(np.minimum(first * factor ** powers, longest), 'intervals', (count,)))

    def with_nodes(self, times: Array) -> HorizonGrid:
        """Return the grid with further nodes, as far as it reaches."""
        every = np.unique(np.concatenate((self.times, times)))
        # a time that rounding moved off a node is that node
        apart = np.diff(every) > 1e-9 * self.sample
        lengths = np.diff(every[np.concatenate(([True], apart))])
        return HorizonGrid(frozen(lengths, 'intervals', lengths.shape), self.sample)

    @cached_property
    def times(self) -> Array:
        """The nodes (N + 1,) between the intervals, from 0."""
        return np.concatenate(([0.0], np.cumsum(self.lengths)))

    @property
    def since_change(self) -> Array:
        """Time (N, 1) from the input before to each input; before the first one, a sample."""
        return np.concatenate(([self.sample], self.lengths[:-1]))[:, None]

    def shift(self, u: Array, x: Array, lengths: Array) -> tuple[Array, Array]:
        """
        Move the plan of the sample before to this grid, one sample later.

        :param u: (M, n_u) inputs, x (M + 1, n_x) nodes and lengths (M,) of that plan.
        :return: the inputs (N, n_u) that held in the middle of each interval, and nodes
            (N + 1, n_x), interpolated linearly; beyond the end of the plan its last values hold.
        """
        old, new = np.concatenate(([0.0], np.cumsum(lengths))), self.sample + self.times
        middle = np.searchsorted(old[1:], 0.5 * (new[1:] + new[:-1]))
        nodes = np.column_stack([np.interp(new, old, column) for column in x.T])
        return u[np.minimum(middle, len(u) - 1)], nodes
