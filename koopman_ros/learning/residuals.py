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

"""The stacked residuals by which a lift is learned, with their hand-derived Jacobian, in torch."""

from __future__ import annotations

from dataclasses import dataclass, replace

from koopman_ros.learning.network import Layout, Parameters, Pass
import torch
from torch import Tensor


@dataclass(frozen=True)
class Data:
    """
    Samples that a lift is learned from, in scaled deviations from the nominal point.

    :param x: (N, n_x) states, float64.
    :param f: (N, n_x) rates dx/dt, less B u where B is known.
    :param u: (N, n_u) inputs whose B is to be learned, or None where it is known.
    """

    x: Tensor
    f: Tensor
    u: Tensor | None = None

    def drift(self, B: Tensor | None) -> Tensor:
        """Return the rates without what the inputs do, (N, n_x)."""
        return self.f if B is None or self.u is None else self.f - self.u @ B.T

    def part(self, start: int, length: int) -> Data:
        """Return some consecutive samples."""
        rows = slice(start, start + length)
        return Data(self.x[rows], self.f[rows], None if self.u is None else self.u[rows])

    def __len__(self) -> int:
        return len(self.x)


@dataclass(frozen=True)
class NormalEquations:
    """
    Cost 0.5 ||r||^2 with gradient J^T r and Gauss-Newton matrix J^T J of stacked residuals.

    :param cost: half the sum of squares.
    :param gradient: (p,), or None when only the cost was asked for.
    :param matrix: (p, p), or None likewise.
    """

    cost: float
    gradient: Tensor | None = None
    matrix: Tensor | None = None


@dataclass(frozen=True)
class ResidualWeights:
    """
    Weights of the residuals beside that of the dynamics, whose weight is 1.

    :param whitening: of E[z z'] - I, 0 to leave it out.
    :param decoder: of x - D(N(x)), the paper's lambda; 0 to leave it out.
    """

    whitening: float = 0.0
    decoder: float = 0.0


@dataclass(frozen=True)
class Problem:
    """
    Least-squares problem of a lift on data: 0.5 times the sum of three squared residuals.

    - *Dynamics*: J_N(x) (dx/dt - B u) - A N(x), root mean square over the samples (paper's
      objective for control-affine systems).
    - *Whitening*: E[z z'] - I. It rules out the collapse of two coordinates into one, which the
      other terms do not see. Entries of identity coordinates alone are constants and left out.
    - *Decoder*: x - D(N(x)), root mean square over the samples, D a network of one hidden layer
      (paper's decoder term).

    Sums run over chunks of the samples, so that memory does not grow with their number.

    :param layout: sizes of the lift.
    :param data: the samples.
    :param weights: weights of the residuals.
    :param chunk: samples at a time; by default as many as keep the residual Jacobian in 2 MiB,
        the cache of a core.
    """

    layout: Layout
    data: Data
    weights: ResidualWeights
    chunk: int = 0

    def __post_init__(self) -> None:
        if self.layout.n_u and self.data.u is None:
            raise ValueError('the inputs are needed to learn B')
        if self.weights.decoder and not self.layout.decoder:
            raise ValueError('a decoder weight needs a decoder network')
        if not self.chunk:
            rows = self.layout.n_z + self.layout.n_x * bool(self.layout.decoder)
            floats = rows * self.layout.size
            object.__setattr__(self, 'chunk', max(64, (1 << 18) // floats))

    def with_weights(self, weights: ResidualWeights) -> Problem:
        """Return the same problem with other weights."""
        return replace(self, weights=weights)

    def evaluate(self, theta: Tensor, *, derivatives: bool) -> NormalEquations:
        """Accumulate the normal equations over chunks of the data."""
        layout, N = self.layout, len(self.data)
        parameters = layout.split(theta)
        n_z, p = layout.n_z, layout.size
        cost = theta.new_zeros(())
        moment = theta.new_zeros((n_z, n_z))
        gradient, matrix = theta.new_zeros(p), theta.new_zeros((p, p))
        moment_rate = theta.new_zeros((n_z, n_z, p))
        for start in range(0, N, self.chunk):
            data = self.data.part(start, self.chunk)
            lifted = Pass(layout, parameters, data.x, data.drift(parameters.B))
            blocks = [(lifted.z_rate - lifted.z @ parameters.A.T,
                       _dynamics_jacobian(layout, parameters, data, lifted)
                       if derivatives else None)]
            if self.weights.decoder:
                blocks.append(_decoder_block(
                    layout, parameters, data, lifted, self.weights.decoder ** 0.5, derivatives))
            for r, J in blocks:
                cost += 0.5 * torch.sum(r * r) / N
                if J is not None:
                    J = J.view(-1, p)
                    gradient += J.T @ r.reshape(-1) / N
                    matrix.addmm_(J.T, J, alpha=1.0 / N)
            if self.weights.whitening:
                moment += lifted.z.T @ lifted.z / N
                if derivatives:
                    _add_moment_rate(moment_rate, layout, parameters, lifted, N)
        if self.weights.whitening:
            r, J = _whitening_block(layout, moment, moment_rate, self.weights.whitening)
            cost += 0.5 * torch.sum(r * r)
            if derivatives:
                gradient += J.T @ r
                matrix += J.T @ J
        if not derivatives:
            return NormalEquations(float(cost))
        return NormalEquations(float(cost), gradient, matrix)


def _dynamics_jacobian(layout: Layout, parameters: Parameters, data: Data, lifted: Pass
                       ) -> Tensor:
    """Differentiate J_N (dx/dt - B u) - A N in the parameters: (N, n_z, p)."""
    A, V, first = parameters.A, parameters.V, layout.n_z - layout.n_free
    at_V, at_A = layout.slices[2 * len(layout.hidden):][:2]
    J = lifted.z.new_zeros((len(data), layout.n_z, layout.size))
    if layout.hidden:
        of_rates = torch.cat([V.new_zeros((first, V.shape[1])), V])
        lifted.pull_back(J, -A[:, first:] @ V, of_rates)
        # r_i holds V_k in -A_ik V_k . features, and in V_k . feature_rates where i is k
        J[:, :, at_V] = torch.einsum(
            'ik,nh->nikh', -A[:, first:], lifted.features).flatten(2)
        for k, row in enumerate(J[:, first:, at_V].unflatten(2, V.shape).unbind(2)):
            row[:, k] += lifted.feature_rates
    at_rows = J[:, :, at_A].unflatten(2, A.shape)
    for i in range(layout.n_z):
        at_rows[:, i, i] = -lifted.z
    if layout.n_u and data.u is not None:
        at_B = layout.slices[2 * len(layout.hidden) + 2]
        J[:, :, at_B] = -torch.einsum('nim,nk->nimk', lifted.jacobian(), data.u).flatten(2)
    return J


def _decoder_block(layout: Layout, parameters: Parameters, data: Data, lifted: Pass,
                   weight: float, derivatives: bool) -> tuple[Tensor, Tensor | None]:
    """Evaluate weight (x - D(N(x))), (N, n_x), and differentiate it: (N, n_x, p)."""
    assert parameters.decoder is not None
    W, b, V, c = parameters.decoder
    t = torch.tanh(torch.addmm(b, lifted.z, W.T))
    r = weight * (data.x - torch.addmm(c, t, V.T))
    if not derivatives:
        return r, None
    slope = 1.0 - t * t
    to_input = -weight * V * slope[:, None, :]  # (N, n_x, g)
    J = r.new_zeros((len(data), layout.n_x, layout.size))
    at_W, at_b, at_V, at_c = layout.slices[-4:]
    J[:, :, at_W] = torch.einsum('nmg,nz->nmgz', to_input, lifted.z).flatten(2)
    J[:, :, at_b] = to_input
    for m in range(layout.n_x):
        J[:, m, at_V].unflatten(1, V.shape)[:, m] = -weight * t
        J[:, m, at_c][:, m] = -weight
    if layout.hidden:
        to_free = (to_input @ W)[:, :, layout.n_z - layout.n_free:]
        lifted.pull_back(J, to_free @ parameters.V, None)
        J[:, :, layout.slices[2 * len(layout.hidden)]] = torch.einsum(
            'nmk,nh->nmkh', to_free, lifted.features).flatten(2)
    return r, J


def _add_moment_rate(moment_rate: Tensor, layout: Layout, parameters: Parameters, lifted: Pass,
                     N: int) -> None:
    """Add a chunk's share of E[z_a dz_b/dtheta] to moment_rate (n_z, n_z, p)."""
    if not layout.hidden:
        return
    V, first = parameters.V, layout.n_z - layout.n_free
    # V sits behind the hidden layers, the rest of the parameters does not move z
    place = layout.slices[2 * len(layout.hidden)]
    z_rate = lifted.z.new_zeros((len(lifted.z), layout.n_free, place.start))
    lifted.pull_back(z_rate, V, None)
    moment_rate[:, first:, :place.start] += torch.einsum('na,nbp->abp', lifted.z, z_rate) / N
    by_features = lifted.z.T @ lifted.features / N
    for k in range(layout.n_free):
        moment_rate[:, first + k, place].unflatten(1, V.shape)[:, k] += by_features


def _whitening_block(layout: Layout, moment: Tensor, moment_rate: Tensor, weight: float
                     ) -> tuple[Tensor, Tensor]:
    """Evaluate the whitening residual and its Jacobian from E[z z'] and E[z dz'/dtheta]."""
    i, j = torch.triu_indices(layout.n_z, layout.n_z, device=moment.device)
    varies = j >= layout.n_z - layout.n_free
    i, j = i[varies], j[varies]
    diagonal = (i == j).to(moment)
    # an off-diagonal entry stands twice in the matrix
    scale = torch.sqrt(weight * (2.0 - diagonal))
    return (scale * (moment[i, j] - diagonal),
            scale[:, None] * (moment_rate[i, j] + moment_rate[j, i]))
