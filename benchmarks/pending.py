# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Time of a control step with commands under way that have not acted yet."""

from dataclasses import replace
from time import thread_time_ns

import numpy as np

from koopman_ros.control import State
from koopman_ros.core.paths import model_path
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.model import load
from koopman_ros.parameters.controller import built, table_of

PLANT, PENDING = 'heated_line', 60
LAWS = ('linear', 'sdre', 'mpc')
_PERIOD, _NOISE, _BLOCK = 5.0, 0.02, 20  # s, K


def step_microseconds(law: str, samples: int) -> dict[int, float]:
    """
    Time steps at rest with and without commands on their way, block by block in turns.

    :return: median processor time of a step by number of commands, in microseconds.
    """
    loops, states = {}, {}
    for count in (0, PENDING):
        model = replace(load(model_path(PLANT)), dead_time=np.array([count * _PERIOD]))
        given = {'system': PLANT, 'fallback_order': (law,)}
        table = table_of(model, given)
        loops[count], states[count] = built(table.amended(
            table.snapshot({}), **given), model), State()
    taken: dict[int, list[int]] = {count: [] for count in loops}
    rest = loops[0].model.states.center[[1]]
    random = np.random.default_rng(0)
    total = 2 * PENDING + samples  # until the commands of the start have acted
    noise = _NOISE * random.standard_normal(total)
    for block in range(0, total, _BLOCK):
        for count, loop in loops.items():
            for k in range(block, min(block + _BLOCK, total)):
                start = thread_time_ns()
                states[count], _, _ = loop.step(
                    states[count], rest + noise[k], round((k + 1) * _PERIOD * NANOSECONDS))
                if k >= 2 * PENDING:
                    taken[count].append(thread_time_ns() - start)
    return {count: 1e-3 * float(np.median(times)) for count, times in taken.items()}
