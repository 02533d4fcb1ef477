# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Growth of a lift one coordinate at a time, which keeps coordinates from collapsing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
import itertools
import math

import torch
from torch import Tensor

from koopman_ros.learning.lift.levenberg_marquardt import minimise, Minimum, MinimumStatus
from koopman_ros.learning.lift.network import check_activation, Layout, Parameters, Pass
from koopman_ros.learning.lift.residuals import LiftProblem, ResidualWeights, ScaledSamples

_STILL = 1e-6  # root mean square, in the scale of the states, of a coordinate that stands still

# Called after every step with (iteration, cost); True ends the minimisation.
Monitor = Callable[[int, float], bool]


@dataclass(frozen=True)
class Grown:
    """A trained parameter vector."""

    layout: Layout  #: its sizes
    theta: Tensor  #: (p,) parameters
    status: MinimumStatus  #: how the last minimisation ended
    decrease: float = math.nan  #: see :class:`Minimum`
    drift_alone: bool = False  #: whether it is the lift z = x, for a read-out of hidden units
    iterations: int = 0  #: steps of the minimisations together


@dataclass(frozen=True)
class Growth:
    """
    The default recipe: coordinates are added one at a time, each from several starts.

    A new coordinate starts as a ridge fit of the product of eigenfunctions that the present
    coordinates span least (products of eigenfunctions are eigenfunctions themselves), on hidden
    units of which a few are new and random. Levenberg-Marquardt then moves all parameters.
    """

    n_z: int  #: number of lifted coordinates
    identity: bool = True  #: whether z starts with the state
    hidden_first: int = 8  #: units of the first free coordinates, in each hidden layer
    hidden_more: int = 3  #: units added with each further coordinate, in each hidden layer
    layers: int = 1  #: number of hidden layers, 1 or 2
    activation: str = 'tanh'  #: ``'tanh'``, ``'sigmoid'``, ``'sine'`` or ``'softplus'``
    whitening: float = 1.0  #: weight of the residual that keeps E[z z'] near the identity
    #: further such weights: starts take all of them in turn, and validation episodes choose
    other_whitenings: tuple[float, ...] = ()
    #: units of the decoder network, which holds on to the states where they are no coordinates
    #: themselves; None for 8 with two or more states in a free lift and none otherwise
    decoder: int | None = None
    #: weight of its residual (the paper's lambda), divided by 1000 for the last steps
    decoder_weight: float = 0.1
    ridge: float = 1e-6  #: ridge weight in the fit that starts a new coordinate
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
        if self.layers not in (1, 2):
            raise ValueError(f'layers must be 1 or 2, got {self.layers}')
        check_activation(self.activation)
        if min(self.whitening, *self.other_whitenings, math.inf) < 0.0:
            raise ValueError('whitening weights must be at least 0, got '
                             f'{(self.whitening, *self.other_whitenings)}')
        if self.pre_feedback is not None and not self.pre_feedback > 0.0:
            raise ValueError('pre_feedback, the weight of the input, must be above 0 or None, got '
                             f'{self.pre_feedback}')

    def of_start(self, number: int) -> Growth:
        """Return the recipe of one of the starts of a round, by its number."""
        weights = (self.whitening, *self.other_whitenings)
        return replace(self, whitening=weights[number % len(weights)], other_whitenings=())

    def rounds(self, n_x: int) -> tuple[int, ...]:
        """Return the n_z after each round of starts; ValueError when the states need more."""
        if self.n_z < n_x + self.identity:
            hint = ' as its first coordinates: use Edmd(degree=1) for a linear model'
            raise ValueError(f'n_z = {self.n_z} is too small for {n_x} states'
                             + (hint if self.identity else ''))
        return tuple(range(n_x + self.identity, self.n_z + 1))

    def start(self, data: ScaledSamples, n_z: int, parent: Grown | None, seed: int,
              monitor: Monitor | None = None) -> Grown:
        """
        Extend the lift of the round before, None in the first one, to `n_z` coordinates.

        One that has so many already is only fitted to the samples.
        """
        if parent is not None and parent.layout.n_z == n_z:
            layout, theta = parent.layout, parent.theta
        else:
            layout, theta = self._extended(data, n_z, parent or self.root(data), seed)
        run = partial(minimise, max_iterations=self.max_iterations, tolerance=self.tolerance,
                      monitor=monitor)
        problem = LiftProblem(layout, data, ResidualWeights(self.whitening,
                                                self.decoder_weight * bool(layout.decoder)))
        minimum: Minimum = run(problem.add_residuals, theta)
        iterations = minimum.iterations
        if layout.decoder and minimum.status is not MinimumStatus.INTERRUPTED:
            last = problem.with_weights(replace(problem.weights,
                                                decoder=1e-3 * self.decoder_weight))
            minimum = run(last.add_residuals, minimum.theta)
            iterations += minimum.iterations
        return Grown(layout, minimum.theta, minimum.status, minimum.decrease,
                     iterations=iterations)

    def root(self, data: ScaledSamples) -> Grown:
        """Return the lift without a network that growth starts from."""
        n_x = data.x.shape[1]
        n_z = n_x if self.identity else 0
        default = 8 if n_x > 1 and not self.identity else 0
        decoder = default if self.decoder is None else self.decoder
        layout = Layout(n_x, n_z, (), self.identity, self.activation,
                        0 if data.u is None else data.u.shape[1], decoder)
        drift, B = linear_drift(data)
        empty = data.x.new_zeros
        network = None if not decoder else (
            empty((decoder, n_z)), empty(decoder), empty((n_x, decoder)), empty(n_x))
        return Grown(layout, layout.join(Parameters(
            (), empty((layout.n_free, 0)), drift if self.identity else empty((0, 0)), B,
            network)), MinimumStatus.CONVERGED)

    def planted(self, data: ScaledSamples, hidden: Sequence[tuple[Tensor, Tensor]], V: Tensor
                ) -> Grown:
        """
        Return the lift of a network that was learned elsewhere, its A fitted to the samples.

        :param hidden: (W, b) of each hidden layer, of the states as the samples have them.
        :param V: (n_free, h) output weights; each coordinate is scaled to variance 1 here.
        :raises ValueError: for a coordinate that stands still on the samples.
        """
        root = self.root(data)
        n_z = root.layout.n_z + len(V)
        layout = replace(root.layout, n_z=n_z, hidden=tuple(len(b) for _, b in hidden))
        given, zero = root.layout.split(root.theta), data.x.new_zeros
        drift = data.drift(given.B)
        begun = Parameters(tuple(hidden), V, zero((n_z, n_z)), given.B)
        plain = replace(layout, decoder=0, n_u=0)
        size = Pass(plain, begun, data.x, drift).z[:, n_z - len(V):].square().mean(0).sqrt()
        if not bool((size > _STILL).all()):
            raise ValueError('a coordinate of the lift that is begun from stands still on the '
                             'samples: begin from that of a plant in the same range, or from '
                             'nothing')
        begun = replace(begun, V=V / size[:, None])
        lifted = Pass(plain, begun, data.x, drift)
        A = least_squares(lifted.z, lifted.z_rate).T
        decoder = None if not layout.decoder else _decoder_start(
            lifted.z, data.x, layout.decoder, torch.Generator().manual_seed(0))
        return Grown(layout, layout.join(replace(begun, A=A, decoder=decoder)),
                     MinimumStatus.CONVERGED)

    def _extended(self, data: ScaledSamples, n_z: int, parent: Grown, seed: int
                  ) -> tuple[Layout, Tensor]:
        """Add the coordinates up to `n_z`, started from what the present ones do not span."""
        old = parent.layout
        generator = torch.Generator().manual_seed(seed)
        given = old.split(parent.theta)
        drift = data.drift(given.B)
        count = self.hidden_more if old.hidden else self.hidden_first
        hidden = _widened(given, old.n_x, count, self.layers, generator)
        layout = replace(old, n_z=n_z, hidden=tuple(len(b) for _, b in hidden))
        zero = data.x.new_zeros
        blank = Parameters(hidden, zero((layout.n_free, layout.hidden[-1])), zero((n_z, n_z)))
        features = Pass(replace(layout, decoder=0, n_u=0), blank, data.x, drift).features
        V = torch.cat([given.V, zero((len(given.V), features.shape[1] - given.V.shape[1]))], 1)
        targets = (_least_spanned_product(parent, data.x, drift)[:, None]
                   if n_z == old.n_z + 1 else _whitened(data.x))
        V = torch.cat([V, _ridge_fit(features, targets, self.ridge).T])
        begun = Parameters(hidden, V, zero((n_z, n_z)), given.B)
        lifted = Pass(layout, begun, data.x, drift)
        A = least_squares(lifted.z, lifted.z_rate).T
        decoder = (_decoder_start(lifted.z, data.x, layout.decoder, generator)
                   if layout.decoder else None)
        return layout, layout.join(replace(begun, A=A, decoder=decoder))


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


def _widened(given: Parameters, n_x: int, count: int, layers: int, generator: torch.Generator
             ) -> tuple[tuple[Tensor, Tensor], ...]:
    """Add `count` random units to each hidden layer; the old ones do not see the new ones."""
    hidden = []
    width, added, like = n_x, 0, given.A
    for i in range(layers):
        W, b = given.hidden[i] if given.hidden else (like.new_zeros((0, width)),
                                                     like.new_zeros(0))
        old = torch.cat([W, W.new_zeros((len(W), added))], 1) if given.hidden else W
        new_W = xavier(count, width, generator).to(like)
        new_b = 0.5 * torch.randn(count, generator=generator, dtype=torch.float64).to(like)
        hidden.append((torch.cat([old, new_W]), torch.cat([b, new_b])))
        width, added = len(b) + count, count
    return tuple(hidden)


def _ridge_fit(features: Tensor, targets: Tensor, ridge: float) -> Tensor:
    """Fit `targets` (N, k) by features (N, h); return the weights (h, k)."""
    N, h = features.shape
    gram = features.T @ features / N + ridge * torch.eye(h).to(features)
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
    fit = _ridge_fit(features, x, 1e-6).T.contiguous()
    return W, b, fit[:, :-1].contiguous(), fit[:, -1].contiguous()


def _least_spanned_product(grown: Grown, x: Tensor, f: Tensor) -> Tensor:
    """Return what the lift spans least of products of slow eigenfunctions (N,), of variance 1."""
    if grown.layout.n_z == 0:
        values, vectors = torch.linalg.eig(least_squares(x, f))
        z = x
    else:
        parameters = grown.layout.split(grown.theta)
        values, vectors = torch.linalg.eig(parameters.A.T)
        z = Pass(grown.layout, parameters, x, f).z
    slowest = torch.argsort(values.real, descending=True)[:max(2, x.shape[1])]
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
    raise ValueError('no new coordinate can be started: the samples are spanned by the present '
                     'lift; use a smaller n_z or samples over a wider range')
