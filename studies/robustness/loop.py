# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The control step on a true plant, sampled once a second, as the nodes run it."""

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from koopman_ros import control, evaluation, plants
from koopman_ros.control import Controller
from koopman_ros.core.arrays import Array
from koopman_ros.core.paths import model_path
from koopman_ros.core.units import SECONDS_PER_MINUTE
from koopman_ros.evaluation import LoopRun
from koopman_ros.model import LiftedModel, load
from koopman_ros.parameters.controller import built, table_of

REACTOR = plants.one_state_reactor()
START = float(REACTOR.nominal_state[0])
COOLANT = float(REACTOR.nominal_input[0])
PERIOD = 1.0  # s
COOLANT_RANGE = (278.15, 305.15)  # K
BANDWIDTH = 6.0  # 1/min
# Margins that are never exceeded: without fallback the learned law acts everywhere.
NO_FALLBACK: dict[str, Any] = {'learned_model_margin': 1e9, 'linear_model_margin': 1e9}


@lru_cache
def shipped_model() -> LiftedModel:
    """Return the lift that the controller loads by default."""
    return load(model_path('reactor_nz4'))


def reactor_controller(*, bandwidth: float | None = BANDWIDTH, coolant_weight: float = 1.0,
                       fallback: bool = True, linear_model_margin: float = 0.5,
                       model: LiftedModel | None = None) -> Controller:
    """
    Return the controller with the default parameters of its node and the shipped model.

    :param bandwidth: of the observer, in 1/min; None for the default, which falls with the
        model's dead time.
    :param coolant_weight: in 1/K^2.
    :param fallback: whether the distance from the training data decides which law acts.
    :param linear_model_margin: up to which the linear law does, in half-ranges.
    """
    model = model or shipped_model()
    observer = {} if bandwidth is None else {'observer_bandwidth': bandwidth / SECONDS_PER_MINUTE}
    tuning = built(table_of(model).snapshot({
        **observer, 'coolant_temperature.weight': coolant_weight,
        'linear_model_margin': linear_model_margin}), model).tuning
    return Controller(model, tuning if fallback else replace(tuning, **NO_FALLBACK))


def changed_reactor(*, heat_transfer: float = 1.0, concentration: float = 1.0,
                    feed: float = 0.0) -> plants.ControlAffineSystem:
    """Return the reactor with UA and C_A multiplied by factors and T_i shifted by `feed` K."""
    usual = plants.ReactorParameters()
    return plants.one_state_reactor(replace(
        usual, heat_transfer_coefficient=heat_transfer * usual.heat_transfer_coefficient,
        concentration=concentration * usual.concentration,
        feed_temperature=feed + usual.feed_temperature), nominal_state=REACTOR.nominal_state)


def at_setpoint(value: float) -> control.Event:
    """Ask for a set-point in K."""
    return control.SetpointRequest(0, np.array([value]))


def on_plant(**changes: Any) -> evaluation.Change:
    """Go on with another `system` or behind another `actuator` from the same state."""
    def change(loop: evaluation.Loop) -> evaluation.Loop:
        assert isinstance(loop.plant, plants.Process)
        return replace(loop, plant=replace(loop.plant, **changes))

    return change


def biased(bias: float, since: float = 0.0) -> evaluation.Sensor:
    """Add an error of the sensor, in state units, from a time in s on."""
    return lambda y, seconds: y + (bias if seconds >= since else 0.0)


def errors(run: LoopRun, reference: float, since: float = 0.0) -> Array:
    """Return the last state's distance from a reference from a time on."""
    return np.asarray(run.states[run.times >= since, -1] - reference)


def settling(run: LoopRun, reference: float, tolerance: float, since: float = 0.0
             ) -> float | None:
    """Return the seconds from `since` until it stays that close; None for never."""
    outside = np.flatnonzero(np.abs(errors(run, reference, since)) > tolerance)
    if not outside.size:
        return 0.0
    start = run.times[run.times >= since]
    if outside[-1] + 1 >= len(start) or run.failure:
        return None
    return float(start[outside[-1] + 1] - since)


def worst(run: LoopRun) -> str:
    """Return the last of the levels that acted."""
    return max(run.levels, key=run.loop.controller.order.levels.index)


def overshoot(run: LoopRun, reference: float, since: float) -> float:
    """Return how far the last state falls below a reference from a time on; 0 for not."""
    return max(0.0, float(np.max(-errors(run, reference, since))))


def run_loop(controller: Controller, system: plants.ControlAffineSystem, seconds: float,
             events: Iterable[evaluation.ScheduledChange] = (), *, x0: Iterable[float] = (START,),
             coolant: float | None = None, actuator: plants.Actuator | None = None,
             tells: bool = False, noise: float = 0.0, **others: Any) -> LoopRun:
    """
    Simulate a loop whose controller takes over from an applied input at the state x0 (n,).

    :param controller: it measures the plant's last n_x states.
    :param coolant: applied until then, in K; None for the one that holds x0.
    :param tells: whether the applied input is measured.
    :param noise: standard deviation of the measurement, in state units.
    :param others: of :func:`simulate`.
    """
    x = np.array([*x0], dtype=np.float64)
    held = plants.equilibrium_input(system, x) if coolant is None else np.array([coolant])
    plant = plants.Process(system, 0, x, held, actuator or plants.Actuator(), held)
    n_x = controller.model.n_x
    return evaluation.run_loop(
        controller, plant, [evaluation.at(0.0, control.Initialisation(held)), *events],
        duration=seconds, C=np.eye(system.n_x)[-n_x:],
        noise=np.full(n_x, noise) if noise else None,
        input_sensor=evaluation.perfect if tells else None, **others)


def run_late(model: LiftedModel, dead_time: float, system: plants.ControlAffineSystem,
             seconds: float, *events: evaluation.ScheduledChange, **others: Any) -> LoopRun:
    """Run the loop by the default parameters from rest, behind a dead time in s."""
    return run_loop(reactor_controller(model=model, bandwidth=None), system, seconds, events,
                    actuator=plants.Actuator(dead_time=dead_time), **others)
