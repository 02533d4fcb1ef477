# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""The lifts and the noisy course of set-point steps on which the control step is timed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control import Controller, State
from koopman_ros.lifting import LiftedModel, load, NetworkObservables
from koopman_ros.nodes.controller_parameters import ControllerParameters
from koopman_ros.nodes.messages import NANOSECONDS
from koopman_ros.nodes.shipped import model_path

Array = NDArray[np.float64]

SHIPPED = (3, 4)
_HIDDEN = 14
_NOISE = 0.05  # K, standard deviation
_PERIOD = 1.0  # s
# Offsets from the nominal point in K, each for so many samples.
_SETPOINTS, _HELD = (0.0, -10.0, -4.0, -8.0), 100


@dataclass(frozen=True)
class Sample:
    """
    One measurement with what a controller has to know at it.

    :param measurement: (1,) in K.
    :param time_ns: its stamp.
    :param requested: (1,) set-point that was asked for just before, or None.
    """

    measurement: Array
    time_ns: int
    requested: Array | None


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


def course(under: Controller, samples: int) -> tuple[Sample, ...]:
    """Return what is measured while a controller leads its own model through set-point steps."""
    model, state = under.model, State()
    rng = np.random.default_rng(0)
    x, found = np.zeros(1), []
    for k in range(samples):
        requested = None if k % _HELD else (
            model.states.center + _SETPOINTS[k // _HELD % len(_SETPOINTS)])
        sample = Sample(model.states.to_physical(x) + _NOISE * rng.normal(size=1),
                        round((k + 1) * _PERIOD * NANOSECONDS), requested)
        found.append(sample)
        if requested is not None:
            state = asked(under, state, requested)
        state, command, _ = under.step(state, sample.measurement, sample.time_ns)
        rate = model.drift(x) + model.B @ model.inputs.to_deviation(command)
        x = x + rate * (_PERIOD / model.seconds_per_time_unit)
    return tuple(found)


def asked(under: Controller, state: State, requested: Array) -> State:
    """Ask a controller for a set-point that it must accept."""
    state, refusal = under.request_setpoint(state, requested)
    if refusal:
        raise ValueError(refusal)
    return state
