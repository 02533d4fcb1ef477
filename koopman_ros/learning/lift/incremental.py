# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Incremental training of a lift, one coordinate at a time, which keeps them from collapsing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import itertools
import math

import torch
from torch import Tensor

from koopman_ros.learning.lift.levenberg_marquardt import minimise, MinimumStatus
from koopman_ros.learning.lift.network import Layout, Parameters, Pass
from koopman_ros.learning.lift.residuals import LiftProblem, ResidualWeights, ScaledSamples

_DECODER_WEIGHTS = (0.1, 1e-4)  # of its residual (the paper's lambda), one after the other
_RIDGE = 1e-6  # weight in the fits that start a new coordinate and a decoder
_STILL = 1e-6  # root mean square, in the scale of the states, of a coordinate that stands still

# Called after every step with (iteration, cost); True ends the minimisation.
Monitor = Callable[[int, float], bool]


@dataclass(frozen=True)
class TrainedLift:
    """A trained parameter vector."""

    layout: Layout  #: its sizes
    theta: Tensor  #: (p,) parameters
    status: MinimumStatus  #: how the last minimisation ended
    decrease: float = math.nan  #: see :class:`LeastSquaresResult`
    drift_alone: bool = False  #: whether it is the lift z = x, for a read-out of hidden units
    iterations: int = 0  #: steps of the minimisations together


@dataclass(frozen=True)
class IncrementalTraining:
    """
    The default recipe: coordinates are added one at a time, each from several starts.

    A new coordinate starts as a ridge fit of the product of eigenfunctions that the present
    coordinates span least (products of eigenfunctions are eigenfunctions themselves), on hidden
    units of which a few are new and random. Levenberg-Marquardt then moves all parameters.
    """

    n_z: int  #: number of lifted coordinates
    identity: bool = True  #: whether z starts with the state
    hidden_first: int = 8  #: hidden units of the first free coordinates
    hidden_more: int = 3  #: units added with each further coordinate
    whitening: float = 1.0  #: weight of the residual that keeps E[z z'] near the identity
    #: further such weights: starts take all of them in turn, and validation episodes choose
    other_whitenings: tuple[float, ...] = ()
    #: units of the decoder network, which holds on to the states where they are no coordinates
    #: themselves; None for 8 with two or more states in a free lift and none otherwise
    decoder: int | None = None
    max_iterations: int = 1000  #: limit of Levenberg-Marquardt steps for each coordinate
    tolerance: float = 1e-3  #: relative decrease of the cost over 20 steps taken as convergence
    #: for unstable plants: weight of the input in the regulator of the linear fit, under whose
    #: feedback the lift is learned, of whitened states; None to learn it of the plant as it is
    pre_feedback: float | None = None

    def __post_init__(self) -> None:
        if self.n_z < 1:
            raise ValueError(f'n_z must be at least 1, got {self.n_z}')
        if self.hidden_first < 1 or self.hidden_more < 0:
            raise ValueError(f'hidden units must be positive, got {self.hidden_first} first and '
                             f'{self.hidden_more} more')
        if min(self.whitening, *self.other_whitenings, math.inf) < 0.0:
            raise ValueError('whitening weights must be at least 0, got '
                             f'{(self.whitening, *self.other_whitenings)}')
        if self.pre_feedback is not None and not self.pre_feedback > 0.0:
            raise ValueError('pre_feedback, the weight of the input, must be above 0 or None, got '
                             f'{self.pre_feedback}')

    def of_start(self, number: int) -> IncrementalTraining:
        """Return the recipe of one of the starts of a round, by its number."""
        weights = (self.whitening, *self.other_whitenings)
        return replace(self, whitening=weights[number % len(weights)], other_whitenings=())

    def rounds(self, n_x: int) -> tuple[int, ...]:
        """Return the n_z after each round of starts; ValueError when the states need more."""
        if self.n_z < n_x + self.identity:
            raise ValueError(
                f'n_z = {self.n_z} is too small for {n_x} states: set lifted_dimension to '
                f'{n_x + self.identity} or more, or model_class to linear')
        return tuple(range(n_x + self.identity, self.n_z + 1))

    def start(self, data: ScaledSamples, n_z: int, parent: TrainedLift | None, seed: int,
              monitor: Monitor | None = None) -> TrainedLift:
        """
        Extend the lift of the round before, None in the first one, to `n_z` coordinates.

        One with n_z coordinates is only fitted to the samples.
        """
        if parent is not None and parent.layout.n_z == n_z:
            layout, theta = parent.layout, parent.theta
        else:
            layout, theta = self._extended(data, n_z, parent or self.root(data), seed)
        iterations = 0
        for weight in _DECODER_WEIGHTS if layout.decoder else (0.0,):
            problem = LiftProblem(layout, data, ResidualWeights(self.whitening, weight))
            minimum = minimise(
                problem.add_residuals, theta, max_iterations=self.max_iterations,
                tolerance=self.tolerance, monitor=monitor)
            theta, iterations = minimum.theta, iterations + minimum.iterations
            if minimum.status is MinimumStatus.INTERRUPTED:
                break
        return TrainedLift(layout, theta, minimum.status, minimum.decrease, iterations=iterations)

    def root(self, data: ScaledSamples) -> TrainedLift:
        """Return the lift without hidden units that growth starts from."""
        n_x = data.x.shape[1]
        n_z = n_x if self.identity else 0
        default = 8 if n_x > 1 and not self.identity else 0
        layout = Layout(n_x, n_z, 0, self.identity, 0 if data.u is None else data.u.shape[1],
                        default if self.decoder is None else self.decoder)
        drift, B = linear_drift(data)
        zeros = layout.split(data.x.new_zeros(layout.size))
        theta = layout.join(replace(zeros, A=drift if self.identity else zeros.A, B=B))
        return TrainedLift(layout, theta, MinimumStatus.CONVERGED)

    def planted(self, data: ScaledSamples, W: Tensor, b: Tensor, V: Tensor) -> TrainedLift:
        """
        Return the lift of a network that was learned elsewhere, its A fitted to the samples.

        :param W: (h, n_x) and b (h,) of the hidden layer, of the states as the samples have them.
        :param V: (n_free, h) output weights; each coordinate is scaled to variance 1 here.
        :raises ValueError: for a coordinate that is constant on the samples.
        """
        root = self.root(data)
        n_z = root.layout.n_z + len(V)
        layout = replace(root.layout, n_z=n_z, hidden=len(b))
        initial = Parameters(
            W, b, V, data.x.new_zeros((n_z, n_z)), root.layout.split(root.theta).B)
        size = _lifted(layout, initial, data).z[:, n_z - len(V):].square().mean(0).sqrt()
        if not bool((size > _STILL).all()):
            raise ValueError('a coordinate of the initial lift is constant on the samples: use '
                             'that of a plant in the same range, or none')
        initial = replace(initial, V=V / size[:, None])
        theta = _with_linear_fits(layout, initial, data, torch.Generator().manual_seed(0))
        return TrainedLift(layout, theta, MinimumStatus.CONVERGED)

    def _extended(self, data: ScaledSamples, n_z: int, parent: TrainedLift, seed: int
                  ) -> tuple[Layout, Tensor]:
        """Add the coordinates up to `n_z`, started from the least spanned product."""
        old = parent.layout
        generator = torch.Generator().manual_seed(seed)
        given = old.split(parent.theta)
        # the coordinates that there are do not depend on the new units
        count = self.hidden_more if old.hidden else self.hidden_first
        W = torch.cat([given.W, xavier(count, old.n_x, generator).to(data.x)])
        b = torch.cat([given.b, 0.5 * torch.randn(count, generator=generator,
                                                  dtype=torch.float64).to(data.x)])
        layout = replace(old, n_z=n_z, hidden=len(b))
        zero = data.x.new_zeros
        initial = Parameters(W, b, zero((layout.n_free, layout.hidden)), zero((n_z, n_z)), given.B)
        features = _lifted(layout, initial, data).features
        targets = (_least_spanned_product(parent, data)[:, None]
                   if n_z == old.n_z + 1 else _whitened(data.x))
        initial = replace(initial, V=torch.cat([
            torch.cat([given.V, zero((len(given.V), count))], 1),
            _ridge_fit(features, targets).T]))
        return layout, _with_linear_fits(layout, initial, data, generator)


def _lifted(layout: Layout, parameters: Parameters, data: ScaledSamples) -> Pass:
    return Pass(layout, parameters, data.x, data.drift(parameters.B))


def _with_linear_fits(layout: Layout, parameters: Parameters, data: ScaledSamples,
                      generator: torch.Generator) -> Tensor:
    """Fit A, and the decoder where there is one; return the vector of all parameters."""
    lifted = _lifted(layout, parameters, data)
    decoder = (_decoder_start(lifted.z, data.x, layout.decoder, generator)
               if layout.decoder else None)
    return layout.join(replace(parameters, A=least_squares(lifted.z, lifted.z_rate).T,
                               decoder=decoder))


def linear_drift(data: ScaledSamples) -> tuple[Tensor, Tensor | None]:
    """Fit dx/dt = A x + B u: A (n_x, n_x), and B (n_x, n_u) where inputs are given, else None."""
    n_x = data.x.shape[1]
    if data.u is None:
        return least_squares(data.x, data.f).T, None
    both = least_squares(torch.cat([data.x, data.u], 1), data.f).T
    return both[:, :n_x].contiguous(), both[:, n_x:].contiguous()


def least_squares(a: Tensor, b: Tensor) -> Tensor:
    """Solve a s = b for s (n, k), of least norm where a (N, n) is short of rank."""
    # not torch.linalg.lstsq: its default driver starts from uninitialised memory, so that the
    # same data give other bits and at times a wrong rank
    # (https://github.com/pytorch/pytorch/issues/187411)
    return torch.linalg.pinv(a) @ b


def xavier(rows: int, columns: int, generator: torch.Generator) -> Tensor:
    """Draw random weights with the variance of Glorot and Bengio (2010)."""
    spread = (2.0 / (rows + columns)) ** 0.5
    return spread * torch.randn((rows, columns), generator=generator, dtype=torch.float64)


def _ridge_fit(features: Tensor, targets: Tensor) -> Tensor:
    """Fit `targets` (N, k) by features (N, h); return the weights (h, k)."""
    N, h = features.shape
    gram = features.T @ features / N + _RIDGE * torch.eye(h).to(features)
    return torch.linalg.solve(gram, features.T @ targets / N)


def _whitened(x: Tensor) -> Tensor:
    """Return linear combinations of the states (N, n_x) with E[z z'] = I."""
    factor = torch.linalg.cholesky(x.T @ x / len(x))
    return torch.linalg.solve_triangular(factor, x.T, upper=False).T


def _decoder_start(z: Tensor, x: Tensor, units: int, generator: torch.Generator
                   ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Draw a decoder's hidden units and fit the rest: W (g, n_z), b (g,), V (n_x, g), c (n_x,)."""
    W = xavier(units, z.shape[1], generator).to(z)
    b = 0.5 * torch.randn(units, generator=generator, dtype=torch.float64).to(z)
    features = torch.cat([torch.tanh(z @ W.T + b), z.new_ones((len(z), 1))], 1)
    fit = _ridge_fit(features, x).T.contiguous()
    return W, b, fit[:, :-1].contiguous(), fit[:, -1].contiguous()


def _least_spanned_product(grown: TrainedLift, data: ScaledSamples) -> Tensor:
    """Return the product of slow eigenfunctions that the lift spans least (N,), of variance 1."""
    x, parameters = data.x, grown.layout.split(grown.theta)
    if grown.layout.n_z == 0:
        values, vectors = torch.linalg.eig(least_squares(x, data.drift(parameters.B)))
        z = x
    else:
        values, vectors = torch.linalg.eig(parameters.A.T)
        z = _lifted(grown.layout, parameters, data).z
    slowest = torch.argsort(values.real, descending=True, stable=True)[:max(2, x.shape[1])]
    functions = z.to(values.dtype) @ vectors[:, slowest]
    basis = z if grown.layout.n_z else z[:, :0]
    # degree by degree, so that the slow, smooth products come first
    for degree in range(2 if grown.layout.n_z else 1, grown.layout.n_z + 3):
        best, best_share = None, 0.0
        for factors in itertools.combinations_with_replacement(
                range(functions.shape[1]), degree):
            product = functions[:, list(factors)].prod(1)
            for part in (product.real, product.imag):
                scale = part.square().mean().sqrt()
                if scale < 1e-12:
                    continue
                part = part / scale
                if basis.shape[1]:
                    part = part - basis @ least_squares(basis, part[:, None])[:, 0]
                share = float(part.square().mean())
                if share > best_share:
                    best, best_share = part, share
        if best is not None and best_share > 1e-6:
            return best / best_share ** 0.5
    raise ValueError('no coordinate can be added: the lift already spans the samples; use '
                     'a smaller n_z or samples over a wider range')
