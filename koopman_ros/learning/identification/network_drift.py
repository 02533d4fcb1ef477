# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A drift that is linear but for a small network of its states."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.core.solvers import decaying
from koopman_ros.learning.identification.drift import Drift, DriftModel
from koopman_ros.model import Coordinates

_FIRST = 0.01  # weights W2 to begin with
_SHARES = {'W1': 1.0, 'b1': 1.0, 'W2': 0.01}  # of the ridge, of which rates need less


@dataclass(frozen=True)
class NetworkDrift(Drift):
    """
    dx/dt = c + A x + r W2 tanh(W1 x + b1) + B u, in deviations within a box.

    Unlike a polynomial it grows no faster than a linear model outside the data. A
    :class:`~koopman_ros.learning.identification.output_error.Refinable` of all of its arrays.
    """

    A: Array  #: (n_x, n_x)
    B: Array  #: (n_x, n_u)
    c: Array  #: (n_x,)
    W1: Array  #: (n_h, n_x)
    b1: Array  #: (n_h,)
    W2: Array  #: (n_x, n_h)
    pace: float  #: r, a rate of the plant in 1/time unit, by which W2 has none
    ridge: float  #: weight of the network's squared parameters in the cost of output error
    learn_input_matrix: bool  #: whether B is refined

    __repr__ = short_repr

    @classmethod
    def added_to(cls, linear: DriftModel, hidden_units: int, seed: int, *, ridge: float,
               learn_input_matrix: bool) -> NetworkDrift:
        """Return a linear drift with a network that has almost no weight yet."""
        rng = np.random.default_rng(seed)
        n_x = len(linear.B)
        A = linear.coefficients[1:1 + n_x].T
        return cls(
            linear.box, A, linear.B, linear.coefficients[0],
            rng.standard_normal((hidden_units, n_x)), rng.standard_normal(hidden_units),
            _FIRST * rng.standard_normal((n_x, hidden_units)),
            float(np.max(np.abs(np.linalg.eigvals(A)))), ridge, learn_input_matrix)

    @property
    def form(self) -> str:
        """The kind of model, in words."""
        return f'drift by a network of {len(self.b1)} hidden units'

    @property
    def varying_input_matrix(self) -> bool:
        """Whether B depends on the state."""
        return False

    @property
    def bounded(self) -> bool:
        """Whether the state stays bounded with bounded inputs, whatever the network is."""
        return bool(decaying(np.linalg.eigvals(self.A)).all())

    @property
    def drift(self) -> NetworkDrift:
        """Itself."""
        return self

    @property
    def _refined(self) -> Iterator[str]:
        return (name for name in ('A', 'c', 'W1', 'b1', 'W2', 'B')
                if name != 'B' or self.learn_input_matrix)

    @property
    def theta(self) -> Array:
        """The refined arrays, one after the other."""
        return np.concatenate([getattr(self, name).ravel() for name in self._refined])

    @property
    def penalty(self) -> Array:
        """Weights of the squared parameters (p,) in the cost."""
        return np.concatenate([
            np.full(getattr(self, name).size, self.ridge * _SHARES.get(name, 0.0))
            for name in self._refined])

    def moved(self, states: Coordinates) -> NetworkDrift:
        """Return the same in deviations of other coordinates of the states."""
        old = self.box.states
        S, shift = states.scale / old.scale, (states.center - old.center) / old.scale
        return replace(
            self, box=replace(self.box, states=states), A=self.A * S / S[:, None],
            B=self.B / S[:, None], c=(self.c + self.A @ shift) / S, W1=self.W1 * S,
            b1=self.b1 + self.W1 @ shift, W2=self.W2 / S[:, None])

    def at(self, theta: Array) -> NetworkDrift:
        """Return the same with other parameters."""
        arrays, first = dict[str, Any](), 0
        for name in self._refined:
            own = getattr(self, name)
            arrays[name] = theta[first:first + own.size].reshape(own.shape)
            first += own.size
        return replace(self, **arrays)

    def scaled_rate(self, xi: Array, v: Array) -> Array:
        """Evaluate the rate in deviations; see :class:`Drift`."""
        network = self.pace * np.tanh(xi @ self.W1.T + self.b1) @ self.W2.T
        rate: Array = xi @ self.A.T + v @ self.B.T + self.c + network
        return rate

    def scaled_slope(self, xi: Array, v: Array | None = None) -> Array:
        """Evaluate the Jacobian of the scaled rate; see :class:`Drift`."""
        return self.A + self._weighed(np.tanh(xi @ self.W1.T + self.b1)) @ self.W1

    def scaled_input_matrix(self, xi: Array) -> Array:
        """Evaluate B in deviations; see :class:`Drift`."""
        return self.B

    def rates(self, xi: Array, v: Array, S: Array) -> tuple[Array, Array]:
        """Evaluate rates of states and sensitivities, as output error needs them."""
        rate = self.scaled_rate(xi, v)
        if not S.shape[-1]:
            return rate, S
        units = np.tanh(xi @ self.W1.T + self.b1)
        slopes = self._weighed(units)
        dS = (self.A + slopes @ self.W1) @ S
        n_x, n_h = self.W2.shape
        place = 0

        def add_rows(values: Array) -> None:
            # parameters of which each row acts on the rate of its own state
            nonlocal place
            width = values.shape[-1]
            for i in range(n_x):
                dS[:, i, place:place + width] += values
                place += width

        add_rows(xi)
        add_rows(np.ones((len(xi), 1)))
        dS[..., place:place + n_h * n_x] += (
            slopes[..., None] * xi[:, None, None, :]).reshape(len(xi), n_x, n_h * n_x)
        place += n_h * n_x
        dS[..., place:place + n_h] += slopes
        place += n_h
        add_rows(self.pace * units)
        if self.learn_input_matrix:
            add_rows(v)
        return rate, dS

    def _weighed(self, units: Array) -> Array:
        """Return the change of the rates with the sums of the hidden units: (..., n_x, n_h)."""
        slopes: Array = self.pace * self.W2 * (1.0 - units ** 2)[..., None, :]
        return slopes
