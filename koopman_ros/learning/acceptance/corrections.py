# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Corrections of an estimated drift that a record does not rule out.

The rate is corrected by sum_k c_k phi_k(x, u) with orthonormal Legendre products phi_k. Along free
runs the residuals are linear in c, by the sensitivities of the runs (H. K. Khalil, *Nonlinear
Systems* (2002), section 3.3), so that c has a Gaussian posterior (D. J. C. MacKay, Neural
Computation 4 (1992) 415). The noise is first-order autoregressive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.core.datasets import cut, Episode
from koopman_ros.core.integration import runge_kutta_step, sensitivity_rate
from koopman_ros.learning.acceptance.settings import DEFAULTS, Thresholds
from koopman_ros.learning.identification import Drift, fitted_starts, longest_step, Segments
from koopman_ros.learning.identification.drift import prediction_error
from koopman_ros.learning.legendre_basis import Correction, LegendreBasis


class OwnTerms(NamedTuple):
    """The terms that an estimated drift has itself: its uncertainty is that of its fit."""

    degree: int  #: of the terms in x alone
    input_degree: int  #: of the factors in x of terms linear in u; -1 for none

    def among(self, basis: LegendreBasis) -> NDArray[np.bool_]:
        """Return which products (p,) of a basis a drift has itself."""
        of_x, of_u = basis.degrees
        return ((of_u == 0) & (of_x <= self.degree)) | (
            (of_u == 1) & (of_x <= self.input_degree))


@dataclass(frozen=True)
class PlausiblePlant:
    """An estimated drift with a correction that the record does not rule out."""

    drift: Drift
    correction: Correction

    __repr__ = short_repr

    def rate(self, x: Array, u: Array) -> Array:
        """Evaluate dx/dt in units: (..., n_x) and (..., n_u) -> (..., n_x)."""
        return self.drift.rate(x, u) + self.correction(x, u)


@dataclass(frozen=True)
class CorrectionPosterior:
    """The distribution of the corrections of a drift, given a record."""

    drift: Drift
    basis: LegendreBasis
    own: NDArray[np.bool_]  #: (p,) products that the drift has itself
    weights: Array  #: (G,) probabilities of the prior's deviations
    deviations: Array  #: (G, n_x p) those of the prior
    factors: Array  #: (G, n_x p, n_x p) Cholesky factors of the precision over the prior's
    means: Array  #: (G, n_x p) of the factored coefficients
    sizes: Array  #: (n_x,) root mean square of the scaled rate in the record
    sigma: Array  #: (n_x,) deviation of the noise's innovations, in scaled deviations
    autocorrelation: Array  #: (n_x,) of the noise from measurement to measurement
    used: float  #: share of the record's pieces that the free runs follow
    settings: Thresholds

    __repr__ = short_repr

    def _coefficients(self, k: int, z: Array) -> Array:
        solved = np.linalg.solve(self.factors[k].T, z)
        return (self.deviations[k] * solved).reshape(len(self.sizes), -1)

    @property
    def mean(self) -> Array:
        """The expected coefficients (n_x, p)."""
        return np.asarray(sum(w * self._coefficients(k, self.means[k])
                              for k, w in enumerate(self.weights) if w > 1e-6))

    def draw(self, count: int, seed: int = 0) -> tuple[PlausiblePlant, ...]:
        """Draw plants that the record cannot tell from the estimated one."""
        rng = np.random.default_rng(seed)
        grid = rng.choice(len(self.weights), count, p=self.weights)
        noise = rng.standard_normal((count, self.means.shape[1]))
        return tuple(PlausiblePlant(self.drift, Correction(
            self.drift.box, self.basis, self._coefficients(k, self.means[k] + noise[i]).T))
            for i, k in enumerate(grid))

    def shares(self) -> Mapping[str, float]:
        """
        Return the size of the expected correction by its group, as shares of the motion.

        The groups have the names of the members of :class:`.missing_structure.Cause`.
        """
        of_x, of_u = self.basis.degrees
        squares = np.sum((self.mean / self.sizes[:, None]) ** 2, axis=0)
        groups = {'input_nonlinear': (of_u > 1) & (of_x == 0),
                  'input_times_state': (of_u == 1) & (of_x > 0),
                  'input_nonlinear_times_state': (of_u > 1) & (of_x > 0),
                  'state': of_u == 0}
        return {name: float(np.sqrt(squares[group & ~self.own].sum()))
                for name, group in groups.items()}


def correction_posterior(drift: Drift, own: OwnTerms, episodes: Sequence[Episode],
                         settings: Thresholds = DEFAULTS, *, seed: int = 0) -> CorrectionPosterior:
    """
    Return the distribution of the corrections of a drift, given the episodes of a record.

    :param own: terms that the drift has itself.
    :param seed: of the choice of segments of a long record.
    :raises ValueError: where the free runs of the drift follow no part of the record.
    """
    box = drift.box
    n = len(box.states)
    degree = settings.degree_of_one_state if n == 1 else settings.degree
    basis = LegendreBasis.of(n, len(box.inputs), max(degree, 1 + own.degree),
                             settings.most_coefficients)
    parts = _pieces(drift, episodes, settings)
    width = n * len(basis.exponents)
    per_sample = n * (width + n)
    order = np.random.default_rng(seed).permutation(len(parts))
    room = np.cumsum([per_sample * len(parts[k]) for k in order]) <= settings.most_numbers
    room[0] = True
    segments = Segments.of([parts[k] for k in np.sort(order[room])], longest_step(parts))
    pieces, followed = _linearised(drift, basis, segments, settings)
    if not pieces:
        raise ValueError('the free runs of the estimated drift follow no part of the record: '
                         'record an input or a state that is missing')
    xi, v = _samples(drift, segments)
    sizes = np.sqrt(np.mean(drift.scaled_rate(xi, v) ** 2, axis=0))
    own_terms = own.among(basis)
    deviations = _prior(basis, own_terms, sizes, settings)
    sigma = np.sqrt(np.array([np.mean(np.concatenate([one.residuals[i] for one in pieces]) ** 2)
                              if any(len(one.residuals[i]) for one in pieces) else 1.0
                              for i in range(n)]))
    sigma, rho, c = np.maximum(sigma, settings.least_noise), np.zeros(n), np.zeros(width)
    for number in range(settings.noise_rounds):
        if number:
            sigma, rho = _noise(pieces, c, settings)
        G, b = _normal_equations(pieces, sigma, rho, width)
        logs, factors, means = [], [], []
        for P in deviations:
            M = P[:, None] * G * P
            # rounding errors are relative to the largest element, and may exceed the 1
            L = np.linalg.cholesky(M + (1.0 + 1e-12 * np.max(np.diag(M))) * np.eye(width))
            z = np.linalg.solve(L, P * b)
            logs.append(0.5 * z @ z - np.log(np.diag(L)).sum())
            factors.append(L)
            means.append(z)
        best = int(np.argmax(logs))
        c = deviations[best] * np.linalg.solve(factors[best].T, means[best])
    weights = np.exp(np.array(logs) - max(logs))
    return CorrectionPosterior(drift, basis, own_terms, weights / weights.sum(), deviations,
                               np.array(factors), np.array(means), sizes, sigma, rho, followed,
                               settings)


class _Piece(NamedTuple):
    """Residuals of a free run and their derivatives, measured state by measured state."""

    residuals: tuple[Array, ...]  #: of each state (N_i,)
    sensitivities: tuple[Array, ...]  #: (N_i, n_x p) to the coefficients
    starts: tuple[Array, ...]  #: (N_i, n_x) to the start


def _pieces(drift: Drift, episodes: Sequence[Episode], settings: Thresholds) -> list[Episode]:
    """Cut episodes until free runs err little more than short ones do."""
    def error(parts: Sequence[Episode]) -> float:
        scale = drift.box.states.scale
        found = prediction_error(drift.rate, Segments.of(parts, longest_step(parts)), scale)
        return float(np.sqrt(np.mean((found / scale) ** 2)))

    shortest = settings.shortest_piece
    least, length, parts = error(cut(episodes, shortest)), max(map(len, episodes)), [*episodes]
    while length >= 2 * shortest and not error(parts) <= settings.growth * least:
        length //= 2
        parts = [one for one in cut(episodes, length) if len(one) >= shortest // 2]
    return parts


def _samples(drift: Drift, segments: Segments) -> tuple[Array, Array]:
    """Return states and inputs of the steps of segments, in deviations."""
    inside = segments.steps > 0.0
    return (drift.box.states.to_deviation(segments.x[:-1])[inside],
            drift.box.inputs.to_deviation(segments.u)[inside])


def _linearised(drift: Drift, basis: LegendreBasis, segments: Segments, settings: Thresholds
                ) -> tuple[list[_Piece], float]:
    """Integrate the free runs with their sensitivities; return those that follow the record."""
    states, n, p = drift.box.states, len(drift.box.states), len(basis.exponents)
    x0 = fitted_starts(drift.rate, segments, states.scale)[0]
    M, width = len(x0), n * p
    y = np.zeros((M, n, 1 + width + n))
    y[..., 0], y[..., 1 + width:] = states.to_deviation(x0), np.eye(n)
    path, disturbance = [y], segments.disturbance / states.scale
    for k in range(len(segments.steps)):
        v = drift.box.inputs.to_deviation(segments.u[k])

        def forcing(xi: Array, v: Array = v) -> Array:
            found = np.zeros((M, n, width + n))
            phi = basis(xi, v)
            for i in range(n):
                found[:, i, i * p:(i + 1) * p] = phi
            return found

        def rate_and_slope(xi: Array, v: Array = v) -> tuple[Array, Array]:
            return drift.scaled_rate(xi, v) + disturbance, drift.scaled_slope(xi, v)

        y = runge_kutta_step(sensitivity_rate(rate_and_slope, forcing), y,
                             segments.steps[k][:, None, None])
        path.append(y)
    runs = np.array(path)  # (K + 1, M, n, 1 + width + n)
    errors = states.to_deviation(segments.x) - runs[..., 0]
    found = []
    for j in range(M):
        rows = [np.flatnonzero(segments.measured[:, j, i]) for i in range(n)]
        residuals = tuple(errors[rows[i], j, i] for i in range(n))
        slopes = tuple(runs[rows[i], j, i, 1:] for i in range(n))
        if all(np.isfinite(one).all() for one in (*residuals, *slopes)) and (
                max(np.abs(one).max(initial=0.0) for one in residuals)
                < settings.largest_residual):
            found.append(_Piece(residuals, *(tuple(one[:, part] for one in slopes) for part in (
                slice(width), slice(width, None)))))
    return found, len(found) / M


def _prior(basis: LegendreBasis, own: NDArray[np.bool_], sizes: Array, settings: Thresholds
           ) -> Array:
    """Return the prior deviations (G, n_x p) for each value of tau and q."""
    order = basis.exponents.sum(axis=1)
    return np.array([
        np.concatenate([size * np.where(own, settings.own_deviation, tau * q ** (order - 2.0))
                        for size in sizes])
        for tau, q in itertools.product(
            np.geomspace(settings.least_deviation, 1.0, settings.deviations), settings.decays)])


def _noise(pieces: Sequence[_Piece], c: Array, settings: Thresholds) -> tuple[Array, Array]:
    """Return deviation and autocorrelation (n_x,) of the noise that a correction leaves."""
    n = len(pieces[0].residuals)
    left: list[list[Array]] = [[] for _ in range(n)]
    for piece in pieces:
        rest = [r - S @ c for r, S in zip(piece.residuals, piece.sensitivities, strict=True)]
        d = np.linalg.lstsq(np.vstack(piece.starts), np.concatenate(rest), rcond=None)[0]
        for i in range(n):
            left[i].append(rest[i] - piece.starts[i] @ d)
    low, high = settings.autocorrelation
    sigma, rho = np.full(n, settings.least_noise), np.zeros(n)
    for i, runs in enumerate(left):
        count = sum(map(len, runs))
        if not count:
            continue
        a0, a1, a2 = (sum(float(r[k:] @ r[:len(r) - k]) for r in runs)
                      / max(1, sum(max(len(r) - k, 0) for r in runs)) for k in range(3))
        if a1 > low * a0:
            # white noise added to a coloured one lowers r1 / r0, but not r2 / r1
            second = a2 / a1 if a1 > 2.0 * low * a0 else 0.0
            rho[i] = np.clip(max(a1 / a0, second), 0.0, high)
        innovations = np.concatenate([r[1:] - rho[i] * r[:-1] for r in runs])
        sigma[i] = max(float(np.sqrt(np.mean(innovations ** 2))) if len(innovations) else 0.0,
                       settings.least_noise)
    return sigma, rho


def _normal_equations(pieces: Sequence[_Piece], sigma: Array, rho: Array, width: int
                      ) -> tuple[Array, Array]:
    """Return G (n_x p, n_x p) and b (n_x p,) of least squares, after the starts are fitted."""
    G, b = np.zeros((width, width)), np.zeros(width)

    def whitened(values: Sequence[Array]) -> Array:
        return np.concatenate([np.concatenate(
            (np.sqrt(1.0 - rho[i] ** 2) * a[:1], a[1:] - rho[i] * a[:-1])) / sigma[i]
            for i, a in enumerate(values)])

    for piece in pieces:
        r, S = whitened(piece.residuals), whitened(piece.sensitivities)
        Q = np.linalg.qr(whitened(piece.starts))[0]
        r, S = r - Q @ (Q.T @ r), S - Q @ (Q.T @ S)
        G += S.T @ S
        b += S.T @ r
    return G, b
