# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The disturbance observer, and the measured state itself, where the states are measured."""

import math
from typing import Any, ClassVar

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.signals import Outputs
from koopman_ros.core.steady_state import steady_state
from koopman_ros.estimation.base import Estimate, Estimator, LOST
from koopman_ros.model import LiftedModel
from koopman_ros.tuning import Tuning


def simulated(model: LiftedModel, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
    """Integrate the model; None after too long, or where the estimate is lost."""
    x = model.integrated(estimate.x, u, estimate.w, seconds)
    if x is None:
        return None
    # far out the model's drift grows without bound, and corrections could not bring x back
    within = (np.abs(x) <= LOST * model.states.half_widths).all()
    return Estimate(x, estimate.w) if within else None


class DisturbanceObserver(Estimator):
    """
    Two equal poles for each measured state, set by `observer_bandwidth`.

    Only applied inputs behind a lag need no measurement: they follow from the commands, without a
    disturbance of their own.

    With p = exp(-bandwidth dt) the state takes 1 - p^2 of the difference between a measurement and
    its prediction, and the disturbance (1 - p)^2 / dt of it, which places both poles of the error
    at p where the model's own motion within a sample is small.

    :raises ValueError: where the outputs leave another state open.
    """

    def __init__(self, model: LiftedModel, outputs: Outputs, tuning: Tuning, parameters: Any
                 ) -> None:
        super().__init__(model, outputs, tuning, parameters)
        #: the states that are not measured
        self._undisturbed = np.flatnonzero(~outputs.C.any(axis=0))
        if not outputs.determine(model.lagged.values()):
            raise ValueError(f'{", ".join(outputs.names)} are measured, which does not determine '
                             f'all {model.n_x} states: measure as many, or set estimator to a '
                             'Kalman filter')

    def predict(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """Integrate the model under input and disturbance."""
        return simulated(self.model, estimate, u, seconds)

    def correct(self, predicted: Estimate, x: Array, seconds: float) -> Estimate:
        """Divide the innovation between state and disturbance."""
        p = math.exp(-self.tuning.observer_bandwidth * seconds)
        duration = seconds / self.model.seconds_per_time_unit
        difference = x - predicted.x
        w = predicted.w + ((1.0 - p) ** 2 / duration) * difference
        return Estimate(predicted.x + (1.0 - p * p) * difference, self.bounded(w))

    def restart(self, predicted: Estimate | None, x: Array, u: Array | None) -> Estimate:
        """Keep a known disturbance; else take the one under which `u` holds the plant."""
        if predicted is not None:
            return Estimate(x, predicted.w)
        if u is None:
            return Estimate(x, np.zeros_like(x))
        return Estimate(x, self.bounded(-self.model.rate_under(u)(x)))

    def bounded(self, w: Array) -> Array:
        """Return the part of a disturbance that acts on measured states, within the bound."""
        if len(self._undisturbed):
            w = w.copy()
            w[self._undisturbed] = 0.0
        return super().bounded(w)


class MeasuredState(DisturbanceObserver):
    """Every measurement is the state, and there is no disturbance, as in the paper."""

    remembers: ClassVar[bool] = False

    def correct(self, predicted: Estimate, x: Array, seconds: float) -> Estimate:
        """Take the measurement as it is."""
        return Estimate(x, np.zeros_like(x))

    def restart(self, predicted: Estimate | None, x: Array, u: Array | None) -> Estimate:
        """Take the measurement as it is."""
        return Estimate(x, np.zeros_like(x))

    def transferred(self, estimate: Estimate, rate: Array) -> Estimate:
        """Keep the state."""
        return Estimate(estimate.x, np.zeros_like(estimate.w))


def equivalent_bias(model: LiftedModel, estimate: Estimate) -> Array:
    """
    Return the error of the measurement that would explain a disturbance just as well.

    With one measured state, a biased sensor and a changed plant cannot be distinguished. Solves
    f(x - bias) = f(x) + w; the result is NaN where the equation has no solution.

    :return: (n_x,) in scaled deviations.
    """
    x, lost = estimate.x, LOST * model.states.half_widths
    wanted = model.drift(x) + estimate.w
    with np.errstate(all='ignore'):
        found = steady_state(lambda y: model.drift(y) - wanted, model.drift_jacobian, x,
                             np.minimum(x, -lost), np.maximum(x, lost), anchor=x)
    return np.full_like(x, np.nan) if found is None else x - found
