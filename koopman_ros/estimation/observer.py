# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Estimators: plugs between measured outputs and the laws; the disturbance observer."""

from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import ClassVar, Protocol

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.kernels import compilable
from koopman_ros.lifting import LiftedModel
from koopman_ros.signals import Outputs
from koopman_ros.values import record

# One step of integration spans at most this share of the model's fastest time constant.
_STEP_SHARE = 0.1
_MAX_STEPS = 20
_CONVERGED = 1e-9  # of scaled deviations; the figure is shown with nine digits


@record
class Innovation:
    """
    By how much measurements differed from what was expected, over what was to be expected.

    See Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
    Navigation* (2001), section 5.4, on tests of consistency.
    """

    normalised: Array  #: (n_y,) of the last one, in its standard deviations
    #: mean of the squares, weighed by the covariance and per output, of the last ones; 1 where the
    #: estimator knows how wrong it is
    mean_square: float
    count: int  #: of measurements in it, at most :attr:`WINDOW`

    #: measurements over which squares are averaged; more fade
    WINDOW: ClassVar[int] = 100

    @property
    def expected(self) -> tuple[float, float]:
        """The range in which the mean square is in 998 of 1,000 cases."""
        # in here: no node needs it before its first diagnostics
        from scipy.special import chdtri

        # a fading mean is worth as many as twice its window
        independent = self.count if self.count < self.WINDOW else 2 * self.WINDOW - 1
        freedom = len(self.normalised) * independent
        lower, upper = (float(chdtri(freedom, p)) / freedom for p in (0.999, 0.001))
        return lower, upper


@record
class Estimate:
    """
    What is known of the plant, in scaled deviations and the model's time unit.

    dx/dt = f(x) + B u + w with f the model's drift, the same that the target is
    calculated from: any difference between the two would be left as an offset.
    """

    x: Array  #: (n_x,) state
    w: Array  #: (n_x,) disturbance of its rate, taken as constant
    #: (2 n_x, 2 n_x) of the errors of both, or None where it is not known, or as at first
    covariance: Array | None = None
    innovation: Innovation | None = None  #: of the last measurement, or None likewise

    @property
    def finite(self) -> bool:
        """Whether state, disturbance and covariance are finite numbers."""
        return all(np.all(np.isfinite(value)) for value in (self.x, self.w, self.covariance)
                   if value is not None)

    def check(self, n_x: int) -> None:
        """Raise a TypeError or ValueError unless it is one of so many states, and finite."""
        P = self.covariance
        shapes = (np.shape(self.x), np.shape(self.w), None if P is None else np.shape(P))
        if shapes not in (((n_x,), (n_x,), None), ((n_x,), (n_x,), (2 * n_x, 2 * n_x))):
            raise ValueError(f'the estimator returned x, w and covariance of shapes {shapes} for '
                             f'{n_x} states')
        if not isinstance(self.innovation, Innovation | None):
            raise TypeError(f'the estimator returned {type(self.innovation).__name__} as the '
                            'innovation')
        if not self.finite:
            raise ValueError('the estimate is not finite')


def _unknown() -> Array:
    return np.zeros(0)


@dataclass(frozen=True)
class EstimatorTuning:
    """What every estimator is built from, beside its model."""

    outputs: Outputs  #: what is measured of the state
    bandwidth: float  #: of an observer, in 1/s
    #: (n_u,) bound on each input of B(0)^+ w, in scaled deviations
    max_disturbance: Array
    noise: Array = field(default_factory=_unknown)  #: (n_y,) of the measurements, in their units
    #: (n_u,) how far an unknown influence wanders in a second, as a change of each input, in
    #: scaled deviations; over longer times with their square root
    wander: Array = field(default_factory=_unknown)
    #: (n_x,) how wrong the first guess may be, in scaled deviations
    initial_error: Array = field(default_factory=_unknown)


class Estimator(Protocol):
    """
    From measured outputs to an estimate with its disturbance; pure, without memory of its own.

    To add one: write a class like :class:`~koopman_ros.estimation.observer.DisturbanceObserver`,
    which takes a model and an :class:`EstimatorTuning`, in any module, and name it in the settings
    as module:class. Measurements come as a state that has the measured outputs and is otherwise
    the predicted one.
    """

    @property
    def model(self) -> LiftedModel:
        """The model whose drift predicts."""

    @property
    def remembers(self) -> bool:
        """Whether an estimate depends on more than the last measurement."""

    def predict(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """
        Carry an estimate forward under a constant input.

        :param u: (n_u,) the input that was applied, in scaled deviations.
        :return: the estimate then, or None after so long that nothing is known any more.
        """

    def correct(self, predicted: Estimate, x: Array, seconds: float) -> Estimate:
        """Take a measurement (n_x,), in scaled deviations, so long after the last into account."""

    def restart(self, predicted: Estimate | None, x: Array, u: Array | None) -> Estimate:
        """
        Start from a measurement (n_x,) alone, as at first, and where no prediction is worth any.

        :param predicted: whose disturbance is kept, or None where nothing is known.
        :param u: (n_u,) input that is supposed to hold the plant there, or None.
        """

    def rebased(self, estimate: Estimate, rate: Array) -> Estimate:
        """
        Take over an estimate from another model, so that the plant's estimated rate stays.

        Estimate and rate, (n_x,) the other model's drift there, are in this model's terms.
        """

    def as_input(self, w: Array) -> Array:
        """Return the (n_u,) input that would act like a disturbance, in scaled deviations."""

    def at_bound(self, w: Array) -> bool:
        """Tell whether a disturbance is as large as is allowed."""


def longest_step(model: LiftedModel) -> float:
    """Return the longest step of integration, in the model's unit of time."""
    fastest = model.linearised.fastest_rate
    return _STEP_SHARE / fastest if fastest > 0.0 else math.inf


def simulated(model: LiftedModel, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
    """Integrate the model from an estimate; see :meth:`Estimator.predict`."""
    duration = seconds / model.seconds_per_time_unit
    steps = max(1, math.ceil(duration / longest_step(model)))
    if steps > _MAX_STEPS:
        return None
    return Estimate(moved(model, estimate.x, estimate.w, u, duration / steps, steps), estimate.w)


@compilable
def moved(model: LiftedModel, x: Array, w: Array, u: Array, h: float, steps: int) -> Array:
    """Return where a state (n_x,) goes in so many of Heun's steps of h, in time units."""
    rate = model.rate_under(u, w)
    for _ in range(steps):
        slope = rate(x)
        x = x + (0.5 * h) * (slope + rate(x + h * slope))
    return x


def _check_determined(outputs: Outputs) -> None:
    if not outputs.determine_state:
        raise ValueError(f'{", ".join(outputs.names)}, measured, do not determine all '
                         f'{outputs.C.shape[1]} states: measure as many, or take a Kalman filter '
                         'as the estimator')


@dataclass(frozen=True)
class BoundedDisturbance:
    """What estimators of a disturbance share: how large it may be, and what it is as an input."""

    model: LiftedModel  #: whose drift predicts
    tuning: EstimatorTuning  #: its bound on the disturbance

    @property
    def remembers(self) -> bool:
        """It does."""
        return True

    def bounded(self, w: Array) -> Array:
        """Return a disturbance within its bound; none where it is not finite."""
        size, bound = self._largest(w)
        if size <= bound:
            return w
        return w * (bound / size) if math.isfinite(size) else np.zeros_like(w)

    def as_input(self, w: Array) -> Array:
        """Return the (n_u,) input that would act like a disturbance, in scaled deviations."""
        return self.model.input_inverse().dot(w)

    def at_bound(self, w: Array) -> bool:
        """Tell whether a disturbance is as large as is allowed, but for rounding."""
        size, bound = self._largest(w)
        return size >= bound * (1.0 - 1e-9)

    def _largest(self, w: Array) -> tuple[float, float]:
        """Return size and bound of the input that is nearest to its bound, or beyond."""
        worst, share = (0.0, math.inf), -1.0
        if len(self._bounds) == 1:
            size = abs(float(self.as_input(w)[0]))
            return (size if math.isfinite(size) else math.inf), self._bounds[0]
        for size, bound in zip(map(abs, self.as_input(w).tolist()), self._bounds, strict=True):
            if not math.isfinite(size):
                return math.inf, bound
            ratio = size / bound if bound else (math.inf if size else 0.0)
            if ratio > share:
                worst, share = (size, bound), ratio
        return worst

    @cached_property
    def _bounds(self) -> list[float]:
        return self.tuning.max_disturbance.tolist()


@dataclass(frozen=True)
class DisturbanceObserver(BoundedDisturbance):
    """
    Two equal poles for each state: one knob between noise and speed; every state is measured.

    With p = exp(-bandwidth dt) the state takes 1 - p^2 of what a measurement differs from its
    prediction, and the disturbance (1 - p)^2 / dt of it, which places both poles of the error at
    p where the model's own motion within a sample is small.

    :raises ValueError: where the outputs leave the state open.
    """

    def __post_init__(self) -> None:
        _check_determined(self.tuning.outputs)

    def predict(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """Integrate the model under input and disturbance."""
        return simulated(self.model, estimate, u, seconds)

    def correct(self, predicted: Estimate, x: Array, seconds: float) -> Estimate:
        """Divide the innovation between state and disturbance."""
        p = math.exp(-self.tuning.bandwidth * seconds)
        duration = seconds / self.model.seconds_per_time_unit
        difference = x - predicted.x
        w = predicted.w + ((1.0 - p) ** 2 / duration) * difference
        return Estimate(predicted.x + (1.0 - p * p) * difference, self.bounded(w))

    def restart(self, predicted: Estimate | None, x: Array, u: Array | None) -> Estimate:
        """Keep a known disturbance; else take the one that makes `u` hold the plant, if given."""
        if predicted is not None:
            return Estimate(x, predicted.w)
        if u is None:
            return Estimate(x, np.zeros_like(x))
        return Estimate(x, self.bounded(-self.model.rate_under(u)(x)))

    def rebased(self, estimate: Estimate, rate: Array) -> Estimate:
        """Let the disturbance make up for the difference between the two models."""
        w = estimate.w + rate - self.model.drift(estimate.x)
        return Estimate(estimate.x, self.bounded(w))


@dataclass(frozen=True)
class MeasuredState:
    """
    Every measurement is the state, and there is no disturbance, as in the paper.

    :raises ValueError: where the outputs leave the state open.
    """

    model: LiftedModel  #: whose drift predicts between measurements
    tuning: EstimatorTuning  #: what is measured

    def __post_init__(self) -> None:
        _check_determined(self.tuning.outputs)

    @property
    def remembers(self) -> bool:
        """It does not."""
        return False

    def predict(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """Integrate the model under the input."""
        return simulated(self.model, estimate, u, seconds)

    def correct(self, predicted: Estimate, x: Array, seconds: float) -> Estimate:
        """Take the measurement as it is."""
        return Estimate(x, np.zeros_like(x))

    def restart(self, predicted: Estimate | None, x: Array, u: Array | None) -> Estimate:
        """Take the measurement as it is."""
        return Estimate(x, np.zeros_like(x))

    def rebased(self, estimate: Estimate, rate: Array) -> Estimate:
        """Keep the state."""
        return Estimate(estimate.x, np.zeros_like(estimate.w))

    def as_input(self, w: Array) -> Array:
        """Return no disturbance."""
        return np.zeros(self.model.n_u)

    def at_bound(self, w: Array) -> bool:
        """There is none."""
        return False


def equivalent_bias(model: LiftedModel, estimate: Estimate) -> Array:
    """
    Return the error of the measurement that would explain a disturbance just as well.

    One measured state cannot tell a biased sensor from a changed plant. Solves
    f(x - bias) = f(x) + w; what comes out is NaN where the drift does not reach that far.

    :return: (n_x,) in scaled deviations.
    """
    wanted = model.drift(estimate.x) + estimate.w
    bias = np.zeros_like(estimate.x)
    with np.errstate(all='ignore'):
        for _ in range(20):
            x = estimate.x - bias
            try:
                step = np.linalg.solve(model.drift_jacobian(x), model.drift(x) - wanted)
            except np.linalg.LinAlgError:
                break
            bias = bias + step
            # steps shrink by their square: the next one would be below rounding
            if not np.all(np.abs(bias) < 1e3) or np.all(np.abs(step) < _CONVERGED):
                break
        solved = np.all(np.abs(bias) < 1e3) and np.allclose(
            model.drift(estimate.x - bias), wanted, rtol=0.0, atol=1e-6)
    return bias if solved else np.full_like(bias, np.nan)
