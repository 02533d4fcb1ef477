# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Closed loops: a controller on a plant, sampled, and a feedback law in continuous time."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
import math
from numbers import Real
import os
from pathlib import Path
from typing import Protocol, runtime_checkable, Self, TypeAlias

import numpy as np

from koopman_ros.control.controller import Controller
from koopman_ros.control.events import apply, Event, Measurement, Silence
from koopman_ros.control.feasibility import FeasibilitySettings
from koopman_ros.control.laws import Feedback, feedback, Weights
from koopman_ros.control.laws.base import Target
from koopman_ros.control.state import State, StepReport
from koopman_ros.control.steady_state import steady_state_target
from koopman_ros.core.arrays import Array, expect, frozen, short_repr
from koopman_ros.core.plots import axis_label, draw_limits, drawing, time_axis
from koopman_ros.core.signals import per_signal
from koopman_ros.core.status import reason, StatusFormatter
from koopman_ros.core.units import difference_text, Displays, NANOSECONDS, printed, shown
from koopman_ros.model import LiftedModel

# what is measured (n,) of a value (n,) at a time in s; NaN for what is not, None for no message
Sensor: TypeAlias = Callable[[Array, float], Array | None]


@runtime_checkable
class Plant(Protocol):
    """The plant in the loop, e.g. ``plants.Process``."""

    @property
    def time_ns(self) -> int:
        """Present time."""

    @property
    def x(self) -> Array:
        """Present state (n,)."""

    @property
    def u(self) -> Array:
        """Input (n_u,) that acts."""

    @property
    def applied(self) -> Array:
        """Input (n_u,) as it is measured, which acts after its dead time."""

    def commanded(self, command: Array, time_ns: int) -> Self:
        """Return the plant with a command (n_u,) given at its present time."""

    def until(self, time_ns: int) -> Self:
        """Return the plant at a later time; RuntimeError when it cannot get there."""


@dataclass(frozen=True)
class Loop:
    """A closed loop at one time."""

    controller: Controller  #: that acts
    state: State  #: of the controller
    plant: Plant  #: under it

    __repr__ = short_repr


Change: TypeAlias = Callable[[Loop], Loop]


@dataclass(frozen=True)
class ScheduledChange:
    """An event at a time."""

    seconds: float  #: from the start of the simulation
    what: Event | Change  #: an event of the controller, or a function of the loop

    def __post_init__(self) -> None:
        if not isinstance(self.seconds, Real):
            raise TypeError(f'the time of an event must be a number of s, got {self.seconds!r}')
        if not 0.0 <= self.seconds < math.inf:
            raise ValueError(f'the time of an event is {self.seconds} s, must be finite and at '
                             'least 0')
        if not (isinstance(self.what, Event) or callable(self.what)):
            raise TypeError('an event must be one of the controller, as in at(20.0, '
                            f'SetpointRequest(0, [0.1])), got {self.what!r}')


def at(seconds: float, what: Event | Change) -> ScheduledChange:
    """
    Declare an event at a time in s, before the measurement of that time.

    >>> at(20.0, SetpointRequest(0, [0.1, 0.15])).seconds
    20.0

    :raises TypeError: for a time that is not a number, or an event that is none.
    :raises ValueError: for a time below 0, or one that is not finite.
    """
    return ScheduledChange(seconds, what)


def exchange(controller: Controller) -> Change:
    """Let another controller take over, with another tuning or model."""
    return lambda loop: replace(
        loop, controller=controller, state=controller.switch_to(loop.controller, loop.state))


def restart(loop: Loop) -> Loop:
    """Restart the controller, which begins from the applied input."""
    return replace(loop, state=loop.controller.initialise(State(), loop.plant.applied))


def perfect(value: Array, _: float) -> Array:
    """Measure a value as it is."""
    return value


def after_a_second(time_ns: int) -> int:
    """Stamp the plant's time 0 with 1 s: a stamp of 0 means 'now' to a set-point."""
    return time_ns + NANOSECONDS


@dataclass(frozen=True, eq=False)
class LoopRun:
    """
    The trajectories of a loop, one row per sample.

    It is made by :func:`run_loop`:

    >>> run = run_loop(controller, plant, duration=20.0, period=5.0)
    >>> run.times.tolist(), run.states.shape
    ([0.0, 5.0, 10.0, 15.0, 20.0], (5, 2))
    >>> run.draw('loop.png')
    """

    times: Array  #: (N,) in s from the start
    states: Array  #: (N, n) of the plant
    measured: Array  #: (N, n_y) received measurements; NaN for none
    inputs: Array  #: (N, n_u) that acted when it was measured
    commands: Array  #: (N, n_u) answered; NaN before the first
    setpoints: Array  #: (N, n_c) active; NaN before the first
    reports: tuple[StepReport, ...]  #: (N) of the controller
    failure: str  #: why the plant could not go on to the end; empty when it could
    loop: Loop  #: after the last sample, to go on from

    __repr__ = short_repr

    @property
    def levels(self) -> tuple[str, ...]:
        """The control levels that acted."""
        return tuple(report.level for report in self.reports)

    def draw(self, path: str | os.PathLike[str]) -> None:
        """
        Draw measurements with set-points, and commands with their limits, as PNG.

        :raises ImportError: without matplotlib.
        """
        controller = self.loop.controller
        outputs, inputs, limits = (controller.measured, controller.model.inputs,
                                   controller.tuning.limits)
        controlled, n_y = list(controller.controlled.names), len(outputs.names)
        signals = [*zip(outputs.names, outputs.units, strict=True),
                   *zip(inputs.names, inputs.units, strict=True)]
        with drawing(Path(path), len(signals), size=(8.0, 1.9 * len(signals) + 0.6), sharex=True
                     ) as (figure, panels):
            time_unit, second = time_axis(float(self.times[-1]))
            times = self.times / second
            for i, (axes, (name, unit)) in enumerate(zip(panels, signals, strict=True)):
                if i < n_y:
                    axes.plot(times, shown(self.measured[:, i], unit), label='measured')
                    if name in controlled:
                        axes.step(times, shown(
                            self.setpoints[:, controlled.index(name)], unit), where='post',
                            color='k', linestyle='--', linewidth=1.0, label='set-point')
                else:
                    axes.step(times, shown(self.commands[:, i - n_y], unit), where='post',
                              color='tab:green', label='command')
                    draw_limits(axes, (shown(end[i - n_y], unit) for end in (
                        limits.lower, limits.upper)), 'limits')
                axes.set_ylabel(axis_label(name, unit))
                axes.legend(fontsize=8, loc='lower right', bbox_to_anchor=(1.0, 1.0), ncols=2,
                            frameon=False)
            panels[-1].set_xlabel(f'time [{time_unit}]')
            figure.suptitle(f'{controller.model.provenance.plant}: {self._outcome()}', fontsize=10)

    def _outcome(self) -> str:
        """Say how the loop ended."""
        controller = self.loop.controller
        outputs, units = controller.measured.names, controller.measured.units
        errors = [(name, units[i], abs(self.setpoints[-1, j] - self.measured[-1, i]))
                  for j, name in enumerate(controller.controlled.names)
                  if name in outputs for i in [outputs.index(name)]]
        return self.failure or ', '.join(
            printed(f'{name.replace("_", " ")} ends {difference_text(error, unit, ".2g")} from '
                    'its set-point')
            for name, unit, error in errors if np.isfinite(error)) or 'no set-point'


def run_loop(controller: Controller, plant: Plant,
             events: Iterable[ScheduledChange] | ScheduledChange = (), *,
             duration: float, period: float = 1.0, C: Array | None = None,
             noise: Array | None = None, seed: int = 0, sensor: Sensor = perfect,
             input_sensor: Sensor | None = None, state: State | None = None,
             stamp: Callable[[int], int] = after_a_second,
             stop: Callable[[Array, Array, StepReport], bool] | None = None,
             disturbances: Callable[[float], Array | None] = lambda _: None) -> LoopRun:
    """
    Run a controller and a plant, sampled at 0, period, 2 period, ... up to the duration.

    A sample measures, lets the controller answer and gives its command to the plant. The same
    arguments give the same numbers.

    >>> run = run_loop(controller, plant, at(20.0, SetpointRequest(0, [0.1, 0.15])),
    ...                duration=400.0, period=5.0)
    >>> run.states[-1].round(3).tolist()
    [0.1, 0.15]

    :param plant: at the start; its present time is that of the first sample.
    :param events: one or more, with their times; those of the same time in the given order.
    :param duration: in s, as the period between samples.
    :param C: (n_y, n) measurement matrix of the plant's state, y = C x; by default that of the
        controller, whose model then has the plant's states.
    :param noise: (n_y,) standard deviations of the measurement noise; none by default.
    :param seed: of the noise.
    :param sensor: sensor model, a function of value and time: a bias, a fault, silence.
    :param input_sensor: the same of the applied input; None where it is not measured.
    :param state: of the controller at the start; knowing nothing by default.
    :param stamp: the stamp of a measurement at a time of the plant, both in ns.
    :param stop: ends the simulation when it is true of state, command and report.
    :param disturbances: (n_d,) measured at a time in s, NaN for one that is not; None for none.
    :raises TypeError: for an argument of another type, such as a plant that does not run.
    :raises ValueError: when arguments do not fit each other, or the controller rejects an event.
    """
    expect(controller=(controller, Controller), plant=(plant, Plant))
    for name, value in (('duration', duration), ('period', period)):
        if not isinstance(value, Real):
            raise TypeError(f'{name} must be a number of s, got {value!r}')
    for name, value, fits in (('duration', duration, duration >= 0.0),
                              ('period', period, period > 0.0)):
        if not (fits and math.isfinite(value)):
            raise ValueError(f'{name} is {value} s, must be finite and '
                             f'{"above" if name == "period" else "at least"} 0')
    observe = _outputs(controller, plant, C)
    if noise is not None:
        noise = np.asarray(noise, dtype=np.float64)
        per_signal('noise', noise, controller.measured.names)
    events = list(events) if isinstance(events, Iterable) else [events]
    if wrong := [one for one in events if not isinstance(one, ScheduledChange)]:
        raise TypeError('events must be made by at, as in [at(20.0, SetpointRequest(0, [0.1]))], '
                        f'got {wrong[0]!r}')
    waiting, last = sorted(events, key=lambda event: event.seconds), round(duration / period)
    if last == 0 < duration:
        raise ValueError(f'period is {period} s, must be at most duration = {duration} s')
    if waiting and round((late := waiting[-1].seconds) * NANOSECONDS) > round(
            last * period * NANOSECONDS):
        raise ValueError(f'the event at {late} s is after the last sample, at {last * period:g} s:'
                         ' give a longer duration')
    loop = Loop(controller, state or State(), plant)
    start_ns, rows, reports, failure = plant.time_ns, [], [], ''
    for number in range(last + 1):
        seconds = number * period
        time_ns = start_ns + round(seconds * NANOSECONDS)
        try:
            loop = replace(loop, plant=loop.plant.until(time_ns))
        except RuntimeError as error:
            failure = str(error)
            break
        while waiting and round(waiting[0].seconds * NANOSECONDS) <= time_ns - start_ns:
            what = waiting.pop(0).what
            loop = what(loop) if callable(what) else _answered(loop, what)[0]
        x, u = loop.plant.x, loop.plant.u
        y = observe(x)
        if noise is not None:
            y = y + noise * np.random.default_rng((seed, number)).standard_normal(len(noise))
        received = sensor(y, seconds)
        event = Silence(stamp(time_ns)) if received is None else Measurement(
            stamp(time_ns), received, None if input_sensor is None else input_sensor(
                loop.plant.applied, seconds), disturbances=disturbances(seconds))
        loop, command, report = _answered(loop, event)
        assert report is not None  # of a measurement as of silence
        reports.append(report)
        active = loop.state.setpoint.active
        rows.append((seconds, x, _or_nan(received, len(y)), u, _or_nan(command, len(u)),
                     _or_nan(active, len(controller.controlled))))
        if stop is not None and stop(x, rows[-1][4], report):
            break
    times, states, measured, inputs, commands, setpoints = map(np.array, zip(*rows, strict=True))
    return LoopRun(times, states, measured, inputs, commands, setpoints, tuple(reports),
                   failure, loop)


def _outputs(controller: Controller, plant: Plant, C: Array | None) -> Callable[[Array], Array]:
    n, outputs = len(plant.x), controller.measured
    if len(plant.u) != controller.model.n_u:
        raise ValueError(f'the plant has {len(plant.u)} inputs and the model '
                         f'{controller.model.n_u}: give the plant of the model')
    if C is not None:
        C = np.asarray(C, dtype=np.float64)
        if C.shape != (len(outputs.names), n):
            raise ValueError(f'incompatible C: expected ({len(outputs.names)}, {n}) for '
                             f'{", ".join(outputs.names)} of the plant, got {C.shape}')
        return C.dot
    if n != controller.model.n_x:
        raise ValueError(f'the plant has {n} states and the model {controller.model.n_x}: give C '
                         f'({len(outputs.names)}, {n}), the measurement matrix of the plant')
    return outputs.of


def _answered(loop: Loop, event: Event) -> tuple[Loop, Array | None, StepReport | None]:
    outcome = apply(loop.controller, loop.state, event)
    if outcome.rejected is not None:
        model = loop.controller.model
        units = dict(zip((*model.states.names, *model.inputs.names),
                         (*model.states.units, *model.inputs.units), strict=True))
        raise ValueError(StatusFormatter(Displays(units))(outcome.rejected))
    plant = loop.plant
    if outcome.command is not None:
        plant = plant.commanded(outcome.command, plant.time_ns)
    return replace(loop, state=outcome.state, plant=plant), outcome.command, outcome.report


def _or_nan(value: Array | None, size: int) -> Array:
    return np.full(size, np.nan) if value is None else value


@dataclass(frozen=True)
class ClosedLoop:
    """A plant under a law."""

    times: Array  #: (K,) in the model's time unit
    states: Array  #: (K, n_x) in state units, up to a failure
    inputs: Array  #: (K, n_u) in input units
    cost: float  #: integral of e' Q e + v' R v; infinite when the loop failed
    failure: str = ''  #: why it ended early, empty when it did not

    __repr__ = short_repr

    def distance(self, model: LiftedModel) -> float:
        """Return how far the path leaves the training box, in halves of its width."""
        return max(model.states.violation(x) for x in self.states)


class _Failed(Exception):  # noqa: N818
    """The loop cannot continue; the message says why."""


# With fewer inputs than controlled states a set-point is held where a steady state is so near, in
# half-ranges of the box.
_NEAR = 0.1


def _target(model: LiftedModel, setpoint: Array, controlled: tuple[str, ...]) -> Target:
    states = model.states
    box = states.only(controlled or states.names)
    per_signal('set-point', setpoint, box.names)
    # the nominal point is known, wherever the data are
    ends = np.minimum(box.lower, box.center), np.maximum(box.upper, box.center)
    for name, unit, value, lower, upper in zip(box.names, box.units, setpoint, *ends, strict=True):
        if not lower <= value <= upper:
            raise ValueError(f'{name} = {value:.6g} {unit} is outside the trained range '
                             f'{lower:.6g} {unit} to {upper:.6g} {unit}: choose a set-point '
                             'inside it, or a model trained over a wider range')
    places = np.array([states.names.index(name) for name in box.names], dtype=np.intp)
    wanted = box.to_deviation(setpoint)
    found = steady_state_target(model, wanted, controlled=places)
    near = FeasibilitySettings().rounding if len(places) <= model.n_u else _NEAR
    if found is None or not np.all(
            np.abs(found.x[places] - wanted) <= near * states.half_widths[places]):
        where = '' if found is None else (
            f'; the nearest steady state is {states.to_physical(found.x).tolist()}')
        raise ValueError(f'no input of the model holds {", ".join(box.names)} at '
                         f'{setpoint.tolist()}{where}: choose another set-point' + (
                             '' if controlled else ', or list in controlled the states that have '
                                                   'one'))
    return found


def run_closed_loop(model: LiftedModel, rate: Callable[[Array, Array], Array], x0: Array,
                    x_ref: Array, weights: Weights, duration: float, *,
                    law: Callable[..., Feedback] = feedback, controlled: tuple[str, ...] = (),
                    samples: int = 301, rtol: float = 1e-8, u_ref: Array | None = None,
                    escape: float = 10.0, max_evaluations: int = 20_000) -> ClosedLoop:
    """
    Integrate a plant under a continuous law and the law's cost with it.

    :param rate: the plant's dx/dt (n_x,) of state and input, e.g.
        ``ControlAffineSystem.derivative``.
    :param x0: (n_x,) start, in state units.
    :param x_ref: (n_c,) set-point within the trained range, in state units.
    :param weights: weights of the law and of the cost, on the model's scaled deviations; see
        :meth:`Weights.physical` for weights in the signals' units.
    :param duration: in the model's time unit.
    :param law: feedback(model, x, target, weights).
    :param controlled: (n_c,) names of the states with a set-point, empty for all.
    :param samples: number of times to return.
    :param u_ref: (n_u,) input from which the cost counts, in input units; by default the one
        that the model takes to hold the set-point.
    :param escape: the loop has failed when a state is further than this from the nominal point,
        in units of its scale.
    :param max_evaluations: of the law, after which the loop has failed: it chatters or is stiff.
    :raises ValueError: where the set-point is outside the trained range, no input of the model
        holds it, or an argument does not fit the model.
    """
    # in here: no node needs it, and it would make a fourth of their start
    from scipy.integrate import DOP853

    target = _target(model, np.asarray(x_ref, dtype=np.float64), controlled)
    x0 = frozen(x0, 'x0', (model.n_x,))
    weights.check(model)
    v_ref = target.u if u_ref is None else model.inputs.to_deviation(np.asarray(u_ref))

    def act(x: Array) -> tuple[Array, Array]:
        xi = model.states.to_deviation(x)
        found = law(model, xi, target, weights)
        if found.riccati.failure is not None:
            words = StatusFormatter(Displays({}))
            raise _Failed(words(reason(found.riccati.failure)))
        return xi, found.u

    def flow(_: float, y: Array) -> Array:
        xi, u = act(y[:-1])
        e, v = xi - target.x, u - v_ref
        return np.append(rate(y[:-1], model.inputs.to_physical(u)),
                         float(e @ weights.Q @ e + v @ weights.R @ v))

    times = np.linspace(0.0, duration, samples)
    states = [x0]
    inputs: list[Array] = []
    cost, failure = np.inf, ''
    try:
        inputs.append(model.inputs.to_physical(act(states[0])[1]))
        solver = DOP853(flow, 0.0, np.append(states[0], 0.0), duration, rtol=rtol,
                        atol=1e-3 * rtol)
        while solver.status == 'running':
            message = solver.step()
            if solver.status == 'failed':
                raise _Failed(f'the integration failed: {message}')
            path = solver.dense_output()
            while len(states) < samples and times[len(states)] <= solver.t:
                x = path(times[len(states)])[:-1]
                inputs.append(model.inputs.to_physical(act(x)[1]))
                states.append(x)
            if np.max(np.abs(model.states.to_deviation(solver.y[:-1]))) > escape:
                raise _Failed('the state diverged')
            if solver.nfev > max_evaluations:
                raise _Failed(f'the law was evaluated {max_evaluations} times before the end')
        cost = float(solver.y[-1])
    except _Failed as error:
        failure = str(error)
        inputs = inputs or [np.full(model.n_u, np.nan)]
    return ClosedLoop(times[:len(states)], np.array(states), np.array(inputs), cost, failure)
