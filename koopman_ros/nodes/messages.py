# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Conversion between messages and SI values, once, at the boundary (REP 103)."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from sensor_msgs.msg import Temperature

from koopman_ros.units import NANOSECONDS as NANOSECONDS

SECONDS_PER_MINUTE = 60.0
ZERO_CELSIUS = 273.15  # K
LAST_STAMP_SECONDS = 2 ** 31 - 1  # of a stamp, whose seconds are an int32
LONGEST_FRAME_ID = 256  # characters that are passed on


def to_kelvin(celsius: float) -> float:
    """Convert a temperature from degrees Celsius."""
    return celsius + ZERO_CELSIUS


def to_celsius(kelvin: float) -> float:
    """Convert a temperature to degrees Celsius."""
    return kelvin - ZERO_CELSIUS


def in_celsius(kelvin: float, unit: str = 'K') -> str:
    """Write a temperature given in K for the operator."""
    return f'{to_celsius(kelvin):.2f} degC'


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


def seconds_text(nanoseconds: int) -> str:
    """Write integer nanoseconds in seconds, with all digits, e.g. '1700000000.25'."""
    seconds, rest = divmod(abs(nanoseconds), NANOSECONDS)
    sign = '-' if nanoseconds < 0 else ''
    return f'{sign}{seconds}.{rest:09d}'.rstrip('0').rstrip('.')


def temperature_message(kelvin: float, stamp: Time, frame_id: str, variance: float = 0.0
                        ) -> Temperature:
    """
    Build a temperature message.

    :param kelvin: temperature in K.
    :param stamp: time of the sample, or of the measurement that is answered.
    :param frame_id: where the temperature is taken.
    :param variance: in K^2; 0 means unknown.
    """
    message = Temperature(temperature=to_celsius(kelvin), variance=variance)
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    return message
