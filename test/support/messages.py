# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Messages and statuses of the node tests."""

from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import Temperature

from koopman_ros.ros.codec import stamp_message, stamp_nanoseconds
from koopman_ros.units import NANOSECONDS

TIMEOUT = 120.0  # s; a test that waits this long has failed, on a busy machine, too


def temperature(celsius: float, seconds: float = 0.0) -> Temperature:
    """Build a temperature with a stamp."""
    message = Temperature(temperature=celsius)
    message.header.stamp = stamp_message(round(seconds * NANOSECONDS))
    return message


def seconds(message: Any) -> float:
    """Return the stamp of a message."""
    return stamp_nanoseconds(message.header.stamp) / NANOSECONDS


def value(status: DiagnosticStatus, key: str) -> str:
    """Return a figure of a status."""
    return next(item.value for item in status.values if item.key == key)
