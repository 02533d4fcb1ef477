# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Margins of the loop at a set-point, and from how far away it gets back there."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
import math
from typing import NamedTuple, TYPE_CHECKING

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

from koopman_ros.control import Controller, SAFE, State, StepReport, Supervisor
from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.estimation import Estimate
from koopman_ros.evaluation import at, Loop
from koopman_ros.plants import ControlAffineSystem, two_state_reactor
from studies.campaign import Metrics
from studies.robustness import loop
from studies.robustness.loop import at_setpoint, COOLANT, COOLANT_RANGE, PERIOD, REACTOR

if TYPE_CHECKING:
    import control

_STEP = 1e-5  # of scaled deviations and K, for differences
_FREQUENCIES = 1500
HORIZON = 2400.0  # s
TOLERANCE = 0.2  # K
# Temperatures from which the one-state reactor is hotter than any coolant can hold.
GONE = 420.0  # K
_SETTLED = 60  # samples within the tolerance that count as arrived
_BOUNDARY = 0.02  # K
_BACK, _LOST = 326.0, 350.0  # K; starts from which the reactor comes back, and never does
STARTS = (*map(float, range(260, 325, 10)), *(325.0 + 2.5 * k for k in range(9)), 355.0)  # K
SETPOINTS = (306.0, 310.0, 314.475, 319.0, 324.475, 326.5)  # K
COOLANTS = (278.15, 285.0, 290.0, 295.0, 300.0, 305.15)  # K
SETPOINT = 314.475  # K, for the applied coolant at the start
_SHORT_STEP = 0.25  # s
_RETURN = 600.0  # s


class Margins(NamedTuple):
    """Margins of the loop at the plant's input."""

    gain: float  #: factor of the gain
    phase_degrees: float
    delay_seconds: float  #: additional dead time


def linearised_reactor(temperature: float) -> control.StateSpace:
    """Linearise the true reactor at a temperature in K, between samples, with the input held."""
    import control
    slope = REACTOR.drift_jacobian(np.array([temperature]))
    whole = expm(PERIOD / 60.0 * np.block([[slope, REACTOR.B], [np.zeros((1, 2))]]))
    return control.ss(whole[:1, :1], whole[:1, 1:], np.ones((1, 1)), np.zeros((1, 1)), PERIOD)


def linearised_controller(controller: Controller, temperature: float) -> control.StateSpace:
    """
    Differentiate the control step at rest: from the measurement in K to the command in K.

    The states are the observer's (state and disturbance) and the last command; at rest the model
    believes that the reactor is held where it is, so no disturbance is there.

    :param temperature: set-point and measurement, in K.
    """
    import control
    model = controller.model
    assert model.n_x == model.n_u == 1
    point = np.array([temperature])
    before, _ = controller.request_setpoint(State(), point)
    # two steps, after which the interval between samples is known
    for number in (1, 2):
        before, u, _ = controller.step(before, point, number * NANOSECONDS)
    rest = before.estimate
    assert rest is not None

    def stepped(x: Array, w: Array, u: Array, y: Array) -> tuple[State, Array]:
        state = before._replace(estimate=Estimate(x, w), transfer=None, command=u,
                        applied=before.applied.corrected(u))
        return controller.step(state, y, 3 * NANOSECONDS)[:2]

    holding = stepped(rest.x, np.zeros(1), u, point)[1]
    centre = np.array([rest.x[0], 0.0, holding[0], temperature])

    def step(values: Array) -> Array:
        after, command = stepped(values[:1], values[1:2], values[2:3], values[3:])
        assert after.estimate is not None
        return np.array([after.estimate.x[0], after.estimate.w[0], command[0]])

    columns = [(step(centre + d) - step(centre - d)) / (2.0 * _STEP) for d in _STEP * np.eye(4)]
    jacobian = np.stack(columns, axis=1)
    return control.ss(jacobian[:, :3], jacobian[:, 3:], jacobian[2:, :3], jacobian[2:, 3:],
                      PERIOD)


def margins_at(controller: Controller, temperature: float) -> Margins:
    """Calculate the margins at a set-point in K."""
    import control
    # the law is positive from measurement to command
    opened = -linearised_controller(controller, temperature) * linearised_reactor(temperature)
    # a little past the highest frequency, where the curve goes back as it came: a crossing at the
    # highest one, as that of a plant of first order, is then between two points
    frequencies = np.geomspace(1e-4, 1.01 * math.pi / PERIOD, _FREQUENCIES)
    response = opened(np.exp(1j * frequencies * PERIOD))
    gains, phases, _, _, crossings, _ = control.stability_margins(
        (np.abs(response), np.degrees(np.angle(response)), frequencies), returnall=True)
    rising = [gain for gain in gains if gain > 1.0]
    # a lead at the crossover is a lag of the rest of the turn to whoever delays it
    delays = [math.radians(phase % 360.0) / frequency
              for phase, frequency in zip(phases, crossings, strict=True)]
    return Margins(
        min(rising, default=math.inf), min(map(abs, phases), default=math.inf),
        min(delays, default=math.inf))


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

    Temperature and applied coolant are those at the start, like the set-point in K; so is the
    concentration in mol/L, which the two-state reactor has.
    """
    near = 0

    def arrived(x: Array, _: Array, report: StepReport) -> bool:
        nonlocal near
        near = near + 1 if abs(x[-1] - setpoint) <= TOLERANCE else 0
        # it could still fall back from there
        gone = x[-1] > GONE and system is REACTOR
        return bool(gone or (near >= _SETTLED and report.level == 'sdre'))

    x0 = [temperature] if concentration is None else [concentration, temperature]
    course = loop.run_loop(
        loop.reactor_controller(fallback=fallback), system, HORIZON,
        [at(0.0, at_setpoint(setpoint))], x0=x0, coolant=coolant, stop=arrived)
    if course.failure or course.states[-1, -1] > GONE:
        return End.RAN_AWAY
    if near < _SETTLED:
        return End.ELSEWHERE
    return {'sdre': End.LEARNED, 'linear': End.LINEAR}.get(loop.worst(course), End.SAFE)


def hottest_start(coolant: float, *, fallback: bool) -> float:
    """Find by bisection the hottest start from which the default loop gets back, in K."""
    lowest, highest = _BACK, _LOST
    while highest - lowest > _BOUNDARY:
        middle = 0.5 * (lowest + highest)
        if end_of(middle, SETPOINT, coolant=coolant, fallback=fallback) in (
                End.RAN_AWAY, End.ELSEWHERE):
            highest = middle
        else:
            lowest = middle
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
    by 1 K a second to the initial one, in K; by Runge and Kutta's method.
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


def two_state_starts() -> list[tuple[float, float]]:
    """Return temperatures in K and concentrations in mol/L to start the two-state reactor at."""
    usual = float(two_state_reactor().nominal_state[0])
    return [(T, concentration)
            for T in (300.0, 310.0, 320.0, 330.0, 340.0, 350.0, 360.0, 380.0, 400.0)
            for concentration in (0.6, 0.75, usual, 0.95)]


def two_state_end(start: tuple[float, float]) -> End:
    """Return the end on the two-state reactor from one of them."""
    system = two_state_reactor()
    return end_of(start[0], round(float(system.nominal_state[1]), 3), fallback=True,
                  system=system, concentration=start[1])


def back_from_safe(system: ControlAffineSystem, linear_model_margin: float) -> Metrics:
    """Start at rest under the safe coolant, by `outside` half-ranges from the trained range."""
    coldest = COOLANT_RANGE[0]
    rest = np.array([brentq(lambda T: system.derivative(np.array([T]), np.array([coldest]))[0],
                            coldest, 320.0)])

    def safe(before: Loop) -> Loop:
        return replace(before, state=before.state._replace(supervisor=Supervisor(SAFE)))

    course = loop.run_loop(
        loop.reactor_controller(linear_model_margin=linear_model_margin), system, _RETURN,
        [at(0.0, safe), at(0.0, at_setpoint(SETPOINT))], x0=rest, coolant=coldest)
    return {'rest_kelvin': float(rest[0]),
            'outside': loop.shipped_model().states.violation(rest),
            'seconds_to_0.2_kelvin': loop.settling(course, SETPOINT, TOLERANCE)}
