# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The least-squares problems that all solvers are given, from the same data and start."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from koopman_ros.arrays import Array
from koopman_ros.learning.growth import Growth
from koopman_ros.learning.network import Layout, Pass
from koopman_ros.learning.residuals import Problem, ResidualWeights, ScaledSamples
from koopman_ros.plants import ControlAffineSystem, one_state_reactor, two_state_example

WHITENING = 1.0
N_Z = 3
_HIDDEN_MORE = 3  # as in the default recipe
_SEED = 0


@dataclass(frozen=True)
class Case:
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
    def problem(self) -> Problem:
        """The objective, as our learner takes it."""
        return Problem(self.layout, self.data, ResidualWeights(WHITENING))

    def rw(self, theta: Tensor) -> float:
        """
        Return rw = ||(J_N f - A N) S^(-1/2)||^2 / ||J_N f S^(-1/2)||^2 with S = E[z z'].

        :param theta: (p,).
        :return: rw, infinite where coordinates have collapsed.
        """
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


def two_state(samples: int, hidden: int) -> Case:
    """Build the two-state example, where the recipe reaches n_z = 3 in its first round."""
    # the exact lift of this box is known: z3 = x1^2
    x, f = _uniform(two_state_example(), [-6.0, -6.0], [6.0, 8.0], [6.0, 7.0], samples)
    return _grown(x, f, Growth(N_Z, hidden_first=hidden, whitening=WHITENING))


def reactor(samples: int, hidden: int) -> Case:
    """
    Build the one-state reactor, where the recipe reaches n_z = 3 in its second round.

    The first round, n_z = 2, is trained here by our learner; what is compared is the second
    round, from the start which that leaves to every solver alike. Without a first round hardly
    any start gets below 1e-6.
    """
    x, f = _uniform(one_state_reactor(), [305.0], [329.0], [12.0], samples)
    return _grown(x, f, Growth(N_Z, hidden_first=hidden - _HIDDEN_MORE, hidden_more=_HIDDEN_MORE,
                               whitening=WHITENING))


SYSTEMS = {'two-state example': two_state, 'one-state reactor': reactor}


def _grown(x: Array, f: Array, growth: Growth) -> Case:
    """Return the start of the last round of a growth."""
    data = ScaledSamples(torch.from_numpy(x), torch.from_numpy(f))
    parent = growth._root(data)
    for n_z in growth.rounds(x.shape[1])[:-1]:
        parent = growth.start(data, n_z, parent, _SEED)
    layout, theta = growth._extended(data, N_Z, parent, _SEED)
    return Case(layout, x, f, theta.numpy())


def _uniform(system: ControlAffineSystem, lower: list[float], upper: list[float],
             scale: list[float], samples: int) -> tuple[Array, Array]:
    """Draw states uniformly from a box and evaluate the exact drift, both scaled."""
    x = np.random.default_rng(_SEED).uniform(lower, upper, (samples, len(lower)))
    f = system.derivative(x, system.nominal_input) / scale
    # time is scaled as in training: rates of order one
    return (x - system.nominal_state) / scale, f / np.sqrt(np.mean(f ** 2))


def artificial(samples: int, n_x: int, n_z: int, hidden: int) -> Case:
    """Build a problem of given sizes for timing: smooth data, a random start of useful size."""
    rng = np.random.default_rng(_SEED)
    x = rng.uniform(-1.0, 1.0, (samples, n_x))
    layout = Layout(n_x, n_z, (hidden,), identity=True)
    return Case(layout, x, -x + 0.3 * np.sin(2.0 * x[:, ::-1]) - 0.2 * x ** 2,
                0.3 * rng.standard_normal(layout.size))
