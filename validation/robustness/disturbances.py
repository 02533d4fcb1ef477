# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What changed plants, lags, biases, saturation and noise do to the loop."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.control import at, perfect, Sensor, Simulation, Timed
from koopman_ros.plants import Actuator, ControlAffineSystem, equilibrium_input, two_state_reactor
from validation.paper.datasets import Metrics
from validation.robustness.loop import (
    at_setpoint,
    BANDWIDTH,
    behind,
    biased,
    changed_reactor,
    COOLANT,
    errors,
    on_plant,
    REACTOR,
    reactor_controller,
    run_loop,
    settling,
    START,
    worst,
)

SETPOINT = START - 10.0
LEAD = 10.0  # s of rest before a change
SECONDS = 1500.0
NOISE = 0.1  # K
BIAS = 2.0  # K
BANDWIDTHS = (0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 20.0)  # 1/min
CHANGED = {
    'UA −20 %': changed_reactor(heat_transfer=0.8), 'UA +20 %': changed_reactor(heat_transfer=1.2),
    'C_A −10 %': changed_reactor(concentration=0.9),
    'C_A +10 %': changed_reactor(concentration=1.1),
    'T_i −5 K': changed_reactor(feed=-5.0), 'T_i +5 K': changed_reactor(feed=5.0)}
# The coolant cannot hold this set-point while the feed is so much warmer.
SATURATED_SETPOINT, WARM_FEED, SATURATED_SECONDS = 308.0, 20.0, 900.0
REACHED = 298.15  # K, the coldest coolant of an actuator that is stuck
_MEASURED = {False: '', True: ', measured'}


@dataclass(frozen=True)
class Case:
    """A loop that is disturbed or whose set-point steps."""

    name: str  #: for the tables
    system: ControlAffineSystem  #: the plant
    x0: Sequence[float]  #: its state at the start
    changes: Sequence[Timed]  #: what happens when, in s
    reference: float  #: where the true temperature ought to go, in K
    since: float = LEAD  #: when the time to get there starts, in s
    overshoot: bool = False  #: whether its deviation counts from the first time that it gets there
    actuator: Actuator | None = None  #: between command and plant; perfect when None
    tells: bool = False  #: whether the applied coolant is measured
    seconds: float = SECONDS  #: how long
    sensor: Sensor = perfect  #: of the temperature

    def run(self, bandwidth: float = BANDWIDTH) -> Simulation:
        """Simulate it with the default controller, from rest."""
        coolant = float(equilibrium_input(self.system, self.x0)[0])
        return run_loop(reactor_controller(bandwidth=bandwidth), self.system, np.array(self.x0),
                        coolant, self.seconds, self.changes, actuator=self.actuator,
                        tells=self.tells, sensor=self.sensor)


def cases() -> Iterator[Case]:
    """Make the cases of the table of offsets."""
    step = [at(LEAD, at_setpoint(SETPOINT))]
    for name, system in CHANGED.items():
        yield Case(f'{name}, in the loop', REACTOR, [START], [at(LEAD, on_plant(system))], START)
    yield Case('set-point −10 K', REACTOR, [START], step, SETPOINT, overshoot=True)
    for name, system in CHANGED.items():
        yield Case(f'set-point −10 K, {name} all along', system, [START], step, SETPOINT,
                   overshoot=True)
    for words, actuator in (
            *((f'lags by {lag:g} s', Actuator(lag=lag)) for lag in (5.0, 10.0, 20.0)),
            ('one sample late', Actuator(delay=1.0)), ('10 s late', Actuator(delay=10.0))):
        for tells in (False, True):
            yield Case(f'set-point −10 K, coolant {words}{_MEASURED[tells]}', REACTOR, [START],
                       step, SETPOINT, overshoot=True, actuator=actuator, tells=tells)
    two = two_state_reactor()
    warm = float(two.nominal_state[1])
    for change in (-3.0, 1.5):
        words = f'{change:+g} K'.replace('-', '−')
        yield Case(f'set-point {words} on the two-state reactor', two,
                   two.nominal_state.tolist(), [at(LEAD, at_setpoint(warm + change))],
                   warm + change, overshoot=True)
    yield Case('sensor bias +2 K', REACTOR, [START - 5.0], [
        at(0.0, at_setpoint(START - 5.0))], START - 5.0, sensor=biased(BIAS, LEAD))
    end = LEAD + SATURATED_SECONDS
    for setpoint, words in ((SATURATED_SETPOINT, 'coolant saturated'),
                            (START, 'coolant in its range')):
        yield Case(f'T_i +{WARM_FEED:g} K for 15 min, {words}, after its end', REACTOR, [setpoint],
                   [at(0.0, at_setpoint(setpoint)),
                    at(LEAD, on_plant(changed_reactor(feed=WARM_FEED))),
                    at(end, on_plant(REACTOR))],
                   setpoint, since=end, overshoot=setpoint == SATURATED_SETPOINT,
                   seconds=end + SECONDS)
    for tells in (False, True):
        yield Case(f'set-point −10 K, coolant stuck at {REACHED:g} K for 15 min, after its end'
                   f'{_MEASURED[tells]}', REACTOR, [START],
                   [*step, at(end, behind(Actuator()))], SETPOINT, since=end, overshoot=True,
                   actuator=Actuator(lower=REACHED), tells=tells, seconds=end + SECONDS)


def judge(case: Case) -> Metrics:
    """
    Run a case.

    :return: `largest_kelvin` (deviation or overshoot), `seconds_to_0.2_kelvin`,
        `seconds_to_0.001_kelvin` (None for never), `final_kelvin` (mean of the last minute),
        `disturbance_kelvin` and `equivalent_bias_kelvin` as estimated at the end, `learned`
        (whether the learned law acted all the time).
    """
    course = case.run()
    away = errors(course, case.reference, case.since)
    last = course.reports[-1].estimate
    bias = course.loop.controller.equivalent_bias(course.loop.state)[0]
    if case.overshoot:
        away = -math.copysign(1.0, away[0]) * away
    return {
        'largest_kelvin': float(np.max(away if case.overshoot else np.abs(away))),
        'seconds_to_0.2_kelvin': finite(settling(course, case.reference, 0.2, case.since)),
        'seconds_to_0.001_kelvin': finite(settling(course, case.reference, 1e-3, case.since)),
        'final_kelvin': float(np.mean(errors(course, case.reference)[-60:])),
        'disturbance_kelvin': math.nan if last is None else float(last.disturbance[0]),
        'equivalent_bias_kelvin': finite(float(bias)),
        'learned': worst(course) == 'sdre'}


def noise_against_speed(bandwidth: float) -> Metrics:
    """
    Measure what an observer's bandwidth costs and brings.

    :param bandwidth: in 1/min.
    :return: standard deviations `coolant_kelvin`, `coolant_change_kelvin` (from one second to the
        next) and `temperature_kelvin` over half an hour with noise of 0.1 K at 1 Hz, and the
        times `<change>_to_0.2_kelvin` and `<change>_to_0.001_kelvin` (None for never) with the
        `<change>_final_kelvin` after UA -20 % (`fouled`) and a step by -10 K (`step`).
    """
    noisy = run_loop(reactor_controller(bandwidth=bandwidth), REACTOR, np.array([START]), COOLANT,
                     2400.0, [at(0.0, at_setpoint(START))], noise=NOISE)
    settled = noisy.times >= 600.0
    coolant = noisy.commands[settled, 0]
    metrics: Metrics = {
        'coolant_kelvin': float(np.std(coolant)),
        'coolant_change_kelvin': float(np.std(np.diff(coolant))),
        'temperature_kelvin': float(np.std(noisy.states[settled, 0]))}
    for name, change, reference in (
            ('fouled', on_plant(CHANGED['UA −20 %']), START),
            ('step', at_setpoint(SETPOINT), SETPOINT)):
        course = Case(name, REACTOR, [START], [at(LEAD, change)], reference).run(bandwidth)
        for tolerance in (0.2, 1e-3):
            metrics[f'{name}_to_{tolerance:g}_kelvin'] = finite(
                settling(course, reference, tolerance, LEAD))
        metrics[f'{name}_final_kelvin'] = float(errors(course, reference)[-1])
    return metrics


def finite(value: float) -> float | None:
    """Return a number, or None where there is none."""
    return value if math.isfinite(value) else None
