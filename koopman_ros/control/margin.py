# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The delay margin of a loop as it is tuned, linearised at the nominal point.

The loop is opened where its commands act on the plant. With L(z) from there through plant,
estimator, prediction over the dead time and law back to the command, a further delay makes the
loop unstable that turns an eigenvalue of L of size 1 to -1 (S. Skogestad, I. Postlethwaite,
*Multivariable Feedback Control* (2005), section 2.4.3; for several inputs with one delay for all).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control.fallback import FallbackLevel
from koopman_ros.core.arrays import Array
from koopman_ros.core.signals import Outputs
from koopman_ros.estimation import Estimate, Estimator

Complex = NDArray[np.complex128]


def delay_margin(level: FallbackLevel, outputs: Outputs, dead_time: float, interval: float,
                 **how: Any) -> float:
    """
    Return the delay in s beyond the known dead time with which a loop becomes unstable.

    See :func:`open_loop`; infinity where every delay is stable.
    """
    omega, loci = open_loop(level, outputs, dead_time, interval, **how)
    model = level.model
    if np.max(np.linalg.eigvals(model.linearised.A).real) > 0.0 and np.abs(loci).max() < 1.0:
        return 0.0  # an unstable plant that is left alone
    return _margin(omega, loci)


def open_loop(level: FallbackLevel, outputs: Outputs, dead_time: float, interval: float,
              frequencies: int = 2000, settled: float = 1e-6, most: int = 500,
              step: float = 1e-4) -> tuple[Array, Complex]:
    """
    Return the eigenvalues of the open loop at frequencies up to that of half a sample.

    :param level: its law and estimator.
    :param dead_time: longest of the inputs, in s, with which the loop reckons.
    :param interval: between measurements, in s.
    :param frequencies: their number.
    :param settled: relative change of the covariance of a filter below which it is steady.
    :param most: measurements that a filter gets for that.
    :param step: of differences, in scaled deviations.
    :return: (N,) frequencies in rad/s, and (N, n_u) eigenvalues, of which -1 is critical.
    :raises ValueError: for a law without a model, or a command that is a state of the model.
    :raises numpy.linalg.LinAlgError: where law or estimator give no numbers.
    """
    model, law = level.model, level.law
    if law.model_free or model.commanded:
        raise ValueError('the loop of this law or model is not linearised')
    n = model.n_x
    A, B, h = model.linearised.A, model.B, interval / model.seconds_per_time_unit
    estimate = _steady(level.estimator, outputs, interval, settled, most)

    def command(s: Array) -> Array:
        target = level.target(model.states.center[level.indices], s[n:], None)
        if target is None:
            raise np.linalg.LinAlgError('no steady state')
        found = law.compute(replace(estimate, x=s[:n], w=s[n:]), target, None, interval, None)
        if found.u is None:
            raise np.linalg.LinAlgError('no law')
        return model.inputs.to_deviation(found.u)

    def estimated(s: Array) -> Array:
        x, w, u, y = np.split(s, (n, 2 * n, 2 * n + model.n_u))
        predicted = level.estimator.predict(replace(estimate, x=x, w=w), u, interval)
        if predicted is None:
            raise np.linalg.LinAlgError('no prediction')
        states = model.states
        found = level.estimator.correct(predicted, states.to_deviation(outputs.state(
            outputs.of(states.center) + y, states.to_physical(predicted.x))), interval)
        return np.concatenate((found.x, found.w))

    K = _slope(command, 2 * n, step)
    F = _slope(estimated, 2 * n + model.n_u + len(outputs.C), step)
    of_state, of_input, of_output = np.split(F, (2 * n, 2 * n + model.n_u), axis=1)
    Phi, Gamma = _held(A, B, h)
    ahead, drive = _held(A, np.eye(n), dead_time / model.seconds_per_time_unit)
    onto = np.vstack((np.hstack((ahead, drive)), np.hstack((np.zeros((n, n)), np.eye(n)))))
    C = outputs.C * model.states.scale
    omega = math.pi / interval * np.geomspace(1e-5, 1.0, frequencies)
    z, late = (np.exp(1j * omega * seconds)[:, None, None] for seconds in (interval, -dead_time))
    through = np.linalg.solve(z * np.eye(n) - Phi, Gamma.astype(np.complex128))
    filtered = K @ onto @ np.linalg.inv(np.eye(2 * n) - of_state / z)
    # the controller knows its commands, also those under way
    known = filtered @ of_input * (late / z) + K[:, :n] @ (through - ahead @ through * late)
    loci = np.linalg.eigvals(np.linalg.solve(
        np.eye(model.n_u) - known, -filtered @ of_output) @ C @ through * late)
    return omega, loci


def _steady(estimator: Estimator, outputs: Outputs, interval: float, settled: float, most: int
            ) -> Estimate:
    """Return the estimate after many measurements of the nominal point."""
    model = estimator.model
    x, u = np.zeros(model.n_x), np.zeros(model.n_u)
    estimate = estimator.restart(None, x, u)
    for _ in range(most if estimate.covariance is not None else 0):
        predicted, before = estimator.predict(estimate, u, interval), estimate.covariance
        if predicted is None:
            raise np.linalg.LinAlgError('no prediction')
        estimate = estimator.correct(predicted, x, interval)
        if estimate.covariance is None or before is None or np.abs(
                estimate.covariance - before).max() <= settled * np.abs(before).max():
            break
    return replace(estimate, x=x, w=np.zeros(model.n_x))


def _slope(function: Callable[[Array], Array], size: int, step: float) -> Array:
    """Return the derivative of a function of (size,) at 0 by central differences."""
    return np.array([(function(step * e) - function(-step * e)) / (2.0 * step)
                     for e in np.eye(size)]).T


def _held(A: Array, B: Array, h: float) -> tuple[Array, Array]:
    """Return exp(A h) and the integral of exp(A t) B over h."""
    from scipy.linalg import expm

    n, m = B.shape
    whole = expm(h * np.vstack((np.hstack((A, B)), np.zeros((m, n + m)))))
    return whole[:n, :n], whole[:n, n:]


def _margin(omega: Array, loci: Complex) -> float:
    """Return the smallest delay that turns a point of size 1 of a locus to -1."""
    size = np.sort(np.abs(loci), axis=1)
    phase = np.take_along_axis(np.angle(-loci), np.argsort(np.abs(loci), axis=1), axis=1)
    found = math.inf
    for values, angles in zip(np.log(size.T), phase.T, strict=True):
        for k in np.flatnonzero((values[:-1] > 0.0) != (values[1:] > 0.0)):
            share = values[k] / (values[k] - values[k + 1])
            turned = angles[k] + share * np.angle(np.exp(1j * (angles[k + 1] - angles[k])))
            found = min(found, float((turned % (2.0 * math.pi)) / (
                omega[k] + share * (omega[k + 1] - omega[k]))))
    return found
