# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recorded signals: one number in each stamped message of a topic, and where they jump."""

from collections.abc import Collection
from dataclasses import dataclass
import os

import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags.limits import BagReadError, reason
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

# Fewer samples do not tell what is usual.
_ENOUGH = 50
# A change is no motion when it is larger than so many times all but the largest changes, ...
_TIMES_USUAL = 10.0
_USUAL = 90.0  # percentile
# ... and than this share of the range in which it mostly is.
_SHARE_OF_RANGE = 0.2
_MOSTLY = (1.0, 99.0)  # percentiles


@dataclass(frozen=True)
class Series:
    """A signal as arrays of one length n, in the order of recording."""

    stamp_ns: NDArray[np.int64]  #: (n,) the header's stamp [ns]
    values: NDArray[np.float64]  #: (n,) the numbers
    unit: str  #: of the numbers


def read_series(path: str | os.PathLike[str], topic: str, *, recover: bool = False) -> Series:
    """
    Return a signal of a bag as arrays; `recover` is that of `read_messages`.

    Raises BagReadError as `read_messages` does, and for a topic that the bag does not hold or
    that is of none of the types in `SCALARS`.
    """
    # first, for what it says of a bag that is none
    messages = read_messages(path, [topic], recover=recover)
    carrier = carriers(path, summary(path), [topic])[topic]
    numbers = [stamped_number(path, entry, carrier) for entry in messages]
    return Series(np.array([stamp for stamp, _ in numbers], dtype=np.int64),
                  np.array([value for _, value in numbers], dtype=np.float64), carrier.unit)


def carriers(path: str | os.PathLike[str], content: BagSummary, topics: Collection[str]
             ) -> dict[str, Scalar]:
    """Return how topics carry their numbers; raise BagReadError for one that has none."""
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


def spikes_and_jumps(values: NDArray[np.float64], least: float
                     ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """
    Find changes that no plant makes: samples that leap away and back, and jumps to another level.

    :param values: (n,) in the order of their times.
    :param least: no smaller change is one of them.
    :return: whether each sample is a spike (n,), and whether the signal jumps to it (n,).
    """
    spike, jump = np.zeros(len(values), dtype=bool), np.zeros(len(values), dtype=bool)
    if len(values) < _ENOUGH:
        return spike, jump
    change = np.diff(values)
    low, high = np.percentile(values, _MOSTLY)
    limit = max(_TIMES_USUAL * float(np.percentile(np.abs(change), _USUAL)),
                _SHARE_OF_RANGE * float(high - low), least)
    large = np.abs(change) > limit
    spike[1:-1] = large[:-1] & large[1:] & (change[:-1] * change[1:] < 0.0)
    # two changes belong to each spike
    jump[1:] = large & ~spike[1:] & ~spike[:-1]
    return spike, jump
