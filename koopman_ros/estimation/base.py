# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What an estimator is: a plug between measured outputs and the laws."""

from dataclasses import dataclass
import math
from typing import Protocol

from koopman_ros.arrays import Array
from koopman_ros.lifting import LiftedModel

# One step of integration spans at most this share of the model's fastest time constant.
_STEP_SHARE = 0.1
_MAX_STEPS = 20


@dataclass(frozen=True)
class Estimate:
    """
    What is known of the plant, in scaled deviations and the model's time unit.

    dx/dt = f(x) + B u + w with f the model's projected drift, the same that the target is
    calculated from: any difference between the two would be left as an offset.
    """

    x: Array  #: (n_x,) state
    w: Array  #: (n_x,) disturbance of its rate, taken as constant


class Estimator(Protocol):
    """
    From the measured state to an estimate with its disturbance; pure, without memory of its own.

    To add one: write a class like :class:`~koopman_ros.estimation.observer.DisturbanceObserver`,
    with the same three arguments, in any module, and name it in the settings as module:class.
    """

    @property
    def model(self) -> LiftedModel:
        """The model whose drift predicts."""
        ...

    @property
    def remembers(self) -> bool:
        """Whether an estimate depends on more than the last measurement."""
        ...

    def predict(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """
        Carry an estimate forward under a constant input.

        :param u: (n_u,) the input that was applied, in scaled deviations.
        :param seconds: how long.
        :return: the estimate then, or None after so long that nothing is known any more.
        """
        ...

    def correct(self, predicted: Estimate, x: Array, seconds: float) -> Estimate:
        """
        Take a measurement into account.

        :param predicted: by :meth:`predict`.
        :param x: (n_x,) measured, in scaled deviations.
        :param seconds: since the last measurement.
        """
        ...

    def restart(self, predicted: Estimate | None, x: Array, u: Array | None) -> Estimate:
        """
        Start from a measurement alone, as at first, and where the prediction is worth nothing.

        :param predicted: whose disturbance is kept, or None where nothing is known.
        :param x: (n_x,) measured, in scaled deviations.
        :param u: (n_u,) input that is supposed to hold the plant there, or None.
        """
        ...

    def rebased(self, estimate: Estimate, rate: Array) -> Estimate:
        """
        Take over an estimate from another model, so that the plant's estimated rate stays.

        :param estimate: in this model's scaled deviations.
        :param rate: (n_x,) the other model's drift there, in this model's units.
        """
        ...

    def as_input(self, w: Array) -> Array:
        """Return the (n_u,) input that would act like a disturbance, in scaled deviations."""
        ...

    def at_bound(self, w: Array) -> bool:
        """Tell whether a disturbance is as large as is allowed."""
        ...


def simulated(model: LiftedModel, estimate: Estimate, u: Array, seconds: float
              ) -> Estimate | None:
    """Integrate the model from an estimate; see :meth:`Estimator.predict`."""
    duration = seconds / model.seconds_per_time_unit
    fastest = model.linearised.fastest_rate
    longest = _STEP_SHARE / fastest if fastest > 0.0 else math.inf
    steps = max(1, math.ceil(duration / longest))
    if steps > _MAX_STEPS:
        return None
    h = duration / steps
    forcing, x, drift = model.B.dot(u) + estimate.w, estimate.x, model.drift
    for _ in range(steps):
        # Heun's method
        slope = drift(x) + forcing
        x = x + (0.5 * h) * (slope + drift(x + h * slope) + forcing)
    return Estimate(x, estimate.w)
