# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The drift alone: a read-out of a lift's features, and a network that is trained for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from koopman_ros.core.datasets import DriftSamples
from koopman_ros.learning.lift.incremental import linear_drift, Monitor, TrainedLift, xavier
from koopman_ros.learning.lift.levenberg_marquardt import minimise, NormalEquations
from koopman_ros.learning.lift.network import Layout, Parameters, Pass
from koopman_ros.learning.lift.residuals import CHUNK, ScaledSamples
from koopman_ros.model import LiftedModel, NetworkObservables

# Directions of the features smaller than this share of the largest are left out of a fit: their
# weights would be as large as the inverse. Which share is best depends on the data.
SMALLEST = (1e-9, 1e-6, 1e-3)
# A unit that moves less on the samples is saturated: with a weight so large, its rounding would be
# steps in the drift, on which no steady state is found.
_STILL = 1e-6


def with_readout(model: LiftedModel, samples: DriftSamples, smallest: float = SMALLEST[0]
                 ) -> LiftedModel:
    """
    Read the drift off the features phi of the lift: f(x) = readout phi(x), by least squares.

    phi(0) = 0, so that f(0) = 0 whatever the weights are.

    :param smallest: share of the largest singular value below which a direction is left out.
    """
    x = model.states.to_deviation(samples.x)
    f = samples.dxdt / model.states.scale - model.forcing(
        x, model.inputs.to_deviation(samples.u))
    phi = model.observables.features.lift(x)
    # each feature in units of its size; one that is constant on all samples gets no weight
    size = np.sqrt(np.mean(phi ** 2, axis=0))
    unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > _STILL)
    weights = np.linalg.lstsq(phi * unit, f, rcond=smallest)[0].T
    return replace(model, readout=weights * unit)


def with_units_of(drift: LiftedModel, lift: LiftedModel) -> LiftedModel:
    """
    Add the hidden units of a network to those of a lift, whose z they leave as it is.

    :raises ValueError: for a model without a network.
    """
    own, added = lift.observables, drift.observables
    if not (isinstance(own, NetworkObservables) and isinstance(added, NetworkObservables)):
        raise ValueError('only a network has hidden units')
    idle = np.zeros((len(own.V), len(added.W)))
    return replace(lift, readout=None, observables=replace(
        own, W=np.vstack([own.W, added.W]), b=np.concatenate([own.b, added.b]),
        V=np.hstack([own.V, idle])))


@dataclass(frozen=True)
class NeuralDrift:
    """
    A network for the drift alone: dx/dt = A x + V (h(x) - h(0)) + B u, h its hidden layer.

    Levenberg-Marquardt on the rates. As a model it is the lift z = x with a read-out: its z is not
    linear, so that only laws based on the drift can use it.
    """

    hidden: int = 16  #: units of the hidden layer
    max_iterations: int = 500  #: limit of Levenberg-Marquardt steps
    tolerance: float = 1e-3  #: as in :class:`IncrementalTraining`

    def __post_init__(self) -> None:
        if self.hidden < 1:
            raise ValueError(f'hidden must be at least 1 unit, got {self.hidden}')

    def rounds(self, n_x: int) -> tuple[int, ...]:
        """Return the n_z of the one round of starts."""
        return (n_x,)

    def start(self, data: ScaledSamples, n_z: int, parent: TrainedLift | None, seed: int,
              monitor: Monitor | None = None) -> TrainedLift:
        """Train from random hidden units; `parent` is not used."""
        # a free lift of this size has the very parameters of the drift: V, A (n_x, n_x) and B
        layout = Layout(n_z, n_z, self.hidden, False, 0 if data.u is None else data.u.shape[1])
        generator = torch.Generator().manual_seed(seed)
        W = 2.0 * xavier(self.hidden, n_z, generator).to(data.x)
        b = torch.randn(self.hidden, generator=generator, dtype=torch.float64).to(data.x)
        A, B = linear_drift(data)
        theta = layout.join(Parameters(W, b, data.x.new_zeros((n_z, self.hidden)), A, B))
        minimum = minimise(NeuralDriftProblem(layout, data).add_residuals, theta,
                           max_iterations=self.max_iterations, tolerance=self.tolerance,
                           monitor=monitor)
        # the read-out is fitted by itself; the A of the lift z = x is that of the linear fit
        found = layout.join(replace(layout.split(minimum.theta), A=A))
        return TrainedLift(layout, found, minimum.status, drift_alone=True,
                           iterations=minimum.iterations)


@dataclass(frozen=True)
class NeuralDriftProblem:
    """Least-squares problem of a drift: 0.5 times the mean of ||f - A x - V (h - h(0))||^2."""

    layout: Layout  #: of a free lift with as many coordinates as states
    data: ScaledSamples  #: the samples

    def add_residuals(self, theta: Tensor, equations: NormalEquations) -> None:
        """Add the residuals at parameters (p,) over all samples."""
        parameters = self.layout.split(theta)
        chunk = max(64, CHUNK // (self.layout.n_x * self.layout.size))
        for start in range(0, len(self.data), chunk):
            data = self.data.part(start, chunk)
            lifted = Pass(self.layout, parameters, data.x, data.f)
            r = data.drift(parameters.B) - data.x @ parameters.A.T - lifted.z
            J = self._jacobian(data, parameters, lifted) if equations.derivatives else None
            equations.add(r, J, count=len(self.data))

    def _jacobian(self, data: ScaledSamples, parameters: Parameters, lifted: Pass) -> Tensor:
        """Differentiate the residual in the parameters: (N, n_x, p)."""
        layout = self.layout
        J = data.x.new_zeros((len(data), layout.n_x, layout.size))
        lifted.pull_back(J, -parameters.V)
        factors = [lifted.features, data.x, *([] if parameters.B is None or data.u is None
                                              else [data.u])]
        for place, shape, factor in zip(layout.slices[2:], layout.shapes[2:], factors,
                                        strict=True):
            rows = J[:, :, place].unflatten(2, shape)
            for i in range(layout.n_x):
                rows[:, i, i] = -factor
        return J
