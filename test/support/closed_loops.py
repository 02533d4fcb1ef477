# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models, laws and closed loops on the true reactor, in which anything may go wrong."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import root

from koopman_ros import control, evaluation, plants
from koopman_ros.core.arrays import Array
from koopman_ros.core.signals import Outputs
from koopman_ros.core.status import StatusFormatter
from koopman_ros.core.units import Displays
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.estimation import DisturbanceObserver
from koopman_ros.event_log.records import encoded
from koopman_ros.model import LiftedModel, load
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.tuning import Tuning

Law = Callable[..., control.Feedback]

REACTOR = plants.one_state_reactor()
FOULED = plants.one_state_reactor(replace(
    plants.ReactorParameters(), heat_transfer_coefficient=(
        0.8 * plants.ReactorParameters().heat_transfer_coefficient)), REACTOR.nominal_state)
START = float(REACTOR.nominal_state[0])
SETPOINT = START - 10.0
COOLANT = float(plants.equilibrium_input(REACTOR, [SETPOINT])[0])
# K, of temperature and of coolant: what the costs are measured in
UNIT = 10.0


def shipped(name: str) -> LiftedModel:
    return load(Path(__file__).parents[2] / 'config' / 'models' / f'{name}.safetensors')


def observing(model: LiftedModel, bandwidth: float, bound: float = np.inf) -> DisturbanceObserver:
    """Return an observer of all states, its bandwidth in 1/s, one bound for all inputs."""
    states = model.states
    return DisturbanceObserver(
        model, Outputs(states.names, states.units, np.eye(model.n_x)), Tuning.for_model(
            model, observer_bandwidth=bandwidth, max_disturbance=bound * model.inputs.scale),
        None)


def steady_state(system: plants.ControlAffineSystem, u: list[float], guess: list[float]
                 ) -> np.ndarray:
    found = root(lambda x: system.derivative(x, u), guess, jac=system.drift_jacobian, tol=1e-13)
    assert found.success
    return found.x


def reactor_weights(model: LiftedModel, R: float) -> control.Weights:
    """Weigh squared deviations in units of 10 K by 1 and by R."""
    return control.Weights(np.diag(np.square(model.states.scale / UNIT)),
                           R * np.diag(np.square(model.inputs.scale / UNIT)))


def run_reactor(model: LiftedModel, law: Law, R: float, minutes: float) -> tuple[float, float]:
    """Drive the true reactor to the set-point; return its cost and its last temperature."""
    run = evaluation.run_closed_loop(
        model, REACTOR.derivative, np.array([START]), np.array([SETPOINT]),
        reactor_weights(model, R), minutes, law=law, samples=2, rtol=1e-10,
        u_ref=np.array([COOLANT]))
    assert not run.failure
    return run.cost, float(run.states[-1, 0])


EPOCH = 1_785_000_000 * SECOND
LOWER, UPPER, RATE = 278.15, 305.15, 1.0  # K, K, K/s
SAFE = LOWER
USUAL = built(table_of(shipped('reactor_nz4')).snapshot({}), shipped('reactor_nz4')).tuning


def controller(model: Any = 'reactor_nz4', *, sensor: Mapping[str, Any] | None = None,
               **changes: Any) -> control.Controller:
    """Return a controller with the default parameters of its node."""
    model = shipped(model) if isinstance(model, str) else model
    return control.Controller(model, replace(
        USUAL, sensor=replace(USUAL.sensor, **(sensor or {})), **changes))


say = StatusFormatter(Displays({'temperature': 'K', 'coolant_temperature': 'K'}))


def content(value: Any) -> str:
    """Write a state, a model or the result of a step so that they compare bit for bit."""
    if type(value) is tuple:
        state, command, report = value
        found = report.estimate
        value = state, command, replace(report, estimate=None), found and (
            found.state, found.disturbance, found.at_bound, found.covariance, found.innovation)
    return json.dumps(encoded(value), sort_keys=True)


@dataclass
class Sample:
    second: int
    temperature: float
    command: float
    report: control.StepReport


class Reactor:
    """A loop on the true reactor that a test leads from one simulation to the next."""

    def __init__(self, controller: control.Controller,
                 plant: plants.ControlAffineSystem = REACTOR, kelvin: float = START, *,
                 actuator: plants.Actuator | None = None, noise: float = 0.0,
                 sensor: evaluation.Sensor = evaluation.perfect,
                 input_sensor: evaluation.Sensor | None = None, coolant: float | None = None
                 ) -> None:
        x = np.append(plant.nominal_state[:-1], kelvin)
        u = plants.equilibrium_input(plant, x) if coolant is None else np.array([coolant])
        self.loop = evaluation.Loop(controller, controller.initialise(control.State(), u),
                                    plants.Process(plant, 0, x, u, actuator or plants.Actuator(),
                                                   u))
        self.noise, self.sensor, self.input_sensor = noise, sensor, input_sensor
        self.waiting: list[control.Event | evaluation.Change] = []
        self.samples: list[Sample] = []

    @property
    def kelvin(self) -> float:
        second = len(self.samples)
        return float(self.loop.plant.until(second * SECOND).x[-1])

    def do(self, *what: control.Event | evaluation.Change) -> None:
        self.waiting += what

    def ask(self, kelvin: float) -> None:
        self.do(control.SetpointRequest(0, np.array([kelvin])))

    def manual(self, kelvin: float) -> None:
        self.do(control.ModeChange(control.Mode.MANUAL), control.ManualCommand(np.array([kelvin])))

    def act(self, actuator: plants.Actuator) -> None:
        self.change(actuator=actuator)

    def change(self, **changes: Any) -> None:
        """Go on with another state, system or actuator."""
        self.do(lambda loop: replace(loop, plant=replace(loop.plant, **changes)))

    def run(self, seconds: int, sensor: Callable[[float], float | None] | None = None
            ) -> list[Sample]:
        """Let the loop run, under a sensor of its own meanwhile; return its samples."""
        first = len(self.samples)

        def measure(y: Array, second: float) -> Array | None:
            found = sensor(float(y[0])) if sensor else self.sensor(y, second)
            return None if found is None else np.reshape(found, 1)

        run = evaluation.run_loop(
            self.loop.controller, self.loop.plant.until(first * SECOND),
            [evaluation.at(0.0, what) for what in self.waiting], duration=seconds - 1.0,
            C=np.eye(len(self.loop.plant.x))[-1:], seed=first, sensor=measure,
            noise=np.array([self.noise]) if self.noise else None, state=self.loop.state,
            input_sensor=self.input_sensor, stamp=lambda time_ns: EPOCH + time_ns)
        assert not run.failure
        self.loop, self.waiting = run.loop, []
        self.samples += [Sample(first + n, *row) for n, row in enumerate(zip(
            run.states[:, -1].tolist(), run.commands[:, 0].tolist(), run.reports, strict=True))]
        return self.samples[first:]


def largest_step(samples: list[Sample]) -> float:
    return float(np.max(np.abs(np.diff([sample.command for sample in samples]))))


def settled(samples: list[Sample], kelvin: float, tolerance: float) -> int:
    """Return how many seconds it takes until the temperature stays within a tolerance."""
    off = [k for k, s in enumerate(samples) if abs(s.temperature - kelvin) > tolerance]
    return off[-1] + 1 if off else 0


def levels(samples: list[Sample]) -> list[str]:
    found: list[str] = []
    for sample in samples:
        if not found or found[-1] != sample.report.level:
            found.append(sample.report.level)
    return found
