# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Test vectors: a loop with faults, answered by the controller that is exported."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.control import Controller
from koopman_ros.control import setpoint as setpoints
from koopman_ros.control.state import State, StepReport
from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import integrate, STEPS
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.export.c_code import CODES

# Faults, or none, that last longer than others.
_LONG = ('', 'silent', 'stuck', 'pushed', 'lost')


@dataclass(frozen=True)
class Call:
    """The inputs of one call of ``controller_step``; see ``controller.h``."""

    elapsed_ns: int
    measured: Array | None  #: (n_y,) None where nothing is received
    setpoint: Array  #: (n_c,)
    applied: Array  #: (n_u,)
    disturbance: Array  #: (n_d,)

    def row(self, controller: Controller) -> list[str]:
        """Return the inputs as a row of a table."""
        none = np.full(len(controller.measured.names), np.nan)
        values = np.concatenate((
            none if self.measured is None else self.measured, self.setpoint, self.applied,
            self.disturbance))
        return [str(self.elapsed_ns), str(int(self.measured is not None)),
                *map(repr, values.tolist())]


def columns(controller: Controller) -> list[str]:
    """Return the names of the columns of a call and its answer."""
    model = controller.model
    return ['elapsed_ns', 'received', *(f'{role} {name}' for role, names in (
        ('measured', controller.measured.names), ('setpoint', controller.controlled.names),
        ('applied', model.inputs.names), ('disturbance', model.disturbances.names),
        ('command', model.inputs.names)) for name in names), 'level', 'status', 'cause']


def answered(controller: Controller, state: State, call: Call, now_ns: int
             ) -> tuple[State, Array, StepReport]:
    """Return the controller's answer to a call at a time in ns."""
    given, box = ~np.isnan(call.setpoint), controller.controlled
    if ((call.setpoint >= box.lower) & (call.setpoint <= box.upper))[given].all():
        state = state._replace(setpoint=setpoints.request(
            state.setpoint, call.setpoint, 0, state.time_ns))
    if call.measured is not None:
        return controller.step(state, call.measured, now_ns, call.applied,
                               disturbances=call.disturbance)
    if state.command is None:
        # the answer to a call before the first measurement acts from then on
        state = controller.initialise(state, controller.safe_input)
    state, command, report = controller.hold(state, now_ns)
    assert command is not None
    return state, command, report


def answer_row(command: Array, report: StepReport) -> list[str]:
    """Return command, level, status and cause as they stand in a table."""
    reason, codes = report.reason, [0, 0]
    if reason is not None:
        codes[0] = CODES.index(reason.code) + 1
        while reason.cause is not None:
            reason = reason.cause
        codes[1] = CODES.index(reason.code) + 1
    return [*(repr(float(value)) for value in command), str(report.depth), *map(str, codes)]


def vectors(controller: Controller, count: int, interval: float, seed: int = 0
            ) -> Iterator[tuple[Call, list[str]]]:
    """
    Yield calls with the answers of the controller.

    Its own model is the plant, under steps of the set-point, a disturbance, noise, measured
    disturbances and faults: a lost or repeated sample, NaN, a jump, a stuck sensor, an actuator
    that does not follow.

    :param interval: between samples in s.
    """
    rng = np.random.default_rng(seed)
    model, outputs = controller.model, controller.measured
    x, w, state = np.zeros(model.n_x), np.zeros(model.n_x), State()
    now_ns, command = NANOSECONDS, controller.nominal_input
    box, inputs, none = controller.controlled, model.inputs, np.full(model.n_u, np.nan)
    setpoint, fault, left, y = np.full(len(box), np.nan), '', 0, np.zeros(0)
    signals, d = model.disturbances, model.disturbances.center
    noise = 1e-4 * np.abs(outputs.C) @ (model.states.upper - model.states.lower)
    for _ in range(count):
        if left == 0:
            fault = str(rng.choice(['', 'silent', 'nan', 'jump', 'stuck', 'stiff', 'repeated',
                                    'pushed', 'lost'], p=[0.6, *[0.05] * 8]))
            left = int(rng.integers(1, 30 if fault in _LONG else 10))
            if rng.random() < 0.2:
                # a plant that has left its model does not come back by itself
                x = np.zeros(model.n_x)
            w = rng.normal(size=model.n_x) * (0.5 if fault == 'pushed' else 0.02) * np.max(
                np.abs(model.B), initial=0.0)
        left -= 1
        elapsed_ns = 0 if fault == 'repeated' and left % 3 == 1 else round(
            interval * NANOSECONDS * float(rng.choice([1.0, 1.0, 1.02, 1.3])))
        now_ns += elapsed_ns
        acting = np.full(model.n_u, 0.3) if fault == 'stiff' else inputs.to_deviation(command)
        x = _moved(controller, x, acting, w + (
            model.disturbance_rate(d) if len(d) else 0.0), elapsed_ns / NANOSECONDS)
        if rng.random() < 0.1:
            d = rng.uniform(signals.lower, signals.upper)
        if rng.random() < 0.02:
            setpoint = rng.uniform(box.lower, box.upper) * rng.choice([1.0, 1.0, 10.0])
        if fault != 'stuck' or not len(y):
            y = outputs.of(model.states.to_physical(x)) + noise * rng.normal(size=len(noise))
        seen = y.copy()
        if fault == 'nan':
            seen[rng.integers(len(y))] = rng.choice([math.nan, math.inf, 1e300])
        elif fault == 'jump' and left % 4 == 0:
            seen[0] += 10.0 * (model.states.upper - model.states.lower)[0]
        call = Call(
            elapsed_ns, None if fault == 'silent' else seen, setpoint,
            inputs.to_physical(acting) if fault == 'stiff' else none,
            np.where(fault == 'lost', np.nan, d))
        state, command, report = answered(controller, state, call, now_ns)
        yield call, answer_row(command, report)


def with_laws(controller: Controller, rows: Sequence[tuple[Call, list[str]]], count: int
              ) -> list[str]:
    """Return the first calls, as rows of a table, up to the given number of answers by a law."""
    laws = [int(answer[-3]) < len(controller.levels) for _, answer in rows]
    last = int(np.searchsorted(np.cumsum(laws), count)) + 1
    return [','.join(call.row(controller)) for call, _ in rows[:last]]


def _moved(controller: Controller, x: Array, u: Array, w: Array, seconds: float) -> Array:
    """Return the state of the model later; at rest at the nominal point where it diverges."""
    model = controller.model
    duration = seconds / model.seconds_per_time_unit
    steps = STEPS.count(duration, model.linearised.fastest_rate) or STEPS.most
    with np.errstate(all='ignore'):
        x = integrate(model.rate_under(u, w), x, duration, steps)
    return x if np.all(np.abs(x) < 5.0 * model.states.half_widths) else np.zeros(model.n_x)
