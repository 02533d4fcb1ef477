# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What the residuals of the dynamics put into the normal equations, summed over the samples.

For a lift of any depth from residual Jacobians sample by sample. With one hidden layer every entry
of that Jacobian, J[n, i, q], is a combination of features of sample n whose coefficients do not
depend on n: J_i = T_i phi(n). Then sum_n J' J = sum_i T_i (sum_n phi phi') T_i', and what is
summed over the samples has neither the length of the parameter vector nor a row for each
coordinate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import itertools

import torch
from torch import Tensor

from koopman_ros.learning.lift.network import Layout, Parameters, Pass


class ProductSums:
    """
    The sums of a lift of any depth over N samples in all.

    :param whitening: whether the derivatives of E[z z'] are wanted; otherwise they stay 0.
    """

    def __init__(self, layout: Layout, parameters: Parameters, N: int, whitening: bool) -> None:
        self._layout, self._parameters, self._N = layout, parameters, N
        self._whitening = whitening
        self._first = layout.n_z - layout.n_free
        p, like = layout.size, parameters.A
        self._gradient, self._matrix = like.new_zeros(p), like.new_zeros((p, p))
        self._moment_rate = like.new_zeros((layout.n_z, layout.n_z, p))

    def add(self, x: Tensor, f: Tensor, u: Tensor | None, lifted: Pass, r: Tensor) -> None:
        """Add a chunk: states, rates, inputs, their pass, and residuals J_N f - A z (N, n_z)."""
        J = self._jacobian(u, lifted).view(-1, len(self._gradient))
        self._gradient += J.T @ r.reshape(-1) / self._N
        self._matrix.addmm_(J.T, J, alpha=1.0 / self._N)
        if self._whitening and self._layout.hidden:
            self._add_moment_rate(lifted)

    @property
    def sums(self) -> tuple[Tensor, ...]:
        """What was summed so far, which adds up over parts of the samples."""
        return self._gradient, self._matrix, self._moment_rate

    @staticmethod
    def result(layout: Layout, parameters: Parameters, whitening: bool, sums: Sequence[Tensor]
               ) -> tuple[Tensor, Tensor, Tensor]:
        """Return of sums J^T r (p,), J^T J (p, p) and E[z_a dz_b/dtheta] (n_z, n_z, p)."""
        gradient, matrix, moment_rate = sums
        return gradient, matrix, moment_rate

    def _jacobian(self, u: Tensor | None, lifted: Pass) -> Tensor:
        """Differentiate J_N (dx/dt - B u) - A N in the parameters: (N, n_z, p)."""
        layout, A, V, first = self._layout, self._parameters.A, self._parameters.V, self._first
        at_V, at_A = layout.slices[2 * len(layout.hidden):][:2]
        J = lifted.z.new_zeros((len(lifted.z), layout.n_z, layout.size))
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
        if layout.n_u and u is not None:
            at_B = layout.slices[2 * len(layout.hidden) + 2]
            J[:, :, at_B] = -torch.einsum('nim,nk->nimk', lifted.jacobian(), u).flatten(2)
        return J

    def _add_moment_rate(self, lifted: Pass) -> None:
        """Add a chunk's share of E[z_a dz_b/dtheta]."""
        layout, V, first, N = self._layout, self._parameters.V, self._first, self._N
        # V sits behind the hidden layers, the rest of the parameters does not move z
        place = layout.slices[2 * len(layout.hidden)]
        z_rate = lifted.z.new_zeros((len(lifted.z), layout.n_free, place.start))
        lifted.pull_back(z_rate, V, None)
        self._moment_rate[:, first:, :place.start] += torch.einsum(
            'na,nbp->abp', lifted.z, z_rate) / N
        by_features = lifted.z.T @ lifted.features / N
        for k in range(layout.n_free):
            self._moment_rate[:, first + k, place].unflatten(1, V.shape)[:, k] += by_features


class MomentSums:
    """The sums of a lift with one hidden layer, from the second moments of its features."""

    def __init__(self, layout: Layout, parameters: Parameters, N: int, whitening: bool) -> None:
        # whether there is whitening matters to what follows from the sums alone
        self._map, self._N = FeatureMap(layout, parameters), N
        K, like = FeatureMap.size(layout), parameters.A
        self._moments, self._by_residual = like.new_zeros((K, K)), like.new_zeros((K, layout.n_z))

    def add(self, x: Tensor, f: Tensor, u: Tensor | None, lifted: Pass, r: Tensor) -> None:
        """Add a chunk, as :meth:`ProductSums.add`."""
        phi = self._map.features(x, f, u, lifted)
        self._moments.addmm_(phi.T, phi, alpha=1.0 / self._N)
        # the residuals themselves, since from the moments they would come out with their rounding
        self._by_residual.addmm_(phi.T, r, alpha=1.0 / self._N)

    @property
    def sums(self) -> tuple[Tensor, ...]:
        """Moments of the features (K, K), and these by the residuals (K, n_z), so far."""
        return self._moments, self._by_residual

    @staticmethod
    def result(layout: Layout, parameters: Parameters, whitening: bool, sums: Sequence[Tensor]
               ) -> tuple[Tensor, Tensor, Tensor]:
        """Return what follows from sums, as :meth:`ProductSums.result`."""
        moments, by_residual = sums
        of = FeatureMap(layout, parameters)
        T = of.residual_rates
        n_z, p, K = T.shape
        gradient = torch.einsum('ipk,ki->p', T, by_residual)
        left = (T.reshape(-1, K) @ moments).view(T.shape).transpose(0, 1).reshape(p, -1)
        matrix = left @ T.transpose(0, 1).reshape(p, -1).T
        if not whitening:
            return gradient, matrix, T.new_zeros((n_z, n_z, p))
        Z, U = of.coordinates, of.coordinate_rates
        moment_rate = (U.reshape(-1, K) @ (moments @ Z.T)).view(n_z, p, n_z)
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
