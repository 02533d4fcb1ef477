# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Measurements of which a few are odd, and what a state is made of."""

from collections.abc import Iterator, Mapping

import numpy as np

from koopman_ros.control import State
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.model import LiftedModel


def odd_event(model: LiftedModel, rng: np.random.Generator, last: State, seconds: float
              ) -> tuple[np.ndarray, int, np.ndarray | None]:
    """Return a measurement, its stamp and the measured input: mostly usual, now and then not."""
    states, y = model.states, last.accepted.value if last.accepted else model.states.center
    usual = y + 0.01 * states.scale * rng.normal(size=len(y))
    wild = [y, states.upper + 0.2 * states.scale, states.center, np.full(len(y), np.nan),
            states.to_physical(rng.uniform(-1.0, 1.0, len(y)))]
    passed = [0.0, 0.3, 2.0, 40.0, 1000.0, -0.2, -3.0]
    ahead = 1.0 if rng.random() < 0.97 else float(rng.choice(passed))
    command = model.inputs.center if last.command is None else last.command
    applied = [None, None, command, command - 0.1 * model.inputs.scale]
    return (usual if rng.random() < 0.97 else wild[rng.integers(len(wild))],
            (last.time_ns or 10 ** 10) + round(ahead * seconds * NANOSECONDS),
            applied[rng.integers(len(applied))])


def leaves(value: object, place: str = '') -> Iterator[tuple[str, object]]:
    """Yield what is at the ends of nested lists and mappings, with its place."""
    if isinstance(value, Mapping):
        for name, part in value.items():
            yield from leaves(part, f'{place}.{name}')
    elif isinstance(value, list | tuple):
        for i, part in enumerate(value):
            yield from leaves(part, f'{place}[{i}]')
    else:
        yield place, value
