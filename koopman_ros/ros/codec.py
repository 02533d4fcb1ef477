# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Messages to SI values and back, once, at the boundary (REP 103)."""

from builtin_interfaces.msg import Time
from sensor_msgs.msg import Temperature

from koopman_ros.units import LAST_STAMP_SECONDS, NANOSECONDS, to_celsius


def stamp_nanoseconds(stamp: Time) -> int:
    """Return a stamp as integer nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def stamp_message(nanoseconds: int) -> Time:
    """Return integer nanoseconds as a stamp, the nearest one when none holds them."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    if seconds > LAST_STAMP_SECONDS:
        return Time(sec=LAST_STAMP_SECONDS, nanosec=NANOSECONDS - 1)
    if seconds < -LAST_STAMP_SECONDS - 1:
        return Time(sec=-LAST_STAMP_SECONDS - 1, nanosec=0)
    return Time(sec=seconds, nanosec=rest)


def temperature_message(kelvin: float, stamp: Time, frame_id: str, variance: float = 0.0
                        ) -> Temperature:
    """Build a message from a temperature in K and its variance in K^2, where 0 means unknown."""
    message = Temperature(temperature=to_celsius(kelvin), variance=variance)
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    return message
