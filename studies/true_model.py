# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A plant's own equations in the place of a learned model, so that the rest can be judged."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.model import Coordinates, LiftedModel, NetworkObservables, Provenance
from koopman_ros.model.input_matrix import InputTerms
from koopman_ros.model.lifted_model import NODES, WEIGHTS
from koopman_ros.plants import ControlAffineSystem

_AFFINE = 1e-9  # relative, of what an input matrix may miss of a straight line


@dataclass(frozen=True)
class TrueModel(LiftedModel):
    """The drift of a plant whose B is constant or affine in x; the lift is the state itself."""

    system: ControlAffineSystem | None = None  #: the plant

    @classmethod
    def of(cls, system: ControlAffineSystem, lower: Array, upper: Array, input_lower: Array,
           input_upper: Array) -> Self:
        """
        Return the model about the nominal point, scaled by half the widths of its box.

        :param lower: (n_x,) of the box, to `upper` (n_x,), in state units.
        :param input_lower: (n_u,) in input units.
        :raises ValueError: where B(x) is not affine.
        """
        states, inputs = (
            Coordinates(names, units, center, 0.5 * (np.asarray(high) - low), low, high)
            for names, units, center, low, high in (
                (system.state_names, system.state_units, system.nominal_state, lower, upper),
                (system.input_names, system.input_units, system.nominal_input, input_lower,
                 input_upper)))
        itself = NetworkObservables.linear(len(states))
        slope = system.slope(states.center, inputs.center) * states.scale / states.scale[:, None]
        B, terms = _input_matrix(system, states, inputs)
        return cls(itself, slope, B, states, inputs, system.time_unit, Provenance(system.name),
                   input_terms=terms, system=system)

    def drift(self, x: Array) -> Array:
        """Evaluate f, the rate of the state at the nominal input: (..., n_x) -> same."""
        assert self.system is not None
        states, u = self.states, self.inputs.center
        rate = self.system.derivative(states.to_physical(x), np.broadcast_to(
            u, (*np.shape(x)[:-1], len(u))))
        return np.asarray(rate / states.scale)

    def drift_jacobian(self, x: Array) -> Array:
        """Evaluate df/dx: (..., n_x) -> (..., n_x, n_x)."""
        assert self.system is not None
        states, u = self.states, self.inputs.center
        slope = self.system.slope(states.to_physical(x), np.broadcast_to(
            u, (*np.shape(x)[:-1], len(u))))
        return np.asarray(slope * states.scale / states.scale[:, None])

    def drift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate both."""
        return self.drift(x), self.drift_jacobian(x)

    def averaged_drift_jacobian(self, x: Array, x_ref: Array) -> Array:
        """Average df/dx along the segment from x_ref to x, both (n_x,)."""
        along = self.drift_jacobian(x_ref + NODES[:, None] * (x - x_ref))
        return WEIGHTS.dot(along.reshape(len(WEIGHTS), -1)).reshape(self.n_x, self.n_x)


def _input_matrix(system: ControlAffineSystem, states: Coordinates, inputs: Coordinates
                  ) -> tuple[Array, InputTerms | None]:
    """Return B (n_x, n_u) at the nominal point and its further terms, in scaled coordinates."""
    def scaled(x: Array) -> Array:
        found = system.input_matrix(states.to_physical(x)) * inputs.scale
        return np.asarray(found / states.scale[:, None])

    n_x = len(states)
    B = scaled(np.zeros(n_x))
    if not callable(system.B):
        return B, None
    slopes = scaled(np.eye(n_x)) - B
    there = np.linspace(-0.7, 1.0, n_x)
    missed = np.max(np.abs(scaled(there) - B - np.tensordot(there, slopes, 1)))
    if not missed <= _AFFINE * np.max(np.abs(B)):
        raise ValueError(f'{system.name}: B(x) misses an affine function by {missed:.2g}: take a '
                         'plant whose input matrix is affine in the state')
    return B, InputTerms(slopes)
