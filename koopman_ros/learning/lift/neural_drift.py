# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The drift alone: read out of a lift's features, and a network that is trained for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
import torch
from torch import Tensor

from koopman_ros.learning.lift.incremental import Grown, linear_drift, Monitor, xavier
from koopman_ros.learning.lift.levenberg_marquardt import minimise, NormalEquations
from koopman_ros.learning.lift.network import check_activation, Layout, Parameters, Pass
from koopman_ros.learning.lift.residuals import ScaledSamples, Sums
from koopman_ros.lifting import LiftedModel, NetworkObservables
from koopman_ros.plant_data import Array, Samples

# Directions of the features smaller than this beside the largest are left out of a fit: their
# weights would be as large as the inverse. What that loses and gains depends on the data.
SMALLEST = (1e-9, 1e-6, 1e-3)
# A unit that moves less on the samples is saturated: with a weight so large, its rounding would be
# steps in the drift, on which no steady state is found.
_STILL = 1e-6
_CHUNK = 1 << 18  # numbers in a part of the Jacobian


def with_readout(model: LiftedModel, samples: Samples, smallest: float = SMALLEST[0]
                 ) -> LiftedModel:
    """
    Read the drift off the features phi of the lift: f(x) = readout phi(x), by least squares.

    phi(0) = 0, so that f(0) = 0 whatever the weights are.

    :param smallest: share of the largest singular value below which a direction is left out.
    """
    return fitted_readout(model, readout_rows(model, samples), len(samples), smallest)


def readout_rows(model: LiftedModel, samples: Samples) -> Array:
    """Return features and what they should give, [phi, f] (N, h + n_x), at samples."""
    x = model.states.to_deviation(samples.x)
    f = samples.dxdt / model.states.scale - model.forcing(
        x, model.inputs.to_deviation(samples.u))
    return np.hstack([model.observables.features.lift(x), f])


def fitted_readout(model: LiftedModel, rows: Array, N: int, smallest: float) -> LiftedModel:
    """
    Fit the read-out to rows of N samples, or to a triangle with the same products of columns.

    :param rows: (M, h + n_x) as :func:`readout_rows`, or R of their QR decomposition.
    """
    phi, f = rows[:, :-model.n_x], rows[:, -model.n_x:]
    # each feature in units of its size; one that stands still on all samples gets no weight
    size = np.sqrt(np.sum(phi ** 2, axis=0) / N)
    unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > _STILL)
    weights = np.linalg.lstsq(phi * unit, f, rcond=smallest)[0].T
    return replace(model, readout=weights * unit)


def with_units_of(drift: LiftedModel, lift: LiftedModel) -> LiftedModel:
    """
    Add the hidden units of a network to those of a lift, whose z they leave as it is.

    :raises ValueError: for networks that differ in their activation or number of layers.
    """
    ours, theirs = lift.observables, drift.observables
    if not (isinstance(ours, NetworkObservables) and isinstance(theirs, NetworkObservables)
            and ours.activation == theirs.activation and len(ours.hidden) == len(theirs.hidden)):
        raise ValueError('units of networks of different kinds cannot stand in one layer')
    hidden = []
    for i, ((W, b), (more_W, more_b)) in enumerate(zip(ours.hidden, theirs.hidden, strict=True)):
        weight = block_diag(W, more_W) if i else np.vstack([W, more_W])
        hidden.append((weight, np.concatenate([b, more_b])))
    idle = np.zeros((len(ours.output), theirs.output.shape[1]))
    return replace(lift, readout=None, observables=replace(
        ours, hidden=tuple(hidden), output=np.hstack([ours.output, idle])))


@dataclass(frozen=True)
class NeuralDrift:
    """
    A network for the drift alone: dx/dt = A x + V (h(x) - h(0)) + B u, h its last hidden layer.

    Levenberg-Marquardt on the rates. As a model it is the lift z = x with a read-out: its z is
    not linear, so that only laws that go by the drift have use for it.
    """

    hidden: tuple[int, ...] = (16,)  #: units of each hidden layer
    activation: str = 'tanh'  #: as in :class:`~koopman_ros.learning.lift.incremental.Growth`
    max_iterations: int = 500  #: limit of Levenberg-Marquardt steps
    tolerance: float = 1e-3  #: as in :class:`~koopman_ros.learning.lift.incremental.Growth`

    def __post_init__(self) -> None:
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError('hidden must name at least one layer, each of 1 unit or more, got '
                             f'{self.hidden}')
        check_activation(self.activation)

    def rounds(self, n_x: int) -> tuple[int, ...]:
        """Return the n_z of the one round of starts."""
        return (n_x,)

    def start(self, data: ScaledSamples, n_z: int, parent: Grown | None, seed: int,
              monitor: Monitor | None = None) -> Grown:
        """Train from random hidden units, as :meth:`Growth.start`; `parent` has no part in it."""
        # a free lift of this size has the very parameters of the drift: V, A (n_x, n_x) and B
        layout = Layout(n_z, n_z, self.hidden, False, self.activation,
                        0 if data.u is None else data.u.shape[1])
        generator = torch.Generator().manual_seed(seed)
        hidden, width = [], n_z
        for units in self.hidden:
            W = 2.0 * xavier(units, width, generator)
            b = torch.randn(units, generator=generator, dtype=torch.float64)
            hidden.append((W.to(data.x), b.to(data.x)))
            width = units
        A, B = linear_drift(data)
        theta = layout.join(Parameters(tuple(hidden), data.x.new_zeros((n_z, width)), A, B))
        minimum = minimise(DriftProblem(layout, data).add_residuals, theta,
                           max_iterations=self.max_iterations, tolerance=self.tolerance,
                           monitor=monitor)
        # the read-out is fitted by itself; the A of the lift z = x is that of the linear fit
        found = layout.join(replace(layout.split(minimum.theta), A=A))
        return Grown(layout, found, minimum.status, drift_alone=True,
                     iterations=minimum.iterations)


@dataclass(frozen=True)
class DriftProblem:
    """Least-squares problem of a drift: 0.5 times the mean of ||f - A x - V (h - h(0))||^2."""

    layout: Layout  #: of a free lift with as many coordinates as states
    data: ScaledSamples  #: the samples

    def on(self, data: ScaledSamples) -> DriftProblem:
        """Return the same problem on other samples."""
        return replace(self, data=data)

    def add_residuals(self, theta: Tensor, equations: NormalEquations) -> None:
        """Add the residuals at parameters (p,) over all samples."""
        equations.add_sums(*self.data.sums(self, theta, equations.derivatives))

    def sums(self, theta: Tensor, derivatives: bool, N: int) -> Sums:
        """Sum over its samples, which are some of N: cost, gradient (p,) and matrix (p, p)."""
        layout = self.layout
        parameters = layout.split(theta)
        equations = NormalEquations(theta, derivatives=derivatives)
        chunk = max(64, _CHUNK // (layout.n_x * layout.size))
        for start in range(0, len(self.data), chunk):
            data = self.data.part(start, chunk)
            lifted = Pass(layout, parameters, data.x, data.f)
            r = data.drift(parameters.B) - data.x @ parameters.A.T - lifted.z
            J = self._jacobian(data, parameters, lifted) if derivatives else None
            equations.add(r, J, count=N)
        return equations.sums

    def _jacobian(self, data: ScaledSamples, parameters: Parameters, lifted: Pass) -> Tensor:
        """Differentiate the residual in the parameters: (N, n_x, p)."""
        layout = self.layout
        J = data.x.new_zeros((len(data), layout.n_x, layout.size))
        lifted.pull_back(J, -parameters.V, None)
        first = 2 * len(layout.hidden)
        by_row = [lifted.features, data.x] + ([data.u] if layout.n_u and data.u is not None
                                              else [])
        for place, shape, factors in zip(layout.slices[first:], layout.shapes[first:], by_row,
                                         strict=True):
            rows = J[:, :, place].unflatten(2, shape)
            for i in range(layout.n_x):
                rows[:, i, i] = -factors
        return J
