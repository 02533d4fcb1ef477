# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Test vectors: a loop with faults, answered by the controller that is exported."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
import math

import numpy as np

from koopman_ros.control import Controller
from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.state import Mode, State, StepReport
from koopman_ros.core.arrays import Array
from koopman_ros.core.solvers import runge_kutta_step
from koopman_ros.core.status import StatusCode
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.export.c_code import CODES

# Largest integration step of the simulated plant, as a share of the fastest time constant.
_STEP = 0.2
# Faults, or none, that last longer than others.
_LONG = ('', 'silent', 'stuck', 'pushed')


@dataclass(frozen=True)
class Call:
    """The inputs of one call of ``koopman_step``; see ``controller.h``."""

    elapsed_ns: int
    measured: Array | None  #: (n_y,) None where nothing is received
    setpoint: Array  #: (n_c,)
    applied: Array  #: (n_u,)
    disturbance: Array  #: (n_d,) at least one
    manual: bool
    manual_input: Array  #: (n_u,)

    def row(self, controller: Controller) -> list[str]:
        """Return the inputs as a row of a table."""
        measured = np.full(len(controller.measured.names), np.nan) if self.measured is None else (
            self.measured)
        return [str(self.elapsed_ns), str(int(self.measured is not None)),
                *(repr(float(value)) for value in (
                    *measured, *self.setpoint, *self.applied, *self.disturbance)),
                str(int(self.manual)), *(repr(float(value)) for value in self.manual_input)]


def columns(controller: Controller) -> list[str]:
    """Return the names of the columns of a call and its answer."""
    inputs = controller.model.inputs.names
    disturbances = controller.model.disturbances.names
    return ['elapsed_ns', 'received', *(f'measured {name}' for name in controller.measured.names),
            *(f'setpoint {name}' for name in controller.controlled.names),
            *(f'applied {name}' for name in inputs),
            *(f'disturbance {name}' for name in disturbances or ('none',)), 'manual',
            *(f'manual {name}' for name in inputs), *(f'command {name}' for name in inputs),
            'level', 'status', 'cause']


def answered(controller: Controller, state: State, call: Call, now_ns: int
             ) -> tuple[State, Array, StepReport]:
    """Return the controller's answer to a call at a time in ns."""
    state = controller.set_mode(state, Mode.MANUAL if call.manual else Mode.AUTOMATIC)
    if call.manual and np.isfinite(call.manual_input).all():
        state, _ = controller.request_manual_input(state, call.manual_input)
    given = ~np.isnan(call.setpoint)
    inside = (call.setpoint >= controller.controlled.lower) & (
        call.setpoint <= controller.controlled.upper)
    if inside[given].all():
        state = replace(state, setpoint=setpoints.request(
            state.setpoint, call.setpoint, 0, state.time_ns))
    if call.measured is not None:
        return controller.step(state, call.measured, now_ns, call.applied,
                               disturbances=call.disturbance[:len(controller.model.disturbances)])
    state, command, report = controller.hold(state, now_ns)
    return state, controller.safe_input if command is None else command, report


def answer_row(controller: Controller, command: Array, report: StepReport, started: bool
               ) -> list[str]:
    """Return command, level, status and cause as they stand in a table."""
    reason, codes = report.reason, [0, 0]
    if reason is not None:
        codes[0] = CODES.index(reason.code) + 1
        while reason.cause is not None:
            reason = reason.cause
        codes[1] = CODES.index(reason.code) + 1
    level = report.depth
    if not started:
        level = len(controller.levels) + 1
        codes = [CODES.index(StatusCode.NO_MEASUREMENT) + 1] * 2
    return [*(repr(float(value)) for value in command), str(level), *map(str, codes)]


def vectors(controller: Controller, count: int, interval: float, seed: int = 0
            ) -> Iterator[tuple[Call, list[str]]]:
    """
    Yield calls with the answers of the controller.

    Its own model is the plant, under steps of the set-point, a disturbance, noise, manual mode and
    faults: a lost or repeated sample, NaN, a jump, a stuck sensor, an actuator that does not
    follow.

    :param interval: between samples in s.
    """
    rng = np.random.default_rng(seed)
    model, outputs = controller.model, controller.measured
    x, w, state = np.zeros(model.n_x), np.zeros(model.n_x), State()
    now_ns, command = NANOSECONDS, controller.nominal_input
    box, inputs, none = controller.controlled, model.inputs, np.full(model.n_u, np.nan)
    setpoint, manual, fault, left, y = np.full(len(box), np.nan), False, '', 0, np.zeros(0)
    noise = 1e-4 * np.abs(outputs.C) @ (model.states.upper - model.states.lower)
    for _ in range(count):
        if left == 0:
            fault = str(rng.choice(['', 'silent', 'nan', 'jump', 'stuck', 'manual', 'stiff',
                                    'repeated', 'pushed'], p=[0.6, *[0.05] * 8]))
            left = int(rng.integers(1, 30 if fault in _LONG else 10))
            if rng.random() < 0.2:
                # a plant that has left its model does not come back by itself
                x = np.zeros(model.n_x)
            w = rng.normal(size=model.n_x) * (0.5 if fault == 'pushed' else 0.02) * np.max(
                np.abs(model.B), initial=0.0)
        left -= 1
        repeated = (fault == 'repeated' and left % 3 == 1) or (manual and fault != 'manual')
        elapsed_ns = 0 if repeated else round(
            interval * NANOSECONDS * float(rng.choice([1.0, 1.0, 1.02, 1.3])))
        now_ns += elapsed_ns
        acting = np.full(model.n_u, 0.3) if fault == 'stiff' else inputs.to_deviation(command)
        x = _moved(controller, x, acting, w, elapsed_ns / NANOSECONDS)
        if rng.random() < 0.02:
            setpoint = rng.uniform(box.lower, box.upper) * rng.choice([1.0, 1.0, 10.0])
        if fault != 'stuck' or not len(y):
            y = outputs.of(model.states.to_physical(x)) + noise * rng.normal(size=len(noise))
        seen = y.copy()
        if fault == 'nan':
            seen[rng.integers(len(y))] = rng.choice([math.nan, math.inf, 1e300])
        elif fault == 'jump' and left % 4 == 0:
            seen[0] += 10.0 * (model.states.upper - model.states.lower)[0]
        manual = fault == 'manual'
        disturbance = np.full(1, np.nan)
        call = Call(
            elapsed_ns, None if fault == 'silent' else seen, setpoint,
            inputs.to_physical(acting) if fault == 'stiff' else none, disturbance, manual,
            rng.uniform(inputs.lower, inputs.upper) if manual and left % 7 == 0 else none)
        state, command, report = answered(controller, state, call, now_ns)
        yield call, answer_row(controller, command, report, state.command is not None)


def _moved(controller: Controller, x: Array, u: Array, w: Array, seconds: float) -> Array:
    """Return the state of the model later; at rest at the nominal point where it diverges."""
    model = controller.model
    duration = seconds / model.seconds_per_time_unit
    steps = min(20, max(1, math.ceil(duration * model.linearised.fastest_rate / _STEP)))
    rate = model.rate_under(u, w)
    with np.errstate(all='ignore'):
        for _ in range(steps):
            x = runge_kutta_step(rate, x, duration / steps)
    return x if np.all(np.abs(x) < 5.0 * model.states.half_widths) else np.zeros(model.n_x)
