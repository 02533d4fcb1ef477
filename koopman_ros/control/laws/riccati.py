# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Laws by Riccati equations: state-dependent, re-centred and averaged, and the linear one."""

from enum import Enum
from functools import lru_cache
import math
from typing import Any, ClassVar, NamedTuple

import numpy as np

from koopman_ros.control.laws.base import (
    Law,
    LawResult,
    SolutionInfo,
    Target,
    Weights,
)
from koopman_ros.core.arrays import Array, pseudo_inverse
from koopman_ros.core.solvers import (
    RiccatiSolution,
    solve_riccati,
    spectral_radius,
)
from koopman_ros.core.status import reason, StatusCode
from koopman_ros.estimation import Estimate
from koopman_ros.model import LiftedModel
from koopman_ros.tuning import Tuning

# Largest mismatch of a closed lift: those of plants that have one come to 2e-7 or less, others to
# 1e-4 or more, and from there on the averaged Jacobian costs less.
_CLOSED = 1e-5


class Form(Enum):
    """The forms of the feedback; the value is the word an operator reads."""

    RECENTRED = 're-centred'
    AVERAGED = 'averaged'


class Feedback(NamedTuple):
    """The outcome of one state-dependent Riccati solution."""

    u: Array  #: (n_u,) u_ref - K e in scaled deviations; not to be used unless solved
    form: Form  #: which form produced it
    riccati: RiccatiSolution  #: the solution with its residual, gain and status
    #: (n_x, n_x) closed loop of the error e = x - x_ref: e' = loop e, or its transition over an
    #: interval
    loop: Array

    @property
    def solved(self) -> bool:
        """Whether `u` may be used."""
        return self.riccati.solved

    def growth(self, interval: float) -> float:
        """
        Predict by which factor the error's largest mode changes from one sample to the next.

        Without an interval it is that of the continuous loop over one unit of time.

        :param interval: between samples, for which it was solved; 0 when it is not known.
        :return: 1 and more, or NaN, when the loop is predicted not to be stable.
        """
        return spectral_radius(self.loop) if interval > 0.0 else float(
            np.exp(np.max(np.linalg.eigvals(self.loop).real)))


def closed(model: LiftedModel) -> bool:
    """Whether the re-centred law suits a model."""
    return model.identity and model.mismatch <= _CLOSED and not model.adds_unstable_modes


def feedback(model: LiftedModel, x: Array, target: Target, weights: Weights,
             **how: float) -> Feedback:
    """
    Evaluate the law that suits the model.

    Re-centred with identity coordinates if the lift is closed, so that z goes as it predicts, and
    A has no unstable modes but those of the linearised plant, which its input moves. Averaged
    otherwise, and when the re-centred law's equation cannot be solved: M^+ e, which weights a free
    lift, is a poor factorisation of the drift away from its nominal point.

    :param x: (n_x,) scaled deviation of the measured state.
    :param how: interval and bounds of :func:`solve_riccati`.
    """
    if closed(model):
        result = recentred(model, x, target, weights, **how)
        if result.riccati.failure is None:
            return result
    return averaged(model, x, target, weights, **how)


def recentred(model: LiftedModel, x: Array, target: Target, weights: Weights,
              **how: float) -> Feedback:
    """
    Solve the Riccati equation of the lifted error e = N(x) - z_ref.

    e' = A e + J(x) B v + (J(x) - J(x_ref)) (B u_ref + w), and the last term is H C e with C e the
    error of the state, so that A + H C takes the place of A. Only with identity coordinates is C e
    linear in e; a free lift uses M^+ e, exact on the manifold of the lift. Where B depends on the
    state it is B(x) with v and B(x_ref) with u_ref, and (B(x) - B(x_ref)) u_ref = D (x - x_ref)
    adds J(x) D to H. Where A holds under a pre-feedback K it takes J(x) B K from H, and B K x_ref
    from B u_ref + w, so that v and its weight R stay those of the input itself.

    Arguments and result as in :func:`feedback`; of use where the input moves every mode of A that
    does not decay.
    """
    n_x, n_z, forcing, D = model.n_x, model.n_z, target.forcing, _input_secant(model, x, target)
    if model.pre_feedback is not None:
        forcing = forcing - model.pre_feedback_rate(target.x)
    J, M, H = model.observables.secants(x, target.x, forcing)
    B = model.B
    if D is not None:
        B, H = model.input_matrix(x), H + J.dot(D)
    if model.pre_feedback is not None:
        H = H - J.dot(model.pre_feedback_slope)
    if model.identity:
        # C picks the first coordinates: the products are written out, which is faster
        A, Q = model.A.copy(), np.zeros((n_z, n_z))
        A[:, :n_x] += H
        Q[:n_x, :n_x] = weights.Q
    else:
        C = pseudo_inverse(M)
        A, Q = model.A + H @ C, C.T @ weights.Q @ C
    riccati = solve_riccati(A, J.dot(B), Q, weights.R, **how)
    # N(x) - N(x_ref) = M e
    loop = riccati.loop.dot(M)
    return Feedback(target.u - riccati.K.dot(M.dot(x - target.x)), Form.RECENTRED, riccati,
                    loop[:n_x] if model.identity else C.dot(loop))


def averaged(model: LiftedModel, x: Array, target: Target, weights: Weights,
             **how: float) -> Feedback:
    """
    Solve the Riccati equation of the state's error e = x - x_ref under the averaged Jacobian.

    e' = f(x) - f(x_ref) + B v = A(x) e + B v, A the mean of df/dx from x_ref to x, and of d(f +
    B(x) u_ref)/dx where B depends on the state. Of all A with that property it is the one that
    also gives the drift in directions other than e. It needs no more than that (A(x), B) be
    stabilisable, so unstable modes of the lift and their products do no harm.

    Arguments and result as in :func:`feedback`.
    """
    A, D = model.averaged_drift_jacobian(x, target.x), _input_secant(model, x, target)
    riccati = solve_riccati(A if D is None else A + D, model.input_matrix(x), weights.Q,
                            weights.R, **how)
    return Feedback(target.u - riccati.K.dot(x - target.x), Form.AVERAGED, riccati, riccati.loop)


def _input_secant(model: LiftedModel, x: Array, target: Target) -> Array | None:
    """Return D (n_x, n_x) with (B(x) - B(x_ref)) u_ref = D (x - x_ref); None where it is 0."""
    terms = model.input_terms
    return None if terms is None else terms.averaged_jacobian(x, target.x, target.u)


class StateDependentRiccati(Law):
    """The law of the paper: the Riccati equation solved with J_N(x) B at each sample."""

    def compute(self, estimate: Estimate, target: Target, memory: object, interval: float,
                previous: Array | None) -> LawResult:
        """Solve the equation at the estimate; see :class:`~koopman_ros.control.laws.base.Law`."""
        within = interval / self.model.seconds_per_time_unit
        try:
            return _result(self.model, feedback(
                self.model, estimate.x, target, self.weights, interval=within,
                max_gain=self.tuning.max_gain, max_residual=self.tuning.max_riccati_residual),
                interval)
        except np.linalg.LinAlgError as error:
            return LawResult(None, reason(StatusCode.SINGULAR, matrix=str(error)))


class Linear(Law):
    """One gain for all states, of the model linearised at its nominal point (LQR)."""

    extrapolates: ClassVar[bool] = True

    def __init__(self, model: LiftedModel, tuning: Tuning, parameters: Any) -> None:
        super().__init__(model.linearised, tuning, parameters)
        # where samples are equally far apart, one solution does for all of them
        self._at_nominal = lru_cache(maxsize=4)(self._solved)

    def _solved(self, interval: float) -> tuple[Feedback, float]:
        """Return the feedback at the nominal point, and how the error grows in a sample."""
        origin = np.zeros(self.model.n_x)
        found = feedback(
            self.model, origin,
            Target.at(self.model, np.zeros(self.model.n_x + self.model.n_u)), self.weights,
            interval=interval, max_gain=self.tuning.max_gain,
            max_residual=self.tuning.max_riccati_residual)
        return found, found.growth(interval)

    def compute(self, estimate: Estimate, target: Target, memory: object, interval: float,
                previous: Array | None) -> LawResult:
        """Apply the gain; see :class:`~koopman_ros.control.laws.base.Law`."""
        found, growth = self._at_nominal(interval / self.model.seconds_per_time_unit)
        u = target.u - found.riccati.K.dot(estimate.x - target.x)
        return _result(self.model, found, interval, u, growth)


def _result(model: LiftedModel, found: Feedback, interval: float, u: Array | None = None,
            growth: float | None = None) -> LawResult:
    """Return the input of a feedback, or (n_u,) of its gain, unless it must not be used."""
    riccati = found.riccati
    if riccati.failure is not None:
        growth = math.nan
    elif growth is None:
        growth = found.growth(interval / model.seconds_per_time_unit)
    info = SolutionInfo(found.form.value, riccati.residual, riccati.gain, growth)
    if riccati.failure is not None:
        return LawResult(None, reason(riccati.failure), info)
    if not growth < 1.0:
        return LawResult(None, reason(StatusCode.PREDICTED_UNSTABLE, interval=interval), info)
    return LawResult(model.inputs.to_physical(found.u if u is None else u), info=info)
