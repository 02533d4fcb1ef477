# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Status of the controller: one of its control level, and one for each kind of warning."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.control import Arrival, Controller, HOLD, Mode, SAFE, State, StepReport
from koopman_ros.control.state import EstimateReport, TargetReport
from koopman_ros.core.arrays import Array
from koopman_ros.core.message_fields import base_name
from koopman_ros.core.status import level_words, Reason, StatusCode
from koopman_ros.core.synchronizer import SampleSynchronizer
from koopman_ros.core.time_base import Advance
from koopman_ros.core.units import display_unit, quantity_text, shown, values_by_name
from koopman_ros.model import Coordinates
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.parameters.signal_topics import Signals, words_of
from koopman_ros.ros.controller_messages import labelled
from koopman_ros.ros.diagnostics import Severity, TaskReport
from koopman_ros.ros.timing import PAUSED, Timing

_REACHED = 1e-3  # of a range; so near a set-point is reached
_PATIENCE = 10.0  # s after which a measurement is old where no time-out is set
_UNRECEIVED = 3.0  # s without a subscriber after which commands are lost
# Tasks of the diagnostics, so that none hides another.
CONTROL = 'control'
CONNECTIONS, MEASUREMENTS, REQUESTS, MODEL, SETPOINT, ACTUATORS = CONDITIONS = (
    'connections', 'measurements', 'requests', 'model', 'set-point', 'actuators')
TASKS = (CONTROL, *CONDITIONS)
_ACTIONS = {HOLD: 'the last command is held', SAFE: 'the safe {} is commanded'}
_WAY_BACK = 'recovering: the {} moves from its safe value towards the nominal one'
_INACTIVE = 'inactive'
_LATCHED = 'the safe state is latched'


@dataclass
class Counts:
    """Counts of measurements (all, late, missed, rejected) and of failed plans."""

    measurements: int = 0
    late: int = 0
    missed: int = 0
    rejected: int = 0
    late_plans: int = 0
    unsolved_plans: int = 0

    def take(self, report: StepReport) -> None:
        """Count an answered measurement."""
        self.measurements += 1
        self.late += report.measurement.arrival is Arrival.LATE
        self.missed += report.measurement.missed
        self.rejected += report.measurement.arrival is Arrival.REJECTED
        if report.reason is not None and (cause := report.reason.cause) is not None:
            self.late_plans += cause.code is StatusCode.TOO_LATE
            self.unsolved_plans += cause.code in (StatusCode.PLAN_NOT_SOLVED,
                                                  StatusCode.PLAN_MOVES)


@dataclass(frozen=True)
class StatusContext:
    """Inputs of :func:`statuses`."""

    controller: Controller
    parameters: ControllerParameters
    signals: Signals
    state: State
    report: StepReport
    counts: Counts
    timing: Timing
    assembler: SampleSynchronizer  #: of the measurements
    missing: str  #: parts of a measurement that are missing, or empty
    measured: Array  #: (n_y,) last measured, in the units of the signals
    complaint: str  #: problem on the graph, e.g. a second controller; or empty
    unheard: Sequence[str]  #: topics of the commands without a subscriber
    unheard_for: float  #: s for which not all have had one
    setpoint_received: bool
    #: why the operator's last request was rejected or limited, or that its sender has gone; or
    #: empty
    request: str
    model_rejected: str  #: why the last model, or the current one, was rejected; or empty
    model: Callable[[], Mapping[str, object]]  #: gives figures of the current model

    @property
    def reason(self) -> str:
        """Reason of the current level, or empty."""
        return words_of(self.signals)(self.report.reason)

    @property
    def input(self) -> str:
        """Names of the inputs for an operator."""
        return ' and '.join(base_name(name, unit) for name, unit in self.signals.inputs.items())

    @property
    def awaited(self) -> str:
        """Parts of a measurement that are missing, or empty."""
        return f' of {self.missing}' if self.missing else ''

    def commanded(self, command: Array) -> str:
        """Write a command (n_u,) with names and units."""
        return ', '.join(
            f'{base_name(name, unit)} at {quantity_text(value, unit, ".2f")}'
            for (name, unit), value in zip(self.signals.inputs.items(), command.tolist(),
                                           strict=True))


def statuses(now: StatusContext) -> dict[str, TaskReport]:
    """Return the status of each of :data:`TASKS`."""
    warnings = list(_warnings(now))
    found = {CONTROL: _control_status(now, warnings)}
    for condition in CONDITIONS:
        sentences = [sentence for of, sentence in warnings if of == condition]
        found[condition] = TaskReport(Severity.WARN, '; '.join(sentences), {
            f'warning {number}': sentence for number, sentence in enumerate(sentences, 1)
        }) if sentences else TaskReport(Severity.OK, 'in order')
    return found


def dead_time_change(before: Controller, after: Controller) -> str:
    """Return which dead times a change of model or parameters has changed, or ''."""
    return ', '.join(
        f'dead time of {name}: {old:g} s -> {new:g} s' for name, old, new in zip(
            after.model.inputs.names, before.tuning.dead_times(before.model).tolist(),
            after.tuning.dead_times(after.model).tolist(), strict=True) if old != new)


def inactive(now: StatusContext) -> dict[str, TaskReport]:
    """Return the statuses of a node that answers no measurement."""
    return {**dict.fromkeys(CONDITIONS, TaskReport(Severity.OK, _INACTIVE)),
            CONTROL: TaskReport(Severity.OK, _INACTIVE, lambda: _figures(now, CONTROL))}


def _control_status(now: StatusContext, warnings: Sequence[tuple[str, str]]) -> TaskReport:
    level, message = _control(now)
    condition = CONTROL
    if not message and warnings:
        level, message = Severity.WARN, '; '.join(warning for _, warning in warnings)
        condition = warnings[0][0]
    elif not message:
        message = _in_order(now)
    if now.complaint and now.timing.silence_cause(_PATIENCE) is Advance.TWO_SOURCES:
        message += f'; {now.complaint}'
    return TaskReport(level, message, lambda: _figures(now, condition))


def _in_order(now: StatusContext) -> str:
    mode, command = now.state.mode, now.report.command
    if mode is Mode.AUTOMATIC and not now.setpoint_received:
        return f'{mode.value}, no set-point yet: the first measurement is the set-point'
    if command.at_range:
        return f'{mode.value}, {now.input} at a limit'
    if command.at_rate:
        return f'{mode.value}, {now.input} at a rate limit'
    return mode.value if not now.controller.estimation.assumed(now.state) else (
        f'{mode.value}, {now.input} before the start is assumed until its dead time is over')


def _control(now: StatusContext) -> tuple[Severity, str]:
    """Return why the preferred law does not act, or an empty message."""
    report, mode = now.report, now.state.mode
    timeout = now.parameters.measurement_timeout
    if not now.counts.measurements:
        waiting = f'waiting for the first measurement{now.awaited}'
        if mode is Mode.MANUAL and now.state.command is None:
            waiting += f': the applied {now.input} is unknown, so no manual command is sent'
        return Severity.WARN, now.complaint or waiting
    silence = now.timing.silence
    # /clock is not read meanwhile
    if timeout and (silence > timeout or (
            now.timing.busy and now.timing.wall_silence > timeout)):
        command = now.state.command
        doing = '' if command is None else f', {now.commanded(command)}'
        doing += f', {_LATCHED}' if now.state.supervisor.latched else ''
        action = 'manual mode' if mode is Mode.MANUAL else (
            _ACTIONS[HOLD] if report.depth == 0 else _action(now))
        if now.timing.busy:
            return Severity.ERROR, (f'no command for more than {timeout:g} s, because the node is '
                                    f'busy: {action}{doing}; reduce the load of the node')
        if (why := now.timing.silence_cause(timeout)) is not None:
            what = ('the stamps of the measurements have not advanced' if why is Advance.OLD
                    else 'two nodes have published the measurement')
            return Severity.ERROR, (f'{what} for more than {timeout:g} s: {action}{doing}; check '
                                    'the clock of the sensor, and that the topic has one '
                                    'publisher')
        return Severity.ERROR, (f'no measurement{now.awaited} for more than {timeout:g} s: '
                                f'{action}{doing}; check sensor and plant')
    if report.reason is not None and mode is Mode.MANUAL:
        return Severity.ERROR, f'{mode.value}: {now.reason}'
    # the last command may be one of manual mode
    if mode is report.mode is Mode.AUTOMATIC and report.depth > 0:
        level = Severity.ERROR if report.level in _ACTIONS else Severity.WARN
        action = _WAY_BACK.format(now.input) if report.command.recovery else _action(now)
        return level, f'{action}: {now.reason}'
    if now.state.supervisor.latched:
        return Severity.WARN, (f'{mode.value}: {_LATCHED}, and is commanded in automatic mode: '
                               'clear it on the panel or by the service clear_safe_state')
    return Severity.OK, ''


def _action(now: StatusContext) -> str:
    level = now.report.level
    return _ACTIONS.get(level, '').format(now.input) or level_words(level)


def _warnings(now: StatusContext) -> Iterator[tuple[str, str]]:
    """Yield each warning with its condition, the most urgent first."""
    report, states = now.report, now.controller.model.states
    age, oldest = now.timing.age, now.parameters.max_measurement_age
    if now.complaint:
        yield CONNECTIONS, now.complaint
    if now.unheard and now.unheard_for > _UNRECEIVED:
        yield CONNECTIONS, (
            f'no subscriber on {", ".join(now.unheard)}: the commands reach no plant; start the '
            'plant, or check its topic and ROS domain')
    if now.timing.paused:
        yield MEASUREMENTS, (
            f'/clock has not advanced for more than {PAUSED:g} s: the simulation is paused or has '
            'ended; the last command remains')
    interval = 0.0 if math.isinf(now.state.interval) else now.state.interval
    overdue = max(_PATIENCE, 3.0 * interval)
    # manual commands are also sent between two measurements
    tuning = now.controller.tuning
    unmeasured = (report.measurement.arrival is Arrival.MISSING and not report.command.recovery
                  and now.timing.silence > max(1.0, 2.0 * interval))
    if report.measurement.arrival is Arrival.REPEATED or (
            now.timing.silence > overdue and now.timing.silence_cause(overdue) is Advance.OLD):
        yield MEASUREMENTS, (
            'the stamp of the measurement does not advance: the last command is held; stamp each '
            'measurement with its time')
    elif now.timing.silence > overdue or (unmeasured and now.counts.measurements):
        yield MEASUREMENTS, (
            f'the last measurement is {now.timing.silence:.0f} s old: check sensor and plant'
            if now.counts.measurements else
            f'no measurement{now.awaited} was received for {now.timing.silence:.0f} s: check '
            'sensor and plant')
    if report.measurement.uncertain:
        yield MEASUREMENTS, (
            f'the quality of {" and ".join(report.measurement.uncertain)} is uncertain: a Kalman '
            f'filter assumes {tuning.uncertain_noise_factor:g} times the noise; check the sensor')
    if now.timing.without_clock:
        yield MEASUREMENTS, (
            'use_sim_time is set, but /clock is not published: time-outs use the wall clock; set '
            'use_sim_time to false, or publish_clock of the plant to true')
    if now.request:
        yield REQUESTS, now.request
    if now.model_rejected:
        yield MODEL, now.model_rejected
    if report.measurement.outside > 0.0:
        outside = _untrained(states.only(tuple(now.signals.states)), now.measured)
        # within the ranges, a state is among the data as far as the nonlinear laws act
        if outside or report.measurement.outside > now.controller.order.margins[0]:
            yield MODEL, (f'{outside or "the state is far from the training data"}: '
                          'the model extrapolates')
    if oldest and abs(age) > oldest:
        yield MEASUREMENTS, (
            f'measurements are {age:.1f} s old on receipt, max_measurement_age allows '
            f'{oldest:g} s: check the connection and the clocks')
    if now.state.disturbances is not None:
        words = words_of(now.signals)
        for fault in now.state.disturbances.faults:
            yield MEASUREMENTS, words(fault)
        if outside := _untrained(now.controller.model.disturbances, now.state.disturbances.value):
            yield MODEL, f'{outside}: the model extrapolates'
    if report.target is not None and (short := _out_of_reach(now, report.target)):
        yield SETPOINT, short
    if not report.measurement.follows:
        yield ACTUATORS, (
            f'the {now.input} does not follow its command within '
            f'{_listed(now, tuning.tracking_tolerance)}: the estimator uses the applied input; '
            'check the actuator and its limits')
    if report.estimate is not None and report.estimate.at_bound:
        yield MODEL, (
            f'the disturbance estimate is at its bound of {_listed(now, tuning.max_disturbance)} '
            f'of {now.input}: the plant differs from the model; retrain')
    if report.estimate is not None and (beyond := _beyond_band(report.estimate)):
        yield MODEL, beyond


def _beyond_band(estimate: EstimateReport) -> str:
    """Return which rates differ from the model by more than its record allows, or ''."""
    model = estimate.estimator.model
    if model.rate_band is None:
        return ''
    errors, allowed = (model.states.scale * np.abs(one) for one in (
        estimate.estimate.w, model.rate_band.error))
    different = ', '.join(
        f'the rate of {name} differs from the model by {error:.2g} {unit}/{model.time_unit}, the '
        f'record allows {most:.2g}' for name, unit, error, most in zip(
            model.states.names, model.states.units, errors.tolist(), allowed.tolist(), strict=True)
        if error > most)
    return different and f'{different}: a disturbance acts, or the plant has changed; retrain then'


def _untrained(box: Coordinates, values: Array) -> str:
    """Return which values (n,) are outside their trained range, or ''."""
    return ', '.join(
        f'{name} is outside the trained range [{shown(lower, unit):.6g}, {shown(upper, unit):.6g}]'
        f' {display_unit(unit)}'
        for name, unit, lower, upper, value in zip(
            box.names, box.units, box.lower.tolist(), box.upper.tolist(), values.tolist(),
            strict=True) if not lower <= value <= upper)


def _out_of_reach(now: StatusContext, target: TargetReport) -> str:
    """Return why the set-point is out of reach of the inputs, or ''."""
    if target.state is None or target.input is None:
        return ''
    states, limits = now.controller.model.states, now.controller.tuning.limits
    # where every state has a set-point, that is where it leads
    for name, wanted in () if target.state is target.setpoint else zip(
            now.signals.controlled, target.setpoint.tolist(), strict=True):
        place, unit = states.names.index(name), now.signals.states[name]
        found, width = float(target.state[place]), 2.0 * states.half_widths[place]
        if abs(found - wanted) > _REACHED * width * states.scale[place]:
            return (f'the set-point {quantity_text(wanted, unit)} of {name} cannot be held within '
                    f'the range of the {now.input}: the nearest is {quantity_text(found, unit)}')
    for (name, unit), wanted, low, high in zip(
            now.signals.inputs.items(), target.input.tolist(), limits.lower.tolist(),
            limits.upper.tolist(), strict=True):
        slack = _REACHED * (high - low)
        if not low - slack <= wanted <= high + slack:
            return (f'the set-point is not reached: the {base_name(name, unit)} would have to be '
                    f'{quantity_text(wanted, unit)}, but its range is {shown(low, unit):.6g} to '
                    f'{shown(high, unit):.6g}')
    return ''


def _listed(now: StatusContext, values: Array) -> str:
    return ', '.join(f'{value:g} {unit}' for value, unit in zip(
        values.tolist(), now.signals.inputs.values(), strict=True))


def _figures(now: StatusContext, condition: str) -> dict[str, object]:
    report, state, timing, signals = now.report, now.state, now.timing, now.signals
    target, law, estimate = report.target, report.command.law, report.estimate
    transfer = np.zeros(len(signals.inputs)) if report.command.transfer is None else (
        report.command.transfer)
    inputs = {base_name(name, unit): unit for name, unit in signals.inputs.items()}
    # an unmeasured state has no sensor bias
    bias = None if estimate is None or signals.estimated else (
        now.controller.equivalent_bias(state))
    controlled = {name: signals.states[name] for name in signals.controlled}
    dead_times = now.controller.tuning.dead_times(now.controller.model)
    return {
        'condition': condition,
        'mode': state.mode.value,
        'active law': level_words(report.level),
        'law': law.form or 'none',
        'reason': now.reason or 'none',
        **({'safe state': 'latched' if state.supervisor.latched else 'not latched'}
           if now.parameters.tuning.safe_latch else {}),
        **now.model(),
        **values_by_name(signals.states, now.measured.tolist()),
        **labelled(controlled, 'set-point', None if target is None else target.setpoint),
        **values_by_name(signals.disturbances, [math.nan] * len(signals.disturbances)
                         if state.disturbances is None else state.disturbances.value.tolist()),
        **values_by_name(inputs, [math.nan] * len(inputs) if state.command is None
                         else state.command.tolist()),
        **labelled(inputs, 'disturbance', None if estimate is None else estimate.disturbance,
                   f' of {now.input}' if len(inputs) == 1 else '', difference=True),
        **labelled(signals.states, 'equivalent sensor bias', bias, difference=True),
        **_estimated(now),
        'distance outside training box [half-ranges]': float(report.measurement.outside),
        'set-point outside training box [half-ranges]': (
            np.nan if target is None else float(target.outside)),
        f'{now.input} outside training box [half-ranges]': float(report.command.outside),
        'Riccati residual': float(law.residual),
        'gain norm': float(law.gain),
        'predicted growth per sample': float(law.growth),
        **labelled(inputs, 'transfer', transfer, difference=True),
        **labelled(dict.fromkeys(inputs, 's'), 'dead time', dead_times),
        'delay margin [s]': now.controller.delay_margin,
        'effect of inputs before the start ends in [s]': now.controller.estimation.assumed(state),
        'scheduled set-points': len(state.setpoint.scheduled),
        'measurements': now.counts.measurements,
        'late measurements': now.counts.late,
        'missed measurements': now.counts.missed,
        'measurements rejected': now.counts.rejected,
        **({'late plans': now.counts.late_plans, 'unsolved plans': now.counts.unsolved_plans}
           if 'mpc' in now.parameters.tuning.fallback_order else {}),
        **{f'{what} messages of {name}': count for what, counts in (
            ('late', now.assembler.late), ('missing', now.assembler.missing),
            ('duplicate', now.assembler.duplicated)) for name, count in counts.items()},
        # signals whose value is not used, or not as it is
        'rejected measurements': ', '.join(
            _signals_of(report.reason)
            if report.measurement.arrival is Arrival.REJECTED else ()) or 'none',
        'uncertain measurements': ', '.join(report.measurement.uncertain) or 'none',
        'since last measurement [s]': timing.wall_silence,
        'age of measurement [s]': timing.age,
        'latency from stamp to command [s]': timing.age + timing.answer_seconds,
        'latency from arrival to command [s]': timing.answer_seconds,
    }


def _signals_of(why: Reason | None) -> Iterator[str]:
    """Yield the signals of a reason, and of those behind it."""
    while why is not None:
        if 'signal' in why.values:
            yield str(why.values['signal'])
        why = why.cause


def _estimated(now: StatusContext) -> dict[str, object]:
    """Return the estimates of unmeasured states, and their consistency with the noise."""
    estimate, states = now.report.estimate, now.controller.model.states
    found: dict[str, object] = {}
    if estimate is None or estimate.deviation is None:
        return found
    for name, unit, value, deviation in zip(states.names, states.units, estimate.state.tolist(),
                                            estimate.deviation.tolist(), strict=True):
        if name in now.signals.estimated:
            found[f'{name}, estimated [{display_unit(unit)}]'] = (
                f'{shown(value, unit):.6g} +/- {deviation:.2g}')
    if estimate.innovation is not None:
        (lower, upper), square = estimate.innovation.expected, estimate.innovation.mean_square
        fits = 'consistent' if lower <= square <= upper else (
            'larger than the noise explains' if square > upper else
            'smaller than the noise predicts')
        found['innovations, mean square over expected'] = (
            f'{square:.3g}: {fits} ({lower:.3g} to {upper:.3g})')
    return found
