# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Riccati equations and Runge-Kutta steps, in numpy and scipy; imports nothing of ours but arrays.

The continuous algebraic Riccati equation is solved by an ordered Schur form, and checked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
import math

import numpy as np
from scipy.linalg import blas, lapack

from koopman_ros.arrays import Array

__all__ = ['RiccatiSolution', 'RiccatiStatus', 'runge_kutta_step', 'solve_riccati']

# A double eigenvalue of the Hamiltonian on the imaginary axis comes out split by about the square
# root of the rounding error: modes within that of the axis cannot be told from undamped ones.
_AXIS_MARGIN = float(np.sqrt(np.finfo(np.float64).eps))


class RiccatiStatus(Enum):
    """How a solution fared."""

    SOLVED = 'solved'
    # there is no stable subspace of full size: (A, B) is not stabilisable, or a mode on the
    # imaginary axis is not weighted
    NOT_STABILISABLE = 'riccati_not_stabilisable'
    # the residual is too large to trust the gain: (A, B) is nearly not stabilisable
    INACCURATE = 'riccati_inaccurate'
    # likewise, seen by the gain
    GAIN_TOO_LARGE = 'riccati_gain_too_large'


@dataclass(frozen=True)
class RiccatiSolution:
    """Solution of A'P + PA - P B R^-1 B' P + Q = 0 with the gain K = R^-1 B' P."""

    P: Array  #: (n, n) symmetric; zeros when there is no stable subspace to take it from
    K: Array  #: (m, n); zeros likewise
    residual: float  #: Frobenius norm of the equation's left side over the sum of its terms' norms
    gain: float  #: spectral norm of K
    status: RiccatiStatus  #: whether K may be used


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

    :param A: (n, n), and B (n, m).
    :param Q: (n, n) symmetric, positive semidefinite, not zero.
    :param R: (m, m) symmetric, positive definite.
    :param max_residual: largest relative residual taken as solved.
    :param max_gain: largest spectral norm of K taken as solved.
    :raises numpy.linalg.LinAlgError: when R is singular.
    """
    n, m = B.shape
    R_inverse_Bt = _solution(R, B.T)
    if R_inverse_Bt is None:
        raise np.linalg.LinAlgError('Singular matrix: the input weight R')
    G = B.dot(R_inverse_Bt)
    size_Q, size_G = _size(Q), _size(G)
    # P scaled to order one, so that neither block of the Hamiltonian dominates
    scale = math.sqrt(size_Q / size_G) if size_G > 0.0 and size_Q > 0.0 else 1.0
    H = np.empty((2 * n, 2 * n), order='F')
    H[:n, :n], H[:n, n:] = A, G * -scale
    H[n:, :n], H[n:, n:] = Q / -scale, -A.T
    size_H = _size(H)
    if not (math.isfinite(size_H) and size_Q > 0.0):
        return _unsolved(B, RiccatiStatus.NOT_STABILISABLE)
    _, stable, real, _, vectors, _, info = lapack.dgees(
        _in_left_half_plane, H, sort_t=1, lwork=16 * n, overwrite_a=1)
    if info != 0 or stable != n or not (real[:n] < -_AXIS_MARGIN * size_H).all():
        return _unsolved(B, RiccatiStatus.NOT_STABILISABLE)
    P = _solution(vectors[:n, :n].T, vectors[n:, :n].T)
    if P is None:
        return _unsolved(B, RiccatiStatus.NOT_STABILISABLE)
    P = (0.5 * scale) * (P + P.T)
    K = R_inverse_Bt.dot(P)
    PA = P.dot(A)
    PGP = P.dot(G).dot(P)
    # the rounding of the sum grows with its terms, so that Q alone would be too strict a measure
    size = size_Q + 2.0 * _size(PA) + _size(PGP)
    residual = _size(PA + PA.T - PGP + Q) / size
    gain = _size(K)
    if min(m, n) > 1 and math.isfinite(gain):
        gain = float(np.linalg.norm(K, 2))
    if not residual <= max_residual:
        status = RiccatiStatus.INACCURATE
    elif not gain <= max_gain:
        status = RiccatiStatus.GAIN_TOO_LARGE
    else:
        status = RiccatiStatus.SOLVED
    return RiccatiSolution(P, K, residual, gain, status)


# LAPACK and BLAS themselves: numpy's functions take several times as long for a few numbers.

def _solution(matrix: Array, right: Array) -> Array | None:
    """Solve a linear system; None when the matrix is singular."""
    _, _, solution, info = lapack.dgesv(matrix, right)
    return solution if info == 0 else None


def _size(matrix: Array) -> float:
    """Return the Frobenius norm."""
    return float(blas.dnrm2(matrix.ravel('K')))


def _unsolved(B: Array, status: RiccatiStatus) -> RiccatiSolution:
    n, m = B.shape
    return RiccatiSolution(np.zeros((n, n)), np.zeros((m, n)), np.inf, np.inf, status)


def runge_kutta_step(rate: Callable[[Array], Array], x: Array, h: Array | float) -> Array:
    """Step dx/dt = rate(x) by h, which broadcasts with x, by the Runge-Kutta method of order 4."""
    k1 = rate(x)
    k2 = rate(x + 0.5 * h * k1)
    k3 = rate(x + 0.5 * h * k2)
    k4 = rate(x + h * k3)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
