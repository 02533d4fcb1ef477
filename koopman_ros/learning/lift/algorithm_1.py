# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What growth is compared with: the paper's recipe, linearisation and polynomial EDMD."""

from dataclasses import dataclass

import numpy as np
import torch

from koopman_ros import __version__
from koopman_ros.learning.lift.incremental import Grown, Monitor
from koopman_ros.learning.lift.input_model import InputModel
from koopman_ros.learning.lift.levenberg_marquardt import minimise, MinimumStatus
from koopman_ros.learning.lift.network import check_activation, Layout
from koopman_ros.learning.lift.residuals import (
    deviations,
    LiftProblem,
    ResidualWeights,
    ScaledSamples,
)
from koopman_ros.lifting import (
    Box,
    LiftedModel,
    linearised_model,
    PolynomialObservables,
    Provenance,
)
from koopman_ros.plant_data import Array, Plant, Samples


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
    from a useless one; see :class:`~koopman_ros.learning.lift.incremental.Growth` for what does.
    """

    n_z: int  #: number of lifted coordinates
    #: whether z starts with the state (the paper's choice in its two-state example)
    identity: bool = False
    hidden: tuple[int, ...] = (8,)  #: units of each hidden layer of the lift
    activation: str = 'tanh'  #: as in :class:`~koopman_ros.learning.lift.incremental.Growth`
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
        if not self.hidden:
            raise ValueError('hidden must name the units of at least one layer')
        if min(self.n_z, self.decoder, self.max_rounds, self.max_iterations, *self.hidden) < 1:
            raise ValueError(f'sizes and limits must be at least 1: {self}')
        check_activation(self.activation)

    def rounds(self, n_x: int) -> tuple[int, ...]:
        """Return the n_z of the one round of starts; ValueError when the states need more."""
        if self.n_z < n_x + self.identity:
            raise ValueError(f'n_z = {self.n_z} is too small for {n_x} states')
        return (self.n_z,)

    def start(self, data: ScaledSamples, n_z: int, parent: Grown | None, seed: int,
              monitor: Monitor | None = None) -> Grown:
        """Run the algorithm once, as :meth:`Growth.start`; `parent` has no part in it."""
        layout = Layout(data.x.shape[1], n_z, self.hidden, self.identity, self.activation,
                        0 if data.u is None else data.u.shape[1], self.decoder)
        generator = torch.Generator().manual_seed(seed)
        theta = torch.randn(layout.size, generator=generator, dtype=torch.float64).to(data.x)
        problem = LiftProblem(layout, data, ResidualWeights())
        status, iterations = MinimumStatus.MAX_ITERATIONS, 0
        for number in range(self.max_rounds):
            weight = self.lambda_initial / self.gamma ** number
            weighted = problem.with_weights(ResidualWeights(decoder=weight))
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
        return Grown(layout, theta, status, iterations=iterations)


@dataclass(frozen=True)
class Linearisation:
    """The linearisation at the nominal point."""

    jacobian: Array  #: (n_x, n_x) df/dx there, in units

    def learn(self, plant: Plant, samples: Samples, box: Box | None = None) -> LiftedModel:
        """Return the model in a box, the samples' by default; ValueError when B is unknown."""
        box = box or Box.of(plant, samples.x, samples.u)
        B = plant.input_matrix(plant.nominal_state)
        return linearised_model(self.jacobian, B, box.states, box.inputs,
                                box.time_unit, _provenance(plant, samples))


@dataclass(frozen=True)
class Edmd:
    """
    Extended dynamic mode decomposition of the generator, with inputs, on monomials.

    dz/dt = A z + J(x) B(x) u by linear least squares on J (dx/dt - B(x) u), z all monomials of the
    scaled states up to a degree; degree 1 is the linear model that fits the samples best. The
    drift is read off the rows of the states, which are a fit to dx/dt by itself. Where B is not
    known it comes from them, too. (Williams, Kevrekidis, Rowley 2015;
    generator with control-affine inputs: Peitz, Otto, Rowley 2020.)
    """

    degree: int = 3  #: highest total degree of the monomials

    def learn(self, plant: Plant, samples: Samples, box: Box | None = None) -> LiftedModel:
        """Fit the model in the coordinates of a box, the samples' by default."""
        box = box or Box.of(plant, samples.x, samples.u)
        x, rate, u = deviations(box, samples)
        observables = PolynomialObservables.total_degree(x.shape[1], self.degree)
        z, J = observables.lift_and_jacobian(x)
        inputs = InputModel.of(plant, box, samples.x)
        drift, regressors = inputs.apart(x, rate, u)
        learned = None
        if regressors is not None:
            both = np.linalg.lstsq(np.hstack([z, regressors]), rate, rcond=None)[0]
            learned = both[z.shape[1]:].T.astype(np.float64)
            drift = rate - regressors @ learned.T
        B, terms = inputs.matrix(learned)
        z_rate = (J @ drift[..., None])[..., 0]
        A = np.linalg.lstsq(z, z_rate, rcond=None)[0].T.astype(np.float64)
        return LiftedModel(observables, A, B, box.states, box.inputs, box.time_unit,
                           _provenance(plant, samples), readout=A[:x.shape[1]],
                           input_terms=terms)


def _provenance(plant: Plant, samples: Samples) -> Provenance:
    return Provenance(plant.name, None, samples.digest(), {}, __version__)
