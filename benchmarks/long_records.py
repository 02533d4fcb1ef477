# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Long records of a plant under random steps, simulated side by side and written as bags."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Schema,
    Statistics,
)
import numpy as np
from numpy.typing import NDArray

from koopman_ros.bags import message_definition
from koopman_ros.bags.records import MAGIC
from koopman_ros.plants import ControlAffineSystem
from koopman_ros.solvers import runge_kutta_step
from koopman_ros.units import NANOSECONDS, SECONDS_PER_TIME_UNIT

TYPE, FIELD = 'geometry_msgs/msg/PointStamped', 'point.x'  # a number with a stamp, of any unit
_MESSAGES = 10_000  # in a chunk, less than a megabyte
# A stamped number in a chunk: head of the record, head of the message, and its CDR.
_RECORD = np.dtype([
    ('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'), ('log', '<u8'),
    ('publish', '<u8'), ('encapsulation', 'V4'), ('sec', '<i4'), ('nanosec', '<u4'),
    ('frame_length', '<u4'), ('frame', 'u1'), ('padding', 'V3'), ('point', '<f8', 3)])
_HEAD = 9  # bytes of opcode and length


@dataclass(frozen=True)
class Design:
    """A record: a plant, how it is driven, and how it is measured."""

    system: ControlAffineSystem
    lower: NDArray[np.float64]  #: (n_u,) lowest input
    upper: NDArray[np.float64]  #: (n_u,) highest input
    hold: tuple[float, float]  #: shortest and longest time between steps, in s
    period: float  #: between samples, in s
    noise: NDArray[np.float64]  #: (n_x,) standard deviation of the measurements


def simulated(design: Design, samples: int, runs: int, seed: int
              ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return noisy states (samples, runs, n_x) and inputs (samples, runs, n_u) of some runs."""
    system, rng = design.system, np.random.default_rng(seed)
    step = design.period / SECONDS_PER_TIME_UNIT[system.time_unit]
    x = np.tile(system.nominal_state, (runs, 1))
    u = rng.uniform(design.lower, design.upper, (runs, len(design.lower)))
    left = rng.uniform(*design.hold, runs)
    states = np.empty((samples, *x.shape))
    inputs = np.empty((samples, *u.shape))
    for k in range(samples):
        states[k], inputs[k] = x, u
        x = runge_kutta_step(partial(_rate, system, u), x, step)
        left -= design.period
        if np.any(new := left <= 0.0):
            u = u.copy()
            u[new] = rng.uniform(design.lower, design.upper, (int(new.sum()), u.shape[1]))
            left[new] = rng.uniform(*design.hold, int(new.sum()))
    return states + design.noise * rng.standard_normal(states.shape), inputs


def _rate(system: ControlAffineSystem, u: NDArray[np.float64], x: NDArray[np.float64]
          ) -> NDArray[np.float64]:
    return system.derivative(x, u)


def write(path: Path, topics: Sequence[str], values: NDArray[np.float64], period: float,
          start: float = 1.0) -> Path:
    """
    Write numbers (N, topics) as stamped messages, one of each topic a sample.

    A year takes the writer of the package hours, message by message; the layout is the same.
    """
    count, n = values.shape
    stamps = round(start * NANOSECONDS) + np.arange(count) * round(period * NANOSECONDS)
    definition = message_definition(TYPE)
    schema = Schema(1, definition.text.encode(), 'ros2msg', TYPE)
    channels = [Channel(number, topic, 'cdr', {'topic_type_hash': definition.type_hash}, 1)
                for number, topic in enumerate(topics)]
    with path.open('wb') as stream:
        stream.write(MAGIC)
        stream.write(_encoded(Header('ros2', ''), schema, *channels))
        per_chunk = max(1, _MESSAGES // n)
        for first in range(0, count, per_chunk):
            rows = slice(first, min(first + per_chunk, count))
            content = _content(stamps[rows], values[rows], first)
            stream.write(_encoded(Chunk('', content, int(stamps[rows][-1]), int(stamps[first]), 0,
                                        len(content))))
        stream.write(_encoded(DataEnd(0)))
        summary = stream.tell()
        stream.write(_encoded(schema, *channels, Statistics(
            0, len(channels), dict.fromkeys(range(n), int(count)), -(-count // per_chunk),
            count * n, int(stamps[-1]), int(stamps[0]), 0, 1)))
        stream.write(_encoded(Footer(summary, 0, 0)) + MAGIC)
    return path


def _encoded(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def _content(stamps: NDArray[np.int64], values: NDArray[np.float64], first: int) -> bytes:
    """Return the messages of a chunk, side by side."""
    records = np.zeros(values.shape, dtype=_RECORD)
    records['opcode'], records['length'] = Opcode.MESSAGE, _RECORD.itemsize - _HEAD
    records['channel'] = np.arange(values.shape[1])
    records['sequence'] = (first + np.arange(len(values)))[:, None]
    records['log'] = records['publish'] = stamps[:, None] + np.arange(values.shape[1])
    records['encapsulation'] = np.void(b'\0\1\0\0')
    records['sec'], records['nanosec'] = (part[:, None] for part in divmod(stamps, NANOSECONDS))
    records['frame_length'] = 1
    records['point'][..., 0] = values
    return records.tobytes()
