# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The reactor behind a dead time, its feed measured; with a shipped lift, and one that is learned.

Run by ``python -m studies.late_reactor`` (needs the `train`, `demo` and `bench` requirements).
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
import math
from pathlib import Path
import sys
from typing import Any

import numpy as np

from koopman_ros import __version__
from koopman_ros.core.arrays import Array
from koopman_ros.core.message_fields import place
from koopman_ros.core.paths import model_path
from koopman_ros.core.plots import table, write_figures
from koopman_ros.core.units import SECONDS_PER_MINUTE
from koopman_ros.evaluation import at
from koopman_ros.evaluation.optimal_cost import cost_along, OptimalTrajectory, Task
from koopman_ros.learning import retrain, TrainingTask
from koopman_ros.model import LiftedModel, load
from koopman_ros.plants import (
    equilibrium_input,
    random_steps,
    RandomStepDesign,
    ReactorParameters,
)
from koopman_ros.records import read, Record, RecordedInput, RecordedState
from studies import report
from studies.campaign import Metrics, over, read_options
from studies.equations import EQUATIONS
from studies.least import least_course
from studies.robustness.disturbances import CHANGED, LEAD, SETPOINT
from studies.robustness.loop import (
    at_setpoint,
    COOLANT,
    COOLANT_RANGE,
    errors,
    on_plant,
    overshoot,
    PERIOD,
    REACTOR,
    run_late,
    START,
)
from studies.shipped_models import FEED, reactor_with_feed

DEAD_TIMES, SHARES = (0.0, 10.0, 30.0, 60.0, 120.0), (0.9, 1.0, 1.1)  # in s, and how much is known
FEED_STEP = 5.0  # K
SETTLED, OPTIMAL = 150.0, 200.0  # s after a dead time, of the loop and of the optimum
FOULED_PERIOD = 2.0  # s, of the long runs
RATE = 1.0  # K/s of the coolant
LEARNED = 'learned'
# the record: the sample period and the dead time of its coolant in s, noise in K
RECORD_PERIOD, RECORD_LATE, NOISE, FEED_NOISE = 5.0, 25.0, 0.02, 0.05
INPUTS = ('coolant_temperature', 'feed_temperature')


def record() -> Record:
    """Return 100 minutes in which both temperatures step, and only the coolant is late."""
    episode = random_steps(reactor_with_feed(), RandomStepDesign(
        input_lower=[282.0, 343.0], input_upper=[300.0, 357.0], state_lower=305.0,
        state_upper=327.0, hold_time=(0.5, 3.0),
        sample_period=RECORD_PERIOD / SECONDS_PER_MINUTE), 100.0, 3)
    assert episode.u is not None
    count, late, rng = len(episode.u), round(RECORD_LATE / RECORD_PERIOD), (
        np.random.default_rng(0))
    coolant, feed = episode.u.T
    return read({
        'time [s]': RECORD_PERIOD * np.arange(count - late),
        'temperature [K]': (episode.x[:count, 0] + NOISE * rng.standard_normal(count))[:-late],
        # commanded so much before it acted
        f'{INPUTS[0]} [K]': coolant[late:],
        f'{INPUTS[1]} [K]': (feed + FEED_NOISE * rng.standard_normal(count))[:-late],
    }, 'temperature', INPUTS)


def task(folder: Path) -> TrainingTask:
    """Return the training on that record, of a polynomial: dead time and both effects unknown."""
    return TrainingTask(
        (), str(folder / 'late.safetensors'), '',
        (RecordedState('temperature', 'K', place('t', 'temperature', 'K')),),
        tuple(RecordedInput(name, 'K', place(name, name, 'K')) for name in INPUTS),
        disturbances=INPUTS[1:], model_class='polynomial')


def _task(x: Array, samples: int) -> Task:
    return Task(REACTOR, x, np.array([SETPOINT]), equilibrium_input(REACTOR, [SETPOINT]),
                np.ones(1), np.ones(1), PERIOD / SECONDS_PER_MINUTE, samples)


def least_cost() -> float:
    """Return the least cost in K^2 min of the step without dead time, from a sample before it."""
    goal = _task(np.array([START]), round(OPTIMAL / PERIOD))
    share = np.linspace(0.0, 1.0, goal.samples + 1)[:, None]
    guess = OptimalTrajectory(
        START + (SETPOINT - START) * share, np.maximum(
            goal.u_ref, COOLANT - RATE * PERIOD * np.arange(goal.samples)[:, None]), math.inf)
    return least_course(goal, EQUATIONS['reactor'], *(np.array([end]) for end in COOLANT_RANGE),
                        step=np.array([RATE * PERIOD]), guess=guess).cost


def late_step(model: LiftedModel, dead_time: float) -> dict[str, float]:
    """Step the set-point by -10 K: overshoot, and cost before and after the first effect."""
    step = at(LEAD, at_setpoint(SETPOINT))
    course = run_late(model, dead_time, REACTOR, LEAD + SETTLED + 3.0 * dead_time, step)
    late = round(dead_time / PERIOD)
    acting = np.vstack((np.tile(course.commands[:1], (late, 1)), course.commands))
    # the last sample before an effect of the step is at rest
    first = round(LEAD / PERIOD) - 1 + late
    moving = _task(course.states[first], len(course.states) - first)
    rest = cost_along(moving, course.states[:1], course.commands[:1])
    return {'overshoot_kelvin': overshoot(course, SETPOINT, LEAD),
            'cost': cost_along(moving, course.states[first:],
                               acting[first:len(course.states)]),
            'cost_at_rest': late * rest}


def fouled(model: LiftedModel, dead_time: float) -> dict[str, float]:
    """Step the set-point while UA is a fifth smaller: the largest overshoot, and the end."""
    course = run_late(model, dead_time, CHANGED['UA −20 %'], 300.0 + 25.0 * dead_time,
                      at(LEAD, at_setpoint(SETPOINT)), period=FOULED_PERIOD)
    return {'fouled_overshoot_kelvin': overshoot(course, SETPOINT, LEAD),
            'fouled_final_kelvin': math.inf if course.failure else float(
                np.max(np.abs(errors(course, SETPOINT)[-30:])))}


def warmer_feed(model: LiftedModel, dead_time: float, *, measured: bool) -> float:
    """Return the largest deviation in K after a step of the feed."""
    feed = ReactorParameters().feed_temperature
    course = run_late(
        model, dead_time, REACTOR, LEAD + 100.0 + 2.0 * dead_time,
        at(LEAD, on_plant(system=CHANGED['T_i +5 K'])), disturbances=lambda seconds: (
            np.array([feed + FEED_STEP * (seconds >= LEAD)]) if measured else None))
    return float(np.max(np.abs(errors(course, START))))


def judge(model: LiftedModel, dead_time: float, share: float) -> Metrics:
    """Return the figures of one dead time, of which the model has that share."""
    known = replace(model, dead_time=share * model.dead_time)
    found: Metrics = {**late_step(known, dead_time), **fouled(known, dead_time)}
    if share == 1.0:
        for measured in (True, False):
            found[f'feed_{"" if measured else "un"}measured_kelvin'] = warmer_feed(
                known, dead_time, measured=measured)
    return found


def table_of(summary: Mapping[str, Any]) -> str:
    """Return the table: the worst of dead times that are known short, right and long."""
    rows = []
    for name, shares in summary['late'].items():
        def worst(figure: str, some: Mapping[str, Any] = shares) -> float:
            return max(float(one[figure]) for one in some.values())

        feed = shares['1']
        rows.append((
            name, f'{worst("overshoot_kelvin"):.2g}',
            f'{worst("cost") / summary["least_cost"]:.3f}',
            f'{worst("fouled_overshoot_kelvin"):.2g}', f'{worst("fouled_final_kelvin"):.1g}',
            f'{feed["feed_measured_kelvin"]:.2f}; {feed["feed_unmeasured_kelvin"]:.2f}'))
    return table(('dead time', 'overshoot [K]', 'cost', 'UA −20 %: overshoot [K]',
                  'end (decays) [K]', 'T_i +5 K, measured; not [K]'), rows)


def main(args: list[str] | None = None) -> int:
    """Run the study."""
    output: Path = read_options(
        args, 'studies.late_reactor', 'Compute steps of a reactor behind a dead time.',
        'out/studies-late').output
    output.mkdir(parents=True, exist_ok=True)
    retrained = retrain(task(output), record=record())
    if not retrained.accepted:
        print(*retrained.reasons, sep='\n', file=sys.stderr)
        return 1
    learned, lift = load(retrained.model_file), load(model_path(FEED))
    assert learned.E is not None
    cases = {f'{seconds:g} s': (replace(lift, dead_time=np.array([seconds])), seconds)
             for seconds in DEAD_TIMES} | {f'{RECORD_LATE:g} s, {LEARNED}': (learned, RECORD_LATE)}
    shares = {name: SHARES if seconds else (1.0,) for name, (_, seconds) in cases.items()}
    found = over(None, partial(_judged, cases), (
        (name, share) for name, some in shares.items() for share in some))
    summary = {
        'package_version': __version__, 'least_cost': least_cost(),
        'learned_dead_time_seconds': float(learned.dead_time[0]),
        'learned_feed_gain': float((learned.E * learned.states.scale[:, None]
                                    / learned.disturbances.scale)[0, 0]),
        'late': {name: {f'{share:g}': found[name, share] for share in some}
                 for name, some in shares.items()}}
    write_figures(output / 'summary.json', summary)
    report.write(output, 'The reactor behind a dead time', [table_of(summary)], [])
    print(f'wrote {output}/report.md and summary.json')
    return 0


def _judged(cases: Mapping[str, tuple[LiftedModel, float]], key: tuple[str, float]) -> Metrics:
    print(key, file=sys.stderr, flush=True)
    return judge(*cases[key[0]], key[1])


if __name__ == '__main__':
    sys.exit(main())
