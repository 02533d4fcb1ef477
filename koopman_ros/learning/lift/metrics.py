# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Held-out figures of a lifted model, invariant under linear maps of its coordinates."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import short_repr
from koopman_ros.core.datasets import Array, DriftSamples
from koopman_ros.evaluation.closed_loop_test import Rate
from koopman_ros.model import LiftedModel

# Beyond it S is singular to working precision, and rw is noise.
_MAX_COND = 1e13
# Of relative mean-square errors below it, which is smaller says nothing.
ROUNDING = 1e-20
# A prediction this far from the nominal point, in units of the scale, has diverged.
_DIVERGED = 1e6


@dataclass(frozen=True)
class Fit:
    """Residuals of a lift in dz/dt = A z + J_N(x) B(x) u on samples."""

    #: ||(J_N f - A N) S^(-1/2)||^2 / ||J_N f S^(-1/2)||^2 with S = E[z z'], invariant under linear
    #: maps of z, so that it cannot be lowered by shrinking z; f is the drift under the model's
    #: pre-feedback, where it has one
    rw: float
    rx: float  #: relative mean-square error of the drift of x that the lift implies
    cond: float  #: condition number of S; large when coordinates have collapsed onto each other
    #: that of the states among its coordinates, which are not learned; 1 where there are none
    cond_of_states: float = 1.0


@dataclass(frozen=True)
class LiftMetrics:
    """Figures of a model on held-out samples."""

    fit: Fit  #: its residuals
    eigenvalues: NDArray[np.complex128] = field(compare=False)  #: (n_z,) of A, in 1/time unit
    #: (n_x,) root mean square error of the prediction over the held-out episodes, in state units;
    #: infinite when it diverges, None when the samples have no times
    rollout_rmse: Array | None = field(compare=False)

    __repr__ = short_repr

    def metrics(self, names: tuple[str, ...]) -> dict[str, float]:
        """Return the finite figures by name, as they are stored with the model."""
        figures = {'rw': self.fit.rw, 'rx': self.fit.rx, 'cond': self.fit.cond}
        if self.rollout_rmse is not None:
            labels = ['rollout_rmse'] if len(names) == 1 else [
                f'rollout_rmse_{name}' for name in names]
            figures |= dict(zip(labels, map(float, self.rollout_rmse), strict=True))
        return {name: value for name, value in figures.items() if np.isfinite(value)}


def evaluate(model: LiftedModel, samples: DriftSamples) -> LiftMetrics:
    """Evaluate all open-loop figures on held-out episodes; raises as :func:`fit`."""
    return LiftMetrics(fit(model, samples.x, samples.dxdt, samples.u), model.eigenvalues,
                       rollout_rmse(model, samples))


def fit(model: LiftedModel, x: Array, dxdt: Array, u: Array) -> Fit:
    """
    Evaluate the residuals of a lift on samples of a plant.

    :param x: (N, n_x) states, in state units.
    :param dxdt: (N, n_x) their derivatives, in state units per time unit.
    :param u: (N, n_u) inputs, in input units.
    :raises ValueError: when the coordinates depend on each other over the samples, or the samples
        do not fit the model.
    """
    xi, f = _drifts(model, x, dxdt, u)
    z, J = model.lift_and_jacobian(xi)
    # of the plant under the pre-feedback of A
    dz = (J @ (f + model.pre_feedback_rate(xi))[..., None])[..., 0]
    S = z.T @ z / len(z)
    cond = float(np.linalg.cond(S))
    if not cond < _MAX_COND:
        raise ValueError(f'{model.n_z} lifted coordinates depend on each other over the {len(z)} '
                         f'samples (condition number {cond:.1e}, must be below {_MAX_COND:.0e}): '
                         'record over a wider range, or choose a smaller lifted_dimension (n_z)')
    factor = np.linalg.cholesky(S)
    residual = np.linalg.solve(factor, (dz - z @ model.A.T).T)
    reference = np.linalg.solve(factor, dz.T)
    return Fit(rw=float(np.sum(residual ** 2) / np.sum(reference ** 2)),
               rx=_relative_error(model, xi, f),
               cond=cond,
               cond_of_states=float(np.linalg.cond(S[:model.n_x, :model.n_x])) if (
                   model.observables.identity) else 1.0)


def drift_error(model: LiftedModel, samples: DriftSamples) -> float:
    """Return `rx` of samples that need not tell the coordinates apart."""
    return _relative_error(model, *_drifts(model, samples.x, samples.dxdt, samples.u))


def _drifts(model: LiftedModel, x: Array, dxdt: Array, u: Array) -> tuple[Array, Array]:
    """Return scaled states (N, n_x), and their rates (N, n_x) less the effect of inputs."""
    x, dxdt = (model.states.array(name, a) for name, a in (('x', x), ('dxdt', dxdt)))
    xi = model.states.to_deviation(x)
    return xi, dxdt / model.states.scale - model.forcing(
        xi, model.inputs.to_deviation(model.inputs.array('u', u)))


def _relative_error(model: LiftedModel, xi: Array, f: Array) -> float:
    error = model.drift(xi) - f
    return float(np.sum(error ** 2) / np.sum(f ** 2))


def rollout_rmse(model: LiftedModel, samples: DriftSamples) -> Array | None:
    """
    Predict every episode from its first state; return the root mean square error (n_x,), in units.

    It is infinite when a prediction diverges, None when the samples have no times.
    """
    if samples.time is None:
        return None
    # episodes with the same times are predicted side by side
    alike: dict[bytes, list[np.ndarray]] = {}
    for number in np.unique(samples.episode):
        rows = np.flatnonzero(samples.episode == number)
        if len(rows) > 1:
            alike.setdefault(np.diff(samples.time[rows]).tobytes(), []).append(rows)
    squares, count = np.zeros(model.n_x), 0
    for group in alike.values():
        rows = np.stack(group)
        periods = np.diff(samples.time[rows[0]])
        try:
            predicted = model.predict(samples.x[rows[:, 0]], samples.u[rows[:, :-1]], periods)
        except (RuntimeError, np.linalg.LinAlgError):
            return np.full(model.n_x, np.inf)
        squares += np.sum((predicted - samples.x[rows]) ** 2, axis=(0, 1))
        count += rows[:, 1:].size
    return np.sqrt(squares / count) if count else None


def lifted_rate(model: LiftedModel, time_unit_seconds: float) -> Rate:
    """
    Return dx/dt of a model's drift, in units and per a time unit given in seconds.

    It is NaN for states that have diverged: their pseudo-inverse does not exist. A linear model
    has a rate everywhere: that of an unstable plant diverges from starts that are not fitted yet.
    """
    factor = time_unit_seconds / model.seconds_per_time_unit
    limit = np.inf if model.states_alone else _DIVERGED

    def rate(x: Array, u: Array) -> Array:
        xi = model.states.to_deviation(x)
        followed = np.all(np.abs(xi) < limit, axis=-1, keepdims=True)
        xi = np.where(followed, xi, 0.0)
        found = model.drift(xi) + model.forcing(xi, model.inputs.to_deviation(u))
        scaled: Array = factor * model.states.scale * np.where(followed, found, np.nan)
        return scaled

    return rate
