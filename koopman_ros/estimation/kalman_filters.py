# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Nonlinear Kalman filters on the model's drift: states that are not measured, disturbances."""

import copy
from dataclasses import replace
from functools import cached_property
import math
from typing import Any

import numpy as np

from koopman_ros.core.arrays import Array, pseudo_inverse
from koopman_ros.core.integration import integrate, sensitivity_rate
from koopman_ros.core.signals import Outputs
from koopman_ros.core.units import SECONDS_PER_MINUTE
from koopman_ros.estimation.base import (
    effect_of_inputs,
    Estimate,
    Estimator,
    Innovation,
    INNOVATION_WINDOW,
    LOST,
)
from koopman_ros.estimation.dead_time import default_bandwidth
from koopman_ros.model import LiftedModel
from koopman_ros.tuning import Tuning

# Where the tuning does not say how uncertain the plant is: noise as a share of half the trained
# range, the random walk as a share of the inputs', over the slowest time constant, and the first
# estimate.
_NOISE, _WANDER, _GUESS = 1e-3, 0.1, 0.5
_LONGEST = 86400.0  # s, of time constants
# A disturbance is at first as uncertain as after so many of the drift's slowest time constants,
# but a day at most.
_WANDERED, _A_DAY = 3.0, 86400.0
# The singular values of a matrix count as 0 below this share of the largest.
_RANK = 1e-9
_NO_VARIANCE = 1e-14  # the same for a covariance


def uncertainty(model: LiftedModel, outputs: Outputs, tuning: Tuning
                ) -> tuple[Array, Array, Array]:
    """
    Return noise, random walk and error of the first estimate: as tuned, or derived from the model.

    The noise of an output that is a state is that of the record that the model was learned from,
    where there was one.

    :return: (n_y,) in the outputs' units, (n_u,) in scaled deviations per square root of a
        second, and (n_x,) in scaled deviations.
    """
    metrics, names = model.provenance.metrics, model.states.names
    recorded = np.array([metrics.get(
        f'noise_{name}' if len(names) > 1 else 'noise', 0.0) if name in names else 0.0
        for name in outputs.names])
    half = 0.5 * (model.states.upper - model.states.lower)
    modes = np.linalg.eigvals(model.linearised.A) / model.seconds_per_time_unit
    slowest = float(np.min(np.abs(modes)))
    disturbance_noise = _WANDER * 0.5 * (model.inputs.upper - model.inputs.lower) * math.sqrt(
        max(slowest, 1.0 / _LONGEST))
    noise = np.where(tuning.measurement_noise > 0.0, tuning.measurement_noise, np.where(
        recorded > 0.0, recorded, _NOISE * np.abs(outputs.C) @ half))
    # the error of a value that is not reported is uniformly distributed
    noise = np.hypot(noise, tuning.sensor.unreported / math.sqrt(3.0))
    bandwidth = default_bandwidth(modes, float(np.max(tuning.dead_times(model), initial=0.0)))
    if math.isfinite(bandwidth):
        # the squared bandwidth of a filter is the ratio between the rate of an output that a
        # disturbance causes and the output's noise, by the root of the sample interval. With a
        # third of the squared bandwidth of an observer, which takes most of a measurement for the
        # state, the loop keeps at least that observer's delay margin
        rates = np.abs(outputs.C * model.states.scale @ effect_of_inputs(model)) / (
            model.inputs.scale * model.seconds_per_time_unit)
        with np.errstate(divide='ignore'):
            disturbance_noise = np.minimum(
                disturbance_noise, bandwidth ** 2 / 3.0 * math.sqrt(
                    model.sample_interval) * np.min(noise[:, None] / rates, axis=0))
    guess = _GUESS * half
    # an applied input that is not measured follows from the commands
    guess[[i for i in model.lagged.values() if not outputs.C[:, i].any()]] = 0.0
    disturbance_noise, error = (
        np.where(own > 0.0, own, default) for own, default in (
            (tuning.disturbance_noise / math.sqrt(SECONDS_PER_MINUTE), disturbance_noise),
            (tuning.initial_error, guess)))
    return noise, disturbance_noise / model.inputs.scale, error / model.states.scale


class ExtendedKalmanFilter(Estimator):
    """
    The extended Kalman filter of state and disturbance: dx/dt = f(x) + B u + w, y = C x + noise.

    There is one disturbance for each output, a random walk: where there are as many inputs, it
    acts like a change of them, otherwise on the outputs' own rates. It removes the offset (G.
    Pannocchia, J. B. Rawlings, AIChE J. 49 (2003)). Prediction is by Runge-Kutta steps with their
    variational equations, correction in the form of Joseph. See A. H. Jazwinski, *Stochastic
    Processes and Filtering Theory* (1970), section 8.3.

    :raises ValueError: where the outputs leave states or disturbances open.
    """

    def __init__(self, model: LiftedModel, outputs: Outputs, tuning: Tuning, parameters: Any
                 ) -> None:
        super().__init__(model, outputs, tuning, parameters)
        self._noise, self._wander, self._initial_error = uncertainty(model, outputs, tuning)
        #: (n_y, n_x) outputs, in their units, of scaled deviations
        self._H = outputs.C * model.states.scale
        self._R = np.diag(self._noise ** 2)
        self._slope = model.drift_jacobian(np.zeros(model.n_x))
        #: (n_x,) sizes of the eigenvalues of the drift at the nominal point, in 1/time unit
        self._rates = np.abs(np.linalg.eigvals(self._slope))
        directions = self._directions()
        #: (n_x, n_x) by which the covariance of the disturbance grows in a second
        self._intensity = directions @ directions.T
        #: (n_x, n_x) projection on possible disturbances
        self._onto_directions = directions @ pseudo_inverse(directions)

    def _directions(self) -> Array:
        """(n_x, n_y) rates of the state that each disturbance adds to, as far as it wanders."""
        model, H = self.model, self._H
        by_input = effect_of_inputs(model) * self._wander
        # an output that no input moves at once wanders as the others do, each in its own size
        sizes = np.linalg.norm(H, axis=1)
        moved = np.max(np.abs(H @ by_input), axis=1)
        usual = np.max(moved / sizes, initial=0.0) or float(np.max(np.linalg.norm(
            by_input, axis=0)))
        by_output = pseudo_inverse(H) * np.where(moved > _RANK * usual * sizes, moved,
                                                 usual * sizes)
        candidates = [by_input] if model.n_u == len(H) else []
        for found in (*candidates, by_output):
            if self._determined(found):
                return found
        names = ', '.join(self.outputs.names)
        raise ValueError(f'the measurements of {names} do not determine the states '
                         f'{", ".join(model.states.names)} and a disturbance for each: measure '
                         'another signal')

    def _determined(self, directions: Array) -> bool:
        """Whether the outputs determine all modes that do not decay, and each disturbance."""
        n, H = self.model.n_x, self._H
        n_d = directions.shape[1]
        A = np.zeros((n + n_d, n + n_d))
        # how fast a disturbance wanders does not matter, and with a long dead time that is little
        scale = float(np.max(self._rates)) / (float(np.linalg.norm(directions)) or 1.0)
        A[:n, :n], A[:n, n:] = self._slope, scale * directions
        C = np.concatenate((H, np.zeros((len(H), n_d))), axis=1)
        # Hautus' test; modes that decay may stay unseen
        for value in np.linalg.eigvals(A):
            if value.real >= -_RANK * max(1.0, float(np.max(self._rates))):
                sizes = np.linalg.svd(np.concatenate((A - value * np.eye(n + n_d), C)),
                                      compute_uv=False)
                if not sizes[-1] > _RANK * sizes[0]:
                    return False
        return True

    @cached_property
    def initial_covariance(self) -> Array:
        """(2 n_x, 2 n_x) of a first guess."""
        n = self.model.n_x
        slowest = float(np.min(self._rates))
        since = min(_A_DAY, _WANDERED * self.model.seconds_per_time_unit / slowest
                    if slowest > 0.0 else _A_DAY)
        P = np.zeros((2 * n, 2 * n))
        P[:n, :n] = np.diag(self._initial_error ** 2)
        P[n:, n:] = since * self._intensity
        return P

    @cached_property
    def _lost(self) -> Array:
        """(n_x,) variances from which on a prediction of the state is worth nothing."""
        # also that of a first guess; it bounds the condition of the covariance, which rounding
        # would make indefinite
        return (LOST * np.maximum(
            self._initial_error, self.model.states.half_widths)) ** 2

    def predict(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """Integrate the model, and the covariance with it; see :class:`Estimator`."""
        n = self.model.n_x
        duration, steps = self.model.integration_steps(estimate.x, u, seconds)
        if steps is None:
            return None
        P = (self.initial_covariance if estimate.covariance is None
             else estimate.covariance).copy()
        # the disturbance wanders first, and then stays for the interval
        P[n:, n:] += seconds * self._intensity
        x, P = self._propagated(estimate.x, estimate.w, P, u, duration, steps)
        # far out a model's drift may grow without bound, which a covariance along it does not show
        if not (np.all(np.diag(P)[:n] <= self._lost) and np.all(x * x <= self._lost)):
            return None
        return replace(estimate, x=x, covariance=0.5 * (P + P.T))

    def predict_state(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """Integrate the model alone; None where the state is lost."""
        x = self.model.integrated(estimate.x, u, estimate.w, seconds)
        return None if x is None or not np.all(x * x <= self._lost) else replace(
            estimate, x=x, covariance=None)

    def _propagated(self, x: Array, w: Array, P: Array, u: Array, duration: float, steps: int
                    ) -> tuple[Array, Array]:
        """Return state and covariance later, after a number of steps; in time units."""
        n = self.model.n_x

        def rate_and_slope(x: Array) -> tuple[Array, Array]:
            rate, slope = self.model.rate_and_slope(x, u)
            return rate + w, slope

        # x and its derivatives by the previous x and w
        whole = integrate(
            sensitivity_rate(rate_and_slope, np.eye(n, 2 * n, n)),
            np.concatenate((x[:, None], np.eye(n, 2 * n)), axis=1), duration, steps)
        F = np.eye(2 * n)
        F[:n] = whole[:, 1:]
        return whole[:, 0].copy(), F @ P @ F.T

    def correct(self, predicted: Estimate, x: Array, seconds: float) -> Estimate:
        """Take the outputs of a state (n_x,) into account, in the form of Joseph."""
        n, H = self.model.n_x, self._H
        P = self.initial_covariance if predicted.covariance is None else predicted.covariance
        innovation = H.dot(x - predicted.x)
        PH = P[:, :n] @ H.T
        S = H @ PH[:n] + self._R
        gain = np.linalg.solve(S, PH.T).T
        keep = np.eye(2 * n)
        keep[:, :n] -= gain @ H
        P = keep @ P @ keep.T + gain @ self._R @ gain.T
        step = gain.dot(innovation)
        square = float(innovation.dot(np.linalg.solve(S, innovation))) / len(innovation)
        return Estimate(
            predicted.x + step[:n], self.bounded(predicted.w + step[n:]), 0.5 * (P + P.T),
            _averaged(predicted.innovation, innovation / np.sqrt(np.diag(S)), square))

    def with_noise(self, factor: Array) -> Estimator:
        """Return the filter for measurements with (n_y,) times the noise."""
        return self._observing(self._H, factor * self._noise)

    def with_analysis(self, predicted: Estimate, index: int, x: float, deviation: float
                      ) -> Estimate:
        """Correct by a value of one state; the innovation stays that of the measurements."""
        H, measured = np.eye(self.model.n_x)[[index]], predicted.x.copy()
        measured[index] = x
        found = self._observing(H, np.array([deviation])).correct(predicted, measured, 0.0)
        return replace(found, innovation=predicted.innovation)

    def _observing(self, H: Array, noise: Array) -> Estimator:
        """Return the filter for other outputs (n, n_x) of scaled deviations with noise (n,)."""
        other = copy.copy(self)
        other._H, other._R = H, np.diag(noise ** 2)
        return other

    def restart(self, predicted: Estimate | None, x: Array, u: Array | None) -> Estimate:
        """Start from a state (n_x,) with the measured outputs; see the observer's."""
        if predicted is not None:
            w = predicted.w
        elif u is None:
            w = np.zeros_like(x)
        else:
            w = self.bounded(-self._onto_directions.dot(self.model.rate_under(u)(x)))
        started = self.correct(Estimate(x, w), x, 0.0)
        return replace(started, innovation=None)

    def transferred(self, estimate: Estimate, rate: Array) -> Estimate:
        """Let the disturbance make up for the difference between the two models, where it can."""
        w = self._onto_directions.dot(estimate.w + rate - self.model.drift(estimate.x))
        return replace(estimate, w=self.bounded(w))


class UnscentedKalmanFilter(ExtendedKalmanFilter):
    """
    The same by sigma points in place of derivatives.

    See S. J. Julier, J. K. Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92
    (2004), with kappa = max(0, 3 - n), where no weight is negative. As outputs are linear in the
    state, the correction is the same.
    """

    def _propagated(self, x: Array, w: Array, P: Array, u: Array, duration: float, steps: int
                    ) -> tuple[Array, Array]:
        """Return mean and covariance of points later, after a number of steps; in time units."""
        model, n = self.model, self.model.n_x
        values, vectors = np.linalg.eigh(P)
        size = int(np.count_nonzero(values > _NO_VARIANCE * values[-1]))
        kappa = max(0.0, 3.0 - size)
        root = vectors[:, -size:] * np.sqrt((size + kappa) * values[-size:])
        points = np.concatenate((x, w)) + np.concatenate(
            (np.zeros((1, 2 * n)), root.T, -root.T))
        weights = np.full(len(points), 0.5 / (size + kappa))
        weights[0] = kappa / (size + kappa)
        moved = integrate(model.rate_under(u, points[:, n:]), points[:, :n], duration, steps)
        points = np.concatenate((moved, points[:, n:]), axis=1)
        mean = weights @ points
        deviation = points - mean
        return mean[:n], (weights[:, None] * deviation).T @ deviation


def _averaged(before: Innovation | None, normalised: Array, square: float) -> Innovation:
    if before is None:
        return Innovation(normalised, square, 1)
    count = min(before.count + 1, INNOVATION_WINDOW)
    return Innovation(
        normalised, before.mean_square + (square - before.mean_square) / count, count)
