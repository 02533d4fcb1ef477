# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""From where the loop gets back to its set-point, and from where no coolant could bring it."""

from dataclasses import replace
from enum import Enum

import numpy as np
from scipy.optimize import brentq

from koopman_ros.arrays import Array
from koopman_ros.control import at, Loop, Report, SAFE, Supervisor
from koopman_ros.plants import ControlAffineSystem, two_state_reactor
from koopman_ros.solvers import runge_kutta_step
from validation.paper.datasets import Metrics
from validation.robustness.disturbances import finite
from validation.robustness.loop import (
    at_setpoint,
    COOLANT,
    COOLANT_RANGE,
    REACTOR,
    reactor_controller,
    run_loop,
    settling,
    shipped_model,
    worst,
)

HORIZON = 2400.0  # s
TOLERANCE = 0.2  # K
# Temperatures from which the one-state reactor is hotter than any coolant can hold.
GONE = 420.0  # K
_SETTLED = 60  # samples within the tolerance that count as arrived
_BOUNDARY = 0.02  # K
STARTS = np.concatenate([np.arange(260.0, 325.0, 10.0), np.arange(325.0, 346.0, 2.5), [355.0]])
SETPOINTS = (306.0, 310.0, 314.475, 319.0, 324.475, 326.5)  # K
COOLANTS = (278.15, 285.0, 290.0, 295.0, 300.0, 305.15)  # K
SETPOINT = 314.475  # K, for the applied coolant at the start
_SHORT_STEP = 0.25  # s
_RETURN = 600.0  # s


class End(Enum):
    """How a loop ends."""

    LEARNED = 'back by the learned law alone'
    LINEAR = 'back, on the way the linear law'
    SAFE = 'back, on the way the safe coolant'
    ELSEWHERE = 'rests elsewhere'
    RAN_AWAY = 'runs away'


def end_of(temperature: float, setpoint: float, *, fallback: bool, coolant: float = COOLANT,
           system: ControlAffineSystem = REACTOR, concentration: float | None = None) -> End:
    """
    Simulate the default loop from a start until it has arrived, ran away or two thirds of an hour.

    :param temperature: of the reactor at the start, in K.
    :param setpoint: where it is to go, in K.
    :param fallback: whether the controller falls back to another level.
    :param coolant: applied at the start, in K.
    :param concentration: in mol/L, at the start; for the two-state reactor.
    """
    near = 0

    def arrived(x: Array, _: Array, report: Report) -> bool:
        nonlocal near
        near = near + 1 if abs(x[-1] - setpoint) <= TOLERANCE else 0
        # it could still fall back from there
        gone = x[-1] > GONE and system is REACTOR
        return bool(gone or (near >= _SETTLED and report.level == 'sdre'))

    x0 = [temperature] if concentration is None else [concentration, temperature]
    course = run_loop(reactor_controller(fallback=fallback), system, np.array(x0), coolant,
                      HORIZON, [at(0.0, at_setpoint(setpoint))], stop=arrived)
    if course.failure or course.states[-1, -1] > GONE:
        return End.RAN_AWAY
    if near < _SETTLED:
        return End.ELSEWHERE
    return {'sdre': End.LEARNED, 'linear': End.LINEAR}.get(worst(course), End.SAFE)


def hottest_start(coolant: float, setpoint: float, *, fallback: bool, lowest: float = 326.0,
                  highest: float = 350.0) -> float:
    """
    Find by bisection the hottest start from which the default loop gets back, in K.

    :param coolant: applied at the start, in K.
    :param lowest: a start that gets back.
    :param highest: one that does not.
    """
    while highest - lowest > _BOUNDARY:
        middle = 0.5 * (lowest + highest)
        back = end_of(middle, setpoint, coolant=coolant, fallback=fallback)
        lowest, highest = ((lowest, middle) if back in (End.RAN_AWAY, End.ELSEWHERE)
                           else (middle, highest))
    return lowest


def hottest_cooled() -> float:
    """Return the temperature above which the reactor heats up under the coldest coolant, in K."""
    coldest = np.array(COOLANT_RANGE[:1])
    # where the slope of the heat balance changes sign
    knee = brentq(lambda T: REACTOR.drift_jacobian(np.array([T]))[0, 0], 320.0, 335.0)
    return float(brentq(lambda T: REACTOR.derivative(np.array([T]), coldest)[0], knee, 400.0))


def hottest_saved(coolant: float) -> float:
    """
    Return the hottest start from which the coolant, moved as fast as it may, saves the reactor.

    Backwards in time from the unstable state under the coldest coolant, while the coolant rises
    by 1 K a second to what is in force at the start; by Runge and Kutta's method.

    :param coolant: at the start, in K.
    """
    seconds = coolant - COOLANT_RANGE[0]
    steps = max(1, round(seconds / _SHORT_STEP))

    def rate(state: Array) -> Array:
        """Return the rates of reactor and coolant, in K/min."""
        return np.array([REACTOR.derivative(state[:1], state[1:])[0], -60.0])

    state = np.array([hottest_cooled(), COOLANT_RANGE[0]])
    for _ in range(steps):
        state = runge_kutta_step(rate, state, -seconds / steps / 60.0)
    return float(state[0])


def grid(*, fallback: bool) -> dict[tuple[float, float], End]:
    """Return the ends by start and set-point, both in K, with a coolant of 300 K at the start."""
    return {(float(start), setpoint): end_of(float(start), setpoint, fallback=fallback)
            for setpoint in SETPOINTS for start in STARTS}


def boundary(coolant: float) -> Metrics:
    """
    Compare the hottest starts that are brought back, in K, for a coolant at the start.

    :return: `physics_kelvin`, `ladder_kelvin`, `no_ladder_kelvin`.
    """
    return {'physics_kelvin': hottest_saved(coolant),
            'ladder_kelvin': hottest_start(coolant, SETPOINT, fallback=True),
            'no_ladder_kelvin': hottest_start(coolant, SETPOINT, fallback=False)}


def two_state_grid() -> dict[tuple[float, float], End]:
    """Return the ends on the two-state reactor, by starting temperature and concentration."""
    system = two_state_reactor()
    rest = float(system.nominal_state[1])
    return {(T, concentration): end_of(
        T, round(rest, 3), fallback=True, system=system, concentration=concentration)
        for T in (300.0, 310.0, 320.0, 330.0, 340.0, 350.0, 360.0, 380.0, 400.0)
        for concentration in (0.6, 0.75, float(system.nominal_state[0]), 0.95)}


def back_from_safe(system: ControlAffineSystem, linear_margin: float) -> Metrics:
    """
    Let the loop start at rest under the safe coolant, where a dead sensor leads it.

    :param system: the reactor, changed or not.
    :param linear_margin: of the fallback, in half widths.
    :return: `rest_kelvin`, `outside` the trained range in half widths, `seconds_to_0.2_kelvin`
        from there (None for never).
    """
    coldest = COOLANT_RANGE[0]
    rest = np.array([brentq(lambda T: system.derivative(np.array([T]), np.array([coldest]))[0],
                            coldest, 320.0)])
    def safe(loop: Loop) -> Loop:
        return replace(loop, state=replace(loop.state, supervisor=Supervisor(SAFE)))

    course = run_loop(reactor_controller(linear_margin=linear_margin), system, rest, coldest,
                      _RETURN, [at(0.0, safe), at(0.0, at_setpoint(SETPOINT))])
    return {'rest_kelvin': float(rest[0]), 'outside': shipped_model().states.violation(rest),
            'seconds_to_0.2_kelvin': finite(settling(course, SETPOINT, TOLERANCE))}
