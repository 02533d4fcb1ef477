# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The least-squares problems that all solvers are given, from the same data and start."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

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
    """One problem with its start."""

    layout: Layout  #: sizes, identity coordinates and one tanh layer
    data: ScaledSamples  #: N samples
    theta: Tensor  #: (p,) where every solver starts

    @property
    def problem(self) -> Problem:
        """The objective, as our learner takes it."""
        return Problem(self.layout, self.data, ResidualWeights(WHITENING))

    def save(self, path: Path) -> None:
        """Write the case for the processes of the solvers."""
        np.savez(path, x=self.data.x.numpy(), f=self.data.f.numpy(), theta=self.theta.numpy(),
                 n_z=self.layout.n_z, hidden=self.layout.hidden)


def load(path: Path) -> Case:
    """Read a case."""
    with np.load(path) as held:
        layout = Layout(held['x'].shape[1], int(held['n_z']),
                        tuple(int(h) for h in held['hidden']), identity=True)
        return Case(layout,
                    ScaledSamples(torch.from_numpy(held['x']), torch.from_numpy(held['f'])),
                    torch.from_numpy(held['theta']))


def two_state(samples: int, hidden: int) -> Case:
    """Build the two-state example, where the recipe reaches n_z = 3 in its first round."""
    # the exact lift of this box is known: z3 = x1^2
    data = _uniform(two_state_example(), [-6.0, -6.0], [6.0, 8.0], [6.0, 7.0], samples)
    growth = Growth(N_Z, hidden_first=hidden, whitening=WHITENING)
    layout, theta = growth._extended(data, N_Z, growth._root(data), _SEED)
    return Case(layout, data, theta)


def reactor(samples: int, hidden: int) -> Case:
    """
    Build the one-state reactor, where the recipe reaches n_z = 3 in its second round.

    The first round, n_z = 2, is trained here by our learner; what is compared is the second
    round, from the start which that leaves to every solver alike. Without a first round hardly
    any start gets below 1e-6.
    """
    data = _uniform(one_state_reactor(), [305.0], [329.0], [12.0], samples)
    growth = Growth(N_Z, hidden_first=hidden - _HIDDEN_MORE, hidden_more=_HIDDEN_MORE,
                    whitening=WHITENING)
    first = growth.start(data, N_Z - 1, None, _SEED)
    layout, theta = growth._extended(data, N_Z, first, _SEED)
    return Case(layout, data, theta)


SYSTEMS = {'two-state example': two_state, 'one-state reactor': reactor}


def _uniform(system: ControlAffineSystem, lower: list[float], upper: list[float],
             scale: list[float], samples: int) -> ScaledSamples:
    """Draw states uniformly from a box and evaluate the exact drift, both scaled."""
    x = np.random.default_rng(_SEED).uniform(lower, upper, (samples, len(lower)))
    f = system.derivative(x, system.nominal_input) / scale
    # time is scaled as in training: rates of order one
    f /= np.sqrt(np.mean(f ** 2))
    return ScaledSamples(torch.from_numpy((x - system.nominal_state) / scale), torch.from_numpy(f))


def artificial(samples: int, n_x: int, n_z: int, hidden: int) -> Case:
    """Build a problem of given sizes for timing: smooth data, a random start of useful size."""
    rng = np.random.default_rng(_SEED)
    x = rng.uniform(-1.0, 1.0, (samples, n_x))
    f = -x + 0.3 * np.sin(2.0 * x[:, ::-1]) - 0.2 * x ** 2
    layout = Layout(n_x, n_z, (hidden,), identity=True)
    theta = 0.3 * rng.standard_normal(layout.size)
    return Case(layout, ScaledSamples(torch.from_numpy(x), torch.from_numpy(f)),
                torch.from_numpy(theta))


def invariant_residual(layout: Layout, data: ScaledSamples, theta: Tensor) -> float:
    """
    Return rw = ||(J_N f - A N) S^(-1/2)||^2 / ||J_N f S^(-1/2)||^2 with S = E[z z'].

    :param theta: (p,).
    :return: rw, infinite where coordinates have collapsed.
    """
    parameters = layout.split(theta)
    lifted = Pass(layout, parameters, data.x, data.f)
    factor, info = torch.linalg.cholesky_ex(lifted.z.T @ lifted.z / len(data))
    if int(info):
        return float('inf')
    both = torch.cat([lifted.z_rate - lifted.z @ parameters.A.T, lifted.z_rate])
    white = torch.linalg.solve_triangular(factor.T, both, upper=True, left=False)
    residual, reference = white.square().sum(1).view(2, -1).sum(1)
    value = float(residual / reference)
    return value if value == value else float('inf')
