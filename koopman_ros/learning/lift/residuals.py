# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The residuals by which a lift is learned, with their hand-derived Jacobian, in torch."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from koopman_ros.core.datasets import Array, DriftSamples
from koopman_ros.learning.lift.levenberg_marquardt import NormalEquations
from koopman_ros.learning.lift.moment_sums import feature_count, MomentSums
from koopman_ros.learning.lift.network import Layout, Parameters, Pass
from koopman_ros.model import Box

# Numbers in a chunk of the residual Jacobian: 2 MiB, the cache of a core.
CHUNK = 1 << 18


def deviations(box: Box, samples: DriftSamples) -> tuple[Array, Array, Array]:
    """Scale samples to deviations: x (N, n_x), dx/dt (N, n_x), u (N, n_u)."""
    return (box.states.to_deviation(samples.x), samples.dxdt / box.states.scale,
            box.inputs.to_deviation(samples.u))


@dataclass(frozen=True)
class ScaledSamples:
    """Samples in the scaled deviations from the nominal point that a lift is learned from."""

    x: Tensor  #: (N, n_x) states, float64
    f: Tensor  #: (N, n_x) rates dx/dt, less B(x) u where it is known
    #: (N, n_u) inputs whose B is to be learned, and their products with monomials of the state
    #: where it depends on that; None where B is known
    u: Tensor | None = None

    def drift(self, B: Tensor | None) -> Tensor:
        """Return the rates less the effect of the inputs, (N, n_x)."""
        return self.f if B is None or self.u is None else self.f - self.u @ B.T

    def part(self, start: int, length: int) -> ScaledSamples:
        """Return some consecutive samples."""
        rows = slice(start, start + length)
        return ScaledSamples(self.x[rows], self.f[rows], None if self.u is None else self.u[rows])

    def __len__(self) -> int:
        return len(self.x)


@dataclass(frozen=True)
class ResidualWeights:
    """Weights of the residuals relative to that of the dynamics, whose weight is 1."""

    whitening: float = 0.0  #: of E[z z'] - I, 0 to leave it out
    decoder: float = 0.0  #: of x - D(N(x)), the paper's lambda; 0 to leave it out


@dataclass(frozen=True)
class LiftProblem:
    """
    Least-squares problem of a lift on data: 0.5 times the sum of three squared residuals.

    - *Dynamics*: J_N(x) (dx/dt - B u) - A N(x), root mean square over the samples (paper's
      objective for control-affine systems).
    - *Whitening*: E[z z'] - I. It rules out the collapse of two coordinates into one, which the
      other terms do not see. Entries of identity coordinates alone are constants and left out.
    - *Decoder*: x - D(N(x)), root mean square over the samples, D a network of one hidden layer
      (paper's decoder term).

    Sums run over chunks of the samples, so that memory does not grow with their number.
    """

    layout: Layout  #: sizes of the lift
    data: ScaledSamples  #: the samples
    weights: ResidualWeights  #: weights of the residuals
    chunk: int = 0  #: samples at a time; by default as many as fit into the cache

    def __post_init__(self) -> None:
        if not self.chunk:
            floats = max(feature_count(self.layout),
                         self.layout.n_x * self.layout.size * bool(self.layout.decoder))
            object.__setattr__(self, 'chunk', max(64, CHUNK // floats))

    def add_residuals(self, theta: Tensor, equations: NormalEquations) -> None:
        """Add the residuals at parameters (p,) over all samples."""
        layout, derivatives, N = self.layout, equations.derivatives, len(self.data)
        parameters = layout.split(theta)
        dynamics = MomentSums(layout, parameters, N) if derivatives else None
        moment, cost = theta.new_zeros((layout.n_z, layout.n_z)), theta.new_zeros(())
        for start in range(0, N, self.chunk):
            data = self.data.part(start, self.chunk)
            f = data.drift(parameters.B)
            lifted = Pass(layout, parameters, data.x, f)
            r = lifted.z_rate - lifted.z @ parameters.A.T
            cost += 0.5 * torch.sum(r * r) / N
            moment += lifted.z.T @ lifted.z / N
            if dynamics is not None:
                dynamics.add(data.x, f, data.u if layout.n_u else None, lifted, r)
            if self.weights.decoder:
                equations.add(*_decoder_block(layout, parameters, data.x, lifted,
                                              self.weights.decoder ** 0.5, derivatives), count=N)
        equations.add_sums(cost, *(dynamics.result() if dynamics else ()))
        if self.weights.whitening > 0.0:
            i, j, scale, residual = _whitening(layout, moment, self.weights.whitening)
            J = None
            if dynamics is not None:
                rates = dynamics.moment_rates()
                J = scale[:, None] * (rates[i, j] + rates[j, i])
            equations.add(residual, J)


def _decoder_block(layout: Layout, parameters: Parameters, x: Tensor, lifted: Pass,
                   weight: float, derivatives: bool) -> tuple[Tensor, Tensor | None]:
    """Evaluate weight (x - D(N(x))), (N, n_x), and differentiate it: (N, n_x, p)."""
    assert parameters.decoder is not None
    W, b, V, c = parameters.decoder
    t = torch.tanh(torch.addmm(b, lifted.z, W.T))
    r = weight * (x - torch.addmm(c, t, V.T))
    if not derivatives:
        return r, None
    slope = 1.0 - t * t
    to_input = -weight * V * slope[:, None, :]  # (N, n_x, g)
    J = r.new_zeros((len(x), layout.n_x, layout.size))
    at_W, at_b, at_V, at_c = layout.slices[-4:]
    J[:, :, at_W] = torch.einsum('nmg,nz->nmgz', to_input, lifted.z).flatten(2)
    J[:, :, at_b] = to_input
    for m in range(layout.n_x):
        J[:, m, at_V].unflatten(1, V.shape)[:, m] = -weight * t
        J[:, m, at_c][:, m] = -weight
    to_free = (to_input @ W)[:, :, layout.n_z - layout.n_free:]
    lifted.pull_back(J, to_free @ parameters.V)
    J[:, :, layout.slices[2]] = torch.einsum('nmk,nh->nmkh', to_free, lifted.features).flatten(2)
    return r, J


def _whitening(layout: Layout, moment: Tensor, weight: float
               ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return rows, columns and weights of the entries of E[z z'] that can change, and residual."""
    i, j = torch.triu_indices(layout.n_z, layout.n_z, device=moment.device)
    varies = j >= layout.n_z - layout.n_free
    i, j = i[varies], j[varies]
    diagonal = (i == j).to(moment)
    # an off-diagonal entry stands twice in the matrix
    scale = torch.sqrt(weight * (2.0 - diagonal))
    return i, j, scale, scale * (moment[i, j] - diagonal)
