# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plants of the study: their equations, initial states and excitation."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.control import Weights
from koopman_ros.core.arrays import Array
from koopman_ros.core.datasets import DriftSamples
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.learning import Linearisation
from koopman_ros.model import Box, LiftedModel
from koopman_ros.plants import (
    box_episodes,
    ControlAffineSystem,
    describe,
    RandomStepDesign,
    two_state_reactor,
)
from studies.shipped_models import library_system, LIFTS

# Of half the box: nearer than that to the nominal state, a secant is the slope.
_NEAR = 1e-6


@dataclass(frozen=True, eq=False)
class Regulation:
    """A plant to regulate to its nominal state from anywhere in a box."""

    system: ControlAffineSystem  #: the truth
    lower: Array  #: (n_x,) lower corner of the starts
    upper: Array  #: (n_x,) upper corner
    design: RandomStepDesign  #: of the steps; episodes that begin in the box may go this far
    episodes: int  #: to learn from
    duration: float  #: of each, in time units

    def samples(self, seed: int, episodes: int | None = None) -> DriftSamples:
        """Simulate episodes from states in the box, a fifth of them from its corners."""
        return box_episodes(self.system, self.design, episodes or self.episodes, self.duration,
                            seed, (self.lower, self.upper))

    @cached_property
    def units(self) -> tuple[Array, Array]:
        """Half widths of the box (n_x,) and of the steps (n_u,), in which errors are weighed."""
        return (0.5 * (self.upper - self.lower), np.broadcast_to(0.5 * (
            np.asarray(self.design.input_upper) - np.asarray(self.design.input_lower)),
            self.system.n_u))

    @cached_property
    def truth(self) -> LiftedModel:
        """The true plant, linearised at its nominal state."""
        few, plant = self.samples(0, 10), describe(self.system)
        return Linearisation(self.system.drift_jacobian(self.system.nominal_state)).learn(
            plant, few, Box.of(plant, few.x, few.u))

    @cached_property
    def horizon(self) -> float:
        """Six time constants of the slowest mode under the linear law, in time units."""
        truth, weights = self.truth, self.weights(self.truth)
        K = solve_riccati(truth.A, truth.B, weights.Q, weights.R).K
        return 6.0 / float(np.min(np.abs(np.linalg.eigvals(truth.A - truth.B @ K).real)))

    def weights(self, model: LiftedModel) -> Weights:
        """Return the weights in a model's scales: 1 on errors in :attr:`units`."""
        x, u = self.units
        return Weights(np.diag((model.states.scale / x) ** 2),
                       np.diag((model.inputs.scale / u) ** 2))

    def starts(self, count: int) -> Array:
        """Return the first (count, n_x) of a Sobol sequence in the box, the same ones always."""
        from scipy.stats import qmc
        points = qmc.Sobol(self.system.n_x, rng=0).random_base2((count - 1).bit_length())
        spread: Array = qmc.scale(points[:count], self.lower, self.upper)
        return spread

    def factorised(self, x: Array) -> Array:
        """
        Factorise the true drift: f(x) - f(x_0) = A(x) (x - x_0), x_0 nominal; A (n_x, n_x).

        State by state in their order, each column is the secant of the drift while one moves. Of
        Van der Pol's oscillator this is [[0, 1], [-1, mu (1 - x1^2)]], of the pendulum the slope
        g/l sin(x1)/x1, of the tanks 1/(sqrt(h) + sqrt(h_0)).
        """
        f, present, A = self.system.drift, self.system.nominal_state.copy(), []
        for i, step in enumerate(x - present):
            slope = self.system.drift_jacobian(present)[:, i]
            before, present[i] = f(present), x[i]
            A.append(slope if abs(step) < _NEAR * self.units[0][i]
                     else (f(present) - before) / step)
        return np.stack(A, axis=1)


def oscillator(name: str, force: Callable[[Array, Array], Array],
               slopes: Callable[[Array, Array], tuple[Array, Array]]) -> ControlAffineSystem:
    """
    Build x1' = x2, x2' = force(x1, x2) + u, nominal at the origin.

    :param slopes: of the force, by x1 and by x2.
    """
    def drift(x: Array) -> Array:
        return np.stack([x[..., 1], force(x[..., 0], x[..., 1])], axis=-1)

    def drift_jacobian(x: Array) -> Array:
        jacobian = np.zeros((*x.shape, 2))
        jacobian[..., 0, 1] = 1.0
        jacobian[..., 1, 0], jacobian[..., 1, 1] = slopes(x[..., 0], x[..., 1])
        return jacobian

    return ControlAffineSystem(
        name=name, state_names=('x1', 'x2'), state_units=('1', '1/s'), input_names=('u',),
        input_units=('1/s^2',), time_unit='s', drift=drift, drift_jacobian=drift_jacobian,
        B=np.array([[0.0], [1.0]]), nominal_state=np.zeros(2), nominal_input=np.zeros(1))


def _case(system: ControlAffineSystem, lower: ArrayLike, upper: ArrayLike, inputs: ArrayLike,
          hold: tuple[float, float], period: float, episodes: int = 120, holds: int = 10,
          room: float = 0.5) -> Regulation:
    """
    Return a case whose episodes may leave the box of their starts.

    :param inputs: how far steps go to both sides of the nominal input.
    :param period: of the samples, of which an episode has `holds` and one.
    :param room: how far they may leave it, in half-ranges.
    """
    lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    more = room * 0.5 * (upper - lower)
    u = np.broadcast_to(np.asarray(inputs), system.n_u)
    design = RandomStepDesign(
        input_lower=system.nominal_input - u, input_upper=system.nominal_input + u,
        state_lower=lower - more, state_upper=upper + more, hold_time=hold, sample_period=period,
        max_redraws=20, rtol=1e-9)
    return Regulation(system, lower, upper, design, episodes, holds * period)


def _shipped(name: str) -> Regulation:
    """Return the case of a shipped lift, whose episodes do not leave their box."""
    lift, system = LIFTS[name], library_system(name)
    lower, upper = (np.broadcast_to(np.asarray(bound, dtype=np.float64), system.n_x)
                    for bound in (lift.design.state_lower, lift.design.state_upper))
    return Regulation(system, lower, upper, lift.design, lift.episodes, lift.duration)


# the steady state with a coolant of 300 K from which the reactor cools down or ignites
SADDLE = np.array([0.4999182859586588, 350.00552869021254])
CASES = {
    'van_der_pol': _case(
        oscillator('Van der Pol', lambda x1, x2: (1.0 - x1 * x1) * x2 - x1,
                   lambda x1, x2: (-2.0 * x1 * x2 - 1.0, 1.0 - x1 * x1)),
        [-2.0, -2.0], [2.0, 2.0], 4.0, (0.05, 0.1), 0.05),
    'duffing': _case(
        oscillator('Duffing', lambda x1, x2: x1 - x1 ** 3 - 0.5 * x2,
                   lambda x1, x2: (1.0 - 3.0 * x1 * x1, -0.5 + 0.0 * x1)),
        [-1.2, -1.2], [1.2, 1.2], 2.0, (0.05, 0.1), 0.05),
    'pendulum': _case(library_system('pendulum'), [-1.8, -2.0], [1.8, 2.0], 8.0, (0.05, 0.1),
                      0.05),
    'two_state_example': _shipped('two_state_example'),
    'reactor_saddle': _case(two_state_reactor(nominal_state=SADDLE), [0.4, 340.0], [0.6, 360.0],
                            10.0, (0.05, 0.1), 0.025),
    'two_tanks': _shipped('two_tanks'),
    'quadruple_tank': _shipped('quadruple_tank'),
}
