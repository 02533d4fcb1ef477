# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""State estimators: the contract of a plug-in, and the estimate."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import Any, ClassVar

import numpy as np

from koopman_ros.core.arrays import Array, pseudo_inverse
from koopman_ros.core.declaration import NoParameters
from koopman_ros.core.signals import Outputs
from koopman_ros.model import LiftedModel
from koopman_ros.tuning import Tuning

# Half-ranges of the training data beyond which a prediction of the state, or its standard
# deviation, is worth nothing.
LOST = 10.0


@dataclass(frozen=True, slots=True)
class Innovation:
    """
    Differences between measurements and their predictions, over their standard deviations.

    See Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
    Navigation* (2001), section 5.4, on tests of consistency.
    """

    normalised: Array  #: (n_y,) of the last measurement, in its standard deviations
    #: mean of the squares, weighed by the covariance and per output, of the last ones; 1 where the
    #: estimator is consistent
    mean_square: float
    count: int  #: of measurements in that mean, at most :data:`INNOVATION_WINDOW`

    @property
    def expected(self) -> tuple[float, float]:
        """The range that holds the mean square in 998 of 1,000 cases."""
        from scipy.special import chdtri

        # a fading mean is worth as many as twice its window
        independent = self.count if self.count < INNOVATION_WINDOW else (
            2 * INNOVATION_WINDOW - 1)
        freedom = len(self.normalised) * independent
        lower, upper = (float(chdtri(freedom, p)) / freedom for p in (0.999, 0.001))
        return lower, upper


#: Measurements over which the squares of an innovation are averaged; more fade.
INNOVATION_WINDOW = 100


@dataclass(frozen=True, slots=True)
class Estimate:
    """
    State and disturbance of the plant, in scaled deviations and the model's time unit.

    dx/dt = f(x) + B u + w with f the model's drift, the same that the target is
    calculated from: any difference between the two would be left as an offset. For a law or a
    prediction w includes the effect E d of measured disturbances; for a correction it does not.
    """

    x: Array  #: (n_x,) state
    w: Array  #: (n_x,) disturbance of its rate, taken as constant
    #: (2 n_x, 2 n_x) of the errors of both, or None where it is not known, or as at first
    covariance: Array | None = None
    innovation: Innovation | None = None  #: of the last measurement, or None

    @property
    def finite(self) -> bool:
        """Whether state, disturbance and covariance are finite numbers."""
        return all(map(math.isfinite, (*self.x.tolist(), *self.w.tolist()))) and (
            self.covariance is None or bool(np.isfinite(self.covariance).all()))

    def under(self, rate: Array | None) -> Estimate:
        """Return the estimate under a further disturbance (n_x,), or None for none."""
        return self if rate is None else replace(self, w=self.w + rate)

    def check(self, n_x: int) -> None:
        """Raise a TypeError or ValueError unless it has n_x states and is finite."""
        P = self.covariance
        shapes = (np.shape(self.x), np.shape(self.w), None if P is None else np.shape(P))
        if shapes not in (((n_x,), (n_x,), None), ((n_x,), (n_x,), (2 * n_x, 2 * n_x))):
            raise ValueError(f'the estimator returned x, w and covariance with shapes {shapes} '
                             f'for {n_x} states')
        if not isinstance(self.innovation, Innovation | None):
            raise TypeError(f'the estimator returned {type(self.innovation).__name__} as the '
                            'innovation')
        if not self.finite:
            raise ValueError('the estimate is not finite')


def with_applied(model: LiftedModel, x: Array, u: Array, places: Mapping[int, int]) -> Array:
    """
    Return a state (n_x,) with some inputs (n_u,) as they act, all in scaled deviations.

    :param places: of the states that these inputs are, by input.
    """
    x, applied = x.copy(), model.inputs.to_physical(u)
    for j, i in places.items():
        x[i] = (applied[j] - model.states.center[i]) / model.states.scale[i]
    return x


def with_commands(model: LiftedModel, estimate: Estimate, u: Array) -> Estimate:
    """Return an estimate whose states that are commands are those inputs (n_u,) that act."""
    return estimate if not model.commanded else replace(
        estimate, x=with_applied(model, estimate.x, u, model.commanded))


class Estimator(ABC):
    """
    From measurements to an estimate of state and disturbance; pure, without memory of its own.

    To add one, derive a class in any module and name it in `estimator` as ``module:Class``.
    Measurements are given as a state that has the measured outputs and is otherwise the predicted
    one. An exception holds the command, and the next measurement restarts the estimate.
    """

    #: frozen dataclass of its own parameters, see :mod:`koopman_ros.core.declaration`
    Parameters: ClassVar[type[Any]] = NoParameters
    #: whether an estimate depends on more than the last measurement
    remembers: ClassVar[bool] = True

    def __init__(self, model: LiftedModel, outputs: Outputs, tuning: Tuning, parameters: Any
                 ) -> None:
        """
        Prepare the estimator; a ValueError rejects the configuration.

        :param model: whose drift predicts.
        :param outputs: the measured outputs.
        :param tuning: with one number for each signal of the model.
        :param parameters: its own, of the class :attr:`Parameters`.
        """
        self.model = model
        self.outputs = outputs
        self.tuning = tuning
        self.parameters = parameters

    @abstractmethod
    def predict(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """
        Predict an estimate under a constant input.

        :param u: (n_u,) applied input, in scaled deviations.
        :return: the estimate then, or None after so long that nothing is known any more.
        """

    @abstractmethod
    def correct(self, predicted: Estimate, x: Array, seconds: float) -> Estimate:
        """Correct by a measurement (n_x,), in scaled deviations, so long after the last one."""

    @abstractmethod
    def restart(self, predicted: Estimate | None, x: Array, u: Array | None) -> Estimate:
        """
        Start from a measurement (n_x,) alone, as at first, and where no prediction is valid.

        :param predicted: whose disturbance is kept, or None where nothing is known.
        :param u: (n_u,) input that is assumed to hold the plant there, or None.
        """

    def predict_state(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """Predict as :meth:`predict`, which is the default; the covariance may be left out."""
        return self.predict(estimate, u, seconds)

    def advance(self, estimate: Estimate, u: Array, seconds: float, *, covariance: bool = True
                ) -> Estimate | None:
        """Predict as :meth:`predict`; states that are commands are those of `u` at once."""
        if self.model.commanded:
            estimate = with_commands(self.model, estimate, u)
        return (self.predict if covariance else self.predict_state)(estimate, u, seconds)

    def predict_over(self, estimate: Estimate, pieces: Iterable[tuple[float, Array]],
                     rate: Array | None) -> Estimate | None:
        """
        Predict an estimate over a number of inputs.

        :param pieces: seconds, and the (n_u,) input that acts for this time, in scaled deviations.
        :param rate: (n_x,) due to the measured disturbances, or None.
        :return: the estimate then, without that rate, or None as from :meth:`predict`.
        """
        begin = estimate if rate is None else estimate.under(rate)
        now: Estimate | None = begin
        for seconds, u in pieces:
            now = now and self.advance(now, u, seconds)
        return now if now is None or rate is None else replace(
            now, w=estimate.w + (now.w - begin.w))

    def with_noise(self, factor: Array) -> Estimator:
        """Return the estimator for measurements with (n_y,) times the noise; itself by default."""
        return self

    def with_analysis(self, predicted: Estimate, index: int, x: float, deviation: float
                      ) -> Estimate:
        """
        Correct by a value of one state alone, a scaled deviation with its standard deviation.

        :raises NotImplementedError: by default; then such values are rejected.
        """
        raise NotImplementedError

    def transferred(self, estimate: Estimate, rate: Array) -> Estimate:
        """
        Take over an estimate from another model, so that the plant's estimated rate stays.

        :param rate: (n_x,) the other model's drift there, in this model's terms.
        """
        w = estimate.w + rate - self.model.drift(estimate.x)
        return replace(estimate, w=self.bounded(w))

    def as_input(self, w: Array) -> Array:
        """Return the (n_u,) input that would act like a disturbance, in scaled deviations."""
        return self._inverse.dot(w)

    @cached_property
    def _inverse(self) -> Array:
        """(n_u, n_x) of :func:`effect_of_inputs`, and of B at applied inputs behind a lag."""
        rows = [*self.model.lagged.values()]
        found = pseudo_inverse(effect_of_inputs(self.model))
        found[:, rows] = self.model.input_inverse()[:, rows]
        return found

    def at_bound(self, w: Array) -> bool:
        """Return whether a disturbance is at `max_disturbance`, but for rounding."""
        return self._share(w) >= 1.0 - 1e-9

    def bounded(self, w: Array) -> Array:
        """Return a disturbance within `max_disturbance`; none where it is not finite."""
        share = self._share(w)
        if share <= 1.0:
            return w
        return w / share if math.isfinite(share) else np.zeros_like(w)

    def _share(self, w: Array) -> float:
        """Return the largest share of its bound that a disturbance has as an input."""
        return float((np.abs(self.as_input(w)) / self._max_disturbance).max(initial=0.0))

    @cached_property
    def _max_disturbance(self) -> Array:
        return self.tuning.max_disturbance / self.model.inputs.scale


def effect_of_inputs(model: LiftedModel) -> Array:
    """Return the rates (n_x, n_u) due to the inputs; behind a lag, due to the applied input."""
    slope, effect = model.drift_jacobian(np.zeros(model.n_x)), model.B.copy()
    for j, i in model.lagged.items():
        effect[:, j] = slope[:, i] * model.inputs.scale[j] / model.states.scale[i]
    effect[[*model.lagged.values()]] = 0.0
    return effect
