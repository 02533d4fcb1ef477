# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Normal equations of the dynamics residual by moments of features, summed over the samples.

Every entry of the residual Jacobian, J[n, i, q], is a combination of features of sample n whose
coefficients do not depend on n: J_i = T_i phi(n). Then sum_n J' J = sum_i T_i (sum_n phi phi')
T_i', and the sums over the samples have neither the length of the parameter vector nor a row for
each coordinate.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from koopman_ros.learning.lift.network import Layout, Parameters, Pass


class MomentSums:
    """
    Moments of the features phi of N samples, and the normal equations that follow.

    phi stacks F (h (n_x + 1)), the part of the feature rates by W and b; G that of the features;
    the feature rates (h); the features (h); x (n_x); and where B is learned slope times u (h n_u)
    and u (n_u).
    """

    def __init__(self, layout: Layout, parameters: Parameters, N: int) -> None:
        self._layout, self._parameters, self._N = layout, parameters, N
        h, n_x, n_u = layout.hidden, layout.n_x, layout.n_u
        ends = list(itertools.accumulate(
            (h * (n_x + 1), h * (n_x + 1), h, h, n_x, h * n_u, n_u), initial=0))
        self._places = tuple(slice(a, b) for a, b in itertools.pairwise(ends))
        K = feature_count(layout)
        self._moments = parameters.A.new_zeros((K, K))
        self._by_residual = parameters.A.new_zeros((K, layout.n_z))

    def add(self, x: Tensor, f: Tensor, u: Tensor | None, lifted: Pass, r: Tensor) -> None:
        """Add a chunk: states, rates, inputs, their pass, and residuals J_N f - A z (N, n_z)."""
        phi = self.features(x, f, u, lifted)
        self._moments.addmm_(phi.T, phi, alpha=1.0 / self._N)
        # the residuals themselves: from the moments they would come out with their rounding
        self._by_residual.addmm_(phi.T, r, alpha=1.0 / self._N)

    def result(self) -> tuple[Tensor, Tensor]:
        """Return J'r (p,) and J'J (p, p)."""
        T = self.residual_rates()
        _, p, K = T.shape
        left = (T.reshape(-1, K) @ self._moments).view(T.shape).transpose(0, 1).reshape(p, -1)
        return (torch.einsum('ipk,ki->p', T, self._by_residual),
                left @ T.transpose(0, 1).reshape(p, -1).T)

    def moment_rates(self) -> Tensor:
        """Return E[z_a dz_b/dtheta] (n_z, n_z, p)."""
        U = self.coordinate_rates()
        n_z, p, K = U.shape
        rates = U.reshape(-1, K) @ (self._moments @ self.coordinates().T)
        return rates.view(n_z, p, n_z).permute(2, 0, 1)

    def features(self, x: Tensor, f: Tensor, u: Tensor | None, lifted: Pass) -> Tensor:
        """Evaluate phi (N, K) for states (N, n_x), rates (N, n_x) and inputs (N, n_u)."""
        slope, shape = lifted.slope, self._layout.shapes[0]
        phi = x.new_empty((len(x), feature_count(self._layout)))
        F, G, rates, values, states, slope_inputs, inputs = (
            phi[:, place] for place in self._places)
        n_W = shape[0] * shape[1]
        at_W = F[:, :n_W].unflatten(1, shape)
        torch.mul(lifted.slope_rate[:, :, None], x[:, None, :], out=at_W)
        at_W.addcmul_(slope[:, :, None], f[:, None, :])
        F[:, n_W:] = lifted.slope_rate
        torch.mul(slope[:, :, None], x[:, None, :], out=G[:, :n_W].unflatten(1, shape))
        torch.sub(slope, lifted.zero_slope, out=G[:, n_W:])
        rates[...] = lifted.feature_rates
        values[...] = lifted.features
        states[...] = x
        if u is not None:
            torch.mul(slope[:, :, None], u[:, None, :],
                      out=slope_inputs.unflatten(1, (slope.shape[1], u.shape[1])))
            inputs[...] = u
        return phi

    def coordinates(self) -> Tensor:
        """Return Z (n_z, K) with z = Z phi."""
        layout, V = self._layout, self._parameters.V
        first = layout.n_z - layout.n_free
        Z = V.new_zeros((layout.n_z, feature_count(layout)))
        Z[:first, self._places[4]] = torch.eye(first, layout.n_x).to(V)
        Z[first:, self._places[3]] = V
        return Z

    def coordinate_rates(self, *, along_drift: bool = False) -> Tensor:
        """Return U (n_z, p, K) with dz_i/dtheta = U_i phi, or that of dz_i/dt along the drift."""
        layout, V = self._layout, self._parameters.V
        first, at_V = layout.n_z - layout.n_free, layout.slices[2]
        hidden, values = self._places[0 if along_drift else 1], self._places[2 + (not along_drift)]
        U = V.new_zeros((layout.n_z, layout.size, feature_count(layout)))
        # the output weights (n_free, h), once for each parameter of the hidden layer
        weights = torch.cat([V.repeat_interleave(layout.n_x, 1), V], 1)
        U[first:, :at_V.start, hidden].diagonal(dim1=1, dim2=2)[...] = weights
        for k in range(layout.n_free):
            rows = slice(at_V.start + k * V.shape[1], at_V.start + (k + 1) * V.shape[1])
            U[first + k, rows, values].diagonal()[...] = 1.0
        return U

    def residual_rates(self) -> Tensor:
        """Return T (n_z, p, K) with dr_i/dtheta = T_i phi for r = J_N f - A N."""
        layout, A, V = self._layout, self._parameters.A, self._parameters.V
        first = layout.n_z - layout.n_free
        T = self.coordinate_rates(along_drift=True) - torch.tensordot(
            A, self.coordinate_rates(), 1)
        at_A, Z = layout.slices[3], self.coordinates()
        for i in range(layout.n_z):
            T[i, at_A.start + i * layout.n_z:at_A.start + (i + 1) * layout.n_z] = -Z
        if layout.n_u:
            slope_inputs, inputs = self._places[5:]
            at_B, shape = layout.slices[4], (layout.n_x, layout.n_u)
            for k in range(layout.n_u):
                T[first:, at_B, slope_inputs].unflatten(1, shape).unflatten(
                    3, (V.shape[1], layout.n_u))[:, :, k, :, k] = -torch.einsum(
                        'ij,jm->imj', V, self._parameters.W)
                for m in range(first):
                    T[m, at_B, inputs].unflatten(0, shape)[m, k, k] = -1.0
        return T


def feature_count(layout: Layout) -> int:
    """Return the number K of features."""
    h = layout.hidden
    return 2 * h * (layout.n_x + 2) + layout.n_x + layout.n_u * (h + 1)
