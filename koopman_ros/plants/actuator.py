# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Actuators: range, delay and lag between a command and the input of a plant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from koopman_ros.plants.process import Process
from koopman_ros.plants.system import ControlAffineSystem, FloatArray
from koopman_ros.units import NANOSECONDS

# After so many time constants exp(-40) of a step is left, less than a double can tell.
_SETTLED = 40.0


@dataclass(frozen=True)
class Actuator:
    """
    How an input follows its command; by default it is the command.

    :param lower: lowest value that each input reaches, in input units.
    :param upper: highest such value.
    :param delay: how long after it was given a command takes effect, in s.
    :param lag: time constant with which the input then follows, in s.
    """

    lower: float = -np.inf
    upper: float = np.inf
    delay: float = 0.0
    lag: float = 0.0


@dataclass(frozen=True, eq=False)
class ActuatedProcess:
    """
    A running plant behind its actuator.

    :param process: the plant; its `u` is the input that acts, up to the present time.
    :param actuator: its actuator.
    :param command: what the input follows (n_u,).
    :param pending: commands that take effect later, by rising time: (time in ns, command (n_u,)).
    """

    process: Process
    actuator: Actuator
    command: FloatArray
    pending: tuple[tuple[int, FloatArray], ...] = ()

    @property
    def time_ns(self) -> int:
        """Present time."""
        return self.process.time_ns

    @property
    def x(self) -> FloatArray:
        """Present state (n_x,)."""
        return self.process.x

    @property
    def u(self) -> FloatArray:
        """Input (n_u,) that acts, up to the present time."""
        return self.process.u

    def commanded(self, command: FloatArray, time_ns: int) -> ActuatedProcess:
        """
        Return the process with a command given at a time.

        It supersedes commands that would take effect at the same time or later, such as those
        given before the delay was shortened.
        """
        effect_ns = time_ns + round(self.actuator.delay * NANOSECONDS)
        earlier = tuple(entry for entry in self.pending if entry[0] < effect_ns)
        return replace(self, pending=(*earlier, (effect_ns, command)))

    def until(self, time_ns: int) -> ActuatedProcess:
        """
        Return the process at a later time, under the commands that took effect before it.

        :raises IntegrationError: as `Process.until` does.
        """
        now = self
        while now.pending and now.pending[0][0] < time_ns:
            (effect_ns, command), *later = now.pending
            now = replace(now._following(effect_ns), command=command, pending=tuple(later))
        return now._following(time_ns)

    def _following(self, time_ns: int) -> ActuatedProcess:
        """Return the process at a later time, its input following the present command."""
        process = self.process
        if time_ns <= process.time_ns:
            return self
        goal = np.clip(self.command, self.actuator.lower, self.actuator.upper)
        settled_ns = process.time_ns + round(_SETTLED * self.actuator.lag * NANOSECONDS)
        if settled_ns > process.time_ns and np.any(process.u != goal):
            process = _lagging(process, goal, self.actuator.lag, min(time_ns, settled_ns))
            if time_ns < settled_ns:
                return replace(self, process=process)
        return replace(self, process=replace(process, u=goal).until(time_ns))


def _lagging(process: Process, goal: FloatArray, lag: float, time_ns: int) -> Process:
    """Return a process at a later time, its input on the way to a goal."""
    system = process.system
    both = _with_input_lag(system, lag / system.seconds_per_time_unit)
    reached = Process(
        both, process.time_ns, np.concatenate([process.x, process.u]), goal).until(time_ns)
    x, u = np.split(reached.x, [system.n_x])
    return replace(process, time_ns=time_ns, x=x, u=u)


def _with_input_lag(system: ControlAffineSystem, time_constant: float) -> ControlAffineSystem:
    """
    Put a first-order lag before each input: d[x; v]/dt = [f(x) + B v; -v / tau] + [0; u / tau].

    The system that results is control-affine again; its last n_u states are the inputs v that
    act, its input u is what they follow.

    :param time_constant: tau, in time units, above 0.
    """
    n_x, n_u = system.n_x, system.n_u
    rate = 1.0 / time_constant

    def drift(state: FloatArray) -> FloatArray:
        x, v = state[..., :n_x], state[..., n_x:]
        return np.concatenate([system.derivative(x, v), -rate * v], axis=-1)

    def drift_jacobian(state: FloatArray) -> FloatArray:
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
