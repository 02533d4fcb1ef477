# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
