# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Prestabilization: an unstable plant is learned under a feedback, its states whitened."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from koopman_ros.core.datasets import Array
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.learning.lift.input_model import InputModel
from koopman_ros.model import NetworkObservables

# Ratio of the smallest to the largest variance of a singular covariance. Rounding decides whether
# a Cholesky factorisation fails there.
_SINGULAR = 1e-14


@dataclass(frozen=True)
class PrestabilizedFrame:
    """
    The plant under a pre-feedback, f(x) + B K x, in states x' = T x with E[x' x''] = I.

    Its training data are changed, by :meth:`enter`, and the learned model is changed back, by
    :meth:`leave`. Scaled deviations throughout; time may be in any unit.
    """

    inputs: InputModel  #: the known part of B
    B: Array  #: (n_x, n_u) at the nominal point, known or of the linear fit
    K: Array  #: (n_u, n_x) gain
    T: Array  #: (n_x, n_x)

    @staticmethod
    def of(inputs: InputModel, x: Array, f: Array, regressors: Array | None, weight: float
           ) -> PrestabilizedFrame:
        """
        Find the gain of the linear-quadratic regulator of the linear fit, and whiten the states.

        :param x: (N, n_x) states.
        :param f: (N, n_x) rates, less B(x) u where it is known.
        :param regressors: as of :meth:`InputModel.apart`.
        :param weight: of u'u against x'x.
        :raises ValueError: when there is no input, the inputs do not reach an unstable mode of the
            fit, or the states do not move each on its own.
        """
        n_x, n_u = x.shape[1], inputs.n_u
        if not n_u:
            raise ValueError('a plant without inputs has no feedback: leave `pre_feedback` out')
        known = x if regressors is None else np.hstack([x, regressors])
        fitted = np.linalg.lstsq(known, f, rcond=None)[0].T.astype(np.float64)
        A = fitted[:, :n_x]
        B = inputs.matrix(None if regressors is None else fitted[:, n_x:])[0]
        riccati = solve_riccati(A, B, np.eye(n_x), weight * np.eye(n_u))
        if not riccati.solved:
            raise ValueError(
                'no feedback of the inputs stabilises the linear fit of the samples, whose '
                f'eigenvalues are {np.round(np.linalg.eigvals(A), 3).tolist()} in 1/time unit: '
                'excite the inputs, add one that acts on the unstable modes, or leave '
                '`pre_feedback` out')
        covariance = x.T @ x / len(x)
        variances = np.linalg.eigvalsh(covariance)
        if not variances[0] > _SINGULAR * variances[-1]:
            raise ValueError('the states of the samples do not move independently: excite the '
                             'plant, or leave out a state')
        return PrestabilizedFrame(inputs, B, -riccati.K,
                                  np.linalg.inv(np.linalg.cholesky(covariance)))

    def enter(self, x: Array, f: Array, regressors: Array | None
              ) -> tuple[Array, Array, Array | None]:
        """Change samples, as they are given to :meth:`of`."""
        feedback = x @ self.K.T
        if regressors is None:
            f = f + feedback @ self.B.T
        else:
            # of the u that is left, B is to be learned
            regressors = regressors.copy()
            regressors[:, :self.inputs.n_u] -= feedback
        return x @ self.T.T, f @ self.T.T, regressors

    def leave(self, observables: NetworkObservables, A: Array, B: Array | None
              ) -> tuple[NetworkObservables, Array, Array | None]:
        """
        Change a lift, its A and the weights of the regressors, where they were learned, back.

        With identity coordinates the others are scaled to the geometric mean of the states'
        largest and smallest variance, so that they do not add to the condition number.
        """
        back = np.linalg.inv(self.T)
        output = observables.V
        if observables.identity:
            spread = np.linalg.eigvalsh(back @ back.T)
            size = float((spread[0] * spread[-1]) ** 0.25)
            output = size * output
            n_free = len(output)
            A = block_diag(back, size * np.eye(n_free)) @ A @ block_diag(
                self.T, np.eye(n_free) / size)
        return (replace(observables, W=observables.W @ self.T, V=output), A,
                None if B is None else back @ B)
