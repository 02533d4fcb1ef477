# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Normal equations of a lift with one hidden layer, from the second moments of a few features.

With one hidden layer every entry of the residual Jacobian of the dynamics, J[n, i, q], is a
combination of features of sample n whose coefficients do not depend on n: J_i = T_i phi(n). Then
sum_n J' J = sum_i T_i (sum_n phi phi') T_i', and what is summed over the samples has neither the
length of the parameter vector nor a row for each coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import itertools

import torch
from torch import Tensor

from koopman_ros.learning.network import Layout, Parameters, Pass


class MomentSums:
    """
    Sums over the samples of what the residuals of the dynamics put into the normal equations.

    :param layout: sizes, with one hidden layer.
    :param parameters: the lift's parameters.
    :param N: number of samples in all.
    :param whitening: whether the derivatives of E[z z'] are wanted; otherwise they stay 0.
    """

    def __init__(self, layout: Layout, parameters: Parameters, N: int, whitening: bool) -> None:
        self._map, self._N = FeatureMap(layout, parameters), N
        self._whitening = whitening
        K, like = FeatureMap.size(layout), parameters.A
        self._moments, self._by_residual = like.new_zeros((K, K)), like.new_zeros((K, layout.n_z))

    def add(self, x: Tensor, f: Tensor, u: Tensor | None, lifted: Pass, r: Tensor) -> None:
        """Add a chunk: states, rates, inputs, their pass, and residuals J_N f - A z (N, n_z)."""
        phi = self._map.features(x, f, u, lifted)
        self._moments.addmm_(phi.T, phi, alpha=1.0 / self._N)
        # the residuals themselves, since from the moments they would come out with their rounding
        self._by_residual.addmm_(phi.T, r, alpha=1.0 / self._N)

    def result(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return J^T r (p,), J^T J (p, p) and E[z_a dz_b/dtheta] (n_z, n_z, p)."""
        T = self._map.residual_rates
        n_z, p, K = T.shape
        gradient = torch.einsum('ipk,ki->p', T, self._by_residual)
        left = (T.reshape(-1, K) @ self._moments).view(T.shape).transpose(0, 1).reshape(p, -1)
        matrix = left @ T.transpose(0, 1).reshape(p, -1).T
        if not self._whitening:
            return gradient, matrix, T.new_zeros((n_z, n_z, p))
        Z, U = self._map.coordinates, self._map.coordinate_rates
        moment_rate = (U.reshape(-1, K) @ (self._moments @ Z.T)).view(n_z, p, n_z)
        return gradient, matrix, moment_rate.permute(2, 0, 1)


@dataclass(frozen=True)
class FeatureMap:
    """
    The features phi of a sample and how residuals and coordinates depend on them.

    phi stacks F (h (n_x + 1)), what the rates of the features give the hidden layer; G likewise,
    what the features give it; the rates of the features (h); the features (h); x (n_x); and where
    B is learned slope times u (h n_u) and u (n_u).
    """

    layout: Layout  #: sizes, with one hidden layer
    parameters: Parameters  #: the lift's parameters

    @cached_property
    def _places(self) -> tuple[slice, ...]:
        layout = self.layout
        (h,), n_x, n_u = layout.hidden, layout.n_x, layout.n_u
        ends = [0]
        for length in (h * (n_x + 1), h * (n_x + 1), h, h, n_x, h * n_u, n_u):
            ends.append(ends[-1] + length)
        return tuple(slice(a, b) for a, b in itertools.pairwise(ends))

    @staticmethod
    def size(layout: Layout) -> int:
        """Return the number K of features."""
        h = layout.hidden[0]
        return 2 * h * (layout.n_x + 2) + layout.n_x + layout.n_u * (h + 1)

    def features(self, x: Tensor, f: Tensor, u: Tensor | None, lifted: Pass) -> Tensor:
        """Evaluate phi (N, K) for states (N, n_x), rates (N, n_x) and inputs (N, n_u)."""
        layer = lifted.layers[0]
        slope, slope_rate = layer.slope, layer.slope_rate
        phi = x.new_empty((len(x), self.size(self.layout)))
        F, G, rates, values, states, slope_inputs, inputs = (
            phi[:, place] for place in self._places)
        n_W = layer.W.numel()
        at_W = F[:, :n_W].unflatten(1, layer.W.shape)
        torch.mul(slope_rate[:, :, None], x[:, None, :], out=at_W)
        at_W.addcmul_(slope[:, :, None], f[:, None, :])
        F[:, n_W:] = slope_rate
        torch.mul(slope[:, :, None], x[:, None, :], out=G[:, :n_W].unflatten(1, layer.W.shape))
        torch.sub(slope, layer.zero_slope, out=G[:, n_W:])
        rates[...] = lifted.feature_rates
        values[...] = lifted.features
        states[...] = x
        if self.layout.n_u and u is not None:
            torch.mul(slope[:, :, None], u[:, None, :],
                      out=slope_inputs.unflatten(1, (slope.shape[1], u.shape[1])))
            inputs[...] = u
        return phi

    @cached_property
    def coordinates(self) -> Tensor:
        """Z (n_z, K) with z = Z phi."""
        layout, V = self.layout, self.parameters.V
        first = layout.n_z - layout.n_free
        Z = V.new_zeros((layout.n_z, self.size(layout)))
        _, _, _, values, states, _, _ = self._places
        Z[:first, states] = torch.eye(first, layout.n_x).to(V)
        Z[first:, values] = V
        return Z

    @cached_property
    def residual_rates(self) -> Tensor:
        """T (n_z, p, K) with dr_i/dtheta = T_i phi for r = J_N f - A N."""
        layout, A, V = self.layout, self.parameters.A, self.parameters.V
        first = layout.n_z - layout.n_free
        W = self.parameters.hidden[0][0]
        F, G, rates, values, _, slope_inputs, inputs = self._places
        T = V.new_zeros((layout.n_z, layout.size, self.size(layout)))
        hidden = slice(0, F.stop)
        of_rates = torch.cat([V.new_zeros((first, V.shape[1])), V])
        for place, weights in ((F, of_rates), (G, -A[:, first:] @ V)):
            T[:, hidden, place].diagonal(dim1=1, dim2=2)[...] = self._per_hidden(weights)
        at_V, at_A = layout.slices[2:4]
        for k in range(layout.n_free):
            rows = slice(at_V.start + k * V.shape[1], at_V.start + (k + 1) * V.shape[1])
            T[first + k, rows, rates].diagonal()[...] = 1.0
            T[:, rows, values].diagonal(dim1=1, dim2=2)[...] = -A[:, first + k, None]
        for i in range(layout.n_z):
            T[i, at_A.start + i * layout.n_z:at_A.start + (i + 1) * layout.n_z] = (
                -self.coordinates)
        if layout.n_u:
            shape = (layout.n_z, layout.n_x, layout.n_u)
            at_B = layout.slices[4]
            for k in range(layout.n_u):
                T[:, at_B, slope_inputs].unflatten(1, shape[1:]).unflatten(
                    3, (V.shape[1], layout.n_u))[:, :, k, :, k] = -torch.einsum(
                        'ij,jm->imj', of_rates, W)
                for m in range(first):
                    T[m, at_B, inputs].unflatten(0, shape[1:])[m, k, k] = -1.0
        return T

    @cached_property
    def coordinate_rates(self) -> Tensor:
        """U (n_z, p, K) with dz_i/dtheta = U_i phi."""
        layout, V = self.layout, self.parameters.V
        first = layout.n_z - layout.n_free
        _, G, _, values, _, _, _ = self._places
        U = V.new_zeros((layout.n_z, layout.size, self.size(layout)))
        U[first:, :G.stop - G.start, G].diagonal(dim1=1, dim2=2)[...] = self._per_hidden(V)
        start = layout.slices[2].start
        for k in range(layout.n_free):
            rows = slice(start + k * V.shape[1], start + (k + 1) * V.shape[1])
            U[first + k, rows, values].diagonal()[...] = 1.0
        return U

    def _per_hidden(self, weights: Tensor) -> Tensor:
        """Repeat weights (R, h) for each parameter of the hidden layer: (R, h (n_x + 1))."""
        return torch.cat([weights.repeat_interleave(self.layout.n_x, 1), weights], 1)

