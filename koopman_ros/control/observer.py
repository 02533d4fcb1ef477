# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The disturbance observer: what the plant does beside its model, from measurements and inputs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np
from numpy.typing import NDArray

from koopman_ros.lifting import LiftedModel

Array = NDArray[np.float64]

# One step of integration spans at most this share of the model's fastest time constant.
_STEP_SHARE = 0.1
_MAX_STEPS = 20


@dataclass(frozen=True)
class Estimate:
    """
    What is believed of the plant, in scaled deviations and the model's time unit.

    dx/dt = f(x) + B u + w with f the model's projected drift, the same that the target is
    calculated from: any difference between the two would be left as an offset.

    :param x: (n_x,) state.
    :param w: (n_x,) disturbance of its rate, taken as constant.
    """

    x: Array
    w: Array


@dataclass(frozen=True)
class Observer:
    """
    Two equal poles for each state: one knob between noise and speed.

    With p = exp(-bandwidth dt) the state takes 1 - p^2 of what a measurement differs from its
    prediction, and the disturbance (1 - p)^2 / dt of it, which places both poles of the error at
    p where the model's own motion within a sample is small.

    :param model: whose drift predicts.
    :param bandwidth: in 1/s; 0 believes every measurement and no disturbance.
    :param max_disturbance: bound on the size of B^+ w, in scaled deviations of the input.
    """

    model: LiftedModel
    bandwidth: float
    max_disturbance: float

    def predict(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """
        Carry an estimate forward under a constant input.

        :param u: (n_u,) the input that was in force, so the limited one, in scaled deviations.
        :param seconds: how long.
        :return: the estimate then, or None after so long that nothing is known any more.
        """
        duration = seconds / self.model.seconds_per_time_unit
        steps = max(1, math.ceil(duration / self._longest_step))
        if steps > _MAX_STEPS:
            return None
        h = duration / steps
        push, x, drift = self.model.B.dot(u) + estimate.w, estimate.x, self.model.drift
        for _ in range(steps):
            # Heun's method
            slope = drift(x) + push
            x = x + (0.5 * h) * (slope + drift(x + h * slope) + push)
        return Estimate(x, estimate.w)

    def correct(self, predicted: Estimate, x: Array, seconds: float) -> Estimate:
        """
        Take a measurement into account.

        :param predicted: by :meth:`predict`.
        :param x: (n_x,) measured.
        :param seconds: since the last measurement.
        """
        p = math.exp(-self.bandwidth * seconds)
        duration = seconds / self.model.seconds_per_time_unit
        difference = x - predicted.x
        w = predicted.w + ((1.0 - p) ** 2 / duration) * difference
        return Estimate(predicted.x + (1.0 - p * p) * difference, self.bounded(w))

    def at_rest(self, x: Array, u: Array) -> Estimate:
        """Return the estimate that explains a state by a steady state under an input."""
        return Estimate(x, self.bounded(-self.model.drift(x) - self.model.B @ u))

    def rebased(self, estimate: Estimate, drift: Array) -> Estimate:
        """
        Carry a disturbance over from another model, so that the plant's rate stays as believed.

        :param estimate: in this model's scaled deviations.
        :param drift: (n_x,) the other model's drift there, in this model's units.
        """
        w = estimate.w + drift - self.model.drift(estimate.x)
        return Estimate(estimate.x, self.bounded(w))

    def bounded(self, w: Array) -> Array:
        """Return a disturbance within its bound; none where it is not finite."""
        d = self.as_input(w)
        size = math.sqrt(d.dot(d))
        if size <= self.max_disturbance:
            return w
        return w * (self.max_disturbance / size) if math.isfinite(size) else np.zeros_like(w)

    def as_input(self, w: Array) -> Array:
        """Return the (n_u,) input that would act like a disturbance, in scaled deviations."""
        found: Array = self.model.input_inverse.dot(w)
        return found

    @cached_property
    def _longest_step(self) -> float:
        fastest = float(np.max(np.abs(self.model.linearised.eigenvalues)))
        return _STEP_SHARE / fastest if fastest > 0.0 else math.inf


def equivalent_bias(model: LiftedModel, estimate: Estimate) -> Array:
    """
    Return the error of the measurement that would explain a disturbance just as well.

    One measured state cannot tell a biased sensor from a changed plant. Solves
    f(x - bias) = f(x) + w; what comes out is NaN where the drift does not reach that far.

    :return: (n_x,) in scaled deviations.
    """
    wanted = model.drift(estimate.x) + estimate.w
    bias, step = np.zeros_like(estimate.x), 1e-6
    with np.errstate(all='ignore'):
        for _ in range(20):
            x = estimate.x - bias
            slope = np.stack([(model.drift(x + d) - model.drift(x - d)) / (2.0 * step)
                              for d in step * np.eye(len(x))], axis=-1)
            try:
                bias = bias + np.linalg.solve(slope, model.drift(x) - wanted)
            except np.linalg.LinAlgError:
                break
            if not np.all(np.abs(bias) < 1e3):
                break
        solved = np.all(np.abs(bias) < 1e3) and np.allclose(
            model.drift(estimate.x - bias), wanted, rtol=0.0, atol=1e-6)
    return bias if solved else np.full_like(bias, np.nan)
