# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Stamps as integer nanoseconds and back."""

from builtin_interfaces.msg import Time

from koopman_ros.core.units import LAST_STAMP_SECONDS, NANOSECONDS


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
