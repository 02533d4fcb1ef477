# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The loop of the reactor: its topics and the parameters that it starts with."""

from typing import Any

from koopman_ros.core.paths import model_path
from koopman_ros.core.units import to_celsius
from koopman_ros.demo.loop import Scenario
from koopman_ros.model import load
from koopman_ros.parameters.controller import table_of
from koopman_ros.parameters.plant import PlantTable

SYSTEM, MODEL = 'reactor', 'reactor_nz4'
TEMPERATURE = 'temperature'
CONCENTRATION = 'concentration'
SETPOINT = 'setpoint'
ACTIVE_SETPOINT = 'active_setpoint'
COOLANT_SETPOINT = 'coolant_setpoint'
COOLANT_TEMPERATURE = 'coolant_temperature'
MANUAL_COOLANT_SETPOINT = 'manual_coolant_setpoint'
PREDICTED_TEMPERATURE = 'predicted_temperature'


def coolant_limits() -> tuple[float, float]:
    """Return the default range of the coolant in °C."""
    limits = table_of(load(model_path(MODEL))).snapshot({}).tuning.limits
    return to_celsius(float(limits.lower[0])), to_celsius(float(limits.upper[0]))


def constant(name: str) -> float:
    """Return the default of a constant of the plant, in SI."""
    return float(PlantTable().rows[f'constants.{name}'].default)


def scenario(model: str, setpoint: float, **others: Any) -> Scenario:
    """Return a loop without disturbance observer, with a set-point in K."""
    return Scenario({TEMPERATURE: setpoint}, controller={
        'model': model, 'observer_bandwidth': 0.0}, **others)
