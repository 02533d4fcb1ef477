# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0


"""The control step on a true plant, sampled once a second, as the nodes run it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
import math
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control import (
    Controller,
    InputLimits,
    LevelSettings,
    Settings,
    State,
    SupervisorSettings,
)
from koopman_ros.estimation import SensorLimits
from koopman_ros.lifting import LiftedModel, load
from koopman_ros.plants import (
    ActuatedProcess,
    Actuator,
    ControlAffineSystem,
    IntegrationError,
    one_state_reactor,
    Process,
    ReactorParameters,
    sensor_noise,
)
from koopman_ros.reasons import Reason

Array = NDArray[np.float64]

REACTOR = one_state_reactor()
START = float(REACTOR.nominal_state[0])
COOLANT = float(REACTOR.nominal_input[0])
PERIOD = 1.0  # s
COOLANT_RANGE = (278.15, 305.15)  # K
BANDWIDTH = 6.0  # 1/min
_NS = 1_000_000_000
# A margin that is never exceeded: without the ladder the learned law acts everywhere.
EVERYWHERE = 1e9


@lru_cache
def shipped_model() -> LiftedModel:
    """Return the lift that the controller loads by default."""
    return load(Path(__file__).parents[2] / 'config' / 'models' / 'reactor_nz4.safetensors')


def reactor_controller(*, bandwidth: float = BANDWIDTH, coolant_weight: float = 1.0,
                       ladder: bool = True, model: LiftedModel | None = None) -> Controller:
    """
    Return the controller with the default parameters of its node.

    :param bandwidth: of the observer, in 1/min.
    :param coolant_weight: in 1/K^2.
    :param ladder: whether the distance from the training data decides which law acts.
    :param model: the shipped one by default.
    """
    lower, upper = COOLANT_RANGE
    two = np.array([2.0])
    return Controller(model or shipped_model(), Settings(
        state_weight=np.ones(1), input_weight=np.array([coolant_weight]),
        limits=InputLimits(np.array([lower]), np.array([upper]), np.ones(1)),
        setpoint_ramp=np.array([1000.0 / 60.0]), max_disturbance=np.array([20.0]),
        input_tolerance=two, safe_input=np.array([lower]),
        sensor=SensorLimits(np.array([253.15]), np.array([423.15]), two, two, 20.0),
        observer_bandwidth=bandwidth / 60.0, supervisor=supervisor_settings() if ladder else (
            supervisor_settings(EVERYWHERE, EVERYWHERE))))


def supervisor_settings(learned: float = 0.1, linear: float = 0.5) -> SupervisorSettings:
    """Return the two levels of the node with their margins, in half widths."""
    return SupervisorSettings((LevelSettings('sdre', learned), LevelSettings('linear', linear)))


def changed_reactor(*, heat_transfer: float = 1.0, concentration: float = 1.0,
                    feed: float = 0.0) -> ControlAffineSystem:
    """
    Return the reactor with other constants.

    :param heat_transfer: factor of UA.
    :param concentration: factor of C_A.
    :param feed: added to T_i, in K.
    """
    usual = ReactorParameters()
    return one_state_reactor(replace(
        usual, heat_transfer_coefficient=heat_transfer * usual.heat_transfer_coefficient,
        concentration=concentration * usual.concentration,
        feed_temperature=feed + usual.feed_temperature), nominal_state=REACTOR.nominal_state)


@dataclass(frozen=True)
class Loop:
    """
    A controller and its plant at one time.

    :param controller: the pure controller.
    :param state: what it remembers.
    :param plant: the plant behind its actuator.
    :param bias: error of the sensor, in state units.
    """

    controller: Controller
    state: State
    plant: ActuatedProcess
    bias: float = 0.0


Change: TypeAlias = Callable[[Loop], Loop]


def at_setpoint(*value: float) -> Change:
    """Ask for a set-point."""
    def change(loop: Loop) -> Loop:
        state, refusal = loop.controller.request_setpoint(loop.state, np.array(value))
        if refusal:
            raise ValueError(refusal)
        return replace(loop, state=state)
    return change


def on_plant(system: ControlAffineSystem) -> Change:
    """Go on with another plant from the same state."""
    def change(loop: Loop) -> Loop:
        process = replace(loop.plant.process, system=system)
        return replace(loop, plant=replace(loop.plant, process=process))
    return change


def behind(actuator: Actuator) -> Change:
    """Put another actuator before the plant."""
    return lambda loop: replace(loop, plant=replace(loop.plant, actuator=actuator))


def with_bias(bias: float) -> Change:
    """Let the sensor err by so much, in state units."""
    return lambda loop: replace(loop, bias=bias)


@dataclass(frozen=True)
class Course:
    """
    What a loop did, one row a sample.

    :param seconds: (N,) times.
    :param x: (N, n) true state of the plant.
    :param u: (N,) command.
    :param disturbance: (N,) estimated, in input units; NaN where there is none.
    :param levels: that acted.
    :param order: of the levels, best first.
    :param reasons: why not a better one.
    :param ran_away: whether the plant left the bounds of its model.
    :param last: the loop at the end.
    """

    seconds: Array
    x: Array
    u: Array
    disturbance: Array
    levels: tuple[str, ...]
    order: tuple[str, ...]
    reasons: tuple[Reason | None, ...]
    ran_away: bool
    last: Loop

    def errors(self, reference: float, since: float = 0.0) -> Array:
        """Return the last state's distance from a reference from a time on."""
        return self.x[self.seconds >= since, -1] - reference

    def settling(self, reference: float, tolerance: float, since: float = 0.0) -> float:
        """Return the seconds from `since` until it stays that close; infinity for never."""
        outside = np.flatnonzero(np.abs(self.errors(reference, since)) > tolerance)
        if not outside.size:
            return 0.0
        start = self.seconds[self.seconds >= since]
        if outside[-1] + 1 >= len(start) or self.ran_away:
            return math.inf
        return float(start[outside[-1] + 1] - since)

    def worst(self) -> str:
        """Return the last of the levels that acted."""
        return max(self.levels, key=self.order.index)


def run_loop(controller: Controller, system: ControlAffineSystem, x0: Array, coolant: float,
             seconds: float, changes: Sequence[tuple[float, Change]] = (), *,
             actuator: Actuator | None = None, tells: bool = False, noise: float = 0.0,
             seed: int = 0, period: float = PERIOD,
             stop: Callable[[Array, Array, str], bool] | None = None) -> Course:
    """
    Run a loop whose controller takes over from an input in force.

    :param controller: it measures the plant's last n_x states.
    :param system: the plant.
    :param x0: (n,) state at time 0.
    :param coolant: input in force at time 0.
    :param seconds: how long.
    :param changes: what happens when, in s.
    :param actuator: between command and plant; perfect by default.
    :param tells: whether the input in force is measured.
    :param noise: standard deviation of the measurement, in state units.
    :param seed: of the noise.
    :param period: between samples, in s.
    :param stop: ends the run when it is true of state, command and level.
    """
    held = np.array([coolant])
    plant = ActuatedProcess(Process(system, 0, np.asarray(x0, dtype=np.float64), held),
                            actuator or Actuator(), held)
    loop = Loop(controller, controller.take_over(State(), held), plant)
    rows: list[tuple[float, Array, float, float]] = []
    levels, reasons, ran_away = [], [], False
    n_x, waiting = controller.model.n_x, sorted(changes, key=lambda change: change[0])
    for number in range(round(seconds / period) + 1):
        # stamps start after 0, which has a meaning of its own to a set-point
        time_ns = round(number * period * _NS)
        try:
            plant = loop.plant.until(time_ns)
        except IntegrationError:
            ran_away = True
            break
        loop = replace(loop, plant=plant)
        while waiting and waiting[0][0] <= number * period:
            loop = waiting.pop(0)[1](loop)
        x = plant.process.x
        measured = x[-n_x:] + loop.bias + sensor_noise(noise, seed, number)
        state, u, report = loop.controller.step(
            loop.state, measured, time_ns + _NS, plant.process.u if tells else None)
        loop = replace(loop, state=state, plant=loop.plant.commanded(u, time_ns))
        disturbance = np.nan if report.estimate is None else (
            float(report.estimate.disturbance[0]))
        rows.append((number * period, x, float(u[0]), disturbance))
        levels.append(report.level)
        reasons.append(report.reason)
        if stop is not None and stop(x, u, report.level):
            break
    times, states, inputs, disturbances = zip(*rows, strict=True)
    return Course(np.array(times), np.array(states), np.array(inputs), np.array(disturbances),
                  tuple(levels), controller.settings.supervisor.order, tuple(reasons), ran_away,
                  loop)
