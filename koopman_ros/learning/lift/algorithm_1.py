# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Algorithm 1 of the paper, to which incremental training is compared."""

from dataclasses import dataclass, replace

import torch

from koopman_ros.learning.lift.incremental import Monitor, TrainedLift
from koopman_ros.learning.lift.levenberg_marquardt import minimise, MinimumStatus
from koopman_ros.learning.lift.network import Layout
from koopman_ros.learning.lift.residuals import LiftProblem, ResidualWeights, ScaledSamples


@dataclass(frozen=True)
class Algorithm1:
    """
    Algorithm 1 of the paper, as printed.

    All parameters (network, A, decoder, B where it is learned) start from the standard normal
    distribution. The dynamics residual plus lambda times the decoder residual is minimised to
    local optimality or `max_iterations`, then lambda is divided by gamma, until the parameters
    move by less than `tolerance` (Euclidean distance, the paper's first criterion) or after
    `max_rounds` (its second). The paper leaves the sizes of the networks open; the solver is
    Levenberg-Marquardt where the paper takes IPOPT.

    The objective falls when z shrinks and the decoder grows, so that it does not tell a good lift
    from a useless one; see :class:`IncrementalTraining` for one that does.
    """

    n_z: int  #: number of lifted coordinates
    #: whether z starts with the state (the paper's choice in its two-state example)
    identity: bool = False
    hidden: int = 8  #: hidden units of the lift
    decoder: int = 8  #: units of the decoder network
    lambda_initial: float = 10.0  #: first weight of the decoder term
    gamma: float = 10.0  #: decay rate of lambda, above 1
    tolerance: float = 1e-3  #: distance between successive parameter vectors taken as convergence
    max_rounds: int = 8  #: limit of minimisations
    max_iterations: int = 300  #: limit of steps in each

    def __post_init__(self) -> None:
        if not self.gamma > 1.0:
            raise ValueError(f'gamma must be above 1, got {self.gamma}')
        if not self.lambda_initial > 0.0:
            raise ValueError(f'lambda_initial must be above 0, got {self.lambda_initial}')
        if min(self.n_z, self.decoder, self.max_rounds, self.max_iterations, self.hidden) < 1:
            raise ValueError(f'sizes and limits must be at least 1: {self}')

    def rounds(self, n_x: int) -> tuple[int, ...]:
        """Return the n_z of the one round of starts; ValueError when the states need more."""
        if self.n_z < n_x + self.identity:
            raise ValueError(f'n_z = {self.n_z} is too small for {n_x} states')
        return (self.n_z,)

    def start(self, data: ScaledSamples, n_z: int, parent: TrainedLift | None, seed: int,
              monitor: Monitor | None = None) -> TrainedLift:
        """Run the algorithm once; `parent` is not used."""
        layout = Layout(data.x.shape[1], n_z, self.hidden, self.identity,
                        0 if data.u is None else data.u.shape[1], self.decoder)
        generator = torch.Generator().manual_seed(seed)
        theta = torch.randn(layout.size, generator=generator, dtype=torch.float64).to(data.x)
        problem = LiftProblem(layout, data, ResidualWeights())
        status, iterations = MinimumStatus.MAX_ITERATIONS, 0
        for number in range(self.max_rounds):
            weight = self.lambda_initial / self.gamma ** number
            weighted = replace(problem, weights=ResidualWeights(decoder=weight))
            minimum = minimise(weighted.add_residuals, theta, max_iterations=self.max_iterations,
                               monitor=monitor)
            iterations += minimum.iterations
            moved = float(torch.linalg.norm(minimum.theta - theta))
            theta, status = minimum.theta, minimum.status
            # where the start itself cannot move it has not converged, but is of no use
            if status is MinimumStatus.INTERRUPTED or (
                    status is MinimumStatus.STALLED and number == 0):
                break
            if moved <= self.tolerance:
                status = MinimumStatus.CONVERGED
                break
        return TrainedLift(layout, theta, status, iterations=iterations)
