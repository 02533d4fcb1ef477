# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A plant with one input that acts late: its optimum, PI control and the Smith predictor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import expm

from koopman_ros.core.arrays import Array
from koopman_ros.core.solvers import differences
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.evaluation.optimal_cost import cost_along, optimum, Task
from koopman_ros.plants import ControlAffineSystem, Process, steady_state

#: sample and measured state (n_x,) to the command (n_u,)
Commands = Callable[[int, Array], Array]
_SETTLED = 0.632  # share of a step after one time constant
_SLOWEST = 20.0  # time constants of the slowest mode that a step response is looked at for
_POINTS = 2000


@dataclass(frozen=True)
class Response:
    """A run under some law."""

    states: Array  #: (N, n_x) at the samples
    commands: Array  #: (N, n_u) at the samples
    effects: Array  #: (N, n_u) of the actuator on the plant from each sample on
    cost: float  #: integral of e' Q e + v' R v, v the effect less the one that holds the set-point


@dataclass(frozen=True)
class Piece:
    """A part of a run, up to the next one."""

    begin: int  #: first sample
    system: ControlAffineSystem  #: the plant
    setpoints: Mapping[str, float]  #: by state


@dataclass(frozen=True, eq=False)
class LateRun:
    """A run of a plant whose dead time is a multiple of the sample period."""

    start: Process  #: at rest
    pieces: Sequence[Piece]  #: the first from sample 0
    period: float  #: in s
    samples: int
    Q: Array  #: (n_x,) weights
    R: Array  #: (n_u,) weights
    noise: Array  #: (samples, n_x) of the measurements

    @property
    def late(self) -> int:
        """The dead time in samples."""
        return round(float(np.max(self.start.actuator.dead_time)) / self.period)

    def under(self, law: Commands) -> Response:
        """Return the run under a law."""
        process, ends = self.start, {piece.begin: piece for piece in self.pieces}
        states, commands, effects = [], [], []
        for n in range(self.samples):
            if n in ends:
                process = replace(process, system=ends[n].system)
            states.append(process.x)
            commands.append(law(n, process.x + self.noise[n]))
            now_ns = process.time_ns
            process = process.commanded(commands[-1], now_ns).until(
                now_ns + round(self.period * NANOSECONDS))
            effects.append(process.actuator.effect(process.u))
        x, acting = np.array(states), np.array(effects)
        cost = sum(cost_along(self._task(piece, x[piece.begin], end - piece.begin),
                              x[piece.begin:end], acting[piece.begin:end])
                   for piece, end in self._ends())
        return Response(x, np.array(commands), acting, cost)

    def optimum(self) -> Response:
        """
        Return the run of least cost on the true equations.

        Nothing is known ahead: each piece is planned at its begin, from a dead time later on.
        """
        actuator, late = self.start.actuator, self.late
        effects = np.tile(actuator.effect(self.start.u), (self.samples + late, 1))

        def planned(n: int, _: Array) -> Array:
            return actuator.position(effects[n + late])

        for piece in self.pieces:
            first = piece.begin + late
            x = self.under(planned).states[first]
            left = self.samples - first
            effects[first:self.samples] = optimum(self._task(piece, x, left)).inputs
            effects[self.samples:] = effects[self.samples - 1]
        return self.under(planned)

    def _ends(self) -> list[tuple[Piece, int]]:
        begins = [*(piece.begin for piece in self.pieces), self.samples]
        return [(piece, end) for piece, (_, end) in zip(
            self.pieces, pairwise(begins), strict=True)]

    def _task(self, piece: Piece, x: Array, samples: int) -> Task:
        return Task(piece.system, x, *steady_state(piece.system, piece.setpoints), self.Q, self.R,
                    self.period / piece.system.seconds_per_time_unit, samples)


@dataclass(frozen=True)
class FirstOrder:
    """A first-order model with dead time, k exp(-theta s) / (tau s + 1)."""

    gain: float  #: k
    time_constant: float  #: tau, in s
    dead_time: float  #: theta, in s

    @classmethod
    def of(cls, process: Process, state: str, hold: float) -> FirstOrder:
        """
        Return the model of a process at rest: static gain and 63.2 % time of its linearisation.

        :param hold: in s, for which an input is held; half of it counts as dead time.
        """
        system, actuator, u = process.system, process.actuator, process.u
        A, seconds = system.slope(process.x, actuator.effect(u)), system.seconds_per_time_unit
        slope = np.diag(differences(actuator.effect, u, np.maximum(np.abs(u), 1.0)))
        b = (system.input_matrix(process.x) * slope)[:, 0]
        i, final = system.state_names.index(state), np.linalg.solve(A, -b)
        step = _SLOWEST / float(np.min(-np.linalg.eigvals(A).real)) / _POINTS
        decay, left, passed = expm(A * step), final, 0
        while left[i] / final[i] > 1.0 - _SETTLED:
            left, passed = decay @ left, passed + 1
        return cls(float(final[i]), passed * step * seconds,
                   float(np.max(actuator.dead_time)) + 0.5 * hold)


def pi_law(model: FirstOrder, bounds: tuple[float, float], start: tuple[float, float], index: int,
           setpoint: Callable[[int], float], period: float, *, predicts: bool) -> Commands:
    """
    Return a PI law, tuned by SIMC with a closed-loop time constant of the dead time.

    Source: Skogestad, *Journal of Process Control* 13 (2003), 291-309. A Smith predictor leaves no
    dead time to tune for.

    :param bounds: of the command, at which the integral part stops.
    :param start: state and command at rest.
    :param index: of the controlled state.
    :param predicts: whether it acts on the output of a Smith predictor.
    """
    tau, theta = model.time_constant, model.dead_time
    wanted = theta + (0.0 if predicts else theta)
    gain, integral_time = tau / (model.gain * wanted), min(tau, 4.0 * wanted)
    late, decay = round(theta / period), float(np.exp(-period / tau))
    expected = [0.0]  # deviations of the output without dead time
    integral = start[1]

    def law(n: int, x: Array) -> Array:
        nonlocal integral
        ahead = expected[-1] - expected[max(len(expected) - 1 - late, 0)] if predicts else 0.0
        error = setpoint(n) - (float(x[index]) + ahead)
        integral = float(np.clip(integral + gain * error * period / integral_time, *bounds))
        command = float(np.clip(integral + gain * error, *bounds))
        expected.append(decay * expected[-1] + (1.0 - decay) * model.gain * (command - start[1]))
        return np.array([command])

    return law
