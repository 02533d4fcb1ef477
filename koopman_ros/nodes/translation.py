# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Messages into control steps: the same for the running controller and for a bag that is replayed.

A message is anything with the fields of sensor_msgs/Temperature: ROS's own, or one decoded from a
bag.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from koopman_ros.control import Controller, Report, Settings, State
from koopman_ros.lifting import LiftedModel
from koopman_ros.nodes.messages import (
    in_celsius,
    NANOSECONDS,
    stamp_nanoseconds,
    to_celsius,
    to_kelvin,
)

# The temperatures of reactor and coolant at an instant are stamped no further apart.
SAME_TIME_NS = 2 * NANOSECONDS


def controller_of(model: LiftedModel, settings: Settings) -> Controller:
    """Return the controller that speaks to an operator in degrees Celsius."""
    return Controller(model, settings, in_celsius)


def answer(controller: Controller, state: State, message: Any, coolant: float | None = None
           ) -> tuple[State, float, Report]:
    """
    Answer a measurement.

    :param controller: model and settings.
    :param state: as returned by the step before.
    :param message: temperature in degrees Celsius with its stamp.
    :param coolant: its temperature in force then, in degrees Celsius, where it is known.
    :return: the new state, the coolant temperature commanded in K, and the report.
    """
    kelvin = to_kelvin(message.temperature)
    # below absolute zero there is nothing to measure
    state, command, report = controller.step(
        state, np.array([kelvin if kelvin >= 0.0 else math.nan]),
        stamp_nanoseconds(message.header.stamp),
        None if coolant is None else np.array([to_kelvin(coolant)]))
    return state, float(command[0]), report


def watch(controller: Controller, state: State, stamp_ns: int
          ) -> tuple[State, float | None, Report]:
    """
    Answer that nothing has been measured up to a time.

    :return: the new state, the coolant temperature commanded in K or None, and the report.
    """
    state, command, report = controller.watch(state, stamp_ns)
    return state, None if command is None else float(command[0]), report


def take_over(controller: Controller, state: State, message: Any) -> State:
    """Start from a coolant temperature that is in force already."""
    return controller.take_over(state, np.array([to_kelvin(message.temperature)]))


def ask_setpoint(controller: Controller, state: State, message: Any) -> tuple[State, str]:
    """Ask for a set-point; return the new state and an empty string, or why it is refused."""
    return controller.request_setpoint(
        state, np.array([to_kelvin(message.temperature)]),
        stamp_nanoseconds(message.header.stamp))


def ask_manual_coolant(controller: Controller, state: State, message: Any) -> tuple[State, str]:
    """Ask for a coolant temperature in manual mode; return as for a set-point."""
    return controller.request_manual_input(state, np.array([to_kelvin(message.temperature)]))


def tracked_celsius(report: Report) -> float:
    """Return the set-point that was tracked in degrees Celsius; NaN where there was none."""
    active = report.active_setpoint
    return math.nan if active is None else to_celsius(float(active[0]))
