# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The least-squares problems that all solvers are given, from the same data and start."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from koopman_ros.core.arrays import Array
from koopman_ros.learning.lift.incremental import IncrementalTraining
from koopman_ros.learning.lift.network import Layout, Pass
from koopman_ros.learning.lift.residuals import LiftProblem, ResidualWeights, ScaledSamples
from koopman_ros.plants import one_state_reactor, two_state_example

WHITENING = 1.0
N_Z = 3
_HIDDEN_MORE = 3  # as in the default recipe
_SEED = 0
# Plant, box of the states, their scale. The exact lift of the first is known: z3 = x1^2. The
# second has a round before, n_z = 2, which our learner trains for all solvers: without it hardly
# any start gets below 1e-6.
SYSTEMS = {
    'two-state example': (two_state_example(), [-6.0, -6.0], [6.0, 8.0], [6.0, 7.0]),
    'one-state reactor': (one_state_reactor(), [305.0], [329.0], [12.0])}


@dataclass(frozen=True)
class PlanningCase:
    """One problem with its start, in numpy's arrays, which can be passed to other processes."""

    layout: Layout  #: sizes, identity coordinates and one tanh layer
    x: Array  #: (N, n_x) scaled
    f: Array  #: (N, n_x) scaled
    start: Array  #: (p,) where every solver starts

    @property
    def data(self) -> ScaledSamples:
        """The samples."""
        return ScaledSamples(torch.from_numpy(self.x), torch.from_numpy(self.f))

    @property
    def theta(self) -> Tensor:
        """The start (p,)."""
        return torch.from_numpy(self.start)

    @property
    def problem(self) -> LiftProblem:
        """The objective, as our learner takes it."""
        return LiftProblem(self.layout, self.data, ResidualWeights(WHITENING))

    def rw(self, theta: Tensor) -> float:
        """Return rw, the residual relative to the motion in the metric of E[z z'], or infinity."""
        parameters, data = self.layout.split(theta), self.data
        lifted = Pass(self.layout, parameters, data.x, data.f)
        factor, info = torch.linalg.cholesky_ex(lifted.z.T @ lifted.z / len(data))
        if int(info):
            return float('inf')
        both = torch.cat([lifted.z_rate - lifted.z @ parameters.A.T, lifted.z_rate])
        white = torch.linalg.solve_triangular(factor.T, both, upper=True, left=False)
        residual, reference = white.square().sum(1).view(2, -1).sum(1)
        value = float(residual / reference)
        return value if value == value else float('inf')


def build(system: str, samples: int, hidden: int) -> PlanningCase:
    """Build the start of the round in which the default recipe reaches n_z = 3."""
    plant, lower, upper, scale = SYSTEMS[system]
    # states from the box and their exact drift; time is scaled as in training: rates of order one
    x = np.random.default_rng(_SEED).uniform(lower, upper, (samples, plant.n_x))
    f = plant.derivative(x, plant.nominal_input) / scale
    x, f = (x - plant.nominal_state) / scale, f / np.sqrt(np.mean(f ** 2))
    data = ScaledSamples(torch.from_numpy(x), torch.from_numpy(f))
    *before, _ = range(plant.n_x + 1, N_Z + 1)
    growth = IncrementalTraining(N_Z, hidden_first=hidden - _HIDDEN_MORE * len(before),
                                 hidden_more=_HIDDEN_MORE, whitening=WHITENING)
    parent = growth.root(data)
    for n_z in before:
        parent = growth.start(data, n_z, parent, _SEED)
    layout, theta = growth._extended(data, N_Z, parent, _SEED)
    return PlanningCase(layout, x, f, theta.numpy())
