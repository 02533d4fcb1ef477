# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The continuous algebraic Riccati equation by an ordered Schur form, checked at every call."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]

# A double eigenvalue of the Hamiltonian on the imaginary axis comes out split by about the square
# root of the rounding error: modes within that of the axis cannot be told from undamped ones.
_AXIS_MARGIN = float(np.sqrt(np.finfo(np.float64).eps))


class RiccatiStatus(Enum):
    """How a solution fared; the value is the sentence for the user."""

    SOLVED = 'solved'
    NOT_STABILISABLE = ('the Hamiltonian has no stable subspace of full size: the pair (A, B) '
                        'is not stabilisable, or a mode on the imaginary axis is not weighted')
    INACCURATE = ('the Riccati residual is too large to trust the gain: the pair (A, B) is '
                  'nearly not stabilisable')
    GAIN_TOO_LARGE = ('the gain exceeds its bound: the pair (A, B) is nearly not stabilisable; '
                      'raise the input weight or the gain bound')


@dataclass(frozen=True)
class RiccatiSolution:
    """
    Solution of A'P + PA - P B R^-1 B' P + Q = 0 with the gain K = R^-1 B' P.

    :param P: (n, n) symmetric; zeros when there is no stable subspace to take it from.
    :param K: (m, n); zeros likewise.
    :param residual: Frobenius norm of the equation's left side over the sum of its terms' norms.
    :param gain: spectral norm of K.
    :param status: whether K may be used.
    """

    P: Array
    K: Array
    residual: float
    gain: float
    status: RiccatiStatus


def _in_left_half_plane(real: float, imaginary: float) -> bool:
    return real < 0.0


# values so large that something overflows end in a residual or a gain that is refused
@np.errstate(all='ignore')
def solve_riccati(A: Array, B: Array, Q: Array, R: Array, *, max_residual: float = 1e-8,
                  max_gain: float = 1e6) -> RiccatiSolution:
    """
    Solve the Riccati equation of the infinite-horizon regulator (Laub, 1979).

    A returned status other than SOLVED means that K must not be used: near the border of
    stabilisability the Schur method yields a P with enormous gains and eigenvalues that look
    fine, which only the residual and the size of the gain reveal.

    :param A: (n, n).
    :param B: (n, m).
    :param Q: (n, n) symmetric, positive semidefinite, not zero.
    :param R: (m, m) symmetric, positive definite.
    :param max_residual: largest relative residual taken as solved.
    :param max_gain: largest spectral norm of K taken as solved.
    :raises numpy.linalg.LinAlgError: when R is singular.
    """
    n = A.shape[0]
    R_inverse_Bt = np.linalg.solve(R, B.T)
    G = B @ R_inverse_Bt
    size_Q, size_G = float(np.linalg.norm(Q)), float(np.linalg.norm(G))
    # P scaled to order one, so that neither block of the Hamiltonian dominates
    scale = np.sqrt(size_Q / size_G) if size_G > 0.0 and size_Q > 0.0 else 1.0
    H = np.empty((2 * n, 2 * n), order='F')
    H[:n, :n], H[:n, n:] = A, -scale * G
    H[n:, :n], H[n:, n:] = -Q / scale, -A.T
    if not (np.all(np.isfinite(H)) and size_Q > 0.0):
        return _unsolved(B, RiccatiStatus.NOT_STABILISABLE)
    margin = _AXIS_MARGIN * np.linalg.norm(H)
    _, stable, real, _, vectors, _, info = lapack.dgees(
        _in_left_half_plane, H, sort_t=1, lwork=16 * n, overwrite_a=1)
    if info != 0 or stable != n or not np.all(real[:n] < -margin):
        return _unsolved(B, RiccatiStatus.NOT_STABILISABLE)
    X, Y = vectors[:n, :n], vectors[n:, :n]
    try:
        P = scale * np.linalg.solve(X.T, Y.T)
    except np.linalg.LinAlgError:
        return _unsolved(B, RiccatiStatus.NOT_STABILISABLE)
    P = 0.5 * (P + P.T)
    K = R_inverse_Bt @ P
    PA = P @ A
    PGP = P @ G @ P
    # the rounding of the sum grows with its terms, so that Q alone would be too strict a measure
    size = size_Q + 2.0 * float(np.linalg.norm(PA)) + float(np.linalg.norm(PGP))
    residual = float(np.linalg.norm(PA + PA.T - PGP + Q)) / size
    gain = float(np.linalg.norm(K, 2))
    if not residual <= max_residual:
        status = RiccatiStatus.INACCURATE
    elif not gain <= max_gain:
        status = RiccatiStatus.GAIN_TOO_LARGE
    else:
        status = RiccatiStatus.SOLVED
    return RiccatiSolution(P, K, residual, gain, status)


def _unsolved(B: Array, status: RiccatiStatus) -> RiccatiSolution:
    n, m = B.shape
    return RiccatiSolution(np.zeros((n, n)), np.zeros((m, n)), np.inf, np.inf, status)
