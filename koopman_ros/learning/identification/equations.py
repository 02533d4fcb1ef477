# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A plant's own equations as a drift, some of whose constants are looked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.core.datasets import PlantDescription
from koopman_ros.core.units import SECONDS_PER_TIME_UNIT
from koopman_ros.learning.identification.drift import Drift
from koopman_ros.model import Box, Coordinates
from koopman_ros.plants import build, Constant, ControlAffineSystem

# Of an angle, by which the equations are differentiated by a constant: rounding and curvature both
# leave about ten digits.
_DIFFERENCE = 1e-5


@dataclass(frozen=True)
class Equations(Drift):
    """
    The equations of a plant's class, refined by the constants that are looked for.

    Each constant moves with the sine of an angle over its range, so that none leaves it. A
    :class:`~koopman_ros.learning.identification.output_error.Refinable` of these angles.
    """

    plant: Any  #: the class, see :func:`koopman_ros.plants.plant_class`
    estimated: tuple[Constant, ...]
    theta: Array  #: (p,) the angles
    #: (n_x,) that a class is given which takes one, for what it stands still at does not matter
    #: here and may not exist; None for another
    nominal: Array | None

    __repr__ = short_repr

    @classmethod
    def of(cls, plant: Any, estimated: Sequence[Constant], known: PlantDescription,
           x: Array, u: Array
           ) -> Equations:
        """
        Return the equations with the constants to begin with; states that are measured come first.

        :param known: names and units of the measured signals.
        :param x: (N, n_y) and u (N, n_u), as measured; states that are not are taken to
            move about their nominal values.
        :raises ValueError: when the names and units are not those of the plant's class.
        """
        theta = np.arcsin([one.start for one in estimated])
        system = _built(plant, estimated, theta, None)
        _check(system, plant, known)
        nominal: Array | None = system.nominal_state
        try:
            _built(plant, estimated, theta, nominal)
        except ValueError:
            nominal = None
        names = (*known.state_names,
                 *(name for name in system.state_names if name not in known.state_names))
        places = [system.state_names.index(name) for name in names[len(known.state_names):]]
        middle, half = system.nominal_state[places], 0.5 * system.state_scale[places]
        completed = replace(
            known, state_names=names, B=None, input_matrix_degree=0,
            state_units=(*known.state_units, *(system.state_units[i] for i in places)),
            nominal_state=np.concatenate((known.nominal_state, middle)))
        ends = np.linspace(-1.0, 1.0, len(x))[:, None]
        box = Box.of(completed, np.hstack([x, middle + half * ends]), u, nominal=False)
        return cls(box, plant, tuple(estimated), theta, nominal)

    @property
    def form(self) -> str:
        """Whose equations they are."""
        return f'equations of {self.plant.__name__}'

    @property
    def drift(self) -> Equations:
        """Itself."""
        return self

    def at(self, theta: Array) -> Equations:
        """Return the same with other angles."""
        return replace(self, theta=theta)

    def moved(self, states: Coordinates) -> Equations:
        """Return the same in deviations of other coordinates of the states."""
        return replace(self, box=replace(self.box, states=states))

    @property
    def shares(self) -> Array:
        """Where in their ranges the constants are (p,), from -1 to 1."""
        return np.sin(self.theta)

    def scaled_rate(self, xi: Array, v: Array) -> Array:
        """Evaluate the rate in deviations; see :class:`Drift`."""
        rate: Array = _rate(self._system, *self._own(xi, v)).take(self._back, axis=-1)
        return rate * self._pace

    def rates(self, xi: Array, v: Array, S: Array) -> tuple[Array, Array]:
        """Evaluate rates of states and, by central differences in the angles, of sensitivities."""
        rate = self.scaled_rate(xi, v)
        if not S.shape[-1]:
            return rate, S
        x, u = self._own(xi, v)
        dS = self.scaled_slope(xi, v) @ S
        for j, (ahead, behind) in enumerate(self._neighbours):
            change = _rate(ahead, x, u) - _rate(behind, x, u)
            dS[..., j] += change.take(self._back, axis=-1) * (self._pace / (2.0 * _DIFFERENCE))
        return rate, dS

    def scaled_slope(self, xi: Array, v: Array | None = None) -> Array:
        """Evaluate the Jacobian of the scaled rate; see :class:`Drift`."""
        x, u = self._own(xi, np.zeros(len(self.box.inputs)) if v is None else v)
        scale = self.box.states.scale
        slope = self._system.slope(x, u)[..., self._back[:, None], self._back]
        mixed: Array = slope * (self._speed * scale / scale[:, None])
        return mixed

    @property
    def varying_input_matrix(self) -> bool:
        """Whether B depends on the state."""
        return callable(self._system.B)

    def scaled_input_matrix(self, xi: Array) -> Array:
        """Evaluate B(x) in deviations; see :class:`Drift`."""
        x = self.box.states.to_physical(xi)
        B = self._speed * (self._system.input_matrix(x[..., self._states])
                           if self.varying_input_matrix else np.asarray(self._system.B))
        order = np.argsort(self._inputs)
        return self.box.input_matrix(B[..., self._back[:, None], order])

    @cached_property
    def _system(self) -> ControlAffineSystem:
        return self._at(self.theta)

    @cached_property
    def _neighbours(self) -> list[tuple[ControlAffineSystem, ControlAffineSystem]]:
        """The equations with each angle a little larger, and smaller."""
        return [(self._at(self.theta + step), self._at(self.theta - step))
                for step in _DIFFERENCE * np.eye(len(self.theta))]

    @cached_property
    def _states(self) -> NDArray[np.int64]:
        """Where the states of the class are among those of the box; below, the other way round."""
        return np.array([self.box.states.names.index(n) for n in self._system.state_names])

    @cached_property
    def _back(self) -> NDArray[np.int64]:
        return np.argsort(self._states)

    @cached_property
    def _inputs(self) -> NDArray[np.int64]:
        return np.array([self.box.inputs.names.index(n) for n in self._system.input_names],
                        dtype=np.int64)

    def _at(self, theta: Array) -> ControlAffineSystem:
        return _built(self.plant, self.estimated, theta, self.nominal)

    @cached_property
    def _speed(self) -> float:
        """Time units of the class in one of the box."""
        return SECONDS_PER_TIME_UNIT[self.box.time_unit] / self._system.seconds_per_time_unit

    @cached_property
    def _pace(self) -> Array:
        """Deviations a time unit of the box in rates of the class (n_x,)."""
        return self._speed / self.box.states.scale

    def _own(self, xi: Array, v: Array) -> tuple[Array, Array]:
        """Return states and inputs as the class has them."""
        return (self.box.states.to_physical(xi).take(self._states, axis=-1),
                self.box.inputs.to_physical(v).take(self._inputs, axis=-1))


def _rate(system: ControlAffineSystem, x: Array, u: Array) -> Array:
    return system.drift(x) + system.forcing(x, u)


def _built(plant: Any, estimated: Sequence[Constant], theta: Array, nominal: Array | None
           ) -> ControlAffineSystem:
    return build(plant, {one.name: one.value(share) for one, share in zip(
        estimated, np.sin(theta).tolist(), strict=True)}, nominal)


def _check(system: ControlAffineSystem, plant: Any, known: PlantDescription) -> None:
    """Raise ValueError unless the signals are states and all inputs of the equations."""
    for kind, exact in (('state', False), ('input', True)):
        own, given = (dict(zip(getattr(one, f'{kind}_names'), getattr(one, f'{kind}_units'),
                               strict=True)) for one in (system, known))
        if not given.items() <= own.items() or (exact and given != own):
            listed, needed = (', '.join(f'{name} [{unit}]' for name, unit in one.items()) or 'none'
                              for one in (given, own))
            raise ValueError(f'the record has the {kind}s {listed}, but {plant.__name__} has '
                             f'{needed}: use the names and units of the class')
