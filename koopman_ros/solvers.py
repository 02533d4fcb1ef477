# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Riccati equations, transitions and Runge-Kutta steps, in numpy and LAPACK; imports little of ours.

The algebraic Riccati equations of the continuous and of the sampled regulator are solved by an
ordered Schur form, and checked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
import math
from typing import NamedTuple

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.lapack import blas, lapack

__all__ = ['RiccatiSolution', 'RiccatiStatus', 'runge_kutta_step', 'solve_riccati', 'transition']

# A double eigenvalue of the Hamiltonian on the imaginary axis comes out split by about the square
# root of the rounding error: modes within that of the axis cannot be told from undamped ones.
_AXIS_MARGIN = float(np.sqrt(np.finfo(np.float64).eps))
# Nor modes of a sampled plant within the rounding of its transition, where samples as far apart as
# a period leave nothing else.
_ROUNDING = 64.0 * float(np.finfo(np.float64).eps)

# Terms of the power series of an exponential of norm 1/2, of which the next would be 2e-20, and of
# norm 2, with 1e-27: both one more than a power of 2. More terms take less time than doublings;
# beyond a norm of 2 they would lose digits.
_FEW, _MANY = 17, 33
_FACTORS = {terms: np.array([1.0 / math.factorial(k) for k in range(terms)])
            for terms in (_FEW, _MANY)}
# What the products of two terms, of the powers j and k of time, contribute to an integral from 0
# to 1.
_SHARES = {terms: np.outer(factors, factors) / (1.0 + np.add.outer(range(terms), range(terms)))
           for terms, factors in _FACTORS.items()}


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
    """
    Solution of a Riccati equation with its gain.

    In continuous time A'P + PA - P B R^-1 B' P + Q = 0 and K = R^-1 B' P; of the sampled regulator
    see :func:`solve_riccati`.
    """

    P: Array  #: (n, n) symmetric; zeros when there is no stable subspace to take it from
    K: Array  #: (m, n); zeros likewise
    residual: float  #: Frobenius norm of the equation's left side over the sum of its terms' norms
    gain: float  #: spectral norm of K
    status: RiccatiStatus  #: whether K may be used


def _in_left_half_plane(real: float, imaginary: float) -> bool:
    return real < 0.0


# values so large that something overflows end in a residual or a gain that is refused
@np.errstate(all='ignore')
def solve_riccati(A: Array, B: Array, Q: Array, R: Array, *, interval: float = 0.0,
                  max_residual: float = 1e-8, max_gain: float = 1e6) -> RiccatiSolution:
    """
    Solve the Riccati equation of the infinite-horizon regulator of dx/dt = A x + B u.

    With an interval it is that of the sampled regulator: the input is held between samples so far
    apart, and the cost is still the integral of x'Q x + u'R u. Then it is a discrete equation,
    P = Phi'P Phi + Q_d - K'(R_d + Gamma'P Gamma) K, K = (R_d + Gamma'P Gamma)^-1 (Gamma'P Phi +
    N_d'), with the plant and the weights over an interval (Van Loan, 1978). Its gain tends to the
    continuous one as the interval goes to 0.

    A returned status other than SOLVED means that K must not be used: near the border of
    stabilisability the Schur method yields a P with enormous gains and eigenvalues that look
    fine, which only the residual and the size of the gain reveal.

    :param A: (n, n), and B (n, m).
    :param Q: (n, n) symmetric, positive semidefinite, not zero.
    :param R: (m, m) symmetric, positive definite.
    :param interval: in the unit of time of A; 0 for continuous time.
    :param max_residual: largest relative residual taken as solved.
    :param max_gain: largest spectral norm of K taken as solved.
    :raises numpy.linalg.LinAlgError: when R is singular, in continuous time.
    """
    solved = _sampled(A, B, Q, R, interval) if interval > 0.0 else _continuous(A, B, Q, R)
    if solved is None:
        n, m = B.shape
        return RiccatiSolution(np.zeros((n, n)), np.zeros((m, n)), np.inf, np.inf,
                               RiccatiStatus.NOT_STABILISABLE)
    P, K, residual = solved
    gain = _size(K)
    if min(K.shape) > 1 and math.isfinite(gain):
        gain = float(np.linalg.norm(K, 2))
    if not residual <= max_residual:
        status = RiccatiStatus.INACCURATE
    elif not gain <= max_gain:
        status = RiccatiStatus.GAIN_TOO_LARGE
    else:
        status = RiccatiStatus.SOLVED
    return RiccatiSolution(P, K, residual, gain, status)


def _continuous(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array, float] | None:
    """Return P, K and the residual; None without a stable subspace of full size (Laub, 1979)."""
    n = len(A)
    R_inverse_Bt = _solution(R, B.T)
    if R_inverse_Bt is None:
        raise np.linalg.LinAlgError('Singular matrix: the input weight R')
    G = B.dot(R_inverse_Bt)
    size_Q, scale = _size(Q), _scale(Q, G)
    H = np.empty((2 * n, 2 * n), order='F')
    H[:n, :n], H[:n, n:] = A, G * -scale
    H[n:, :n], H[n:, n:] = Q / -scale, -A.T
    P = _stable_graph(H, scale) if size_Q > 0.0 else None
    if P is None:
        return None
    PA = P.dot(A)
    PGP = P.dot(G).dot(P)
    # the rounding of the sum grows with its terms, so that Q alone would be too strict a measure
    size = size_Q + 2.0 * _size(PA) + _size(PGP)
    return P, R_inverse_Bt.dot(P), _size(PA + PA.T - PGP + Q) / size


def _sampled(A: Array, B: Array, Q: Array, R: Array, interval: float
             ) -> tuple[Array, Array, float] | None:
    """
    Return the same of the sampled regulator.

    The Cayley transform (S + I)^-1 (S - I) of the symplectic pencil is a Hamiltonian matrix with
    the same stable subspace. It inverts no transition matrix, so that modes may decay as fast as
    they like within an interval.
    """
    n = len(A)
    held = _over_interval(A, B, Q, R, interval)
    if held is None:
        return None
    D, W, size = held
    step, push = D[:n, :n], D[:n, n:]
    Q_d, N, R_d = W[:n, :n], W[:n, n:], W[n:, n:]
    # what the cross term makes of input and weight
    by_R = _solution(R_d, np.concatenate((push.T, N.T), axis=1))
    if by_R is None:
        return None
    rest, G, Q_rest = step - push.dot(by_R[:, n:]), push.dot(by_R[:, :n]), Q_d - N.dot(by_R[:, n:])
    scale = _scale(Q_rest, G)
    less = np.empty((2 * n, 2 * n), order='F')
    less[:n, :n], less[:n, n:] = rest, G * -scale
    less[n:, :n], less[n:, n:] = Q_rest / -scale, -rest.T
    more = less.copy(order='F')
    more[:, n:] *= -1.0
    more.ravel(order='K')[::2 * n + 1] += 2.0
    H = _solution(more, less)
    P = (_stable_graph(H, scale, _ROUNDING * min(size, 1.0))
         if H is not None and _size(Q_d) > 0.0 else None)
    if P is None:
        return None
    P_step, P_push = P.dot(step), P.dot(push)
    right = N.T + push.T.dot(P_step) + P_push.T
    K = _solution(R_d + push.T.dot(P_push), right)
    if K is None:
        return None
    # the equation less P on both sides, whose terms shrink with the interval
    square, feedback = step.T.dot(P_step), right.T.dot(K)
    size = _size(Q_d) + 2.0 * _size(P_step) + _size(square) + _size(feedback)
    return P, K, _size(P_step + P_step.T + square + Q_d - feedback) / size


def _over_interval(A: Array, B: Array, Q: Array, R: Array, interval: float
                   ) -> tuple[Array, Array, float] | None:
    """
    Integrate state, held input and cost over an interval; None for what is not finite.

    By the power series of the exponential of [A, B; 0, 0], over so short a part of the interval
    that it ends within rounding. D is the series without its constant term, so that no digits
    are lost where the part is short. A general function for exponentials takes twice as long.

    :return: with y = (x, u), the D (n + m, n + m) of y(interval) = (I + D) y(0), whose lower rows
        are zeros, W of the cost y(0)'W y(0), and the norm of [A, B] times the interval.
    """
    n, m = B.shape
    N = n + m
    W = np.zeros((N, N))
    W[:n, :n], W[n:, n:] = Q, R
    series, size_W = _Series.over(A, B, interval), _size(W)
    if series is None or not (math.isfinite(size_W) and size_W > 0.0):
        return None
    powers, D, terms = series.powers, series.D, series.terms
    weighed = np.matmul(W / size_W, powers.reshape(terms, N, N)).reshape(-1, N)
    W = weighed.T.dot(_SHARES[terms].dot(powers.reshape(terms, -1)).reshape(-1, N))
    W = (0.5 * series.part * size_W) * (W + W.T)
    # twice the time, again and again: the series over all of it would lose its digits
    for _ in range(series.doublings):
        DW = D.T.dot(W)
        W = 2.0 * W + DW + DW.T + DW.dot(D)
        D = 2.0 * D + D.dot(D)
    return D, W, series.size


@np.errstate(all='ignore')
def transition(A: Array, B: Array, interval: float) -> Array:
    """
    Integrate dx/dt = A x + B u over an interval, with the input held.

    :param A: (n, n), and B (n, m).
    :return: [Phi - I, Gamma] (n, n + m) of x+ = Phi x + Gamma u; not finite where it overflows.
    """
    series = _Series.over(A, B, interval)
    if series is None:
        return np.full((len(A), len(A) + B.shape[1]), np.nan)
    D = series.D
    for _ in range(series.doublings):
        D = 2.0 * D + D.dot(D)
    return D[:len(A)]


class _Series(NamedTuple):
    """Power series of the exponential of F = [A, B; 0, 0] over a part of an interval."""

    powers: Array  #: (terms (n + m), n + m) of F times the part, below each other
    D: Array  #: (n + m, n + m) its sum without the constant term
    part: float  #: in units of time
    terms: int  #: of the series
    doublings: int  #: from the part to the interval
    size: float  #: norm of F times the interval

    @classmethod
    def over(cls, A: Array, B: Array, interval: float) -> '_Series | None':
        """Sum it up over so short a part that it ends within rounding; None if not finite."""
        n, m = B.shape
        N = n + m
        F = np.zeros((N, N))
        F[:n, :n], F[:n, n:] = A, B
        size = _size(F) * interval
        if not math.isfinite(size):
            return None
        terms = _FEW if size < 0.5 else _MANY
        doublings = 0 if size < 2.0 else math.frexp(size)[1] - 1
        part = math.ldexp(interval, -doublings)
        # those known times the highest give as many more
        powers = np.empty((terms * N, N))
        powers[:N] = np.eye(N)
        np.multiply(F, part, out=powers[N:2 * N])
        known = 1
        while known < terms - 1:
            highest = (known + 1) * N
            np.dot(powers[N:highest], powers[highest - N:highest],
                   out=powers[highest:highest + known * N])
            known *= 2
        D = _FACTORS[terms][1:].dot(powers[N:].reshape(terms - 1, -1)).reshape(N, N)
        return cls(powers, D, part, terms, doublings, size)


def _scale(Q: Array, G: Array) -> float:
    """Return by how much to divide P for order one, so that no block dominates the Hamiltonian."""
    size_Q, size_G = _size(Q), _size(G)
    return math.sqrt(size_Q / size_G) if size_G > 0.0 and size_Q > 0.0 else 1.0


def _stable_graph(H: Array, scale: float, least: float = 0.0) -> Array | None:
    """
    Return `scale` times the P whose graph is the stable subspace of a Hamiltonian, or None.

    :param least: distance of its modes from the imaginary axis.
    """
    n, size = len(H) // 2, _size(H)
    if not math.isfinite(size):
        return None
    _, stable, real, _, vectors, _, info = lapack.dgees(
        _in_left_half_plane, H, sort_t=1, lwork=16 * n, overwrite_a=1)
    least = max(least, _AXIS_MARGIN * size)
    if info != 0 or stable != n or not (real[:n] < -least).all():
        return None
    P = _solution(vectors[:n, :n].T, vectors[n:, :n].T)
    return None if P is None else (0.5 * scale) * (P + P.T)


# LAPACK and BLAS themselves: numpy's functions take several times as long for a few numbers.

def _solution(matrix: Array, right: Array) -> Array | None:
    """Solve a linear system; None when the matrix is singular."""
    _, _, solution, info = lapack.dgesv(matrix, right)
    return solution if info == 0 else None


def _size(matrix: Array) -> float:
    """Return the Frobenius norm."""
    return float(blas.dnrm2(matrix.ravel('K')))


def runge_kutta_step(rate: Callable[[Array], Array], x: Array, h: Array | float) -> Array:
    """Step dx/dt = rate(x) by h, which broadcasts with x, by the Runge-Kutta method of order 4."""
    k1 = rate(x)
    k2 = rate(x + 0.5 * h * k1)
    k3 = rate(x + 0.5 * h * k2)
    k4 = rate(x + h * k3)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
