# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control-affine system dx/dt = f(x) + B(x) u that every plant is, and its holding inputs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.core.arrays import Array, frozen, short_repr
from koopman_ros.core.datasets import PlantDescription
from koopman_ros.core.solvers import differences
from koopman_ros.core.steady_state import bounded_least_squares
from koopman_ros.core.steady_state import steady_state as find_steady_state
from koopman_ros.core.units import check_time_unit, checked_signals, SECONDS_PER_TIME_UNIT

ArrayFunction = Callable[[Array], Array]

# Largest difference between a given Jacobian and finite differences, as a share of the largest
# entry in a row. Both are compared these shares of the magnitudes away from the nominal state.
_JACOBIAN_TOLERANCE = 1e-4
_NEARBY = (0.01, 0.02)
_UNDERFLOW = 1e-12  # a change of a rate that differences lose


def checked_vector(name: str, value: ArrayLike, length: int, *, finite: bool = True) -> Array:
    """Return :func:`frozen` of a vector, which may be given by one number for all of it."""
    array = np.asarray(value, dtype=np.float64)
    whole = np.broadcast_to(array, (length,)) if array.ndim == 0 else array
    return frozen(whole, name, (length,), finite=finite)


def _magnitude(nominal: Array) -> Array:
    """Return the sizes (n,) of nominal values, and 1 where these are zero."""
    return np.where(nominal != 0.0, np.abs(nominal), 1.0)


@dataclass(frozen=True)
class _DifferencedDrift:
    """The Jacobian of a drift by central differences."""

    drift: ArrayFunction
    scale: Array  # (n_x,) magnitudes of the states

    def __call__(self, x: Array) -> Array:
        return differences(self.drift, x, self.scale)


@dataclass(frozen=True, eq=False)
class ControlAffineSystem:
    """
    A plant dx/dt = f(x) + B(x) u (paper, eq. 22), with names, units and a nominal point.

    :raises ValueError: for a shape, a unit or a bound that does not fit, or a Jacobian that is not
        the derivative of the drift; the message names the entry.
    """

    name: str  #: name of the plant in messages
    state_names: tuple[str, ...]  #: n_x names; their units, one each, in `state_units`
    state_units: tuple[str, ...]
    #: n_u names (n_u may be 0); their units, one each, in `input_units`
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    time_unit: str  #: 'min' or 's', the unit of every duration and of the rates
    drift: ArrayFunction = field(repr=False)  #: f, states (..., n_x) to rates (..., n_x)
    #: df/dx, states (..., n_x) to (..., n_x, n_x); checked against finite differences of `drift`,
    #: which are used by default
    drift_jacobian: ArrayFunction = field(
        default=cast(ArrayFunction, None), repr=False, kw_only=True)
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
        check_time_unit(self.time_unit)
        for kind in ('state', 'input'):
            for what, given in zip(('names', 'units'), checked_signals(
                    kind, getattr(self, f'{kind}_names'), getattr(self, f'{kind}_units')),
                    strict=True):
                object.__setattr__(self, f'{kind}_{what}', given)
        if not self.state_names:
            raise ValueError('state_names is empty: a system needs at least one state')
        if not callable(self.B):
            object.__setattr__(self, 'B', frozen(self.B, 'B', (self.n_x, self.n_u)))
        for name, checked in (
                ('nominal_state', self.checked_state), ('nominal_input', self.checked_input),
                ('state_lower', self.checked_bound), ('state_upper', self.checked_bound)):
            object.__setattr__(self, name, checked(name, getattr(self, name)))
        if not np.all(self.state_lower < self.state_upper):
            raise ValueError(
                f'state_lower {self.state_lower} must lie below state_upper {self.state_upper}')
        if self.drift_jacobian is None or isinstance(self.drift_jacobian, _DifferencedDrift):
            object.__setattr__(
                self, 'drift_jacobian', _DifferencedDrift(self.drift, self.state_scale))
        # a drift or a Jacobian that does not keep its leading axes
        single = self.nominal_state
        for state in (single, np.stack([single, single])):
            for name, function, expected in (
                ('drift(x)', self.drift, state.shape),
                ('drift_jacobian(x)', self.drift_jacobian, (*state.shape, self.n_x)),
                ('B(x)', self.input_matrix, (*state.shape, self.n_u)),
            ):
                actual = np.shape(function(state))
                if actual != expected:
                    raise ValueError(
                        f'incompatible {name} at x of shape {state.shape}: '
                        f'expected {expected}, got {actual}')
        self._check_jacobian()

    def _check_jacobian(self) -> None:
        """Raise ValueError for the worst entry of a given Jacobian that differs from the drift."""
        if isinstance(self.drift_jacobian, _DifferencedDrift):
            return
        scale, excesses = self.state_scale, []
        # two states, neither of them nominal, where a drift may have a kink that is legitimate
        for share in _NEARBY:
            x = np.clip(self.nominal_state + share * scale, self.state_lower, self.state_upper)
            with np.errstate(all='ignore'):
                given = np.asarray(self.drift_jacobian(x), dtype=np.float64)
                expected = differences(self.drift, x, scale)
                rate = np.abs(self.drift(x))[:, None]
            # in the magnitudes of the states
            largest = np.maximum(rate, np.max(np.abs(expected) * scale, axis=-1, keepdims=True))
            allowed = _JACOBIAN_TOLERANCE * largest + _UNDERFLOW
            excesses.append(np.where(
                np.abs(x - self.nominal_state) > 0.5 * share * scale,
                np.abs(given - expected) * scale - allowed, 0.0))
        excess = np.nan_to_num(np.min(excesses, axis=0))
        i, j = np.unravel_index(np.argmax(excess), excess.shape)
        if excess[i, j] > 0.0:
            raise ValueError(
                f'{self.name}: drift_jacobian has {given[i, j]:.6g} in row {i}, column {j} (rate '
                f'of {self.state_names[i]} by {self.state_names[j]}) at {self.describe_state(x)}, '
                f'finite differences of drift give {expected[i, j]:.6g}: correct it, or give no '
                'drift_jacobian')

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
        return _magnitude(self.nominal_state)

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
        return slope + differences(lambda states: self.forcing(states, u[..., None, :]), x,
                                    self.state_scale)

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
    """Return the known description of a plant, for training: all but the drift."""
    return PlantDescription(system.name, system.state_names, system.state_units,
                            system.input_names,
                            system.input_units, system.time_unit, system.nominal_state,
                            system.nominal_input, system.B)


class EquilibriumError(ValueError):
    """A requested steady state or holding input does not exist."""


def equilibrium_input(system: ControlAffineSystem, state: ArrayLike) -> Array:
    """
    Find the constant input (n_u,) that holds a state (n_x,), of several the nearest to nominal.

    A state is held when no state variable changes by more than 1e-9 of itself a time unit.

    :raises ValueError: when `state` does not fit the system.
    :raises EquilibriumError: when no input holds that state.
    """
    held, size = system.checked_state('state', state), _magnitude(system.nominal_input)
    B, endless = system.input_matrix(held) * size, np.full(system.n_u, np.inf)
    nominal = system.nominal_input / size
    magnitude = np.where(held != 0.0, np.abs(held), system.state_scale)
    u = size * bounded_least_squares(
        ((B / magnitude[:, None], -system.drift(held) / magnitude),
         (np.eye(system.n_u), nominal)), -endless, endless, nominal)
    rate = system.derivative(held, u)
    worst = int(np.argmax(np.abs(rate) / magnitude))
    if not abs(rate[worst]) <= 1e-9 * magnitude[worst]:
        raise EquilibriumError(
            f'{system.name}: no input holds {system.describe_state(held)}: '
            f'{system.state_names[worst]} still changes by {rate[worst]:.3g} '
            f'{system.state_units[worst]}/{system.time_unit}; choose a steady state')
    return u


def steady_state(system: ControlAffineSystem, wanted: Mapping[str, float]
                 ) -> tuple[Array, Array]:
    """
    Find the state (n_x,) and the input (n_u,) that hold some states at values, given by name.

    Where the values leave a choice it is the steady state nearest to the nominal point.

    :raises ValueError: for a name that is not a state.
    :raises EquilibriumError: when no input holds them.
    """
    if unknown := wanted.keys() - set(system.state_names):
        raise ValueError(f'{min(unknown)} is not a state of {system.name}: choose from '
                         f'{", ".join(system.state_names)}')
    held = np.array([name in wanted for name in system.state_names])
    n, x = system.n_x, system.nominal_state.copy()
    x[held] = [wanted[name] for name in system.state_names if name in wanted]
    unit = np.concatenate([system.state_scale, _magnitude(system.nominal_input)])
    endless = np.full(system.n_u, np.inf)
    lower, upper = (
        np.concatenate([np.where(held, x, end), sign * endless]) / unit
        for sign, end in ((-1.0, system.state_lower), (1.0, system.state_upper)))
    y = np.concatenate([x, system.nominal_input]) / unit

    def slope(y: Array) -> Array:
        x, u = np.split(y * unit, [n])
        return np.hstack([system.slope(x, u), system.input_matrix(x)]) * unit / unit[:n, None]

    found = find_steady_state(
        lambda y: system.derivative(*np.split(y * unit, [n])) / unit[:n], slope, y, lower, upper,
        anchor=y)
    if found is None:
        return x, equilibrium_input(system, x)
    x, u = np.where(held, x, (found * unit)[:n]), (found * unit)[n:]
    equilibrium_input(system, x)
    return x, u
