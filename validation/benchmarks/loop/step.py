# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What a control step takes, beside the same law with general tools.

As a program, given the number of steps and those of coordinates, it prints the figures as JSON.
"""

from dataclasses import dataclass
import json
import os
import subprocess
import sys
from time import perf_counter_ns, thread_time_ns
from typing import Any

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control import Controller, Form, State
from koopman_ros.units import NANOSECONDS
from validation.benchmarks.loop import lifts
from validation.benchmarks.loop.naive import NaiveLaw
from validation.benchmarks.options import ONE_THREAD

_BLOCK = 50  # steps of one side, then of the other
_TOLERANCE = 1e-6  # K between the commands of both sides


# by the wall and of the processor, ns
Taken = tuple[int, int]


@dataclass(frozen=True)
class Asked:
    """One call of the naive law."""

    measurement: Array  #: (1,) in K
    setpoint: Array  #: (1,) that the controller tracked, in K
    seconds: float  #: since the call before
    command: Array  #: (1,) that the controller gave, in K


def measured(coordinates: tuple[int, ...], samples: int) -> dict[str, dict[str, Any]]:
    """
    Compare in a process with one thread: with so few numbers others only wait and spin.

    :return: what :func:`compare` returns, by n_z.
    """
    command = [sys.executable, '-m', 'validation.benchmarks.loop.step',
               *map(str, (samples, *coordinates))]
    done = subprocess.run(command, env={**os.environ, **ONE_THREAD}, check=True, text=True,
                          stdout=subprocess.PIPE)
    found: dict[str, dict[str, Any]] = json.loads(done.stdout)
    return found


def compare(n_z: int, samples: int) -> dict[str, Any]:
    """Time both sides on one course, block by block in turns, once they are seen to agree."""
    model = lifts.lift(n_z)
    under = lifts.controller(model)
    course = lifts.course(under, samples)
    asked = _answered(under, course)
    apart = _distance(NaiveLaw(model, under.settings), asked)
    if not apart <= _TOLERANCE:
        raise ValueError(f'the commands for n_z = {n_z} differ by {apart:.2g} K, so the two sides '
                         f'are not the same law: they must agree to {_TOLERANCE:g} K')
    ours, theirs = _timed(under, course, NaiveLaw(model, under.settings), asked)
    return {**_quantiles('', ours), **_quantiles('naive_', theirs), 'steps': samples,
            'largest_difference_kelvin': apart}


def _timed(under: Controller, course: tuple[lifts.Sample, ...], naive: NaiveLaw,
           asked: tuple[Asked, ...]) -> tuple[list[Taken], list[Taken]]:
    """Return what each step of either side takes."""
    state = State()
    ours: list[Taken] = []
    theirs: list[Taken] = []
    for block in range(0, len(course), _BLOCK):
        for sample in course[block:block + _BLOCK]:
            if sample.requested is not None:
                state = lifts.asked(under, state, sample.requested)
            used, start = thread_time_ns(), perf_counter_ns()
            state, _, _ = under.step(state, sample.measurement, sample.time_ns)
            ours.append((perf_counter_ns() - start, thread_time_ns() - used))
        for call in asked[block:block + _BLOCK]:
            used, start = thread_time_ns(), perf_counter_ns()
            naive.step(call.measurement, call.setpoint, call.seconds)
            theirs.append((perf_counter_ns() - start, thread_time_ns() - used))
    return ours, theirs


def _answered(under: Controller, course: tuple[lifts.Sample, ...]) -> tuple[Asked, ...]:
    """Run the controller, and return what the naive law has to be asked."""
    state, asked, before = State(), [], course[0].time_ns
    for sample in course:
        if sample.requested is not None:
            state = lifts.asked(under, state, sample.requested)
        state, command, report = under.step(state, sample.measurement, sample.time_ns)
        if report.command.law.form != Form.RECENTRED.value or report.target is None:
            raise ValueError(f'the re-centred law is not in force: {report}')
        asked.append(Asked(sample.measurement, report.target.setpoint,
                           (sample.time_ns - before) / NANOSECONDS, command))
        before = sample.time_ns
    return tuple(asked)


def _distance(naive: NaiveLaw, asked: tuple[Asked, ...]) -> float:
    """Return by how much the commands differ at most, in K."""
    return max(float(np.max(np.abs(
        naive.step(call.measurement, call.setpoint, call.seconds) - call.command)))
        for call in asked)


def _quantiles(side: str, taken: list[Taken]) -> dict[str, float]:
    wall, cpu = 1e-3 * np.array(taken).T
    return {f'{side}median_us': float(np.median(wall)),
            f'{side}p99_us': float(np.percentile(wall, 99)),
            f'{side}cpu_median_us': float(np.median(cpu))}


if __name__ == '__main__':
    count, *all_coordinates = map(int, sys.argv[1:])
    print(json.dumps({str(n_z): compare(n_z, count) for n_z in all_coordinates}))
