# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Effects of changed plants, lags, biases, saturation and noise on the loop."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
import math
from typing import Any

import numpy as np

from koopman_ros.evaluation import at, LoopRun, perfect, ScheduledChange, Sensor
from koopman_ros.plants import Actuator, ControlAffineSystem
from studies.campaign import Metrics
from studies.robustness import loop
from studies.robustness.loop import at_setpoint, changed_reactor, on_plant, REACTOR, START

SETPOINT = START - 10.0
LEAD = 10.0  # s of rest before a change
SECONDS = 1500.0
NOISE = 0.1  # K
BIAS = 2.0  # K
# Dead times that are known, in s, and how much longer or shorter that of the plant is.
DEAD_TIMES, SHARES = (10.0, 30.0, 60.0, 120.0), (0.7, 1.0, 1.3)
BANDWIDTHS = (0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 20.0)  # 1/min
CHANGED = {
    'UA −20 %': changed_reactor(heat_transfer=0.8), 'UA +20 %': changed_reactor(heat_transfer=1.2),
    'C_A −10 %': changed_reactor(concentration=0.9),
    'C_A +10 %': changed_reactor(concentration=1.1),
    'T_i −5 K': changed_reactor(feed=-5.0), 'T_i +5 K': changed_reactor(feed=5.0)}
REACHED, STUCK_SECONDS = 298.15, 900.0  # K, s: the coldest coolant of an actuator that is stuck


@dataclass(frozen=True)
class Disturbed:
    """A loop that is disturbed or whose set-point steps."""

    name: str  #: for the tables
    changes: Sequence[ScheduledChange]  #: events with their times, in s
    reference: float = START  #: where the true temperature ought to go, in K
    system: ControlAffineSystem = REACTOR  #: the plant
    x0: Sequence[float] = (START,)  #: its state at the start
    since: float = LEAD  #: when the time to get there starts, in s
    overshoot: bool = False  #: whether its deviation counts from the first time that it gets there
    actuator: Actuator | None = None  #: between command and plant; perfect when None
    tells: bool = False  #: whether the applied coolant is measured
    seconds: float = SECONDS  #: how long
    sensor: Sensor = perfect  #: of the temperature

    def run(self, bandwidth: float = loop.BANDWIDTH) -> LoopRun:
        """Simulate it with the default controller, from rest."""
        return loop.run_loop(
            loop.reactor_controller(bandwidth=bandwidth), self.system, self.seconds, self.changes,
            x0=self.x0, actuator=self.actuator, tells=self.tells, sensor=self.sensor)


def _step(words: str, *changes: ScheduledChange, **details: Any) -> Disturbed:
    return Disturbed(f'set-point −10 K{words}', [at(LEAD, at_setpoint(SETPOINT)), *changes],
                     SETPOINT, overshoot=True, **details)


def cases() -> Iterator[Disturbed]:
    """Make the cases of the table of offsets."""
    for name, system in CHANGED.items():
        yield Disturbed(f'{name}, in the loop', [at(LEAD, on_plant(system=system))])
    yield _step('')
    for name in ('UA −20 %', 'UA +20 %'):
        yield _step(f', {name} all along', system=CHANGED[name])
    told = ((False, ''), (True, ', measured'))
    for lag, (tells, measured) in product((5.0, 10.0, 20.0), told):
        yield _step(f', coolant lags by {lag:g} s{measured}', actuator=Actuator(lag=lag),
                    tells=tells)
    yield Disturbed('sensor bias +2 K', [at(0.0, at_setpoint(START - 5.0))], START - 5.0,
                    x0=[START - 5.0], sensor=loop.biased(BIAS, LEAD))
    end = LEAD + STUCK_SECONDS
    for tells, measured in told:
        yield _step(f', coolant stuck at {REACHED:g} K for 15 min, after its end{measured}',
                    at(end, on_plant(actuator=Actuator())), since=end,
                    actuator=Actuator(lower=REACHED), tells=tells, seconds=end + SECONDS)


def judge(case: Disturbed) -> Metrics:
    """Run a case; the time is None for never."""
    course = case.run()
    away = loop.errors(course, case.reference, case.since)
    last = course.reports[-1].estimate
    if case.overshoot:
        away = -math.copysign(1.0, away[0]) * away
    return {
        'largest_kelvin': float(np.max(away if case.overshoot else np.abs(away))),
        'seconds_to_0.2_kelvin': loop.settling(course, case.reference, 0.2, case.since),
        'final_kelvin': float(np.mean(loop.errors(course, case.reference)[-60:])),
        'disturbance_kelvin': math.nan if last is None else float(last.disturbance[0])}


def late(known: float, share: float, system: ControlAffineSystem) -> Metrics:
    """Step by -10 K with a coolant that is `share` times as late as is known, in s."""
    model = replace(loop.shipped_model(), dead_time=np.array([known]))
    course = loop.run_late(model, share * known, system, SECONDS, at(LEAD, at_setpoint(SETPOINT)))
    return {'largest_kelvin': loop.overshoot(course, SETPOINT, LEAD),
            'seconds_to_0.2_kelvin': loop.settling(course, SETPOINT, 0.2, LEAD),
            'final_kelvin': float(np.max(np.abs(loop.errors(course, SETPOINT)[-60:])))}


def noise_against_speed(bandwidth: float) -> Metrics:
    """
    Measure costs and benefits of an observer's bandwidth in 1/min.

    :return: standard deviations over half an hour with noise of 0.1 K at 1 Hz, `change` from one
        second to the next; times after UA -20 % (`fouled`), None for never.
    """
    noisy = loop.run_loop(
        loop.reactor_controller(bandwidth=bandwidth), REACTOR, 2400.0,
        [at(0.0, at_setpoint(START))], noise=NOISE)
    settled = noisy.times >= 600.0
    coolant = noisy.commands[settled, 0]
    metrics: Metrics = {
        'coolant_kelvin': float(np.std(coolant)),
        'coolant_change_kelvin': float(np.std(np.diff(coolant))),
        'temperature_kelvin': float(np.std(noisy.states[settled, 0]))}
    course = Disturbed('fouled', [at(LEAD, on_plant(system=CHANGED['UA −20 %']))]).run(bandwidth)
    for tolerance in (0.2, 1e-3):
        metrics[f'fouled_to_{tolerance:g}_kelvin'] = loop.settling(
            course, START, tolerance, LEAD)
    return metrics
