# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The loop that every controller is run in, and the criteria."""

from dataclasses import dataclass
import itertools
from time import process_time_ns

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.evaluation.optimal_cost import cost_along, OptimalTrajectory
from koopman_ros.plants import Process
from studies.equations import EQUATIONS
from studies.least import least_course
from studies.partly_measured.cases import PartialCase
from studies.partly_measured.contenders import Contender

_LATE = 1.0 / 3.0  # of a part, over which its offset is the mean


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """The course of a controlled plant."""

    times: Array  #: (N,) in s
    states: Array  #: (N, n_x)
    commands: Array  #: (N, n_u)
    step_us: Array  #: (N,) processor time of each step, in microseconds
    failure: str  #: why it ended early, or empty


def run(case: PartialCase, contender: Contender, seed: int) -> ComparedRun:
    """Run a controller on the true plant, sampled; the noise follows from seed and sample."""
    plant = Process(case.system, 0, *case.start)
    rows: list[tuple[float, Array, Array, float]] = []
    failure = ''
    for number in range(round(case.duration / case.period)):
        seconds = number * case.period
        try:
            plant = plant.until(round(seconds * NANOSECONDS))
            if plant.system is case.system and seconds >= case.loaded_at:
                plant = Process(case.loaded, plant.time_ns, plant.x, plant.u)
            draw = np.random.default_rng((seed, number)).standard_normal(len(case.noise))
            y = case.outputs.of(plant.x) + case.noise * draw
            begun = process_time_ns()
            command = contender.step(y, case.wanted(seconds))
            spent = 1e-3 * (process_time_ns() - begun)
        except RuntimeError as error:
            failure = str(error)
            break
        rows.append((seconds, plant.x, command, spent))
        plant = plant.commanded(command, plant.time_ns)
    times, states, commands, step_us = map(np.array, zip(*rows, strict=True))
    return ComparedRun(times, states, commands, step_us, failure)


@dataclass(frozen=True)
class ComparedFigures:
    """Cost and errors of a run."""

    #: of the step of the set-point, over the least of all-knowing control from the same state
    cost: float
    #: mean distances from the set-point late before and after the step, the larger, and late under
    #: the load, largest over the states with a set-point in the unit of the last
    offsets: tuple[float, float]
    farthest: float  #: the same of the largest distance under the load
    violation: float  #: largest excess over a limit of a state, in its unit
    lost: bool  #: whether one of them was further than the tolerance


def least(case: PartialCase, x0: Array) -> OptimalTrajectory:
    """Return the course of least cost of the step of the set-point from a state (n_x,)."""
    return least_course(case.task(x0), EQUATIONS[case.plant], case.lower, case.upper,
                        state_upper=case.state_upper)


def judge(case: PartialCase, found: ComparedRun) -> ComparedFigures:
    """Judge a run."""
    first = round(case.stepped_at / case.period)
    end = first + round((case.loaded_at - case.stepped_at) / case.period)
    if found.failure or len(found.times) <= end:
        return ComparedFigures(float('inf'), (float('inf'),) * 2, float('inf'), float('inf'), True)
    begin = found.states[first]
    cost = cost_along(case.task(begin), found.states[first:end], found.commands[first:end])
    units = dict(zip(case.system.state_names, case.system.state_units, strict=True))
    shown = [i for i, name in enumerate(case.setpoint) if units[name] == case.unit]
    states = [case.system.state_names.index(list(case.setpoint)[i]) for i in shown]
    offsets, farthest = [], 0.0
    for since, until in itertools.pairwise(
            [0.0, case.stepped_at, case.loaded_at, case.duration]):
        within = (found.times >= since) & (found.times < until)
        late = within & (found.times >= until - _LATE * (until - since))
        away = found.states[:, states] - case.wanted(since)[shown]
        offsets.append(float(np.max(np.abs(np.mean(away[late], axis=0)))))
        farthest = float(np.max(np.abs(away[within])))
    excess = found.states - case.state_upper if len(case.state_upper) else np.zeros(1)
    return ComparedFigures(cost / least(case, begin).cost, (max(offsets[:2]), offsets[2]),
                           farthest, float(max(np.max(excess), 0.0)),
                           not max(offsets) <= case.reached)
