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

"""Growth of a lift one coordinate at a time: the start from which training does not collapse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from koopman_ros.lifting.levenberg_marquardt import minimise, Status
from koopman_ros.lifting.residuals import Layout, lift, Problem
import numpy as np
import torch
from torch import Tensor

# Called after every step with (n_z, iteration, cost); True ends the training.
Monitor = Callable[[int, int, float], bool]


@dataclass(frozen=True)
class Recipe:
    """
    How a lift is grown.

    :param n_z: number of lifted coordinates.
    :param identity: whether z starts with the state.
    :param hidden_first: tanh units of the first free coordinate.
    :param hidden_more: tanh units added with each further coordinate.
    :param whitening: weight of the residual that keeps E[z z'] near the identity.
    :param ridge: ridge weight in the fit that starts a new coordinate.
    :param max_iterations: limit of Levenberg-Marquardt steps for each coordinate.
    """

    n_z: int
    identity: bool = True
    hidden_first: int = 8
    hidden_more: int = 3
    whitening: float = 1.0
    ridge: float = 1e-6
    max_iterations: int = 1000

    def __post_init__(self) -> None:
        if self.n_z < 1:
            raise ValueError(f'n_z must be at least 1, got {self.n_z}')
        if self.hidden_first < 1 or self.hidden_more < 0:
            raise ValueError(f'hidden units must be positive, got {self.hidden_first} first and '
                             f'{self.hidden_more} more')


@dataclass(frozen=True)
class Grown:
    """
    A trained parameter vector.

    :param layout: its sizes.
    :param theta: (p,) parameters.
    :param status: how the last minimisation ended.
    :param iterations: Levenberg-Marquardt steps over all coordinates.
    """

    layout: Layout
    theta: Tensor
    status: Status
    iterations: int


def grow(x: Tensor, f: Tensor, recipe: Recipe, seed: int, monitor: Monitor | None = None
         ) -> Grown:
    """
    Train a lift by adding coordinates one at a time, each followed by Levenberg-Marquardt.

    A new coordinate starts as a ridge fit of the product of eigenfunctions that the present
    coordinates span least (products of eigenfunctions are eigenfunctions themselves), on hidden
    units of which a few are new and random.

    :param x: (N, n_x) scaled deviations from the fixed point.
    :param f: (N, n_x) scaled drift dx/dt - B u, zero at the fixed point.
    :param recipe: what to grow.
    :param seed: seed of the random hidden units.
    :param monitor: progress, and the way to end early.
    """
    n_x = x.shape[1]
    generator = torch.Generator().manual_seed(seed)
    layout = Layout(n_x, n_x if recipe.identity else 0, 0, recipe.identity)
    empty = x.new_zeros
    W, b, V = empty((0, n_x)), empty(0), empty((0, 0))
    A = _drift_matrix(x, f) if recipe.identity else empty((0, 0))
    grown = Grown(layout, layout.join(W, b, V, A), Status.CONVERGED, 0)
    for n_z in range(layout.n_z + 1, recipe.n_z + 1):
        count = recipe.hidden_more if W.shape[0] else recipe.hidden_first
        target = _least_spanned_product(grown, x, f)
        W = torch.cat([W, _xavier(count, n_x, generator).to(x)])
        b = torch.cat([b, 0.5 * torch.randn(count, generator=generator, dtype=x.dtype).to(x)])
        V = torch.cat([V, empty((V.shape[0], count))], 1)
        V = torch.cat([V, _ridge_fit(x, W, b, target, recipe.ridge)])
        layout = Layout(n_x, n_z, W.shape[0], recipe.identity)
        start = layout.join(W, b, V, empty((n_z, n_z)))
        lifted = lift(layout, start, x, f, derivatives=False)
        start = layout.join(W, b, V, _drift_matrix(lifted.z, lifted.dz))
        minimum = minimise(
            Problem(layout, x, f, recipe.whitening).evaluate, start,
            max_iterations=recipe.max_iterations,
            interrupted=None if monitor is None else partial(monitor, n_z))
        grown = Grown(layout, minimum.theta, minimum.status,
                      grown.iterations + minimum.iterations)
        W, b, V, _ = layout.split(minimum.theta)
        if minimum.status in (Status.INTERRUPTED, Status.STALLED):
            break
    return grown


def _xavier(rows: int, columns: int, generator: torch.Generator) -> Tensor:
    """Draw random weights with the variance of Glorot and Bengio (2010)."""
    spread = (2.0 / (rows + columns)) ** 0.5
    return spread * torch.randn((rows, columns), generator=generator, dtype=torch.float64)


def _drift_matrix(z: Tensor, dz: Tensor) -> Tensor:
    """Solve dz = A z for A by linear least squares."""
    return _least_squares(z, dz).T


def _least_squares(a: Tensor, b: Tensor) -> Tensor:
    """Solve a s = b for s (n, k), of least norm where a (N, n) is short of rank."""
    # not torch.linalg.lstsq: its default driver starts from uninitialised memory, so that the
    # same data give other bits and at times a wrong rank
    # (https://github.com/pytorch/pytorch/issues/187411)
    return torch.linalg.pinv(a) @ b


def _ridge_fit(x: Tensor, W: Tensor, b: Tensor, target: Tensor, ridge: float) -> Tensor:
    """Fit `target` (N,) by tanh(W x + b) - tanh(b); return the weights as a row (1, h)."""
    features = torch.tanh(x @ W.T + b) - torch.tanh(b)
    gram = features.T @ features / len(x) + ridge * torch.eye(len(b)).to(x)
    return torch.linalg.solve(gram, features.T @ target / len(x))[None, :]


def _least_spanned_product(grown: Grown, x: Tensor, f: Tensor) -> Tensor:
    """
    Return the product of slow eigenfunctions that the lift spans least, with unit variance.

    :return: (N,) its component orthogonal to the present coordinates.
    """
    if grown.layout.n_z == 0:
        values, vectors = torch.linalg.eig(_drift_matrix(x, f).T)
        z = x
    else:
        values, vectors = torch.linalg.eig(grown.layout.split(grown.theta)[3].T)
        z = lift(grown.layout, grown.theta, x, f, derivatives=False).z
    slowest = torch.argsort(values.real, descending=True)[:max(2, x.shape[1])]
    functions = z.to(values.dtype) @ vectors[:, slowest]
    basis = z if grown.layout.n_z else z[:, :0]
    # degree by degree, so that the slow, smooth products come first
    for degree in range(2 if grown.layout.n_z else 1, grown.layout.n_z + 3):
        best, best_share = None, 0.0
        for exponents in _exponents(functions.shape[1], degree):
            product = torch.ones(len(x), dtype=functions.dtype, device=x.device)
            for i, exponent in enumerate(exponents):
                product = product * functions[:, i] ** exponent
            for part in (product.real, product.imag):
                scale = part.square().mean().sqrt()
                if scale < 1e-12:
                    continue
                part = part / scale
                if basis.shape[1]:
                    part = part - basis @ _least_squares(basis, part[:, None])[:, 0]
                share = float(part.square().mean())
                if share > best_share:
                    best, best_share = part, share
        if best is not None and best_share > 1e-6:
            return best / best_share ** 0.5
    raise ValueError('no new coordinate can be started: the samples are spanned by the present '
                     'lift; use a smaller n_z or samples over a wider range')


def _exponents(n: int, degree: int) -> list[tuple[int, ...]]:
    """List the exponents of all products of n functions with the given total degree."""
    grid = np.indices((degree + 1,) * n).reshape(n, -1).T
    return [tuple(int(i) for i in row) for row in grid if row.sum() == degree]
