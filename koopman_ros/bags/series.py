# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recorded signals as arrays, for plots and studies."""

from dataclasses import dataclass
import os

import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags.errors import BagReadError, reason
from koopman_ros.bags.reader import read_messages, summary

_TEMPERATURE = 'sensor_msgs/msg/Temperature'
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class TemperatureSeries:
    """
    A sensor_msgs/Temperature topic as arrays of one length n, in the order of recording.

    `stamp_ns` is the header's stamp [ns] (n, int64), `stamp_s` the same relative to the chosen
    origin [s] (n, float64), `celsius` the temperature [degC] (n, float64; REP-103), `variance`
    its variance [K^2] (n, float64; 0 where unknown).
    """

    stamp_ns: NDArray[np.int64]
    stamp_s: NDArray[np.float64]
    celsius: NDArray[np.float64]
    variance: NDArray[np.float64]


def temperature_series(
    path: str | os.PathLike[str], topic: str, *, origin_ns: int = 0, recover: bool = False
) -> TemperatureSeries:
    """
    Return a temperature topic of a bag as arrays.

    `stamp_s` is (stamp - `origin_ns`) in seconds, subtracted as integers: seconds since the
    epoch resolve no better than 0.24 us in float64, seconds since the start of the bag are
    exact to the nanosecond for 100 days. `recover` is that of `read_messages`.

    Raises BagReadError as `read_messages` does, and for a topic that the bag does not hold or
    that is not of type sensor_msgs/msg/Temperature.
    """
    entries = read_messages(path, [topic], recover=recover)
    content = summary(path)
    if topic not in content.types:
        raise BagReadError(
            f'bag {os.fspath(path)!r} has no topic {topic!r}: choose one of '
            f'{", ".join(sorted(content.types)) or "none (it is empty)"}')
    if content.types[topic] != _TEMPERATURE:
        raise _other_type(path, topic, content.types[topic])
    stamps, celsius, variance = [], [], []
    try:
        for entry in entries:
            if entry.type_name != _TEMPERATURE:
                raise _other_type(path, topic, entry.type_name)
            stamp = entry.message.header.stamp
            stamps.append(_NS_PER_S * stamp.sec + stamp.nanosec)
            celsius.append(entry.message.temperature)
            variance.append(entry.message.variance)
        stamp_ns = np.array(stamps, dtype=np.int64)
        values = np.array([celsius, variance], dtype=np.float64)
    except BagReadError:
        raise
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise BagReadError(
            f'topic {topic!r} of bag {os.fspath(path)!r} calls itself {_TEMPERATURE} and is laid '
            f'out differently ({reason(error)}): read it with read_messages') from error
    return TemperatureSeries(
        stamp_ns=stamp_ns,
        stamp_s=(stamp_ns - origin_ns) / _NS_PER_S,
        celsius=values[0],
        variance=values[1],
    )


def _other_type(path: str | os.PathLike[str], topic: str, found: str) -> BagReadError:
    return BagReadError(f'topic {topic!r} of bag {os.fspath(path)!r} is {found}, not '
                        f'{_TEMPERATURE}: read it with read_messages')
