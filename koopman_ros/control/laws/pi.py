# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Proportional-integral control, which asks nothing of a model but the names of its signals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control.laws.base import Figures, LawResult, Target, Tuning
from koopman_ros.control.limits import finite, InputLimits
from koopman_ros.estimation import Estimate
from koopman_ros.lifting import LiftedModel
from koopman_ros.reasons import Code, Reason, reason


@dataclass(frozen=True)
class ProportionalIntegral:
    """
    A PI law for each state with a gain; the first of them moves the first input, and so on.

    u_k = u_{k-1} + K (e_k - e_{k-1} + e_k h / T), with e the set-point less the state, from the
    command before: in the velocity form nothing winds up at a range or a rate, and the law begins
    where another one ended. See K. J. Astrom, T. Hagglund, *PID Controllers* (1995), section 3.5.

    :raises ValueError: for more gains than inputs.
    """

    model: LiftedModel  #: whose signals they are
    tuning: Tuning  #: gains and integral times

    #: it goes to the set-point, wherever a model has its steady states
    model_free = True

    def __post_init__(self) -> None:
        if len(self._places) > self.model.n_u:
            names = ', '.join(self.model.states.names[i] for i in self._places)
            raise ValueError(f'{self.model.n_u} inputs for the PI laws of {names}: set pi_gain to '
                             '0 for those that are not controlled')

    @cached_property
    def _places(self) -> list[int]:
        return np.flatnonzero(self.tuning.pi_gain).tolist()

    @property
    def unusable(self) -> Reason | None:
        """Why it never gives an input: it has no gain."""
        return None if self._places else reason(Code.NO_PI_GAIN)

    def compute(self, estimate: Estimate, target: Target, limits: InputLimits, memory: object,
                interval: float, deadline: float = math.inf, last: Array | None = None
                ) -> LawResult:
        """Move the inputs; see :class:`~koopman_ros.control.laws.base.Law`."""
        if self.unusable is not None:
            return LawResult(None, self.unusable)
        places = self._places
        gain, time = self.tuning.pi_gain[places], self.tuning.pi_time[places]
        error = (target.x - estimate.x)[places] * self.model.states.scale[places]
        before = memory if isinstance(memory, np.ndarray) and (
            memory.shape == error.shape) else error
        u = self.model.inputs.center.copy() if last is None else last.copy()
        u[:len(places)] += gain * (error - before + error * interval / time)
        if not finite(u):
            return LawResult(None, reason(Code.COMMAND_NOT_FINITE))
        within = limits.within(u)
        return LawResult(within, None, Figures('proportional-integral'), error,
                         clipped=bool((within != u).any()))
