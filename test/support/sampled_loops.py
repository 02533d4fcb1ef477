# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A sampled closed loop on the true reactor, in which anything may go wrong at any time."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
import json
from typing import Any

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control import (
    at,
    Change,
    Controller,
    Event,
    LevelSettings,
    Loop,
    ManualCommand,
    Mode,
    ModeChange,
    perfect,
    Report,
    Sensor,
    SetpointRequest,
    simulate,
    State,
    SupervisorSettings,
)
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.plants import (
    Actuator,
    ControlAffineSystem,
    equilibrium_input,
    Process,
)
from koopman_ros.reasons import Words
from koopman_ros.replay.records import encoded
from koopman_ros.units import Displays
from koopman_ros.units import NANOSECONDS as SECOND
from support.closed_loops import REACTOR, shipped, START

EPOCH = 1_785_000_000 * SECOND
LOWER, UPPER, RATE = 278.15, 305.15, 1.0  # K, K, K/s
SAFE = LOWER


def controller(model: Any = 'reactor_nz4', *, supervisor: Mapping[str, float] | None = None,
               sensor: Mapping[str, Any] | None = None, **changes: Any) -> Controller:
    """Return a controller with the default parameters of its node."""
    model = shipped(model) if isinstance(model, str) else model
    usual = ControllerParameters().settings()
    return Controller(model, replace(
        usual, sensor=replace(usual.sensor, **(sensor or {})),
        supervisor=supervisor_settings(**(supervisor or {})), **changes))


def supervisor_settings(learned: float = 0.1, linear: float = 0.5, **times: float
                        ) -> SupervisorSettings:
    """Return the two levels of the node with their margins."""
    return SupervisorSettings(
        (LevelSettings('sdre', learned), LevelSettings('linear', linear)), **times)


say = Words(Displays({'temperature': 'K', 'coolant_temperature': 'K'}))


def content(value: Any) -> str:
    """Write states, commands and reports so that they compare bit for bit."""
    return json.dumps(encoded(value), sort_keys=True)


@dataclass
class Sample:
    """What happened at one second."""

    second: int
    temperature: float
    command: float
    report: Report


class Reactor:
    """
    A loop on the true reactor that a test leads from one simulation to the next, each second.

    :param controller: it finds the coolant that holds the plant at the start.
    :param plant: temperature last in its state.
    :param kelvin: at the start.
    :param sensor: what it makes of the temperature.
    :param input_sensor: the same of the coolant; None where it is not measured.
    """

    def __init__(self, controller: Controller, plant: ControlAffineSystem = REACTOR,
                 kelvin: float = START, *, actuator: Actuator | None = None, noise: float = 0.0,
                 sensor: Sensor = perfect, input_sensor: Sensor | None = None,
                 coolant: float | None = None) -> None:
        x = np.append(plant.nominal_state[:-1], kelvin)
        u = equilibrium_input(plant, x) if coolant is None else np.array([coolant])
        self.loop = Loop(controller, controller.initialise(State(), u),
                         Process(plant, 0, x, u, actuator or Actuator(), u))
        self.noise, self.sensor, self.input_sensor = noise, sensor, input_sensor
        self.waiting: list[Event | Change] = []
        self.samples: list[Sample] = []

    @property
    def kelvin(self) -> float:
        """The temperature at the next sample."""
        second = len(self.samples)
        return float(self.loop.plant.until(second * SECOND).x[-1])

    def do(self, *what: Event | Change) -> None:
        """Let something happen before the next sample."""
        self.waiting += what

    def ask(self, kelvin: float) -> None:
        self.do(SetpointRequest(0, np.array([kelvin])))

    def manual(self, kelvin: float) -> None:
        self.do(ModeChange(Mode.MANUAL), ManualCommand(np.array([kelvin])))

    def act(self, actuator: Actuator) -> None:
        """Put another actuator before the plant."""
        self.change(actuator=actuator)

    def change(self, **changes: Any) -> None:
        """Go on with another state, system or actuator."""
        self.do(lambda loop: replace(loop, plant=replace(loop.plant, **changes)))

    def run(self, seconds: int, sensor: Callable[[float], float | None] | None = None
            ) -> list[Sample]:
        """
        Let the loop run.

        :param sensor: what is measured of the temperature meanwhile; None for nothing.
        :return: the samples of this run.
        """
        first = len(self.samples)

        def measure(y: Array, second: float) -> Array | None:
            found = sensor(float(y[0])) if sensor else self.sensor(y, second)
            return None if found is None else np.reshape(found, 1)

        run = simulate(
            self.loop.controller, self.loop.plant.until(first * SECOND),
            [at(0.0, what) for what in self.waiting], duration=seconds - 1.0,
            C=np.eye(len(self.loop.plant.x))[-1:], seed=first, sensor=measure,
            noise=np.array([self.noise]) if self.noise else None, state=self.loop.state,
            input_sensor=self.input_sensor, stamp=lambda time_ns: EPOCH + time_ns)
        assert not run.failure
        self.loop, self.waiting = run.loop, []
        self.samples += [Sample(first + n, *row) for n, row in enumerate(zip(
            run.states[:, -1].tolist(), run.commands[:, 0].tolist(), run.reports, strict=True))]
        return self.samples[first:]


def largest_step(samples: list[Sample]) -> float:
    """Return the largest change of command from one second to the next."""
    return float(np.max(np.abs(np.diff([sample.command for sample in samples]))))


def settled(samples: list[Sample], kelvin: float, tolerance: float) -> int:
    """Return how many seconds it takes until the temperature stays within a tolerance."""
    off = [k for k, s in enumerate(samples) if abs(s.temperature - kelvin) > tolerance]
    return off[-1] + 1 if off else 0


def levels(samples: list[Sample]) -> list[str]:
    """Return the control levels in the order in which they acted."""
    found: list[str] = []
    for sample in samples:
        if not found or found[-1] != sample.report.level:
            found.append(sample.report.level)
    return found
