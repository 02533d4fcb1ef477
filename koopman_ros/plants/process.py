# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A plant that runs in time, behind its actuators and dead times, and its sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from typing import cast

import numpy as np

from koopman_ros.core.arrays import all_finite, Array, expect, short_repr
from koopman_ros.core.signals import numbers
from koopman_ros.core.units import NANOSECONDS, nanoseconds
from koopman_ros.plants.simulation import advance
from koopman_ros.plants.system import ArrayFunction, ControlAffineSystem

# After so many time constants exp(-40) of a step is left, less than a double can tell.
_SETTLED = 40.0


@dataclass(frozen=True)
class Actuator:
    """How the inputs follow their commands, a number for all or (n_u,); by default at once."""

    lower: float | Array = -np.inf  #: lowest value that each input reaches, in input units
    upper: float | Array = np.inf  #: highest such value
    delay: float | Array = 0.0  #: how long after it was given a command is applied, in s
    lag: float | Array = 0.0  #: time constant with which the input then follows, in s
    dead_time: float | Array = 0.0  #: how long after it was applied an input acts, in s
    #: of a valve of equal percentage between finite `lower` and `upper`: its largest by its
    #: smallest gain; 1 for one that acts linearly
    rangeability: float | Array = 1.0

    def effect(self, u: Array) -> Array:
        """Return the inputs (..., n_u) that act on the plant at the given positions."""
        return self._over_range(u, lambda share, R: np.expm1(share * np.log(R)) / (R - 1.0))

    def position(self, effect: Array) -> Array:
        """Return the positions (..., n_u) at which inputs act: the inverse of :meth:`effect`."""
        return self._over_range(effect, lambda share, R: np.log1p(share * (R - 1.0)) / np.log(R))

    def _over_range(self, u: Array, law: Callable[[Array, Array], Array]) -> Array:
        """Apply a law to the shares of the range, where it is not the identity."""
        curved = np.greater(self.rangeability, 1.0)
        if not curved.any():
            return u
        curved = np.broadcast_to(curved, np.shape(u)[-1:])
        lower, upper, R = (np.broadcast_to(value, curved.shape)[curved]
                           for value in (self.lower, self.upper, self.rangeability))
        found = np.array(u)
        found[..., curved] = lower + (upper - lower) * law(
            np.clip((found[..., curved] - lower) / (upper - lower), 0.0, 1.0), R)
        return found


@dataclass(frozen=True, eq=False)
class Process:
    """
    A running plant: its equations, present time and state, and its input.

    Each method returns the plant as it is then; none changes it.

    >>> tanks = build('two_tanks')
    >>> plant = Process(tanks, 0, tanks.nominal_state, tanks.nominal_input)
    >>> plant.commanded(tanks.nominal_input, 0).until(60_000_000_000).time_ns
    60000000000

    :raises ValueError: for a state or an input that does not fit the system.
    """

    system: ControlAffineSystem  #: the plant
    time_ns: int  #: present time, in integer nanoseconds so that instants repeat exactly
    x: Array  #: present state (n_x,)
    u: Array  #: position (n_u,) of the actuator that acts, up to the present time
    actuator: Actuator = Actuator()  #: between commands and input
    command: Array | None = None  #: (n_u,) that the input follows; None for u
    #: commands that take effect later, by rising time: (time in ns, number of the input, value)
    pending: tuple[tuple[int, int, float], ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        expect(system=(self.system, ControlAffineSystem))
        about = self.system
        for name, value in (('time_ns', nanoseconds(self.time_ns)),
                            ('x', numbers('x', self.x, about.state_names)),
                            ('u', numbers('u', self.u, about.input_names))):
            object.__setattr__(self, name, value)
        if not (all_finite(self.x) and all_finite(self.u)):
            raise ValueError(f'x = {self.x.tolist()} and u = {self.u.tolist()} must be finite')

    @property
    def followed(self) -> Array:
        """The delayed command (n_u,) that the input follows."""
        return self.u if self.command is None else self.command

    @property
    def applied(self) -> Array:
        """Input (n_u,) that is applied, as a sensor measures it, and acts after its dead time."""
        dead, lag = (np.broadcast_to(value, self.u.shape)
                     for value in (self.actuator.dead_time, self.actuator.lag))
        if not dead.any():
            return self.u
        # inputs that act a dead time later depend on no later command
        end_ns = [self.time_ns + round(seconds * NANOSECONDS) for seconds in dead.tolist()]
        u, goal, since_ns = self.u.copy(), np.array(self.followed), [self.time_ns] * len(dead)
        ends = ((end, i, np.nan) for i, end in enumerate(end_ns))
        for due, i, command in (*self.pending, *ends):
            if not since_ns[i] <= due <= end_ns[i]:
                continue
            if due > since_ns[i]:
                reached = np.clip(goal, self.actuator.lower, self.actuator.upper)[i]
                seconds = (due - since_ns[i]) / NANOSECONDS
                u[i] = reached + (math.exp(-seconds / lag[i]) * (u[i] - reached)
                                  if lag[i] > 0.0 else 0.0)
            goal[i], since_ns[i] = command, due
        return u

    def commanded(self, command: Array, time_ns: int) -> Process:
        """Return the process with a command given, in place of any that would act later."""
        delays = np.broadcast_to(
            np.add(self.actuator.delay, self.actuator.dead_time), command.shape).tolist()
        effect_ns = [time_ns + round(delay * NANOSECONDS) for delay in delays]
        earlier = [entry for entry in self.pending if entry[0] < effect_ns[entry[1]]]
        new = zip(effect_ns, range(len(command)), command.tolist(), strict=True)
        return replace(self, pending=tuple(sorted([*earlier, *new])))

    def until(self, time_ns: int) -> Process:
        """Return the process at a later time, else itself; raise IntegrationError past bounds."""
        now = self
        while now.pending and now.pending[0][0] < time_ns:
            effect_ns = now.pending[0][0]
            now = now._following(effect_ns)
            command = np.array(now.followed)
            for due, i, value in now.pending:
                if due == effect_ns:
                    command[i] = value
            now = replace(now, command=command, pending=tuple(
                entry for entry in now.pending if entry[0] > effect_ns))
        return now._following(time_ns)

    def _following(self, time_ns: int) -> Process:
        """Return the process at a later time, its input following the present command."""
        if time_ns <= self.time_ns:
            return self
        now, goal = self, np.clip(self.followed, self.actuator.lower, self.actuator.upper)
        lag = np.broadcast_to(self.actuator.lag, goal.shape)
        settled_ns = self.time_ns + round(_SETTLED * float(np.max(lag, initial=0.0)) * NANOSECONDS)
        u = np.where(lag > 0.0, self.u, goal)
        if settled_ns > self.time_ns and np.any(u != goal):
            end_ns = min(time_ns, settled_ns)
            both = _with_input_lag(
                self.system, lag / self.system.seconds_per_time_unit, self.actuator.effect)
            reached = _moved(both, np.concatenate([self.x, u]), goal, end_ns - self.time_ns)
            x, u = np.split(reached, [self.system.n_x])
            now = replace(self, time_ns=end_ns, x=x, u=u)
            if time_ns < settled_ns:
                return now
        return replace(now, time_ns=time_ns, u=goal, x=_moved(
            self.system, now.x, self.actuator.effect(goal), time_ns - now.time_ns))


def _moved(system: ControlAffineSystem, x: Array, u: Array, time_ns: int) -> Array:
    """Return a state (n_x,) after a duration in nanoseconds."""
    if time_ns == 0:
        return x
    return advance(system, x, u, time_ns / NANOSECONDS / system.seconds_per_time_unit)


def _with_input_lag(system: ControlAffineSystem, time_constants: Array,
                    effect: Callable[[Array], Array]) -> ControlAffineSystem:
    """
    Put a lag before each input: d[x; v]/dt = [f(x) + B(x) g(v); -v / tau] + [0; u / tau].

    The positions v become states; the time constants tau (n_u,) are in time units. An input
    without lag, of which tau is 0, stays where it is.
    """
    n_x, n_u = system.n_x, system.n_u
    rate = np.zeros(n_u)
    np.divide(1.0, time_constants, out=rate, where=time_constants > 0.0)

    def drift(state: Array) -> Array:
        x, v = state[..., :n_x], state[..., n_x:]
        return np.concatenate([system.derivative(x, effect(v)), -rate * v], axis=-1)

    unbounded = np.full(n_u, np.inf)
    return replace(
        system,
        name=f'{system.name} with input lag',
        state_names=(*system.state_names, *system.input_names),
        state_units=(*system.state_units, *system.input_units),
        drift=drift,
        drift_jacobian=cast(ArrayFunction, None),
        B=np.concatenate([np.zeros((n_x, n_u)), np.diag(rate)]),
        nominal_state=np.concatenate([system.nominal_state, system.nominal_input]),
        state_lower=np.concatenate([system.state_lower, -unbounded]),
        state_upper=np.concatenate([system.state_upper, unbounded]),
    )


def sensor_noise(deviation: float, seed: int, sample: int, signal: int = 0) -> float:
    """Return the noise of one sample of a standard deviation, the same for seed and numbers."""
    if deviation == 0.0:
        return 0.0
    number = (seed, sample, signal) if signal else (seed, sample)
    return deviation * float(np.random.default_rng(number).standard_normal())
