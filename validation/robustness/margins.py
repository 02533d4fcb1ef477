# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Gain, phase and delay margins of the loop, linearised at a set-point and opened at the plant."""

from dataclasses import dataclass, replace
import math

import numpy as np
from scipy.signal import cont2discrete

import control
from koopman_ros.arrays import Array
from koopman_ros.control import at, Controller, State
from koopman_ros.estimation import Estimate
from koopman_ros.lifting import LiftedModel
from koopman_ros.plants import Actuator, ControlAffineSystem, equilibrium_input
from validation.robustness.loop import at_setpoint, errors, PERIOD, REACTOR, run_loop

_NS = 1_000_000_000
_STEP = 1e-5  # of scaled deviations and K, for differences
_KICK = 1e-4  # K
_FREQUENCIES = 1500


@dataclass(frozen=True)
class Margins:
    """What the loop bears at the plant's input before it oscillates without end."""

    gain: float  #: factor of the gain
    phase: float  #: in degrees
    delay: float  #: additional dead time, in s
    distance: float  #: smallest distance of the Nyquist curve from -1


def sampled_plant(slope: float, gain: float) -> control.StateSpace:
    """
    Return dx/dt = slope x + gain u between samples, with the input held.

    :param slope: in 1/min.
    :param gain: in 1/min.
    """
    period = PERIOD / 60.0
    a, b, c, d, _ = cont2discrete(
        (np.array([[slope]]), np.array([[gain]]), np.ones((1, 1)), np.zeros((1, 1))), period)
    return control.ss(a, b, c, d, PERIOD)


def linearised_reactor(temperature: float, system: ControlAffineSystem = REACTOR
                       ) -> control.StateSpace:
    """Linearise the true reactor at a temperature in K."""
    return sampled_plant(float(system.drift_jacobian(np.array([temperature]))[0, 0]),
                         float(system.B[0, 0]))


def linearised_lift(model: LiftedModel, temperature: float) -> control.StateSpace:
    """Linearise the drift that a lift of one state implies at a temperature in K."""
    x = model.states.to_deviation(np.array([temperature]))
    slope = (model.drift(x + _STEP) - model.drift(x - _STEP)) / (2.0 * _STEP)
    ratio = model.states.scale[0] / model.inputs.scale[0]
    return sampled_plant(float(slope[0]), float(model.B[0, 0]) * ratio)


def linearised_controller(controller: Controller, temperature: float) -> control.StateSpace:
    """
    Differentiate the control step at rest: from the measurement in K to the command in K.

    The states are the observer's (state and disturbance) and the last command; at rest the model
    believes that the reactor is held where it is, so no disturbance is there.

    :param temperature: set-point and measurement, in K.
    """
    model = controller.model
    point = np.array([temperature])
    before, _ = controller.request_setpoint(State(), point)
    # two steps, after which the interval between samples is known
    for number in (1, 2):
        before, u, _ = controller.step(before, point, number * _NS)
    rest = before.estimate
    assert rest is not None
    holding = controller.step(replace(before, estimate=Estimate(rest.x, np.zeros(1)),
                                      transfer=None, command=u), point, 3 * _NS)[1]
    centre = np.array([rest.x[0], 0.0, holding[0], temperature])

    def step(values: Array) -> Array:
        state = replace(before, estimate=Estimate(values[:1], values[1:2]), command=values[2:3],
                        transfer=None)
        after, command, _ = controller.step(state, values[3:], 3 * _NS)
        assert after.estimate is not None
        return np.array([after.estimate.x[0], after.estimate.w[0], command[0]])

    columns = [(step(centre + d) - step(centre - d)) / (2.0 * _STEP) for d in _STEP * np.eye(4)]
    jacobian = np.stack(columns, axis=1)
    assert model.n_x == model.n_u == 1
    return control.ss(jacobian[:, :3], jacobian[:, 3:], jacobian[2:, :3], jacobian[2:, 3:],
                      PERIOD)


def margins(plant: control.StateSpace, law: control.StateSpace) -> Margins:
    """
    Calculate the margins of a plant under a law, both from input to output and sampled.

    :param law: positive from measurement to command, so that the loop is plant times minus law.
    """
    opened = -law * plant
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
        min(delays, default=math.inf), float(np.min(np.abs(1.0 + response))))


def margins_at(controller: Controller, temperature: float, *, of_model: bool = False) -> Margins:
    """Calculate the margins at a set-point in K, on the true reactor or on the lift itself."""
    plant = (linearised_lift(controller.model, temperature) if of_model
             else linearised_reactor(temperature))
    return margins(plant, linearised_controller(controller, temperature))


def holding_coolant(temperature: float) -> float:
    """Return the coolant that holds the true reactor, in K."""
    return float(equilibrium_input(REACTOR, [temperature])[0])


def amplified(temperature: float, factor: float) -> ControlAffineSystem:
    """Return the reactor whose coolant deviates from what holds a temperature by a factor."""
    held = equilibrium_input(REACTOR, [temperature])
    return replace(
        REACTOR, B=factor * REACTOR.B,
        drift=lambda x: REACTOR.drift(x) + (1.0 - factor) * (REACTOR.B @ held))


def grows(controller: Controller, temperature: float, *, factor: float = 1.0, delay: float = 0.0,
          seconds: float = 1800.0) -> bool:
    """
    Simulate whether a small deviation grows on the true reactor.

    :param factor: of the coolant's deviation.
    :param delay: of the coolant, in s.
    """
    plant = amplified(temperature, factor)
    course = run_loop(controller, plant, np.array([temperature + _KICK]),
                      holding_coolant(temperature), seconds,
                      [at(0.0, at_setpoint(temperature))], actuator=Actuator(delay=delay))
    # the swing at the end: without an observer an offset is left
    late = errors(course, temperature)[-len(course.times) // 3:]
    return bool(np.ptp(late) > 2.0 * _KICK)
