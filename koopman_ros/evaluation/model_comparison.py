# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recent measurements, and how well models predict them: a check before a model is activated."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
import itertools

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.controller import Controller
from koopman_ros.control.events import Measurement
from koopman_ros.control.state import Arrival, MeasurementReport
from koopman_ros.core.arrays import Array
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation import Estimate, held_means, with_commands
from koopman_ros.estimation.disturbance_observer import simulated
from koopman_ros.model import LiftedModel

# A row for each hundredth of the remembered time: ten in a time constant by default.
_ROWS = 100
# Windows are a fifth of the remembered time, overlap by half, and are no shorter than this.
_WINDOWS = 5
_LEAST_STEPS = 8
_GAP = 3.0  # so many usual steps without a row end a window
# An error below this share of a signal's movement, and of its training box, counts as none.
_SHARE_OF_MOTION, _SHARE_OF_BOX = 0.1, 5e-4


class MeasurementBuffer:
    """
    The last measurements of all states and the inputs that acted between them.

    It costs the same for each sample, and no more memory however many there are: rows closer than
    a hundredth of the history are thinned, their inputs averaged.
    """

    def __init__(self) -> None:
        self._rows: deque[tuple[int, Array, Array]] = deque(maxlen=_ROWS + 1)
        self._time_ns = self._row_ns = 0  # of the last sample, of the last row
        self._impulse: Array | float = 0.0  # integral of the inputs since that row, in ns

    def add(self, event: Measurement, report: MeasurementReport, command: Array | None,
            seconds: float, disturbances: Array | None = None) -> None:
        """
        Take a measurement of all states into account; one that is older restarts the history.

        :param report: its outcome.
        :param command: (n_u,) before it, or None; where the input is measured, that
            counts.
        :param seconds: how much is to be remembered.
        :param disturbances: (n_d,) measured ones that act, or None where there are none.
        """
        if report.arrival not in (Arrival.ACCEPTED, Arrival.REJECTED):
            return
        known = event.applied is not None and bool(np.isfinite(event.applied).all())
        u = event.applied if known else command
        if u is not None and disturbances is not None:
            u = np.concatenate((u, disturbances))
        if event.stamp_ns <= self._time_ns or u is None:
            self._rows.clear()
        elif self._rows:
            self._impulse = self._impulse + (event.stamp_ns - self._time_ns) * u
        self._time_ns = event.stamp_ns
        passed = event.stamp_ns - self._row_ns
        if report.arrival is Arrival.REJECTED or (
                self._rows and passed * _ROWS < seconds * NANOSECONDS):
            return
        # nothing has acted before the first
        mean = self._impulse / passed if self._rows else np.empty(0)
        self._rows.append((event.stamp_ns, event.measured, np.asarray(mean)))
        self._row_ns, self._impulse = event.stamp_ns, 0.0

    def windows(self, seconds: float) -> PredictionWindows | None:
        """Cut the younger part into windows, or return None where it is too short for one."""
        oldest = self._time_ns - round(seconds * NANOSECONDS)
        # where measurements are that rare, they are all there is
        count = max(_LEAST_STEPS + 1, sum(row[0] >= oldest for row in self._rows))
        rows = list(self._rows)[-count:]
        if len(rows) <= _LEAST_STEPS:
            return None
        x = np.array([row[1] for row in rows])
        u = np.array([row[2] for row in rows[1:]])
        steps = np.array([(row[0] - before[0]) / NANOSECONDS
                          for before, row in itertools.pairwise(rows)])
        usual = float(np.median(steps))
        K = max(_LEAST_STEPS, round(seconds / _WINDOWS / usual))
        # the last one ends with the last row
        places = np.arange(len(steps) - K, -1, -max(1, K // 2))[:, None] + np.arange(K)
        places = places[(steps[places] <= _GAP * usual).all(axis=1)]
        return PredictionWindows(x, u, steps, places) if len(places) else None


@dataclass(frozen=True)
class PredictionWindows:
    """N measurements in M windows of K steps each."""

    x: Array  #: (N, n_y) measured, in units
    u: Array  #: (N - 1, n_u + n_d) inputs and disturbances that acted between them, in units
    steps: Array  #: (N - 1,) time between them, in s
    places: NDArray[np.intp]  #: (M, K) which steps are in a window

    @property
    def seconds(self) -> float:
        """How long ago they began."""
        return float(self.steps.sum())

    @property
    def motion(self) -> Array:
        """How far (n_x,) the signals moved: root mean square distance from a window's mean."""
        x = self.x[self.places]
        return rms(np.mean(np.square(x - x.mean(axis=1, keepdims=True)), axis=1))

    def delayed(self, dead_time: Array) -> PredictionWindows:
        """
        Return the windows with the inputs that acted, each (n_u + n_d,) seconds later.

        The first one is taken to have been applied before, too.
        """
        if not dead_time.any():
            return self
        times = np.concatenate(([0.0], np.cumsum(self.steps)))
        return replace(self, u=np.hstack([
            held_means(np.append(-dead, times), np.vstack((column[:1], column)), times - dead)
            for dead, column in zip(dead_time.tolist(), self.u.T[..., None], strict=True)]))

    def squares(self, model: LiftedModel, size: Array) -> Array:
        """
        Return the mean squared errors (M, n_x) with which a model predicts, in units squared.

        Start and a constant disturbance of each window are those that suit the model best: a
        measured start would bring its noise into the prediction, and whatever is constant an
        observer makes up for. The drift is linearised at the measurements, which makes that one
        linear fit and is valid near them; far from it the error is large either way. A prediction
        that is not finite has an infinite error.

        :param size: (n_x,) in which errors of the states are weighed, in units.
        """
        model = model.joined
        n, (M, K) = model.n_x, self.places.shape
        every = np.full((M, n), np.inf)
        x, eye = model.states.to_deviation(self.x), np.eye(n)
        h = (self.steps / model.seconds_per_time_unit)[:, None]
        try:
            u, half = model.inputs.to_deviation(self.u), 0.5 * h[..., None]
            (f0, F0), (f1, F1) = (model.rate_and_slope(x[rows], u)
                                  for rows in (slice(-1), slice(1, None)))
            # the trapezoidal rule for the error e: e' = F e + w + (f + B(x) u - dx/dt)
            lack = h * (0.5 * (f0 + f1))
            right = np.concatenate([(lack - np.diff(x, axis=0))[..., None], np.broadcast_to(
                h[..., None] * eye, (len(h), n, n)), eye + half * F0], axis=-1)
            step = np.linalg.solve(eye - half * F1, right)
        except np.linalg.LinAlgError:
            return every
        # columns: without a fit, by disturbance, by start
        e = np.broadcast_to(np.concatenate([np.zeros((n, 1 + n)), eye], axis=1), (M, n, 2 * n + 1))
        path = [e]
        for k in self.places.T:
            e = step[k, :, n + 1:] @ e
            e[..., :n + 1] += step[k, :, :n + 1]
            path.append(e)
        # (M, K + 1, n_x, 2 n_x + 1), in sizes
        errors = np.stack(path, axis=1) * (model.states.scale / size)[:, None]
        usable = np.isfinite(errors).all(axis=(1, 2, 3))
        rows = errors[usable].reshape(-1, (K + 1) * n, 2 * n + 1)
        length = np.linalg.norm(rows[..., 1:], axis=1, keepdims=True)
        fitted = rows[..., 1:] / np.maximum(length, np.finfo(np.float64).tiny)
        rest = rows[..., :1] - fitted @ (np.linalg.pinv(fitted) @ rows[..., :1])
        every[usable] = np.mean(np.square(rest.reshape(-1, K + 1, n)), axis=1) * size ** 2
        return every


def _predicted(controller: Controller, windows: PredictionWindows) -> Array:
    """
    Return the mean squared errors (., n_y) of predicting windows from the data before them.

    Those of the later half, and the last one: before that, states that are not measured are not
    known yet. Infinite where the model is lost.
    """
    model, outputs = controller.model, controller.measured
    estimator = next(iter(controller.levels.values())).estimator
    inputs, steps = model.inputs.to_deviation(windows.u[:, :model.n_u]), windows.steps.tolist()
    rates = model.disturbance_rate(windows.u[:, model.n_u:])
    estimate = estimator.restart(
        None, model.states.to_deviation(controller.position(windows.x[0])), inputs[0])
    known = [estimate := estimate.under(-rates[0])]
    for y, u, rate, seconds in zip(windows.x[1:], inputs, rates, steps, strict=True):
        predicted = (estimator.advance(estimate.under(rate), u, seconds)
                     or estimate.under(rate)).under(-rate)
        x = outputs.state(y, model.states.to_physical(predicted.x))
        estimate = estimator.correct(predicted, model.states.to_deviation(x), seconds)
        known.append(estimate)
    # the last one comes first
    late = [places for k, places in enumerate(windows.places.tolist())
            if not k or places[0] >= len(steps) // 2]
    found = np.full((len(late), len(outputs.names)), np.inf)
    for window, places in zip(found, late, strict=True):
        ahead: Estimate | None = known[places[0]]
        errors = []
        for k in places:
            ahead = ahead and simulated(model, with_commands(
                model, ahead.under(rates[k]), inputs[k]), inputs[k], steps[k])
            ahead = ahead and ahead.under(-rates[k])
            if ahead is None or not bool(np.isfinite(ahead.x).all()):
                break
            errors.append(windows.x[k + 1] - outputs.of(model.states.to_physical(ahead.x)))
        else:
            window[:] = np.mean(np.square(errors), axis=0)
    return found


def rms(squares: Array) -> Array:
    """Return the root of the mean (n,) over windows of squares (M, n)."""
    return np.asarray(np.sqrt(squares.mean(axis=0)))


@dataclass(frozen=True)
class ModelComparison:
    """How well two models predict recent measurements."""

    seconds: float  #: how long that was
    present: Array  #: (n_x,) root mean square error of the current model, in units
    candidate: Array  #: (n_x,) of the one that is to take over; infinite where it diverges
    motion: Array  #: (n_x,) how far the signals moved
    negligible: Array  #: (n_x,) an error that is as good as none

    @property
    def allowance(self) -> Array:
        """The scale of the candidate's errors (n_x,), in units."""
        return np.asarray(np.maximum(self.present, self.negligible))

    @property
    def ratio(self) -> Array:
        """Ratio (n_x,) of the error of the candidate to that of the current model."""
        return self.candidate / self.allowance

    @property
    def tells(self) -> bool:
        """Whether a signal moved, and as the current model predicts."""
        return bool(np.any((self.motion > self.negligible) & (self.present < 0.5 * self.motion)))


def compare(present: Controller, candidate: Controller,
            windows: PredictionWindows) -> ModelComparison | None:
    """
    Let the models of two controllers predict; None where the current one never can.

    Where not every state is measured they start from the estimates of their filters.
    """
    box, motion = present.model.states, windows.motion
    negligible = np.maximum(_SHARE_OF_MOTION * motion, _SHARE_OF_BOX * (
        np.abs(present.measured.C) @ (box.upper - box.lower)))
    whole = present.measured.all_states and candidate.measured.all_states
    with np.errstate(all='ignore'):
        own, new = (acted.squares(one.model, negligible) if whole else _predicted(one, acted)
                    for one in (present, candidate)
                    for acted in (windows.delayed(np.append(
                        one.tuning.dead_times(one.model), np.zeros(len(one.model.disturbances)))),
                                  ))
    known = np.isfinite(own).all(axis=1)
    if not known.any():
        return None
    return ModelComparison(windows.seconds, rms(own[known]), rms(new[known]), motion, negligible)
