# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controller's messages: into events of its step, and its status, internals and records."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
import itertools
import math
import secrets
import threading
import time
from typing import Any

from builtin_interfaces.msg import Duration, Time
import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from koopman_ros.arrays import along_last, Array
from koopman_ros.assembler import Assembler
from koopman_ros.control import Arrival, Controller, events, HOLD, Mode, Report, SAFE, State
from koopman_ros.control.laws import Plan
from koopman_ros.control.state import TargetReport
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.parameters.wire import Signals
from koopman_ros.reasons import level_words
from koopman_ros.replay.records import fields_of, Record, SNAPSHOT, START
from koopman_ros.ros import topics
from koopman_ros.ros.node import Level, Status, words_of
from koopman_ros.ros.watchdog import PAUSED, Timing
from koopman_ros.time_base import Advance
from koopman_ros.units import display_unit, NANOSECONDS, shown
from koopman_ros.wire import stem

_REACHED = 1e-3  # of a range; so near a set-point is reached
_SNAPSHOT_PERIOD = 10.0  # s by the wall
_PATIENCE = 10.0  # s after which a measurement is old where no time-out is set
_AGAIN = 1.0  # s, within which two nodes know each other
_UNRECEIVED = 3.0  # s without a subscriber after which commands are lost
# Tasks of the diagnostics: that of the control level, and one for each kind of warning, so that
# none hides another.
CONTROL = 'control'
CONNECTIONS, MEASUREMENTS, REQUESTS, MODEL, SETPOINT, ACTUATORS = CONDITIONS = (
    'connections', 'measurements', 'requests', 'model', 'set-point', 'actuators')
_ACTIONS = {HOLD: 'the last command is held', SAFE: 'the safe {} is commanded'}
_WAY_BACK = 'the {} leads the plant back from where the safe one keeps it'


@dataclass
class Counts:
    """How many measurements came, late or not at all, and whether the operator spoke."""

    measurements: int = 0
    late: int = 0
    missed: int = 0
    refused: int = 0
    late_plans: int = 0
    unsolved_plans: int = 0
    setpoint_received: bool = False


@dataclass(frozen=True, slots=True)
class Situation:
    """All that a status tells of."""

    controller: Controller
    parameters: ControllerParameters
    signals: Signals
    state: State
    report: Report
    counts: Counts
    timing: Timing
    complaint: str  #: what is wrong around the node, e.g. a second controller; or empty
    request: str  #: why the operator's last request was refused or limited, or empty
    model_refused: str  #: why the last model was refused, or empty
    model: Callable[[], Mapping[str, object]]  #: gives figures of the model in force
    measured: Array  #: (n_y,) last measured, in the units of the signals
    assembler: Assembler  #: what waits to be put together
    open_loop: Status  #: whether the commands are received

    @property
    def reason(self) -> str:
        """Why the level acts, in words, or empty."""
        return words_of(self.signals)(self.report.reason)

    @property
    def input(self) -> str:
        """What an operator calls the inputs."""
        return ' and '.join(stem(name, unit) for name, unit in self.signals.inputs.items())

    def commanded(self, command: Array) -> str:
        """Write a command (n_u,) with names and units."""
        return ', '.join(
            f'{stem(name, unit)} at {shown(value, unit):.2f} {display_unit(unit)}'
            for (name, unit), value in zip(self.signals.inputs.items(), command.tolist(),
                                           strict=True))


def status(now: Situation) -> Status:
    """Return the status of the control task."""
    level, message, condition = _verdict(now)
    if now.complaint and now.timing.no_news(_PATIENCE) is Advance.TWO_SOURCES:
        message += f'; {now.complaint}'
    return Status(level, message, lambda: {'condition': condition, **_figures(now)})


def condition(now: Situation, name: str) -> Status:
    """Return the status of one of :data:`CONDITIONS`, whatever the others are."""
    sentences = [sentence for of, sentence in _warnings(now) if of == name]
    return Status(Level.WARN, '; '.join(sentences)) if sentences else Status(Level.OK, 'in order')


def open_loop(topic_names: Collection[str], seconds: float) -> Status:
    """
    Return whether the commands have subscribers.

    :param topic_names: of the commands that have no subscriber.
    :param seconds: for which not all have had one.
    """
    if not topic_names or seconds < _UNRECEIVED:
        return Status(Level.OK, 'the commands are received')
    return Status(Level.WARN, f'no subscriber on {", ".join(topic_names)}: the commands reach no '
                              'plant; start the plant, or check its topic and domain')


def _verdict(now: Situation) -> tuple[Level, str, str]:
    """Return level and sentence of the control task, and the condition that it is due to."""
    level, sentence = _control(now)
    if sentence:
        return level, sentence, CONTROL
    if warnings := list(_warnings(now)):
        return Level.WARN, '; '.join(warning for _, warning in warnings), warnings[0][0]
    report, mode = now.report, now.state.mode
    message = mode.value
    if mode is Mode.AUTOMATIC and not now.counts.setpoint_received:
        message += ', no set-point yet: what was first measured is held'
    elif report.command.at_range:
        message += f', {now.input} at a limit'
    elif report.command.at_rate:
        message += f', {now.input} at a rate limit'
    return Level.OK, message, CONTROL


def _control(now: Situation) -> tuple[Level, str]:
    """Return what keeps the best law from acting, or an empty sentence."""
    report, mode = now.report, now.state.mode
    timeout = now.parameters.measurement_timeout
    if not now.counts.measurements:
        awaited = f' of {now.assembler.awaited}' if now.assembler.awaited else ''
        waiting = f'waiting for the first measurement{awaited}'
        if mode is Mode.MANUAL and now.state.command is None:
            waiting += f': the applied {now.input} is not known, and no manual command goes out'
        return Level.WARN, now.complaint or waiting
    silence = now.timing.silence
    # /clock is not read meanwhile
    if timeout and (silence > timeout or (
            now.timing.busy and now.timing.wall_silence > timeout)):
        command = now.state.command
        doing = '' if command is None else f', {now.commanded(command)}'
        action = 'manual mode' if mode is Mode.MANUAL else (
            _ACTIONS[HOLD] if report.depth == 0 else _action(now))
        if now.timing.busy:
            return Level.ERROR, (f'no measurement answered for more than {timeout:g} s, as the '
                                 f'node is busy: {action}{doing}; ask for less at once')
        if (why := now.timing.no_news(timeout)) is not None:
            what = ('the stamps of the measurements have not advanced' if why is Advance.OLD
                    else 'two sources have published the measurement in turn')
            return Level.ERROR, (f'{what} for more than {timeout:g} s: {action}{doing}; check '
                                 'the clock of the sensor, and that it has one publisher')
        awaited = f' of {now.assembler.awaited}' if now.assembler.awaited else ''
        return Level.ERROR, (f'no measurement{awaited} for more than {timeout:g} s: '
                             f'{action}{doing}; check sensor and plant')
    if report.reason is not None and mode is Mode.MANUAL:
        return Level.ERROR, f'{mode.value}: {now.reason}'
    if mode is Mode.AUTOMATIC and report.depth > 0:
        level = Level.ERROR if report.level in _ACTIONS else Level.WARN
        action = _WAY_BACK.format(now.input) if report.command.recovery else _action(now)
        return level, f'{action}: {now.reason}'
    return Level.OK, ''


def _action(now: Situation) -> str:
    level = now.report.level
    return _ACTIONS.get(level, '').format(now.input) or level_words(level)


def _warnings(now: Situation) -> Iterator[tuple[str, str]]:
    """Yield every warning with the name of its condition, the most urgent first."""
    report, states = now.report, now.controller.model.states
    age, oldest = now.timing.age, now.parameters.max_measurement_age
    if now.complaint:
        yield CONNECTIONS, now.complaint
    if now.open_loop.level is not Level.OK:
        yield CONNECTIONS, now.open_loop.message
    if now.timing.paused:
        yield MEASUREMENTS, (
            f'/clock has stood still for more than {PAUSED:g} s: the simulation is paused or '
            'has ended, and the last command stays')
    interval = 0.0 if math.isinf(now.state.interval) else now.state.interval
    overdue = max(_PATIENCE, 3.0 * interval)
    # manual commands are also sent between two measurements
    unmeasured = (report.measurement.arrival is Arrival.MISSING and not report.command.recovery
                  and now.timing.silence > max(1.0, 2.0 * interval))
    if report.measurement.arrival is Arrival.REPEATED or (
            now.timing.silence > overdue and now.timing.no_news(overdue) is Advance.OLD):
        yield MEASUREMENTS, (
            'the stamp of the measurement does not advance: the last command is held; stamp '
            'measurements with their time')
    elif now.timing.silence > overdue or (unmeasured and now.counts.measurements):
        yield MEASUREMENTS, (
            f'the last measurement is {now.timing.silence:.0f} s old: commands follow from '
            'the model and from requests alone; check sensor and plant')
    if now.timing.without_clock:
        yield MEASUREMENTS, (
            'use_sim_time is set and nobody publishes /clock: time-outs count by the wall '
            'clock; set use_sim_time to false, or publish_clock of the plant to true')
    if now.request:
        yield REQUESTS, now.request
    if now.model_refused:
        yield MODEL, now.model_refused
    if report.measurement.outside > 0.0:
        box = states.only(tuple(now.signals.states))
        outside = [f'{name} is outside the trained range [{shown(lower, unit):.6g}, '
                   f'{shown(upper, unit):.6g}] {display_unit(unit)}'
                   for name, unit, lower, upper, value in zip(
                       box.names, box.units, box.lower.tolist(), box.upper.tolist(),
                       now.measured.tolist(), strict=True) if not lower <= value <= upper]
        yield MODEL, (f'{", ".join(outside) or "the state is far from the training data"}: '
                      'the model extrapolates')
    if oldest and abs(age) > oldest:
        yield MEASUREMENTS, (
            f'measurements are {age:.1f} s old when they arrive, at most {oldest:g} s are '
            'expected: check the connection and the clocks')
    if report.target is not None and (short := _out_of_reach(now, report.target)):
        yield SETPOINT, short
    if not report.measurement.follows:
        yield ACTUATORS, (
            f'the {now.input} does not follow its command within '
            f'{_listed(now, now.controller.tuning.tolerance)}: the observer goes by what is '
            'measured; check the actuator and its limits')
    if report.estimate is not None and report.estimate.at_bound:
        yield MODEL, (
            'the disturbance estimate is at its bound of '
            f'{_listed(now, now.controller.tuning.max_disturbance)} of {now.input}: the plant is '
            'far from its model; retrain')


def _out_of_reach(now: Situation, target: TargetReport) -> str:
    """Say that the inputs do not suffice for the set-point as things are, or return ''."""
    if target.state is None or target.input is None:
        return ''
    states, limits = now.controller.model.states, now.controller.tuning.limits
    for name, wanted in zip(
            now.signals.controlled, target.setpoint.tolist(), strict=True):
        place, unit = states.names.index(name), now.signals.states[name]
        found, width = float(target.state[place]), 2.0 * states.half_widths[place]
        if abs(found - wanted) > _REACHED * width * states.scale[place]:
            return (f'the set-point {shown(wanted, unit):.6g} {display_unit(unit)} of {name} '
                    f'cannot be held within the range of the {now.input}: '
                    f'{shown(found, unit):.6g} {display_unit(unit)} is the nearest')
    for (name, unit), wanted, low, high in zip(
            now.signals.inputs.items(), target.input.tolist(), limits.lower.tolist(),
            limits.upper.tolist(), strict=True):
        slack = _REACHED * (high - low)
        if not low - slack <= wanted <= high + slack:
            return (f'the set-point would need the {stem(name, unit)} at '
                    f'{shown(wanted, unit):.6g} {display_unit(unit)}, its range is '
                    f'{shown(low, unit):.6g} to {shown(high, unit):.6g}: it is not reached')
    return ''


def _listed(now: Situation, values: Array) -> str:
    return ', '.join(f'{value:g} {unit}' for unit, value in zip(
        now.signals.inputs.values(), values.tolist(), strict=True))


def labelled(names: Collection[str], text: str) -> list[str]:
    """Return a label for each of some signals, which are named where there are several."""
    return [text] if len(names) == 1 else [f'{name} {text}' for name in names]


def _each(signals: Mapping[str, str], text: str, values: Array | None, difference: bool = False
          ) -> dict[str, float]:
    """Return values by label with the unit of each; `{}` in the text stands for that."""
    numbers = [math.nan] * len(signals) if values is None else values.tolist()
    labels = _labels(tuple(signals.items()), text, difference)
    if difference:
        return dict(zip(labels, numbers, strict=True))
    return {label: shown(value, unit) for label, unit, value in zip(
        labels, signals.values(), numbers, strict=True)}


@lru_cache(maxsize=256)
def _labels(signals: tuple[tuple[str, str], ...], text: str, difference: bool) -> tuple[str, ...]:
    return tuple(label.replace('{}', unit if difference else display_unit(unit))
                 for label, (_, unit) in zip(labelled(dict(signals), text), signals, strict=True))


def _figures(now: Situation) -> dict[str, object]:
    report, state, timing, signals = now.report, now.state, now.timing, now.signals
    target, law, transfer = report.target, report.command.law, report.command.transfer
    inputs = {stem(name, unit): unit for name, unit in signals.inputs.items()}
    estimate = report.estimate
    # a bias of what is not measured is no sensor's
    bias = None if estimate is None or signals.estimated else (
        now.controller.equivalent_bias(state))
    unit = {name: signals.states[name] for name in signals.controlled}
    return {
        'mode': state.mode.value,
        'active law': level_words(report.level),
        'law': law.form or 'none',
        'reason': now.reason or 'none',
        **now.model(),
        **{f'{name} [{display_unit(own)}]': shown(value, own) for (name, own), value in zip(
            signals.states.items(), now.measured.tolist(), strict=True)},
        **_each(unit, 'set-point [{}]', None if target is None else target.setpoint),
        **{f'{name} [{display_unit(own)}]': value for (name, own), value in zip(
            inputs.items(), _each(inputs, '{}', state.command).values(), strict=True)},
        **_each(inputs, f'disturbance [{{}} of {now.input}]' if len(inputs) == 1
                else 'disturbance [{}]', None if estimate is None else estimate.disturbance, True),
        **_each(signals.states, 'equivalent sensor bias [{}]', bias, True),
        **_estimated(now),
        'distance outside training box [half widths]': float(report.measurement.outside),
        'set-point outside training box [half widths]': (
            np.nan if target is None else float(target.outside)),
        f'{now.input} outside training box [half widths]': float(report.command.outside),
        'Riccati residual': float(law.residual),
        'gain norm': float(law.gain),
        'predicted growth per sample': float(law.growth),
        **_each(inputs, 'transfer [{}]', np.zeros(len(inputs)) if transfer is None else transfer,
                True),
        'scheduled set-points': len(state.setpoint.scheduled),
        'measurements': now.counts.measurements,
        'late measurements': now.counts.late,
        'missed measurements': now.counts.missed,
        'measurements rejected': now.counts.refused,
        **({'late plans': now.counts.late_plans, 'unsolved plans': now.counts.unsolved_plans}
           if 'mpc' in now.parameters.tuning.levels else {}),
        **{f'{what} parts of {name}': count for what, counts in (
            ('late', now.assembler.late), ('missing', now.assembler.missing),
            ('doubled', now.assembler.doubled)) for name, count in counts.items()},
        'since last measurement [s]': timing.wall_silence,
        'age of measurement [s]': timing.age,
        'latency from stamp to command [s]': timing.age + timing.answer_seconds,
        'latency from arrival to command [s]': timing.answer_seconds,
    }


def _estimated(now: Situation) -> dict[str, object]:
    """Return what is estimated of states that are not measured, and how well it fits."""
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
            'more than the noise explains' if square > upper else 'less than the noise said')
        found['innovations, mean square over expected'] = (
            f'{square:.3g}: {fits} ({lower:.3g} to {upper:.3g})')
    return found


def internals(signals: Signals, report: Report, stamp: Time, frame_id: str) -> JointState:
    """Return what a person would plot beside the signals, under names with units."""
    law, transfer, estimate = report.command.law, report.command.transfer, report.estimate
    inputs, target = signals.inputs, report.target
    states = signals.every
    covariance = None if estimate is None else estimate.covariance
    innovation = None if estimate is None else estimate.innovation
    values = {
        **_each(inputs, 'disturbance [{}]',
                None if estimate is None else estimate.disturbance, True),
        **{f'estimated_{name} [{display_unit(unit)}]': value for (name, unit), value in zip(
            states.items(),
            _each(states, '{}', None if estimate is None else estimate.state).values(),
            strict=True)},
        'distance_outside [half widths]': float(report.measurement.outside),
        'level [0 learned, 1 linear, 2 hold, 3 safe, 4 manual]': float(report.depth),
        'gain': float(law.gain),
        'riccati_residual': float(law.residual),
        'growth_per_sample': float(law.growth),
        **_each(inputs, 'transfer [{}]', np.zeros(len(inputs)) if transfer is None else transfer,
                True),
        **_each({name: signals.states[name] for name in signals.controlled}, 'setpoint [{}]',
                None if target is None else target.setpoint),
        # of a filter alone; at the end, so that the places of the others stay
        **({} if covariance is None else _spread(states, covariance)),
        **({f'innovation_{name} [standard deviations]': value for name, value in zip(
            signals.states, innovation.normalised.tolist(), strict=True)}
           if innovation is not None else {}),
    }
    return _named(values, stamp, frame_id)


def _spread(states: Mapping[str, str], covariance: Array) -> dict[str, float]:
    """Return the standard deviation of each state, and the covariance of each pair."""
    several = list(enumerate(states.items()))
    return {
        **{f'deviation_{name} [{unit}]': math.sqrt(covariance[i, i])
           for i, (name, unit) in several},
        **{f'covariance_{name}_{other} [{unit} {by}]': float(covariance[i, j])
           for (i, (name, unit)), (j, (other, by)) in itertools.combinations(several, 2)}}


def _named(values: Mapping[str, float], stamp: Time, frame_id: str) -> JointState:
    message = JointState(name=list(values), position=list(values.values()))
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    return message


def planned(signals: Signals, plan: Plan, stamp: Time, frame_id: str) -> JointTrajectory:
    """
    Return the path of the controlled states in a plan, and its inputs, under names with units.

    There is a point for each node; what a point says of an input holds until the next one.
    """
    names = list(signals.every)
    columns = [(name, signals.states[name], plan.states[:, names.index(name)])
               for name in signals.controlled]
    # up to the end, the last one is held
    held = np.concatenate((plan.inputs, plan.inputs[-1:]))
    columns += [(*of, held[:, i]) for i, of in enumerate(signals.inputs.items())]
    rows = along_last(*(shown(column, unit) for _, unit, column in columns))
    message = JointTrajectory(
        joint_names=[f'{name} [{display_unit(unit)}]' for name, unit, _ in columns],
        points=[JointTrajectoryPoint(positions=row, time_from_start=Duration(
            sec=int(time), nanosec=int(NANOSECONDS * (time % 1.0))))
            for time, row in zip(plan.times.tolist(), rows, strict=True)])
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    return message


def active_limits(signals: Signals, plan: Plan, stamp: Time, frame_id: str) -> JointState:
    """Return which limits are active in a plan, under names that say what -1 and 1 stand for."""
    return _named({what.format(name): value for what, of, values in (
        ('at_range_{} [-1 lower, 1 upper]', signals.inputs, plan.at_range),
        ('at_rate_{} [-1 falling, 1 rising]', signals.inputs, plan.at_rate),
        ('at_limit_{} [-1 lower, 1 upper]', signals.every, plan.at_state))
        for name, value in zip(of, values.tolist(), strict=True)}, stamp, frame_id)


class RecordPublisher:
    """
    Publish numbered records; the caller holds the lock of the controller's state meanwhile.

    A replay begins at a snapshot of that state: there is one when the controller begins to act,
    before which nothing is published, one every ten seconds, and two for each new subscriber: it
    may know this publisher later than this one knows it, and miss what was published meanwhile.
    """

    def __init__(self, matching: topics.Matching, snapshot: Callable[[], Mapping[str, Any]],
                 lock: threading.Lock) -> None:
        self._snapshot, self._lock = snapshot, lock
        self._run, self._number, self._due = secrets.token_hex(8), 0, 0.0
        self._started = False
        self._publisher = matching.publish(topics.CONTROLLER_EVENTS, matched=self._on_matched)

    def start(self) -> None:
        """Publish the state from which the controller begins to act."""
        self._started = True
        self.publish_snapshot(START)

    def _on_matched(self, info: Any) -> None:
        if info.current_count_change > 0:
            with self._lock:
                self.publish_snapshot()
                self._due = time.monotonic() + _AGAIN

    def watch(self) -> None:
        """Publish the state to whoever listens, where that is due."""
        if time.monotonic() > self._due and topics.heard(self._publisher):
            self.publish_snapshot()

    def publish_snapshot(self, event: str = SNAPSHOT) -> None:
        """Publish the state."""
        self._publish(event, self._snapshot())
        self._due = time.monotonic() + _SNAPSHOT_PERIOD

    def publish_event(self, event: events.Event, outcome: events.Outcome) -> None:
        """Publish an event and what it led to."""
        if topics.heard(self._publisher):
            self.publish(*fields_of(event, outcome))
        elif self._started:
            self._number += 1

    def publish(self, event: str, fields: Mapping[str, Any]) -> None:
        """Publish an event by its name."""
        self._publish(event, fields)
        self.watch()

    def _publish(self, event: str, fields: Mapping[str, Any]) -> None:
        if not self._started:
            return
        number, self._number = self._number, self._number + 1
        # who comes later begins at a snapshot
        if topics.heard(self._publisher):
            self._publisher.publish(String(data=Record(self._run, number, event, fields).text()))
