# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Proportional-integral control, which needs only the names of a model's signals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from koopman_ros.control.laws.base import Law, LawResult, SolutionInfo, Target
from koopman_ros.core.arrays import Array
from koopman_ros.core.declaration import column, Settings, UNBOUNDED
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.estimation import Estimate
from koopman_ros.model import LiftedModel
from koopman_ros.tuning import Tuning


@dataclass(frozen=True)
class PIParameters(Settings):
    """Gains and integral times; the first state with a gain moves the first input, and so on."""

    gain: Array = column(
        'states', 0.0, 'Proportional gain: change of the command per error. The first signal with '
                       'a gain acts on the first input, and so on; 0: not '
                       'controlled.', 'of input/({unit})', -UNBOUNDED)
    integral_time: Array = column(
        'states', 60.0, 'Integral time.', 's', maximum=86400.0, open_minimum=True)


class ProportionalIntegral(Law):
    """
    A PI law for each state with a gain; the first of them moves the first input, and so on.

    u_k = u_{k-1} + K (e_k - e_{k-1} + e_k h / T), with e the set-point less the state, from the
    command before: in the velocity form nothing winds up at a range or a rate, and the law begins
    where another one ended. See K. J. Astrom, T. Hagglund, *PID Controllers* (1995), section 3.5.

    :raises ValueError: for more gains than inputs.
    """

    Parameters = PIParameters
    model_free: ClassVar[bool] = True
    extrapolates: ClassVar[bool] = True
    parameters: PIParameters

    def __init__(self, model: LiftedModel, tuning: Tuning, parameters: Any) -> None:
        super().__init__(model, tuning, parameters)
        self._states = np.flatnonzero(self.parameters.gain)
        if len(self._states) > model.n_u:
            names = ', '.join(model.states.names[i] for i in self._states)
            raise ValueError(f'{model.n_u} inputs for the PI laws of {names}: set the gain of the '
                             'other signals to 0')

    def unusable(self) -> Reason | None:
        """Return that there is no gain."""
        return None if len(self._states) else reason(StatusCode.NO_PI_GAIN)

    def compute(self, estimate: Estimate, target: Target, memory: object, interval: float,
                previous: Array | None) -> LawResult:
        """Move the inputs; see :class:`~koopman_ros.control.laws.base.Law`."""
        states = self._states
        gain, time = self.parameters.gain[states], self.parameters.integral_time[states]
        error = (target.x - estimate.x)[states] * self.model.states.scale[states]
        before = memory if isinstance(memory, np.ndarray) and (
            memory.shape == error.shape) else error
        u = self.model.inputs.center.copy() if previous is None else previous.copy()
        u[:len(states)] += gain * (error - before + error * interval / time)
        return LawResult(u, info=SolutionInfo('proportional-integral'), memory=error)
