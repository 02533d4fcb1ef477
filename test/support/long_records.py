# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Records of a reactor under random steps of its coolant, in many bags."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
import struct

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import NANOSECONDS, SECONDS_PER_MINUTE
from koopman_ros.learning import TrainingTask
from koopman_ros.learning.identification import Drift
from koopman_ros.learning.record import RecordSource
from koopman_ros.plants.library.reactor import OneStateReactor
from koopman_ros.records import BagWriter, message_definition, RecordedInput, RecordedState

TYPE, FIELD = 'geometry_msgs/msg/PointStamped', 'point.x'  # a number with a stamp, of any unit
SAMPLES = 2500  # of a bag, one a second
SYSTEM = OneStateReactor().system()
_COOLANT, _HOLD, _NOISE = (281.3, 300.5), (30.0, 120.0), 0.1  # K, s, K
_POINT = struct.Struct('<4siII4x3d')  # encapsulation, stamp, empty frame, point


def simulated(samples: int, runs: int, seed: int, noise: float = _NOISE) -> tuple[Array, Array]:
    """Return temperatures and coolants (samples, runs) of runs side by side, a sample a second."""
    rng = np.random.default_rng(seed)
    x = np.tile(SYSTEM.nominal_state, (runs, 1))
    u, left = rng.uniform(*_COOLANT, (runs, 1)), rng.uniform(*_HOLD, runs)
    states, inputs = np.empty((2, samples, runs))
    for k in range(samples):
        states[k], inputs[k] = x[:, 0], u[:, 0]
        x = runge_kutta_step(
            partial(lambda u, x: SYSTEM.derivative(x, u), u), x, 1.0 / SECONDS_PER_MINUTE)
        left -= 1.0
        new = left <= 0.0
        u = np.where(new[:, None], rng.uniform(*_COOLANT, (runs, 1)), u)
        left = np.where(new, rng.uniform(*_HOLD, runs), left)
    return states + noise * rng.standard_normal(states.shape), inputs


def write(path: Path, topics: Sequence[str], values: Array, period: float, start: float = 1.0
          ) -> Path:
    """Write numbers (N, topics) as stamped messages, one of each topic a sample."""
    with BagWriter(path, max_chunk_bytes=2**16) as writer:
        for topic in topics:
            writer.add_topic(topic, message_definition(TYPE))
        for k, row in enumerate(values.tolist()):
            stamp = round(start * NANOSECONDS) + k * round(period * NANOSECONDS)
            for n, (topic, value) in enumerate(zip(topics, row, strict=True)):
                data = _POINT.pack(b'\0\1\0\0', *divmod(stamp, NANOSECONDS), 1, value, 0.0, 0.0)
                writer.write(topic, data, stamp + n, stamp + n)
    return path


def bags_of(count: int, folder: Path) -> list[Path]:
    """Write so many bags, an hour between two."""
    states, inputs = simulated(SAMPLES, count, 0)
    return [write(folder / f'{run:04d}.mcap', ['/temperature', '/coolant_temperature'],
                  np.column_stack([states[:, run], inputs[:, run]]), 1.0,
                  1.0 + run * (SAMPLES + 3600.0)) for run in range(count)]


def task(bags: Sequence[Path], output: Path) -> TrainingTask:
    """Return the task of a first model from some bags."""
    state, coolant = (MessageField(f'/{name}', TYPE, FIELD, 'K')
                      for name in ('temperature', 'coolant_temperature'))
    return TrainingTask(tuple(map(str, bags)), str(output), '',
                        (RecordedState('temperature', 'K', state),),
                        (RecordedInput('coolant_temperature', 'K', coolant),),
                        plant='reactor at 1 Hz', model_class='polynomial',
                        dead_time={'coolant_temperature': 0.0})


def source(bags: Sequence[Path]) -> RecordSource:
    """Return how some bags are read."""
    given = task(bags, Path('none.safetensors'))
    return RecordSource(given.bags, given.states, given.inputs, 0, None)


def drift_error(drift: Drift) -> float:
    """Return the error of a drift along a fresh run, relative to the drift's size."""
    x, u = (values[::7] for values in simulated(7_000, 1, 99, noise=0.0))
    true = SYSTEM.derivative(x, u) / SECONDS_PER_MINUTE
    return float(np.sqrt(np.mean((drift.rate(x, u) - true) ** 2) / np.mean(true ** 2)))
