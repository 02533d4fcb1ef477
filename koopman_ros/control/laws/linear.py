# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The linear law: the regulator of the model linearised at its nominal point."""

from dataclasses import dataclass, replace
from functools import cached_property
import math

import numpy as np

from koopman_ros.control.laws.base import LawResult, Tuning
from koopman_ros.control.laws.sdre import checked, Feedback, feedback
from koopman_ros.control.limits import InputLimits
from koopman_ros.control.target import steady_state_target, Target
from koopman_ros.estimation import Estimate
from koopman_ros.lifting import LiftedModel
from koopman_ros.reasons import Code, reason


@dataclass(frozen=True)
class Linear:
    """One gain for all states, of the Riccati equation of the linearised model."""

    lift: LiftedModel  #: that is linearised
    tuning: Tuning  #: weights and bounds

    @property
    def model(self) -> LiftedModel:
        """The lift linearised at its nominal point."""
        return self.lift.linearised

    @cached_property
    def _at_nominal(self) -> Feedback:
        origin = np.zeros(self.model.n_x)
        return feedback(self.model, origin, steady_state_target(self.model, origin),
                        self.tuning.weights, max_gain=self.tuning.max_gain,
                        max_residual=self.tuning.max_residual)

    def compute(self, estimate: Estimate, target: Target, limits: InputLimits, memory: object,
                interval: float, deadline: float = math.inf) -> LawResult:
        """Apply the gain; see :class:`~koopman_ros.control.laws.base.Law`."""
        try:
            found = self._at_nominal
            return checked(self.model, replace(
                found, u=target.u - found.riccati.K.dot(estimate.x - target.x)), limits, interval)
        except np.linalg.LinAlgError as error:
            return LawResult(None, reason(Code.SINGULAR, matrix=str(error)))
