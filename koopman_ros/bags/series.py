# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recorded signals: one number in each stamped message of a topic."""

from collections.abc import Collection
from dataclasses import dataclass
import os

import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags.errors import BagReadError, reason
from koopman_ros.bags.reader import BagMessage, BagSummary, read_messages, summary
from koopman_ros.units import NANOSECONDS


@dataclass(frozen=True)
class Scalar:
    """How messages of a type carry a number."""

    field: str  #: its name in the message
    unit: str  #: of the number
    lowest: float  #: that it can be, in this unit; what is below is no measurement
    highest: float  #: likewise
    least_jump: float  #: smallest change that may be one to another level, as after a reset


# The types that can be read as signals, in the units of REP 103.
SCALARS = {
    'sensor_msgs/msg/Temperature': Scalar('temperature', 'degC', -273.15, 1e4, 1.0),
    'sensor_msgs/msg/FluidPressure': Scalar('fluid_pressure', 'Pa', -1e12, 1e12, 1e3),
}


@dataclass(frozen=True)
class Series:
    """
    A signal as arrays of one length n, in the order of recording.

    `stamp_ns` is the header's stamp [ns] (n, int64), `stamp_s` the same relative to the chosen
    origin [s] (n, float64), `values` the numbers (n, float64) in `unit`.
    """

    stamp_ns: NDArray[np.int64]
    stamp_s: NDArray[np.float64]
    values: NDArray[np.float64]
    unit: str


def read_series(path: str | os.PathLike[str], topic: str, *, origin_ns: int = 0,
                recover: bool = False) -> Series:
    """
    Return a signal of a bag as arrays.

    `stamp_s` is (stamp - `origin_ns`) in seconds, subtracted as integers: seconds since the
    epoch resolve no better than 0.24 us in float64, seconds since the start of the bag are
    exact to the nanosecond for 100 days. `recover` is that of `read_messages`.

    Raises BagReadError as `read_messages` does, and for a topic that the bag does not hold or
    that is of none of the types in `SCALARS`.
    """
    # first, for what it says of a bag that is none
    messages = read_messages(path, [topic], recover=recover)
    carrier = carriers(path, summary(path), [topic])[topic]
    numbers = [stamped_number(path, entry, carrier) for entry in messages]
    stamp_ns = np.array([stamp for stamp, _ in numbers], dtype=np.int64)
    return Series(stamp_ns, (stamp_ns - origin_ns) / NANOSECONDS,
                  np.array([value for _, value in numbers], dtype=np.float64), carrier.unit)


def carriers(path: str | os.PathLike[str], content: BagSummary, topics: Collection[str]
             ) -> dict[str, Scalar]:
    """
    Return how the messages of some topics carry their numbers.

    Raises BagReadError for a topic that the bag lacks, or of a type that carries no number.
    """
    for topic in topics:
        if topic not in content.types:
            known = ', '.join(sorted(content.types)) or 'no topic at all'
            raise BagReadError(f'bag {os.fspath(path)!r} has no topic {topic!r}, it has {known}: '
                               'name the right topics, or record them')
        if content.types[topic] not in SCALARS:
            raise _other_type(path, topic, content.types[topic])
    return {topic: SCALARS[content.types[topic]] for topic in topics}


def stamped_number(path: str | os.PathLike[str], entry: BagMessage, carrier: Scalar
                   ) -> tuple[int, float]:
    """Return stamp [ns] and number of a message; raise BagReadError where it has none."""
    if SCALARS.get(entry.type_name) is not carrier:
        raise _other_type(path, entry.topic, entry.type_name)
    try:
        stamp = entry.message.header.stamp
        return (int(np.int64(NANOSECONDS * stamp.sec + stamp.nanosec)),
                float(getattr(entry.message, carrier.field)))
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise BagReadError(
            f'topic {entry.topic!r} of bag {os.fspath(path)!r} calls itself {entry.type_name} and '
            f'is laid out differently ({reason(error)}): read it with read_messages') from error


def _other_type(path: str | os.PathLike[str], topic: str, found: str) -> BagReadError:
    return BagReadError(f'topic {topic!r} of bag {os.fspath(path)!r} is {found}, not '
                        f'{" or ".join(SCALARS)}: name another topic')
