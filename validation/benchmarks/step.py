# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a control step takes, beside the same law with general tools: jacrev and dlqr."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter_ns, thread_time_ns
from typing import Any

import numpy as np
from scipy.linalg import block_diag, expm
import torch
from torch.func import jacrev

import control
from koopman_ros.arrays import Array
from koopman_ros.control import (
    at,
    Controller,
    Form,
    SetpointRequest,
    simulate,
    Simulation,
    State,
    Tuning,
)
from koopman_ros.control.simulate import after_a_second
from koopman_ros.lifting import LiftedModel, load, NetworkObservables
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.resources import model_path
from koopman_ros.units import NANOSECONDS
from validation.benchmarks.process import Tell

_SHIPPED = (3, 4)
_HIDDEN = 14
_NOISE = 0.05  # K, standard deviation
# Offsets from the nominal point in K, each for so many samples of a second.
_SETPOINTS, _HELD = (0.0, -10.0, -4.0, -8.0), 100
_BLOCK = 50  # steps of one side, then of the other
_TOLERANCE = 1e-6  # K between the commands of both sides
# Where the state is so near to its reference, the secant of the Jacobian is its derivative.
_NEAR = 1e-6
# Weights of a layer, for a lift that is linear up to rounding.
_BENT = 1e-9


def compare(n_z: int, samples: int) -> dict[str, Any]:
    """Time both sides on one course, block by block in turns, once they are seen to agree."""
    model = _lift(n_z)
    ours = built(table_of(model).snapshot({}), model)
    course, requested = _course(ours, samples)
    if any(report.command.law.form != Form.RECENTRED.value for report in course.reports):
        raise ValueError(f'the re-centred law is not always in force for n_z = {n_z}')
    naive, naive_again = (NaiveLaw(model, ours.tuning) for _ in range(2))
    setpoints = [report.target.setpoint for report in course.reports if report.target]
    calls = list(zip(course.measured, setpoints, np.diff(course.times, prepend=0.0), strict=True))
    apart = max(float(np.max(np.abs(naive.step(*call) - command)))
                for call, command in zip(calls, course.commands, strict=True))
    if not apart <= _TOLERANCE:
        raise ValueError(f'the commands for n_z = {n_z} differ by {apart:.2g} K, so the two sides '
                         f'are not the same law: they must agree to {_TOLERANCE:g} K')
    sides, states = {'': ours}, {'': State()}
    taken: dict[str, list[tuple[int, int]]] = {side: [] for side in (*sides, 'naive_')}
    for block in range(0, samples, _BLOCK):
        for side, controller in sides.items():
            state = states[side]
            for k in range(block, min(block + _BLOCK, samples)):
                if k in requested:
                    state, _ = controller.request_setpoint(state, requested[k])
                used, start = thread_time_ns(), perf_counter_ns()
                state, _, _ = controller.step(
                    state, course.measured[k], after_a_second(k * NANOSECONDS))
                taken[side].append((perf_counter_ns() - start, thread_time_ns() - used))
            states[side] = state
        for call in calls[block:block + _BLOCK]:
            used, start = thread_time_ns(), perf_counter_ns()
            naive_again.step(*call)
            taken['naive_'].append((perf_counter_ns() - start, thread_time_ns() - used))
    found: dict[str, Any] = {'steps': samples, 'largest_difference_kelvin': apart}
    for side, pairs in taken.items():
        wall, cpu = 1e-3 * np.array(pairs).T
        median, p99 = np.percentile(wall, (50, 99))
        found.update({f'{side}median_us': float(median), f'{side}p99_us': float(p99),
                      f'{side}cpu_median_us': float(np.median(cpu))})
    return found


def compare_all(tell: Tell, sizes: tuple[int, ...], samples: int) -> None:
    """Compare with lifts of several n_z, in a process with nothing else."""
    for n_z in sizes:
        tell({str(n_z): compare(n_z, samples)})


def _lift(n_z: int) -> LiftedModel:
    """Return the shipped lift of so many coordinates, or a random one, which takes as long."""
    if n_z in _SHIPPED:
        return load(model_path(f'reactor_nz{n_z}'))
    rng = np.random.default_rng(n_z)
    network = NetworkObservables(
        _BENT * rng.normal(size=(_HIDDEN, 1)), rng.normal(size=_HIDDEN),
        rng.normal(size=(n_z - 1, _HIDDEN)) / np.sqrt(_HIDDEN), identity=True)
    # multiples of the state that decay as it does: the lift is closed, and the re-centred law the
    # one in force
    return replace(load(model_path('reactor_nz4')), observables=network, A=-np.eye(n_z))


@dataclass(frozen=True)
class _Euler:
    """A model as a plant, from sample to sample by one step of Euler's method."""

    model: LiftedModel
    x: Array
    u: Array
    time_ns: int = 0

    def commanded(self, command: Array, time_ns: int) -> _Euler:
        return replace(self, u=command)

    def until(self, time_ns: int) -> _Euler:
        model, h = self.model, (time_ns - self.time_ns) / NANOSECONDS
        rate = model.drift(model.states.to_deviation(self.x)) + (
            model.B @ model.inputs.to_deviation(self.u))
        return replace(self, time_ns=time_ns, x=self.x + model.states.scale * rate * (
            h / model.seconds_per_time_unit))


def _course(ours: Controller, samples: int) -> tuple[Simulation, dict[int, Array]]:
    """Let a controller lead its own model through set-point steps, which come at these samples."""
    states = ours.model.states
    requested = {k: states.center + _SETPOINTS[k // _HELD % len(_SETPOINTS)]
                 for k in range(0, samples, _HELD)}
    plant = _Euler(ours.model, states.center, ours.model.inputs.center)
    return simulate(ours, plant, [
        at(float(k), SetpointRequest(0, value)) for k, value in requested.items()],
        duration=samples - 1.0, noise=np.array([_NOISE])), requested


class NaiveLaw:
    """The re-centred law with the disturbance observer, for one state and one input."""

    def __init__(self, model: LiftedModel, tuning: Tuning) -> None:
        network = model.observables
        assert isinstance(network, NetworkObservables)
        self._W, self._b, self._output = map(torch.tensor, (network.W, network.b, network.V))
        self._model, self._limits = model, tuning.limits
        self._Q = np.diag(tuning.state_weight * model.states.scale ** 2)
        self._R = np.diag(tuning.input_weight * model.inputs.scale ** 2)
        self._C = np.eye(1, model.n_z)
        self._at_zero = self._activations(torch.zeros(1, dtype=torch.float64))
        self._jacobian = jacrev(self._lift_twice, has_aux=True)
        self._second = jacrev(jacrev(self._lift))
        self._bandwidth = tuning.disturbance_bandwidth
        self._setpoint = np.full(1, np.nan)
        self._x, self._w = np.full(1, np.nan), np.zeros(1)
        self._command: Array | None = None
        self._interval = 0.0

    def step(self, measurement: Array, setpoint: Array, seconds: float) -> Array:
        """Answer a measurement (1,), so many seconds after the one before, by a command (1,)."""
        model = self._model
        x = self._observed(model.states.to_deviation(measurement), seconds)
        x_ref = model.states.to_deviation(setpoint)
        if setpoint != self._setpoint:
            self._setpoint = setpoint
            self._z_ref, self._J_ref = self._lift_and_jacobian(x_ref)
            self._f_ref = self._drift(x_ref)
        u_ref = np.linalg.solve(model.B, -self._f_ref - self._w)
        z, J = self._lift_and_jacobian(x)
        H = self._secant(x, x_ref, J) @ (model.B @ u_ref + self._w)[:, None]
        K = self._gain(model.A + H @ self._C, J @ model.B, min(self._interval, seconds))
        self._interval = seconds
        u = np.clip(model.inputs.to_physical(u_ref - K @ (z - self._z_ref)),
                    self._limits.lower, self._limits.upper)
        if self._command is not None:
            reach = self._limits.rate * seconds
            u = np.clip(u, self._command - reach, self._command + reach)
        self._command = u
        return u

    def _gain(self, A: Array, B: Array, seconds: float) -> Array:
        """Return the gain (1, n_z) under an input held for so long; 0 for continuous time."""
        Q, h = self._C.T @ self._Q @ self._C, seconds / self._model.seconds_per_time_unit
        if not h > 0.0:
            continuous: Array = control.lqr(A, B, Q, self._R)[0]
            return continuous
        n, F = len(A), np.block([[A, B], [np.zeros((1, len(A) + 1))]])
        exponential = expm(h * np.block([[-F.T, block_diag(Q, self._R)], [np.zeros_like(F), F]]))
        end = exponential[n + 1:, n + 1:]
        W = end.T @ exponential[:n + 1, n + 1:]
        W = 0.5 * (W + W.T)
        sampled: Array = control.dlqr(
            end[:n, :n], end[:n, n:], W[:n, :n], W[n:, n:], W[:n, n:])[0]
        return sampled

    def _observed(self, x: Array, seconds: float) -> Array:
        """Return the observer's state (1,), which predicts by one step of Heun's method."""
        if self._command is None:
            self._x = x
            return x
        h = seconds / self._model.seconds_per_time_unit
        push = self._model.B @ self._model.inputs.to_deviation(self._command) + self._w
        slope = self._drift(self._x) + push
        predicted = self._x + 0.5 * h * (slope + self._drift(self._x + h * slope) + push)
        p = np.exp(-self._bandwidth * seconds)
        self._w = self._w + (1.0 - p) ** 2 / h * (x - predicted)
        self._x = predicted + (1.0 - p ** 2) * (x - predicted)
        return self._x

    def _drift(self, x: Array) -> Array:
        z, J = self._lift_and_jacobian(x)
        found: Array = np.linalg.pinv(J) @ self._model.A @ z
        return found

    def _secant(self, x: Array, x_ref: Array, J: Array) -> Array:
        """Return (J(x) - J(x_ref)) / (x - x_ref), (n_z, 1)."""
        distance = float(x[0] - x_ref[0])
        if abs(distance) < _NEAR:
            second: Array = self._second(torch.from_numpy(x)).numpy()[:, :, 0]
            return second
        return (J - self._J_ref) / distance

    def _lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        J, z = self._jacobian(torch.from_numpy(x))
        return z.numpy(), J.numpy()

    def _activations(self, x: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self._W @ x + self._b)

    def _lift(self, x: torch.Tensor) -> torch.Tensor:
        return torch.cat((x, self._output @ (self._activations(x) - self._at_zero)))

    def _lift_twice(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        z = self._lift(x)
        return z, z
