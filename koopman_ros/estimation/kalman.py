# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Nonlinear Kalman filters on the model's drift: states that are not measured, disturbances."""

from dataclasses import dataclass, replace
from functools import cached_property
import math

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.estimation.observer import BoundedDisturbance, Estimate, Innovation
from koopman_ros.kernels import compilable
from koopman_ros.lifting import LiftedModel
from koopman_ros.solvers import runge_kutta_step
from koopman_ros.values import record

# One step of integration spans at most this share of the drift's fastest time constant.
_STEP_SHARE = 0.5
_MAX_STEPS = 40
# A disturbance is at first as uncertain as after so many of the drift's slowest time constants,
# but a day at most.
_WANDERED, _A_DAY = 3.0, 86400.0
# The singular values of a matrix count as 0 below this share of the largest.
_RANK = 1e-9
_NO_VARIANCE = 1e-14  # likewise of a covariance
# A prediction says nothing whose standard deviation is so many times that of a first guess, and so
# many half widths of the training data. That also bounds the condition of the covariance, which
# rounding would make indefinite.
_LOST = 10.0


@dataclass(frozen=True)
class ExtendedKalmanFilter(BoundedDisturbance):
    """
    The extended Kalman filter of state and disturbance: dx/dt = f(x) + B u + w, y = C x + noise.

    There is one disturbance for each output, which wanders: where there are as many inputs, it
    acts like a change of them, otherwise on the outputs' own rates. It is what leaves no offset
    (G. Pannocchia, J. B. Rawlings, AIChE J. 49 (2003)). Prediction is by Runge-Kutta steps with
    their variational equations, correction in the form of Joseph. See A. H. Jazwinski,
    *Stochastic Processes and Filtering Theory* (1970), section 8.3.

    :raises ValueError: where the outputs leave states or disturbances open, or noise, wander or
        initial error is not given.
    """

    def __post_init__(self) -> None:
        model, tuning = self.model, self.tuning
        n_y = len(tuning.outputs.names)
        for name, size in (('noise', n_y), ('wander', model.n_u), ('initial_error', model.n_x)):
            value = getattr(tuning, name)
            if value.shape != (size,) or not np.all(np.isfinite(value) & (value > 0.0)):
                raise ValueError(f'{name} must be {size} finite numbers above 0, got '
                                 f'{value.tolist()}')
        # what cannot be built is refused now
        assert self._intensity.size

    @cached_property
    def _H(self) -> Array:
        """(n_y, n_x) outputs, in their units, of scaled deviations."""
        return self.tuning.outputs.C * self.model.states.scale

    @cached_property
    def _R(self) -> Array:
        return np.diag(self.tuning.noise ** 2)

    @cached_property
    def _slope(self) -> Array:
        return self.model.drift_jacobian(np.zeros(self.model.n_x))

    @cached_property
    def _rates(self) -> Array:
        """(n_x,) sizes of the eigenvalues of the drift at the nominal point, in 1/time unit."""
        return np.abs(np.linalg.eigvals(self._slope))

    @cached_property
    def _directions(self) -> Array:
        """(n_x, n_y) rates of the state that each disturbance adds to, as far as it wanders."""
        model, H = self.model, self._H
        by_input = model.B * self.tuning.wander
        # an output that no input moves at once wanders as the others do, each in its own size
        sizes = np.linalg.norm(H, axis=1)
        moved = np.max(np.abs(H @ by_input), axis=1)
        usual = np.max(moved / sizes, initial=0.0) or float(np.max(np.linalg.norm(
            by_input, axis=0)))
        by_output = np.linalg.pinv(H) * np.where(moved > _RANK * usual * sizes, moved,
                                                 usual * sizes)
        candidates = [by_input] if model.n_u == len(H) else []
        for found in (*candidates, by_output):
            if self._determined(found):
                return found
        names = ', '.join(self.tuning.outputs.names)
        raise ValueError(f'{names}, measured, do not determine the states '
                         f'{", ".join(model.states.names)} and a disturbance for each: measure '
                         'another signal')

    def _determined(self, directions: Array) -> bool:
        """Tell whether outputs show all modes that do not decay, and each disturbance."""
        n, H = self.model.n_x, self._H
        n_d = directions.shape[1]
        A = np.zeros((n + n_d, n + n_d))
        A[:n, :n], A[:n, n:] = self._slope, directions
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
    def _intensity(self) -> Array:
        """(n_x, n_x) by which the covariance of the disturbance grows in a second."""
        return self._directions @ self._directions.T

    @cached_property
    def _onto_directions(self) -> Array:
        """(n_x, n_x) projection on what disturbances can be."""
        return self._directions @ np.linalg.pinv(self._directions)

    @cached_property
    def initial_covariance(self) -> Array:
        """(2 n_x, 2 n_x) of a first guess."""
        n = self.model.n_x
        slowest = float(np.min(self._rates))
        since = min(_A_DAY, _WANDERED * self.model.seconds_per_time_unit / slowest
                    if slowest > 0.0 else _A_DAY)
        P = np.zeros((2 * n, 2 * n))
        P[:n, :n] = np.diag(self.tuning.initial_error ** 2)
        P[n:, n:] = since * self._intensity
        return P

    @cached_property
    def _lost(self) -> Array:
        """(n_x,) variances from which on a prediction of the state is worth nothing."""
        return (_LOST * np.maximum(
            self.tuning.initial_error, self.model.states.half_widths)) ** 2

    def predict(self, estimate: Estimate, u: Array, seconds: float) -> Estimate | None:
        """Integrate the model, and the covariance with it; see :class:`Estimator`."""
        duration = seconds / self.model.seconds_per_time_unit
        steps = max(1, math.ceil(duration * float(np.max(self._rates)) / _STEP_SHARE))
        if steps > _MAX_STEPS:
            return None
        n = self.model.n_x
        P = (self.initial_covariance if estimate.covariance is None
             else estimate.covariance).copy()
        # the disturbance wanders first, and then stays for the interval
        P[n:, n:] += seconds * self._intensity
        x, P = self._propagated(estimate.x, estimate.w, P, u, duration / steps, steps)
        if not np.all(np.diag(P)[:n] <= self._lost):
            return None
        return replace(estimate, x=x, covariance=0.5 * (P + P.T))

    def _propagated(self, x: Array, w: Array, P: Array, u: Array, h: float, steps: int
                    ) -> tuple[Array, Array]:
        """Return state and covariance after so many steps of h, in time units."""
        return propagated(self.model, x, w, P, u, h, steps)

    def correct(self, predicted: Estimate, x: Array, seconds: float) -> Estimate:
        """Take the outputs of a state (n_x,) into account, in the form of Joseph."""
        n, H = self.model.n_x, self._H
        P = self.initial_covariance if predicted.covariance is None else predicted.covariance
        found = corrected(self.model, H, self._R, P, x - predicted.x)
        return Estimate(
            predicted.x + found.step[:n], self.bounded(predicted.w + found.step[n:]),
            found.covariance, _averaged(predicted.innovation, found))

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

    def rebased(self, estimate: Estimate, rate: Array) -> Estimate:
        """Let the disturbance make up for the difference between the two models, where it can."""
        w = self._onto_directions.dot(estimate.w + rate - self.model.drift(estimate.x))
        return replace(estimate, w=self.bounded(w))


@dataclass(frozen=True)
class UnscentedKalmanFilter(ExtendedKalmanFilter):
    """
    The same by sigma points in place of derivatives.

    See S. J. Julier, J. K. Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92
    (2004), with kappa = max(0, 3 - n), where no weight is negative. As outputs are linear in the
    state, the correction is the same.
    """

    def _propagated(self, x: Array, w: Array, P: Array, u: Array, h: float, steps: int
                    ) -> tuple[Array, Array]:
        """Return mean and covariance of points that are moved so many steps of h."""
        model, n = self.model, self.model.n_x
        values, vectors = np.linalg.eigh(P)
        size = int(np.count_nonzero(values > _NO_VARIANCE * values[-1]))
        kappa = max(0.0, 3.0 - size)
        root = vectors[:, -size:] * np.sqrt((size + kappa) * values[-size:])
        points = np.concatenate((x, w)) + np.concatenate(
            (np.zeros((1, 2 * n)), root.T, -root.T))
        weights = np.full(len(points), 0.5 / (size + kappa))
        weights[0] = kappa / (size + kappa)
        rate, moved = model.rate_under(u, points[:, n:]), points[:, :n]
        for _ in range(steps):
            moved = runge_kutta_step(rate, moved, h)
        points = np.concatenate((moved, points[:, n:]), axis=1)
        mean = weights @ points
        deviation = points - mean
        return mean[:n], (weights[:, None] * deviation).T @ deviation


@compilable
def propagated(model: LiftedModel, x: Array, w: Array, P: Array, u: Array, h: float, steps: int
               ) -> tuple[Array, Array]:
    """
    Return state and covariance after so many steps of h, in time units.

    :param x: (n_x,) and w (n_x,), of which P (2 n_x, 2 n_x) is the covariance.
    :param u: (n_u,) input.
    """
    n = model.n_x
    forced = np.concatenate((np.zeros((n, n)), np.eye(n)), axis=1)
    # x and its derivatives by what x and w were
    whole = np.concatenate((x[:, None], np.eye(n), np.zeros((n, n))), axis=1)

    def rate(whole: Array) -> Array:
        x = whole[:, 0]
        f, J = model.drift_and_jacobian(x)
        if model.input_terms is not None:
            J = J + model.forcing_jacobian(x, u)
        return np.concatenate(((f + model.forcing(x, u) + w)[:, None],
                               J @ whole[:, 1:] + forced), axis=1)

    for _ in range(steps):
        whole = runge_kutta_step(rate, whole, h)
    F = np.eye(2 * n)
    F[:n] = whole[:, 1:]
    return whole[:, 0].copy(), F @ P @ F.T


@record
class Correction:
    """What outputs (n_y,) add to a prediction."""

    step: Array  #: (2 n_x,) of state and disturbance
    covariance: Array  #: (2 n_x, 2 n_x) of both afterwards
    innovation: Array  #: (n_y,) what was measured less what was expected
    deviation: Array  #: (n_y,) its standard deviations
    square: float  #: its square, weighed by its covariance


@compilable
def corrected(model: LiftedModel, H: Array, R: Array, P: Array, difference: Array) -> Correction:
    """
    Take a measured difference (n_x,) from a prediction into account, in the form of Joseph.

    :param H: (n_y, n_x) outputs, of noise with covariance R (n_y, n_y).
    :param P: (2 n_x, 2 n_x) covariance of state and disturbance.
    """
    n = len(difference)
    innovation = H.dot(difference)
    PH = P[:, :n] @ H.T
    S = H @ PH[:n] + R
    gain = np.linalg.solve(S, PH.T).T
    keep = np.eye(2 * n)
    keep[:, :n] -= gain @ H
    P = keep @ P @ keep.T + gain @ R @ gain.T
    return Correction(gain.dot(innovation), 0.5 * (P + P.T), innovation, np.sqrt(np.diag(S)),
                      float(innovation.dot(np.linalg.solve(S, innovation))))


def _averaged(before: Innovation | None, found: Correction) -> Innovation:
    square = found.square / len(found.innovation)
    normalised = found.innovation / found.deviation
    if before is None:
        return Innovation(normalised, square, 1)
    count = min(before.count + 1, Innovation.WINDOW)
    return Innovation(
        normalised, before.mean_square + (square - before.mean_square) / count, count)
