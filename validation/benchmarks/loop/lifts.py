# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The lifts and the noisy course of set-point steps on which the control step is timed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control import at, Controller, SetpointRequest, simulate, State
from koopman_ros.lifting import LiftedModel, load, NetworkObservables
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.resources import model_path
from koopman_ros.units import NANOSECONDS

SHIPPED = (3, 4)
_HIDDEN = 14
_NOISE = 0.05  # K, standard deviation
_PERIOD = 1.0  # s
# Offsets from the nominal point in K, each for so many samples.
_SETPOINTS, _HELD = (0.0, -10.0, -4.0, -8.0), 100


@dataclass(frozen=True)
class Sample:
    """One measurement with what a controller has to know at it."""

    measurement: Array  #: (1,) in K
    time_ns: int  #: its stamp
    requested: Array | None  #: (1,) set-point that was asked for just before, or None


def lift(n_z: int) -> LiftedModel:
    """
    Return the shipped lift with so many coordinates, or a random one of the same kind.

    How long a step takes depends on the sizes, not on how good the lift is.
    """
    if n_z in SHIPPED:
        return load(model_path(f'reactor_nz{n_z}'))
    rng = np.random.default_rng(n_z)
    network = NetworkObservables(
        ((rng.normal(size=(_HIDDEN, 1)), rng.normal(size=_HIDDEN)),),
        rng.normal(size=(n_z - 1, _HIDDEN)) / np.sqrt(_HIDDEN), identity=True)
    # modes that decay, so that the re-centred law is the one in force
    A = 0.2 * rng.normal(size=(n_z, n_z)) - np.diag(np.linspace(1.0, 3.0, n_z))
    return replace(load(model_path('reactor_nz4')), observables=network, A=A)


def controller(model: LiftedModel) -> Controller:
    """Return the controller with the node's default tuning."""
    return Controller(model, ControllerParameters().settings())


@dataclass(frozen=True)
class _Euler:
    """A model as a plant, from sample to sample by one step of Euler's method."""

    model: LiftedModel
    deviation: Array
    u: Array
    time_ns: int = 0

    @property
    def x(self) -> Array:
        return self.model.states.to_physical(self.deviation)

    def commanded(self, command: Array, time_ns: int) -> _Euler:
        return replace(self, u=command)

    def until(self, time_ns: int) -> _Euler:
        seconds = (time_ns - self.time_ns) / NANOSECONDS
        rate = self.model.drift(self.deviation) + self.model.B @ self.model.inputs.to_deviation(
            self.u)
        return replace(self, time_ns=time_ns, deviation=self.deviation + rate * (
            seconds / self.model.seconds_per_time_unit))


def course(under: Controller, samples: int) -> tuple[Sample, ...]:
    """Return what is measured while a controller leads its own model through set-point steps."""
    model, rng = under.model, np.random.default_rng(0)
    requested = {k: model.states.center + _SETPOINTS[k // _HELD % len(_SETPOINTS)]
                 for k in range(0, samples, _HELD)}
    run = simulate(
        under, _Euler(model, np.zeros(1), model.inputs.center),
        [at(k * _PERIOD, SetpointRequest(0, value)) for k, value in requested.items()],
        duration=(samples - 1) * _PERIOD, period=_PERIOD,
        sensor=lambda y, _: y + _NOISE * rng.normal(size=1))
    return tuple(Sample(measured, round((k + 1) * _PERIOD * NANOSECONDS), requested.get(k))
                 for k, measured in enumerate(run.measured))


def asked(under: Controller, state: State, requested: Array) -> State:
    """Ask a controller for a set-point that it must accept."""
    state, refusal = under.request_setpoint(state, requested)
    if refusal:
        raise ValueError(refusal)
    return state
