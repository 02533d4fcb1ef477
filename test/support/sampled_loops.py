# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A sampled closed loop on the true reactor, in which anything may go wrong at any time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np

from koopman_ros.control import (
    Controller,
    InputLimits,
    LevelSettings,
    Mode,
    Report,
    Settings,
    State,
    SupervisorSettings,
)
from koopman_ros.estimation import SensorLimits
from koopman_ros.plants import (
    advance,
    ControlAffineSystem,
    equilibrium_input,
    one_state_reactor,
    ReactorParameters,
)
from koopman_ros.reasons import Words
from koopman_ros.units import Displays
from support.closed_loops import REACTOR, shipped, START

SECOND = 1_000_000_000
EPOCH = 1_785_000_000 * SECOND
LOWER, UPPER, RATE = 278.15, 305.15, 1.0  # K, K, K/s
SAFE = LOWER


def controller(model: Any = 'reactor_nz4', *, supervisor: Mapping[str, float] | None = None,
               sensor: Mapping[str, Any] | None = None, **changes: Any) -> Controller:
    """Return a controller with the node's default tuning."""
    model = shipped(model) if isinstance(model, str) else model
    settings = Settings.for_model(
        model, state_weight=np.ones(1), input_weight=np.ones(1),
        limits=InputLimits(np.array([LOWER]), np.array([UPPER]), np.array([RATE])),
        observer_bandwidth=6.0 / 60.0, max_disturbance=np.array([20.0]),
        input_tolerance=np.array([2.0]), safe_input=np.array([SAFE]),
        sensor=replace(SensorLimits(np.array([253.15]), np.array([423.15]), np.array([2.0]),
                                    np.array([2.0]), 20.0), **(sensor or {})),
        supervisor=supervisor_settings(**(supervisor or {})))
    return Controller(model, replace(settings, **changes))


def supervisor_settings(learned: float = 0.1, linear: float = 0.5, **times: float
                        ) -> SupervisorSettings:
    """Return the two levels of the node with their margins."""
    return SupervisorSettings(
        (LevelSettings('sdre', learned), LevelSettings('linear', linear)), **times)


say = Words(Displays({'temperature': 'K', 'coolant_temperature': 'K'}))


def changed_reactor(feed_shift: float = 0.0, **factors: float) -> ControlAffineSystem:
    """Return the reactor with constants multiplied, and the feed's temperature shifted."""
    before = ReactorParameters()
    constants = {name: getattr(before, name) * factor for name, factor in factors.items()}
    constants['feed_temperature'] = before.feed_temperature + feed_shift
    return one_state_reactor(replace(before, **constants), nominal_state=REACTOR.nominal_state)


@dataclass
class Sample:
    """What happened at one second."""

    second: int
    temperature: float
    command: float
    report: Report


@dataclass
class Loop:
    """
    A controller and a plant, one second a sample.

    :param plant: temperature last in its state.
    :param bias: error of the sensor in K.
    :param lag: time constant of the coolant in s.
    :param delay: samples that a command is late.
    :param noise: of the sensor in K, from a fixed seed.
    :param reached: range of the coolant that the actuator reaches.
    :param tells: whether the coolant in force is measured.
    :param coolant_error: of that measurement in K.
    """

    controller: Controller
    plant: ControlAffineSystem = REACTOR
    kelvin: float = START
    bias: float = 0.0
    lag: float = 0.0
    delay: int = 0
    noise: float = 0.0
    reached: tuple[float, float] = (0.0, 1000.0)
    tells: bool = False
    coolant_error: float = 0.0
    state: State = field(default_factory=State)
    samples: list[Sample] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.x = self.plant.nominal_state.copy()
        self.x[-1] = self.kelvin
        self.coolant = float(equilibrium_input(self.plant, self.x)[0])
        self.state = self.controller.initialise(self.state, np.array([self.coolant]))
        self._late = [self.coolant] * self.delay
        self._rng = np.random.default_rng(0)

    @property
    def second(self) -> int:
        return len(self.samples)

    def ask(self, kelvin: float) -> None:
        self.state, refused = self.controller.request_setpoint(self.state, np.array([kelvin]))
        assert refused is None

    def set_mode(self, mode: Mode) -> None:
        self.state = self.controller.set_mode(self.state, mode)

    def replace(self, other: Controller) -> None:
        self.state = other.hand_over(self.controller, self.state)
        self.controller = other

    def restart(self) -> None:
        """Kill the controller; the next one finds the coolant in force."""
        self.state = self.controller.initialise(State(), np.array([self.coolant]))

    def run(self, seconds: int, sensor: Callable[[float], float | None] = lambda kelvin: kelvin
            ) -> list[Sample]:
        """
        Let the loop run.

        :param sensor: what is measured of a temperature; None for nothing.
        :return: the samples of this run.
        """
        first = self.second
        for _ in range(seconds):
            measured = sensor(float(self.x[-1]) + self.bias
                              + self.noise * float(self._rng.standard_normal()))
            now = EPOCH + self.second * SECOND
            if measured is None:
                self.state, command, report = self.controller.hold(self.state, now)
                assert command is not None
            else:
                self.state, command, report = self.controller.step(
                    self.state, np.array([measured]), now,
                    np.array([self.coolant + self.coolant_error]) if self.tells else None)
            self.samples.append(Sample(self.second, float(self.x[-1]), float(command[0]), report))
            self._move(float(command[0]))
        return self.samples[first:]

    def _move(self, command: float) -> None:
        self._late.append(command)
        command = min(max(self._late.pop(0), self.reached[0]), self.reached[1])
        # a lag in steps that are short beside it
        parts = 5 if self.lag else 1
        for _ in range(parts):
            share = -math.expm1(-1.0 / parts / self.lag) if self.lag else 1.0
            self.coolant += share * (command - self.coolant)
            self.x = advance(self.plant, self.x, np.array([self.coolant]), 1.0 / 60.0 / parts)


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
