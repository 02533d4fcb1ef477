# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The reactor on the wire, as the demos know it: topics, messages and parameters."""

from typing import Any

from builtin_interfaces.msg import Time
from sensor_msgs.msg import Temperature

from koopman_ros.demo.loop import Scenario
from koopman_ros.lifting import load
from koopman_ros.parameters.controller import ControllerParameters, table_of
from koopman_ros.parameters.table import ParameterTable
from koopman_ros.resources import model_path
from koopman_ros.units import to_celsius

SYSTEM, MODEL, LINEAR_MODEL = 'reactor', 'reactor_nz4', 'reactor_linear'
TEMPERATURE = 'temperature'
CONCENTRATION = 'concentration'
SETPOINT = 'setpoint'
ACTIVE_SETPOINT = 'active_setpoint'
COOLANT_SETPOINT = 'coolant_setpoint'
COOLANT_TEMPERATURE = 'coolant_temperature'
MANUAL_COOLANT_SETPOINT = 'manual_coolant_setpoint'
PREDICTED_TEMPERATURE = 'predicted_temperature'


def controller_table() -> ParameterTable[ControllerParameters]:
    """Return the parameters of a controller."""
    return table_of(load(model_path(MODEL)))


def coolant_limits() -> tuple[float, float]:
    """Return the range of the coolant in degC."""
    rows = controller_table().rows
    return rows[f'{COOLANT_TEMPERATURE}.min'].default, rows[f'{COOLANT_TEMPERATURE}.max'].default


def constant(name: str) -> float:
    """Return a constant of a plant that was given none, in SI."""
    # here, as it takes scipy's integrators, a third of a second that others do without
    from koopman_ros.parameters.plant import PlantTable

    return float(PlantTable().rows[f'constants.{name}'].default)


def scenario(model: str, setpoint: float, **others: Any) -> Scenario:
    """
    Return a loop that a model controls alone, with a set-point in K.

    The observer would make up for what a model does not know, which is what is to be seen.
    """
    return Scenario({TEMPERATURE: setpoint}, controller={
        'model': model, 'disturbance_bandwidth': 0.0}, **others)


def temperature_message(kelvin: float, stamp: Time, frame_id: str) -> Temperature:
    """Build a message from a temperature in K."""
    message = Temperature(temperature=to_celsius(kelvin))
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    return message
