# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What may come to a controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Silence:
    """
    No measurement up to a time, which the controller answered with a command.

    :param stamp_ns: that of the command.
    """

    stamp_ns: int


@dataclass(frozen=True)
class TakeOver:
    """
    A start from the coolant temperature that was in force, in degrees Celsius.

    :param temperature: as in a message.
    """

    temperature: float


@dataclass(frozen=True)
class Input:
    """
    What came to the controller: a message of one of its topics, or something else that happened.

    :param topic: absolute name; empty when it was no message.
    :param time_ns: when it was recorded.
    :param message: with the fields of sensor_msgs/Temperature, or a mode, a silence, a take-over,
        or None when the controller was started again.
    :param command: for a temperature, what was commanded in degrees Celsius, or None.
    :param active: for a temperature, the set-point that changed with it in degrees Celsius.
    :param coolant: for a temperature, what was in force then in degrees Celsius, or None.
    """

    topic: str
    time_ns: int
    message: Any
    command: float | None = None
    active: float | None = None
    coolant: float | None = None
