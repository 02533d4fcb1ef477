# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controller's messages: into events of its step, and its status, internals and records."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
import secrets
import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from koopman_ros.arrays import Array
from koopman_ros.control import Arrival, Controller, events, HOLD, Mode, Report, SAFE, State
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.reasons import level_words
from koopman_ros.replay.records import fields_of, Record, SNAPSHOT, START
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_nanoseconds
from koopman_ros.ros.node import Level, Status, words_of
from koopman_ros.ros.watchdog import Timing
from koopman_ros.units import in_celsius, NANOSECONDS, to_celsius, to_kelvin

# The temperatures of reactor and coolant at an instant are stamped no further apart.
_SAME_TIME_NS = 2 * NANOSECONDS
_SNAPSHOT_PERIOD = 10.0  # s by the wall
_ACTIONS = {HOLD: 'the last command is held', SAFE: 'the safe coolant temperature is commanded'}
_WAY_BACK = 'the coolant leads the reactor back from where the safe coolant keeps it'


def measurement(message: Any, coolant: Any) -> events.Measurement:
    """Return the event of a measurement, with the coolant measured last where it goes with it."""
    kelvin, stamp_ns = to_kelvin(message.temperature), stamp_nanoseconds(message.header.stamp)
    applied = None
    if coolant is not None and (
            abs(stamp_nanoseconds(coolant.header.stamp) - stamp_ns) <= _SAME_TIME_NS):
        applied = np.array([to_kelvin(coolant.temperature)])
    # below absolute zero there is nothing to measure
    return events.Measurement(
        stamp_ns, np.array([kelvin if kelvin >= 0.0 else math.nan]), applied)


def initialisation(message: Any) -> events.Initialisation:
    """Return the event of a start from the coolant temperature that is applied already."""
    return events.Initialisation(np.array([to_kelvin(message.temperature)]))


def setpoint_request(message: Any) -> events.SetpointRequest:
    """Return the event of a set-point, whose stamp says from when it holds."""
    return events.SetpointRequest(stamp_nanoseconds(message.header.stamp),
                                  np.array([to_kelvin(message.temperature)]))


def manual_command(message: Any) -> events.ManualCommand:
    """Return the event of a coolant temperature commanded in manual mode."""
    return events.ManualCommand(np.array([to_kelvin(message.temperature)]))


@dataclass
class Counts:
    """How many measurements came, late or not at all, and whether the operator spoke."""

    measurements: int = 0
    late: int = 0
    missed: int = 0
    refused: int = 0
    setpoint_received: bool = False


@dataclass(frozen=True)
class Situation:
    """All that a status tells of."""

    controller: Controller
    parameters: ControllerParameters
    state: State
    report: Report
    counts: Counts
    timing: Timing
    complaint: str  #: what is wrong around the node, e.g. a second controller; or empty
    request_refused: str  #: why the operator's last request was refused, or empty
    model_refused: str  #: why the last model was refused, or empty
    model: Mapping[str, object]  #: figures of the model in force
    temperature: float  #: last measured, in degrees Celsius

    @property
    def reason(self) -> str:
        """Why the level acts, in words, or empty."""
        return words_of(self.controller.model)(self.report.reason)


def status(now: Situation) -> Status:
    """Return the status of the control task."""
    return Status(*_verdict(now), lambda: _figures(now))


def _verdict(now: Situation) -> tuple[Level, str]:
    report, mode = now.report, now.state.mode
    timeout = now.parameters.measurement_timeout
    if not now.counts.measurements:
        return Level.WARN, now.complaint or 'waiting for the first temperature measurement'
    if timeout and max(now.timing.silence, now.timing.wall_silence) > timeout:
        command = now.state.command
        doing = '' if command is None else f', coolant at {in_celsius(float(command[0]))}'
        action = 'manual mode' if mode is Mode.MANUAL else (
            _ACTIONS[HOLD] if report.depth == 0 else _action(report))
        if now.timing.busy:
            return Level.ERROR, (f'no measurement answered for more than {timeout:g} s, as the '
                                 f'node is busy: {action}{doing}; ask for less at once')
        return Level.ERROR, (f'no measurement for more than {timeout:g} s: {action}{doing}; check '
                             'sensor and plant')
    if report.reason is not None and mode is Mode.MANUAL:
        return Level.ERROR, f'{mode.value}: {now.reason}'
    if mode is Mode.AUTOMATIC and report.depth > 0:
        level = Level.ERROR if report.level in _ACTIONS else Level.WARN
        action = _WAY_BACK if report.command.way_back else _action(report)
        return level, f'{action}: {now.reason}'
    if warning := _warning(now):
        return Level.WARN, warning
    message = mode.value
    if mode is Mode.AUTOMATIC and not now.counts.setpoint_received:
        message += ', no set-point yet: the temperature first measured is held'
    elif report.command.at_range:
        message += ', coolant at its limit'
    elif report.command.at_rate:
        message += ', coolant at its rate limit'
    return Level.OK, message


def _action(report: Report) -> str:
    return _ACTIONS.get(report.level) or level_words(report.level)


def _warning(now: Situation) -> str:
    """Return the first thing that an operator should know of, or an empty string."""
    report, states = now.report, now.controller.model.states
    age, oldest = now.timing.age, now.parameters.max_measurement_age
    if now.complaint:
        return now.complaint
    if report.measurement.arrival is Arrival.REPEATED:
        return ('the stamp of the measurement does not advance: the last command is held; stamp '
                'measurements with their time')
    if now.timing.without_clock:
        return ('use_sim_time is set and nobody publishes /clock: time-outs count by the wall '
                'clock; set use_sim_time to false, or publish_clock of the plant to true')
    if now.request_refused:
        return f'request refused: {now.request_refused}'
    if now.model_refused:
        return now.model_refused
    if report.measurement.outside > 0.0:
        return (f'temperature is outside the trained range '
                f'[{to_celsius(states.lower[0]):.2f}, {to_celsius(states.upper[0]):.2f}] degC: '
                'the model extrapolates')
    if oldest and abs(age) > oldest:
        return (f'measurements are {age:.1f} s old when they arrive, at most {oldest:g} s are '
                'expected: check the connection and the clocks')
    if not report.measurement.follows:
        return (f'the coolant does not follow its set-point within '
                f'{now.parameters.coolant_tolerance:g} K: the observer goes by the coolant '
                'temperature; check the actuator and its limits')
    if report.estimate is not None and report.estimate.at_bound:
        return (f'the disturbance estimate is at its bound of {now.parameters.max_disturbance:g} '
                'K of coolant: the plant is far from its model; retrain')
    return ''


def _figures(now: Situation) -> dict[str, object]:
    report, state, timing = now.report, now.state, now.timing
    target, law = report.target, report.command.law
    setpoint, disturbance, transfer = _setpoint_disturbance_transfer(report)
    bias = None if report.estimate is None else now.controller.equivalent_bias(state)
    return {
        'mode': state.mode.value,
        'active law': level_words(report.level),
        'law': law.form or 'none',
        'reason': now.reason or 'none',
        **now.model,
        'temperature [degC]': float(now.temperature),
        'set-point [degC]': setpoint,
        'coolant [degC]': to_celsius(_first(state.command)),
        'disturbance [K of coolant]': disturbance,
        'equivalent sensor bias [K]': _first(bias),
        'distance outside training box [half widths]': float(report.measurement.outside),
        'set-point outside training box [half widths]': (
            np.nan if target is None else float(target.outside)),
        'coolant outside training box [half widths]': float(report.command.outside),
        'Riccati residual': float(law.residual),
        'gain norm': float(law.gain),
        'predicted growth per sample': float(law.growth),
        'transfer [K]': transfer,
        'scheduled set-points': len(state.setpoint.scheduled),
        'measurements': now.counts.measurements,
        'late measurements': now.counts.late,
        'missed measurements': now.counts.missed,
        'measurements rejected': now.counts.refused,
        'since last measurement [s]': timing.wall_silence,
        'age of measurement [s]': timing.age,
        'latency from stamp to command [s]': timing.age + timing.answer_seconds,
        'latency from arrival to command [s]': timing.answer_seconds,
    }


def _first(values: Array | None) -> float:
    return np.nan if values is None else float(values[0])


def _setpoint_disturbance_transfer(report: Report) -> tuple[float, float, float]:
    transfer = report.command.transfer
    return (to_celsius(_first(report.target.setpoint if report.target else None)),
            _first(report.estimate.disturbance if report.estimate else None),
            0.0 if transfer is None else _first(transfer))


def internals(report: Report, stamp: Time, frame_id: str) -> JointState:
    """Return what a person would plot beside the temperatures, under names with units."""
    law = report.command.law
    setpoint, disturbance, transfer = _setpoint_disturbance_transfer(report)
    values = {
        'disturbance [K]': disturbance,
        'estimated_temperature [degC]': to_celsius(
            _first(report.estimate.state if report.estimate else None)),
        'distance_outside [half widths]': float(report.measurement.outside),
        'level [0 learned, 1 linear, 2 hold, 3 safe, 4 manual]': float(report.depth),
        'gain': float(law.gain),
        'riccati_residual': float(law.residual),
        'growth_per_sample': float(law.growth),
        'transfer [K]': transfer,
        'setpoint [degC]': setpoint,
    }
    message = JointState(name=list(values), position=list(values.values()))
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    return message


class RecordPublisher:
    """
    Publish numbered records; the caller holds the lock of the controller's state meanwhile.

    A replay begins at a snapshot of that state: there is one at the start, one for each new
    subscriber, and one every ten seconds.
    """

    def __init__(self, matching: topics.Matching, snapshot: Callable[[], Mapping[str, Any]],
                 lock: threading.Lock) -> None:
        self._snapshot, self._lock = snapshot, lock
        self._run, self._number, self._due = secrets.token_hex(8), 0, 0.0
        self._publisher = matching.publish(topics.CONTROLLER_EVENTS, matched=self._on_matched)
        self.publish_snapshot(START)

    def _on_matched(self, info: Any) -> None:
        if info.current_count_change > 0:
            with self._lock:
                self.publish_snapshot()

    def publish_snapshot(self, event: str = SNAPSHOT) -> None:
        """Publish the state."""
        self._publish(event, self._snapshot())
        self._due = time.monotonic() + _SNAPSHOT_PERIOD

    def publish_event(self, event: events.Event, outcome: events.Outcome) -> None:
        """Publish an event and what it led to."""
        self.publish(*fields_of(event, outcome))

    def publish(self, event: str, fields: Mapping[str, Any]) -> None:
        """Publish an event by its name."""
        self._publish(event, fields)
        if time.monotonic() > self._due:
            self.publish_snapshot()

    def _publish(self, event: str, fields: Mapping[str, Any]) -> None:
        record = Record(self._run, self._number, event, fields)
        self._number += 1
        self._publisher.publish(String(data=record.text()))
