# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Messages into events of the control step.

A message is anything with the fields of sensor_msgs/Temperature.
"""

import math
from typing import Any

import numpy as np

from koopman_ros.control.events import (
    Initialisation,
    ManualCommand,
    Measurement,
    SetpointRequest,
)
from koopman_ros.ros.codec import stamp_nanoseconds
from koopman_ros.units import NANOSECONDS, to_kelvin

# The temperatures of reactor and coolant at an instant are stamped no further apart.
SAME_TIME_NS = 2 * NANOSECONDS


def measurement(message: Any, coolant: float | None = None) -> Measurement:
    """
    Return the event of a measurement.

    :param message: temperature in degrees Celsius with its stamp.
    :param coolant: its temperature applied then, in degrees Celsius, where it is known.
    """
    kelvin = to_kelvin(message.temperature)
    # below absolute zero there is nothing to measure
    return Measurement(stamp_nanoseconds(message.header.stamp),
                       np.array([kelvin if kelvin >= 0.0 else math.nan]),
                       None if coolant is None else np.array([to_kelvin(coolant)]))


def initialisation(message: Any) -> Initialisation:
    """Return the event of a start from the coolant temperature that is applied already."""
    return Initialisation(np.array([to_kelvin(message.temperature)]))


def setpoint_request(message: Any) -> SetpointRequest:
    """Return the event of a set-point, whose stamp says from when it holds."""
    return SetpointRequest(stamp_nanoseconds(message.header.stamp),
                           np.array([to_kelvin(message.temperature)]))


def manual_command(message: Any) -> ManualCommand:
    """Return the event of a coolant temperature commanded in manual mode."""
    return ManualCommand(np.array([to_kelvin(message.temperature)]))
