# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A plant that runs in time, behind its actuators (range, delay, lag), and its sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.plants.simulation import advance
from koopman_ros.plants.system import ControlAffineSystem
from koopman_ros.units import NANOSECONDS

# After so many time constants exp(-40) of a step is left, less than a double can tell.
_SETTLED = 40.0


@dataclass(frozen=True)
class Actuator:
    """How an input follows its command; by default it is the command."""

    lower: float = -np.inf  #: lowest value that each input reaches, in input units
    upper: float = np.inf  #: highest such value
    delay: float = 0.0  #: how long after it was given a command takes effect, in s
    lag: float = 0.0  #: time constant with which the input then follows, in s


@dataclass(frozen=True, eq=False)
class Process:
    """A running plant: its equations, present time and state, and its input."""

    system: ControlAffineSystem  #: the plant
    time_ns: int  #: present time, in integer nanoseconds so that instants repeat exactly
    x: Array  #: present state (n_x,)
    u: Array  #: input (n_u,) that acts, up to the present time
    actuator: Actuator = Actuator()  #: between commands and input
    command: Array | None = None  #: what the input follows (n_u,); None for what it is
    #: commands that take effect later, by rising time: (time in ns, command (n_u,))
    pending: tuple[tuple[int, Array], ...] = ()

    @property
    def followed(self) -> Array:
        """What the input follows (n_u,)."""
        return self.u if self.command is None else self.command

    def commanded(self, command: Array, time_ns: int) -> Process:
        """Return the process with a command given, in place of any that would act later."""
        effect_ns = time_ns + round(self.actuator.delay * NANOSECONDS)
        earlier = tuple(entry for entry in self.pending if entry[0] < effect_ns)
        return replace(self, pending=(*earlier, (effect_ns, command)))

    def until(self, time_ns: int) -> Process:
        """Return the process at a later time, else itself; raise IntegrationError past bounds."""
        now = self
        while now.pending and now.pending[0][0] < time_ns:
            (effect_ns, command), *later = now.pending
            now = replace(now._following(effect_ns), command=command, pending=tuple(later))
        return now._following(time_ns)

    def _following(self, time_ns: int) -> Process:
        """Return the process at a later time, its input following the present command."""
        if time_ns <= self.time_ns:
            return self
        now, goal = self, np.clip(self.followed, self.actuator.lower, self.actuator.upper)
        settled_ns = self.time_ns + round(_SETTLED * self.actuator.lag * NANOSECONDS)
        if settled_ns > self.time_ns and np.any(self.u != goal):
            end_ns = min(time_ns, settled_ns)
            both = _with_input_lag(
                self.system, self.actuator.lag / self.system.seconds_per_time_unit)
            reached = _moved(both, np.concatenate([self.x, self.u]), goal, end_ns - self.time_ns)
            x, u = np.split(reached, [self.system.n_x])
            now = replace(self, time_ns=end_ns, x=x, u=u)
            if time_ns < settled_ns:
                return now
        return replace(now, time_ns=time_ns, u=goal, x=_moved(
            self.system, now.x, goal, time_ns - now.time_ns))


def _moved(system: ControlAffineSystem, x: Array, u: Array, time_ns: int) -> Array:
    """Return a state (n_x,) so many nanoseconds later."""
    if time_ns == 0:
        return x
    return advance(system, x, u, time_ns / NANOSECONDS / system.seconds_per_time_unit)


def _with_input_lag(system: ControlAffineSystem, time_constant: float) -> ControlAffineSystem:
    """
    Put a first-order lag before each input: d[x; v]/dt = [f(x) + B v; -v / tau] + [0; u / tau].

    The inputs v that act become states; the time constant tau is in time units, above 0.
    """
    n_x, n_u = system.n_x, system.n_u
    rate = 1.0 / time_constant

    def drift(state: Array) -> Array:
        x, v = state[..., :n_x], state[..., n_x:]
        return np.concatenate([system.derivative(x, v), -rate * v], axis=-1)

    def drift_jacobian(state: Array) -> Array:
        jacobian = np.zeros((*state.shape, n_x + n_u))
        jacobian[..., :n_x, :n_x] = system.drift_jacobian(state[..., :n_x])
        jacobian[..., :n_x, n_x:] = system.B
        jacobian[..., n_x:, n_x:] = -rate * np.eye(n_u)
        return jacobian

    unbounded = np.full(n_u, np.inf)
    return replace(
        system,
        name=f'{system.name} with input lag',
        state_names=(*system.state_names, *system.input_names),
        state_units=(*system.state_units, *system.input_units),
        drift=drift,
        drift_jacobian=drift_jacobian,
        B=np.concatenate([np.zeros((n_x, n_u)), rate * np.eye(n_u)]),
        nominal_state=np.concatenate([system.nominal_state, system.nominal_input]),
        state_lower=np.concatenate([system.state_lower, -unbounded]),
        state_upper=np.concatenate([system.state_upper, unbounded]),
    )


def sensor_noise(deviation: float, seed: int, sample: int) -> float:
    """Return the noise of one sample of a standard deviation, the same for seed and number."""
    if deviation == 0.0:
        return 0.0
    return deviation * float(np.random.default_rng((seed, sample)).standard_normal())


def in_steps(value: float, resolution: float) -> float:
    """Return the nearest multiple of a sensor's resolution; 0 shows every value."""
    return value if resolution == 0.0 else value - math.remainder(value, resolution)
