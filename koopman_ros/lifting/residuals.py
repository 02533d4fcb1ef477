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

"""The stacked residuals of the lifted dynamics and their hand-derived Jacobian, in torch."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Layout:
    """
    Sizes of a one-hidden-layer lift and the places of its parameters in one flat vector.

    The vector stacks W (h, n_x), b (h,), V (n_free, h) and A (n_z, n_z), row by row, where
    N(x) = [x; V (tanh(W x + b) - tanh(b))] with identity coordinates and without x otherwise.

    :param n_x: number of states.
    :param n_z: number of lifted coordinates.
    :param hidden: number h of tanh units.
    :param identity: whether z starts with the state.
    """

    n_x: int
    n_z: int
    hidden: int
    identity: bool

    @property
    def n_free(self) -> int:
        """Number of coordinates the network provides."""
        return self.n_z - self.n_x if self.identity else self.n_z

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Number of entries of W, b, V and A."""
        return (self.hidden * self.n_x, self.hidden, self.n_free * self.hidden, self.n_z ** 2)

    def split(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return views of W, b, V and A in the flat vector."""
        W, b, V, A = torch.split(theta, list(self.sizes))
        return (W.view(self.hidden, self.n_x), b, V.view(self.n_free, self.hidden),
                A.view(self.n_z, self.n_z))

    def join(self, W: Tensor, b: Tensor, V: Tensor, A: Tensor) -> Tensor:
        """Stack W, b, V and A into one flat vector."""
        return torch.cat([W.reshape(-1), b, V.reshape(-1), A.reshape(-1)])


@dataclass(frozen=True)
class Lifted:
    """
    Lift and its derivatives at a batch of samples.

    :param z: (N, n_z) N(x).
    :param dz: (N, n_z) J_N(x) f.
    :param dz_dtheta: (N, n_z, p) derivative of dz with respect to (W, b, V, A), or None.
    :param z_dtheta: (N, n_z, p) derivative of z likewise, or None.
    """

    z: Tensor
    dz: Tensor
    z_dtheta: Tensor | None = None
    dz_dtheta: Tensor | None = None


def lift(layout: Layout, theta: Tensor, x: Tensor, f: Tensor, *, derivatives: bool) -> Lifted:
    """
    Evaluate z = N(x) and J_N(x) f, with their derivatives in the parameters on request.

    With a = W x + b, t = tanh a, d = 1 - t^2, e = W f, the free coordinates are
    V (t - tanh b) and their drift V (d e); every derivative below follows by hand.

    :param layout: sizes of the lift.
    :param theta: (p,) parameters.
    :param x: (N, n_x) scaled states.
    :param f: (N, n_x) scaled drift, dx/dt - B u.
    :param derivatives: whether to evaluate the derivatives as well.
    """
    W, b, V, _ = layout.split(theta)
    t, t0 = torch.tanh(x @ W.T + b), torch.tanh(b)
    d, e = 1.0 - t * t, f @ W.T
    dt = t - t0
    z, dz = dt @ V.T, (d * e) @ V.T
    if layout.identity:
        z, dz = torch.cat([x, z], 1), torch.cat([f, dz], 1)
    if not derivatives:
        return Lifted(z, dz)

    N, h, n_x = x.shape[0], layout.hidden, layout.n_x
    first = layout.n_z - layout.n_free
    z_dtheta = torch.zeros((N, layout.n_z, theta.numel()), dtype=x.dtype, device=x.device)
    dz_dtheta = torch.zeros_like(z_dtheta)
    n_W, n_b, _, _ = layout.sizes
    curvature = -2.0 * t * d * e
    # dz_k/dW_jm = V_kj d_j x_m and d(dz_k)/dW_jm = V_kj (curvature_j x_m + d_j f_m)
    per_W = d[:, :, None] * x[:, None, :]
    rate_per_W = curvature[:, :, None] * x[:, None, :] + d[:, :, None] * f[:, None, :]
    rows = V.repeat_interleave(n_x, dim=1)
    z_dtheta[:, first:, :n_W] = rows * per_W.reshape(N, 1, h * n_x)
    dz_dtheta[:, first:, :n_W] = rows * rate_per_W.reshape(N, 1, h * n_x)
    z_dtheta[:, first:, n_W:n_W + n_b] = V * (d - (1.0 - t0 * t0))[:, None, :]
    dz_dtheta[:, first:, n_W:n_W + n_b] = V * curvature[:, None, :]
    for k in range(layout.n_free):
        start = n_W + n_b + k * h
        z_dtheta[:, first + k, start:start + h] = dt
        dz_dtheta[:, first + k, start:start + h] = d * e
    return Lifted(z, dz, z_dtheta, dz_dtheta)


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
class Problem:
    """
    Residuals of a lift on data: J_N f - A N (paper's objective) and whitening.

    The whitening residual keeps E[z z'] near the identity, which rules out the collapse of two
    coordinates into one; entries that only hold identity coordinates are constants and left out.

    :param layout: sizes of the lift.
    :param x: (N, n_x) scaled states, float64.
    :param f: (N, n_x) scaled drift dx/dt - B u, float64.
    :param whitening: weight of the whitening residual, 0 to leave it out.
    :param chunk: samples per block; peak memory grows with it, not with N.
    """

    layout: Layout
    x: Tensor
    f: Tensor
    whitening: float
    chunk: int = 4096

    def evaluate(self, theta: Tensor, *, derivatives: bool) -> NormalEquations:
        """Accumulate the normal equations over chunks of the data."""
        layout, N, p = self.layout, self.x.shape[0], theta.numel()
        n_z, A = layout.n_z, layout.split(theta)[3]
        cost = 0.0
        moment = torch.zeros((n_z, n_z), dtype=theta.dtype, device=theta.device)
        gradient = torch.zeros(p, dtype=theta.dtype, device=theta.device)
        matrix = torch.zeros((p, p), dtype=theta.dtype, device=theta.device)
        moment_dtheta = torch.zeros((n_z, n_z, p), dtype=theta.dtype, device=theta.device)
        for start in range(0, N, self.chunk):
            part = slice(start, start + self.chunk)
            lifted = lift(layout, theta, self.x[part], self.f[part], derivatives=derivatives)
            r = (lifted.dz - lifted.z @ A.T) / N ** 0.5
            cost += 0.5 * float(torch.sum(r * r))
            moment += lifted.z.T @ lifted.z / N
            if derivatives:
                assert lifted.z_dtheta is not None and lifted.dz_dtheta is not None
                J = lifted.dz_dtheta - A @ lifted.z_dtheta
                for i in range(n_z):
                    column = p - n_z * n_z + i * n_z
                    J[:, i, column:column + n_z] -= lifted.z
                J = J.reshape(-1, p) / N ** 0.5
                gradient += J.T @ r.reshape(-1)
                matrix += J.T @ J
                moment_dtheta += torch.einsum('na,nbp->abp', lifted.z, lifted.z_dtheta) / N
        if self.whitening > 0.0:
            first = n_z - layout.n_free
            i, j = torch.triu_indices(n_z, n_z)
            varies = j >= first
            i, j = i[varies], j[varies]
            # an off-diagonal entry stands twice in the matrix
            weight = torch.sqrt(self.whitening * (2.0 - (i == j).to(theta)))
            r = weight * (moment[i, j] - (i == j).to(theta))
            cost += 0.5 * float(torch.sum(r * r))
            if derivatives:
                J = weight[:, None] * (moment_dtheta[i, j] + moment_dtheta[j, i])
                gradient += J.T @ r
                matrix += J.T @ J
        return NormalEquations(cost, gradient, matrix) if derivatives else NormalEquations(cost)
