# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Normal equations of a lift of any depth, from residual Jacobians sample by sample."""

from __future__ import annotations

import torch
from torch import Tensor

from koopman_ros.learning.network import Layout, Parameters, Pass


class ProductSums:
    """
    Sums over the samples of what the residuals of the dynamics put into the normal equations.

    :param layout: sizes.
    :param parameters: the lift's parameters.
    :param N: number of samples in all.
    :param whitening: whether the derivatives of E[z z'] are wanted; otherwise they stay 0.
    """

    def __init__(self, layout: Layout, parameters: Parameters, N: int, whitening: bool) -> None:
        self._layout, self._parameters, self._N = layout, parameters, N
        self._whitening = whitening
        p, like = layout.size, parameters.A
        self._gradient, self._matrix = like.new_zeros(p), like.new_zeros((p, p))
        self._moment_rate = like.new_zeros((layout.n_z, layout.n_z, p))

    def add(self, x: Tensor, f: Tensor, u: Tensor | None, lifted: Pass, r: Tensor) -> None:
        """Add a chunk: states, rates, inputs, their pass, and residuals J_N f - A z (N, n_z)."""
        J = _dynamics_jacobian(self._layout, self._parameters, u, lifted).view(-1, len(
            self._gradient))
        self._gradient += J.T @ r.reshape(-1) / self._N
        self._matrix.addmm_(J.T, J, alpha=1.0 / self._N)
        if self._whitening:
            _add_moment_rate(self._moment_rate, self._layout, self._parameters, lifted, self._N)

    def result(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return J^T r (p,), J^T J (p, p) and E[z_a dz_b/dtheta] (n_z, n_z, p)."""
        return self._gradient, self._matrix, self._moment_rate


def _dynamics_jacobian(layout: Layout, parameters: Parameters, u: Tensor | None, lifted: Pass
                       ) -> Tensor:
    """Differentiate J_N (dx/dt - B u) - A N in the parameters: (N, n_z, p)."""
    A, V, first = parameters.A, parameters.V, layout.n_z - layout.n_free
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
