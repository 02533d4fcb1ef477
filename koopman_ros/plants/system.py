# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control-affine system dx/dt = f(x) + B(x) u that every plant is, and its holding inputs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.core.arrays import Array, frozen, short_repr
from koopman_ros.core.datasets import PlantDescription
from koopman_ros.core.units import SECONDS_PER_TIME_UNIT

ArrayFunction = Callable[[Array], Array]

# Of each state, by which B(x) is differentiated: rounding and curvature both leave about ten
# digits.
_DIFFERENCE = 1e-5
_NEWTON_STEPS = 50  # which are quick, and more than a plant near its nominal point needs


def checked_vector(name: str, value: ArrayLike, length: int, *, finite: bool = True) -> Array:
    """Return :func:`frozen` of a vector, which may be given by one number for all of it."""
    array = np.asarray(value, dtype=np.float64)
    whole = np.broadcast_to(array, (length,)) if array.ndim == 0 else array
    return frozen(whole, name, (length,), finite=finite)


@dataclass(frozen=True, eq=False)
class ControlAffineSystem:
    """
    A plant dx/dt = f(x) + B(x) u (paper, eq. 22), with names, units and a nominal point.

    :raises ValueError: when a shape, a unit or a bound does not fit, naming it.
    """

    name: str  #: what the plant is called in messages
    state_names: tuple[str, ...]  #: n_x names; their units, one each, in `state_units`
    state_units: tuple[str, ...]
    #: n_u names (n_u may be 0); their units, one each, in `input_units`
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    time_unit: str  #: 'min' or 's', the unit of every duration and of the rates
    drift: ArrayFunction = field(repr=False)  #: f, states (..., n_x) to rates (..., n_x)
    #: df/dx, states (..., n_x) to (..., n_x, n_x)
    drift_jacobian: ArrayFunction = field(repr=False)
    #: input matrix (n_x, n_u), or a function of states (..., n_x) to (..., n_x, n_u)
    B: Array | ArrayFunction
    nominal_state: Array  #: the point (n_x,) that deviations are measured from
    nominal_input: Array  #: the input (n_u,) that goes with it
    #: lowest states (n_x,) at which the model means anything; none by default
    state_lower: Array = field(default_factory=lambda: np.array(-np.inf))
    #: highest such states (n_x,); none by default
    state_upper: Array = field(default_factory=lambda: np.array(np.inf))

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if self.time_unit not in SECONDS_PER_TIME_UNIT:
            raise ValueError(
                f'time_unit is {self.time_unit!r}, must be one of '
                + ', '.join(map(repr, SECONDS_PER_TIME_UNIT)))
        for kind in ('state', 'input'):
            names, units = (tuple(getattr(self, f'{kind}_{what}')) for what in ('names', 'units'))
            object.__setattr__(self, f'{kind}_names', names)
            object.__setattr__(self, f'{kind}_units', units)
            if len(names) != len(units):
                raise ValueError(f'incompatible {kind}_units: expected ({len(names)},), '
                                 f'got ({len(units)},)')
        if not self.state_names:
            raise ValueError('state_names is empty, a system has at least one state')
        if not callable(self.B):
            object.__setattr__(self, 'B', frozen(self.B, 'B', (self.n_x, self.n_u)))
        for name, checked in (
                ('nominal_state', self.checked_state), ('nominal_input', self.checked_input),
                ('state_lower', self.checked_bound), ('state_upper', self.checked_bound)):
            object.__setattr__(self, name, checked(name, getattr(self, name)))
        if not np.all(self.state_lower < self.state_upper):
            raise ValueError(
                f'state_lower {self.state_lower} must lie below state_upper {self.state_upper}')
        # a drift or a Jacobian that does not keep its leading axes
        single = self.nominal_state
        for state in (single, np.stack([single, single])):
            for name, function, expected in (
                ('drift(x)', self.drift, state.shape),
                ('drift_jacobian(x)', self.drift_jacobian, (*state.shape, self.n_x)),
                ('B(x)', self.input_matrix, (*state.shape, self.n_u)),
            ):
                got = np.shape(function(state))
                if got != expected:
                    raise ValueError(
                        f'incompatible {name} at x of shape {state.shape}: '
                        f'expected {expected}, got {got}')

    @property
    def n_x(self) -> int:
        """The number of states."""
        return len(self.state_names)

    @property
    def n_u(self) -> int:
        """The number of inputs."""
        return len(self.input_names)

    @property
    def seconds_per_time_unit(self) -> float:
        """The length of `time_unit` in seconds."""
        return SECONDS_PER_TIME_UNIT[self.time_unit]

    @property
    def state_scale(self) -> Array:
        """The magnitude (n_x,) of each state: the nominal one, and 1 where that is zero."""
        magnitude = np.abs(self.nominal_state)
        return np.where(magnitude > 0.0, magnitude, 1.0)

    def derivative(self, x: ArrayLike, u: ArrayLike) -> Array:
        """Evaluate dx/dt = f(x) + B(x) u: (..., n_x), (..., n_u) that broadcast -> (..., n_x)."""
        x, u = np.asarray(x, dtype=np.float64), np.asarray(u, dtype=np.float64)
        for name, value, length in (('x', x, self.n_x), ('u', u, self.n_u)):
            if value.ndim == 0 or value.shape[-1] != length:
                raise ValueError(
                    f'incompatible {name}: expected (..., {length}), got {value.shape}')
        return self.drift(x) + self.forcing(x, u)

    def input_matrix(self, x: Array) -> Array:
        """Evaluate B(x): (..., n_x) -> (..., n_x, n_u)."""
        if callable(self.B):
            return np.asarray(self.B(x), dtype=np.float64)
        return np.broadcast_to(self.B, (*x.shape, self.n_u))

    def forcing(self, x: Array, u: Array) -> Array:
        """Evaluate B(x) u: (..., n_x), (..., n_u) that broadcast -> (..., n_x)."""
        if callable(self.B):
            return (self.input_matrix(x) @ u[..., None])[..., 0]
        return u @ self.B.T

    def slope(self, x: Array, u: Array) -> Array:
        """Evaluate d(f(x) + B(x) u)/dx: (..., n_x), (..., n_u) -> (..., n_x, n_x)."""
        slope = self.drift_jacobian(x)
        if not callable(self.B):
            return slope
        # of B by central differences
        steps = _DIFFERENCE * np.diag(self.state_scale)
        ahead, behind = (self.forcing(x[..., None, :] + sign * steps, u[..., None, :])
                         for sign in (1.0, -1.0))
        columns = (ahead - behind) / (2.0 * _DIFFERENCE * self.state_scale[:, None])
        return slope + columns.swapaxes(-1, -2)

    def checked_state(self, name: str, value: ArrayLike) -> Array:
        """Return `value` as a read-only state (n_x,); raise ValueError naming it if it is none."""
        return frozen(value, name, (self.n_x,))

    def checked_input(self, name: str, value: ArrayLike) -> Array:
        """Return `value` as a read-only input (n_u,); raise ValueError naming it if it is none."""
        return frozen(value, name, (self.n_u,))

    def checked_bound(self, name: str, value: ArrayLike) -> Array:
        """Return `value`, a scalar or (n_x,) and possibly infinite, as a bound on the states."""
        return checked_vector(name, value, self.n_x, finite=False)

    def describe_state(self, x: Array) -> str:
        """Write a state (n_x,) with names and units, for a message."""
        return ', '.join(
            f'{name} = {value:.10g}' + ('' if unit == '1' else f' {unit}')
            for name, value, unit in zip(self.state_names, x, self.state_units, strict=True))


def describe(system: ControlAffineSystem) -> PlantDescription:
    """Return what training may know of a plant beside its data: all but the drift."""
    return PlantDescription(system.name, system.state_names, system.state_units,
                            system.input_names,
                            system.input_units, system.time_unit, system.nominal_state,
                            system.nominal_input, system.B)


class EquilibriumError(ValueError):
    """There is no steady state or no holding input where one was asked for."""


def equilibrium_input(system: ControlAffineSystem, state: ArrayLike) -> Array:
    """
    Find the constant input (n_u,) that holds a state (n_x,): B(x) u = -f(x) by least squares.

    A state is held when no state variable changes by more than 1e-9 of itself a time unit.

    :raises ValueError: when `state` does not fit the system.
    :raises EquilibriumError: when no input holds that state.
    """
    held = system.checked_state('state', state)
    u = np.asarray(np.linalg.lstsq(
        system.input_matrix(held), -system.drift(held), rcond=None)[0], np.float64)
    rate = system.derivative(held, u)
    magnitude = np.where(held != 0.0, np.abs(held), system.state_scale)
    worst = int(np.argmax(np.abs(rate) / magnitude))
    if not abs(rate[worst]) <= 1e-9 * magnitude[worst]:
        raise EquilibriumError(
            f'{system.name}: no input holds {system.describe_state(held)}: '
            f'{system.state_names[worst]} still changes by {rate[worst]:.3g} '
            f'{system.state_units[worst]}/{system.time_unit}; '
            'choose a steady state')
    return u


def steady_state(system: ControlAffineSystem, wanted: Mapping[str, float]
                 ) -> tuple[Array, Array]:
    """
    Find the state (n_x,) and the input (n_u,) that hold some states at values, given by name.

    Newton's method from the nominal point, by least norm where values leave a choice.

    :raises ValueError: for a name that is no state.
    :raises EquilibriumError: when no input holds them.
    """
    if unknown := wanted.keys() - set(system.state_names):
        raise ValueError(f'{min(unknown)} is no state of {system.name}: choose of '
                         f'{", ".join(system.state_names)}')
    held = np.array([name in wanted for name in system.state_names])
    x, u = system.nominal_state.copy(), system.nominal_input
    x[held] = [wanted[name] for name in system.state_names if name in wanted]
    others = np.eye(system.n_x)[:, ~held]
    for _ in range(_NEWTON_STEPS):
        slope = np.hstack([system.slope(x, u) @ others, system.input_matrix(x)])
        change = np.linalg.lstsq(slope, -system.derivative(x, u), rcond=None)[0]
        x = x + others @ change[:others.shape[1]]
        u = u + change[others.shape[1]:]
    equilibrium_input(system, x)
    return x, u
