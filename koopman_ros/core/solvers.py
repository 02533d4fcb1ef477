# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Riccati equations of the continuous and the sampled regulator, Jacobians."""

from collections.abc import Callable
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgees, dgeev, dgesv, dtrsen

from koopman_ros.core.arrays import Array
from koopman_ros.core.status import StatusCode

__all__ = ['RiccatiSolution', 'decaying', 'differences', 'over_interval', 'solve_riccati',
           'spectral_radius']

# A double eigenvalue of the Hamiltonian on the imaginary axis comes out split by about the square
# root of the rounding error: modes within that of the axis look undamped.
_AXIS_MARGIN = float(np.sqrt(np.finfo(np.float64).eps))
# Nor modes of a sampled plant within the rounding of its transition, where samples as far apart as
# a period leave nothing else.
_ROUNDING = 64.0 * float(np.finfo(np.float64).eps)
# Step of a central difference, as a share of the magnitude: rounding and curvature both leave
# about ten digits.
_DIFFERENCE = 1e-5
# The power series of exp(M) - I, for |M| < 2/3, by M to M^4 in rows that are multiplied by powers
# of M^4 (M. S. Paterson, L. J. Stockmeyer, SIAM J. Comput. 2 (1973)).
_SERIES = np.array([[1.0 / math.factorial(4 * i + j) for j in range(1, 5)] for i in range(4)])


class RiccatiSolution(NamedTuple):
    """
    Solution of a Riccati equation with its gain.

    In continuous time A'P + PA - P B R^-1 B' P + Q = 0 and K = R^-1 B' P; of the sampled regulator
    see :func:`solve_riccati`.
    """

    P: Array  #: (n, n) symmetric; zeros when there is no stable subspace to take it from
    K: Array  #: (m, n); zeros without a solution
    residual: float  #: Frobenius norm of the equation's left side over the sum of its terms' norms
    gain: float  #: spectral norm of K
    loop: Array  #: (n, n) A - B K, or the transition of the closed loop over an interval
    failure: StatusCode | None  #: why K must not be used, None where it may

    @property
    def solved(self) -> bool:
        """Whether K may be used."""
        return self.failure is None


def solve_riccati(A: Array, B: Array, Q: Array, R: Array, *, interval: float = 0.0,
                  max_residual: float = 1e-8, max_gain: float = 1e6) -> RiccatiSolution:
    """
    Solve the Riccati equation of the infinite-horizon regulator of dx/dt = A x + B u.

    With an interval it is that of the sampled regulator: the input is held between samples so far
    apart, and the cost is still the integral of x'Q x + u'R u. Then it is a discrete equation,
    P = Phi'P Phi + Q_d - K'(R_d + Gamma'P Gamma) K, K = (R_d + Gamma'P Gamma)^-1 (Gamma'P Phi +
    N_d'), with the plant and the weights over an interval (C. F. Van Loan, IEEE Trans. Automat.
    Contr. 23 (1978)). Its gain tends to the continuous one as the interval goes to 0.

    K must not be used where there is a failure: near the border of stabilisability the Schur
    method yields a P with enormous gains and eigenvalues that look fine, which only the residual
    and the size of the gain reveal.

    :param A: (n, n), and B (n, m).
    :param Q: (n, n) symmetric, positive semidefinite, not zero.
    :param R: (m, m) symmetric, positive definite.
    :param interval: in the unit of time of A; 0 for continuous time.
    :param max_residual: largest relative residual taken as solved.
    :param max_gain: largest spectral norm of K taken as solved.
    """
    try:
        # values so large that something overflows end in a residual or a gain that is rejected
        with np.errstate(all='ignore'):
            P, K, residual, loop = _sampled(A, B, Q, R, interval) if interval > 0.0 else (
                _continuous(A, B, Q, R))
            gain = float(np.linalg.norm(K, 2)) if min(K.shape) > 1 else _size(K)
    except (ArithmeticError, ValueError):
        # a singular matrix, no stable subspace, or numbers that are not finite
        return RiccatiSolution(np.zeros_like(A), np.zeros_like(B.T), math.inf, math.inf, A,
                               StatusCode.NOT_STABILISABLE)
    return RiccatiSolution(P, K, residual, gain, loop, (
        StatusCode.RICCATI_INACCURATE if not residual <= max_residual else
        StatusCode.GAIN_TOO_LARGE if not gain <= max_gain else None))


def _continuous(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array, float, Array]:
    """
    Return P, K, the residual and the closed loop.

    By A. J. Laub, IEEE Trans. Automat. Contr. 24 (1979).
    """
    R_inverse_Bt = _solved(R, B.T)
    G = B @ R_inverse_Bt
    scale = _scale(_size(Q), _size(G))
    P = scale * _stable_graph(np.block([[-A.T, -Q / scale], [-scale * G, A]]))
    PA, PGP = P @ A, P @ G @ P
    # the rounding of the sum grows with its terms, so that Q alone would be too strict a measure
    size = _size(Q) + 2.0 * _size(PA) + _size(PGP)
    K = R_inverse_Bt @ P
    return P, K, _size(PA + PA.T - PGP + Q) / size, A - B @ K


def _sampled(A: Array, B: Array, Q: Array, R: Array, interval: float
             ) -> tuple[Array, Array, float, Array]:
    """
    Return the same of the sampled regulator.

    The Cayley transform (S + I)^-1 (S - I) of the symplectic pencil is a Hamiltonian matrix with
    the same stable subspace. It inverts no transition matrix, so that modes may decay as fast as
    they like within an interval. The held input is a third part of the pencil, next to costate
    and state.
    """
    n = len(A)
    D, W = over_interval(A, B, Q, R, interval)
    D, size_Q = D[:n], _size(W[:n, :n])
    scale = _scale(size_Q, _size(D[:, n:]) ** 2 / (_size(W[n:, n:]) or 1.0))
    size = n + len(W)
    less = np.zeros((size, size))
    less[:n, n:], less[n:, :n], less[n:, n:] = D, -D.T, W / -scale
    more = less.copy()
    more[n:, :n] = D.T
    diagonals = more.ravel()
    diagonals[n:n * size:size + 1] += 2.0
    diagonals[n * size:2 * n * size:size + 1] += 2.0
    least = min((_size(A) + _size(B)) * interval, 1.0)
    P = scale * _stable_graph(_solved(more, less[:, :2 * n])[:2 * n], _ROUNDING * least)
    PD = P.dot(D)
    # [Phi, Gamma]'P [Phi, Gamma] + W less P, whose terms shrink with the interval
    cost = W + D.T.dot(PD)
    cost[:n] += PD
    cost[:, :n] += PD.T
    right = cost[n:, :n]
    K = _solved(cost[n:, n:], right)
    feedback = right.T.dot(K)
    loop = D[:, :n] - D[:, n:].dot(K)
    loop.ravel()[::n + 1] += 1.0
    terms = size_Q + 2.0 * _size(PD[:, :n]) + _size(feedback)
    return P, K, _size(cost[:n, :n] - feedback) / terms, loop


def over_interval(A: Array, B: Array, Q: Array, R: Array, interval: float
                  ) -> tuple[Array, Array]:
    """
    Integrate state, held input and cost over an interval.

    By the power series of the exponential of [-F', W; 0, F], F = [A, B; 0, 0] (Van Loan), over a
    part of the interval, which is then doubled.

    :return: with y = (x, u), the D (n + m, n + m) of y(interval) = (I + D) y(0), which keeps its
        digits where the interval is short, and W of the cost y(0)'W y(0).
    """
    n, m = B.shape
    N = n + m
    powers = np.zeros((4, 2 * N, 2 * N))
    M, M2, M3, M4 = powers
    M[N:N + n, N:N + n], M[N:N + n, N + n:] = A, B
    M[:N, :N] = -M[N:, N:].T
    doublings = max(0, math.frexp(1.5 * _size(M) * interval)[1])
    M[:n, N:N + n], M[n:N, N + n:] = Q, R
    M *= math.ldexp(interval, -doublings)
    M.dot(M, out=M2)
    M2.dot(M, out=M3)
    M2.dot(M2, out=M4)
    *parts, total = _SERIES.dot(powers.reshape(4, -1)).reshape(powers.shape)
    for part in reversed(parts):
        total = part + M4.dot(total)
    D, W = total[N:, N:], total[:N, N:]
    W = W + D.T.dot(W)
    for _ in range(doublings):
        DW = D.T.dot(W)
        W = 2.0 * W + DW + DW.T + DW.dot(D)
        D = 2.0 * D + D.dot(D)
    return D, W


def spectral_radius(M: Array) -> float:
    """Return the largest size of an eigenvalue of a matrix (n, n); infinity if not finite."""
    # LAPACK has no answer, or the wrong one
    if not math.isfinite(_size(M)):
        return math.inf
    # of so few numbers in a quarter of the time of numpy.linalg.eigvals
    real, imaginary, *_ = dgeev(M, compute_vl=0, compute_vr=0)
    return max(map(math.hypot, real.tolist(), imaginary.tolist()))


def _solved(M: Array, right: Array) -> Array:
    """Return M^-1 right (n, m); for small M in a third of the time of numpy.linalg.solve."""
    *_, found, info = dgesv(M, right)
    if info:
        raise np.linalg.LinAlgError('singular matrix')
    return np.asarray(found, dtype=np.float64)


def _scale(size_Q: float, size_G: float) -> float:
    """Return a divisor of P for order one, so that no block of the Hamiltonian dominates."""
    return math.sqrt(size_Q / size_G) if size_Q > 0.0 and size_G > 0.0 else 1.0


def _stable_graph(H: Array, least: float = 0.0) -> Array:
    """
    Return the P whose graph is the stable subspace of a Hamiltonian matrix, costate P state.

    :param H: (2 n, 2 n) of costate and state.
    :param least: distance of its modes from the imaginary axis.
    :raises numpy.linalg.LinAlgError: where that subspace has not full size.
    """
    n, size = len(H) // 2, _size(H)
    if not math.isfinite(size):
        raise np.linalg.LinAlgError('the Hamiltonian is not finite')
    # as scipy.linalg.schur, which takes three times as long for so few numbers
    triangle, _, real, _, vectors, _, failed = dgees(lambda *_: True, H)
    _, vectors, real, _, stable, *_, moved = dtrsen(real < 0.0, triangle, vectors, job='N')
    if failed or moved or stable != n or not max(real[:n].tolist()) < -max(
            least, _AXIS_MARGIN * size):
        raise np.linalg.LinAlgError('no stable subspace of full dimension exists')
    P = _solved(vectors[n:, :n].T, vectors[:n, :n].T)
    return 0.5 * (P + P.T)


def _size(matrix: Array) -> float:
    """Return the Frobenius norm."""
    flat = matrix.ravel()
    return math.sqrt(flat.dot(flat))


def decaying(eigenvalues: NDArray[np.inexact[Any]], tolerance: float = 1e-8
             ) -> NDArray[np.bool_]:
    """
    Return which modes (..., n) of a linear system decay.

    :param eigenvalues: (..., n), not in any order.
    :param tolerance: of the fastest mode: rounding moves the eigenvalue of an integrator to either
        side of 0, and those of a double integrator by the square root of the precision.
    """
    size = np.max(np.abs(eigenvalues), axis=-1, keepdims=True, initial=0.0)
    return np.asarray(eigenvalues.real < -tolerance * size)


def differences(function: Callable[[Array], Array], x: Array, scale: Array) -> Array:
    """
    Differentiate a function of (..., n) to (..., m) by central differences: (..., m, n).

    :param scale: (n,) magnitudes of the arguments.
    """
    steps = _DIFFERENCE * np.diag(scale)
    ahead, behind = (function(x[..., None, :] + sign * steps) for sign in (1.0, -1.0))
    columns = (ahead - behind) / (2.0 * _DIFFERENCE * scale[:, None])
    return np.asarray(columns.swapaxes(-1, -2), dtype=np.float64)
