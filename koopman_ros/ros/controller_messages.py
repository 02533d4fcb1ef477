# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Messages of the controller: internals, plans, active constraints, event log."""

from collections.abc import Callable, Mapping
import itertools
import math
import secrets
import time
from typing import Any

from builtin_interfaces.msg import Duration, Time
import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from koopman_ros.control import events, StepReport
from koopman_ros.control.laws.base import Plan
from koopman_ros.core.arrays import along_last, Array
from koopman_ros.core.units import display_unit, NANOSECONDS, shown, values_by_name
from koopman_ros.event_log.records import EventRecord, fields_of, SNAPSHOT, START
from koopman_ros.parameters.signal_topics import Signals, SignalTopics
from koopman_ros.ros import topics
from koopman_ros.ros.signals import SignalPublisher

_SNAPSHOT_PERIOD = 10.0  # s by the wall
_AGAIN = 1.0  # s, within which two nodes know each other


def labelled(signals: Mapping[str, str], quantity: str, values: Array | None,
             note: str = '', difference: bool = False) -> dict[str, float]:
    """
    Return values under labels like ``set-point [degC]``, led by the signal if there are several.

    :param signals: unit of each signal, by name.
    :param values: (n,) in these units; None stands for NaN.
    :param note: text after the unit.
    :param difference: whether the values are differences, which stay in K.
    """
    prefixes = [''] if len(signals) == 1 else [f'{name} ' for name in signals]
    numbers = [math.nan] * len(signals) if values is None else values.tolist()
    return {f'{prefix}{quantity} [{unit if difference else display_unit(unit)}{note}]':
            number if difference else shown(number, unit)
            for prefix, unit, number in zip(prefixes, signals.values(), numbers, strict=True)}


def internals(signals: Signals, report: StepReport, stamp: Time, frame_id: str) -> JointState:
    """Return internal values of the controller for plots, under names with units."""
    law, estimate = report.command.law, report.estimate
    inputs, target = signals.inputs, report.target
    transfer = np.zeros(len(inputs)) if report.command.transfer is None else (
        report.command.transfer)
    states = signals.every
    covariance = None if estimate is None else estimate.covariance
    innovation = None if estimate is None else estimate.innovation
    values = {
        **labelled(inputs, 'disturbance', None if estimate is None else estimate.disturbance,
                   difference=True),
        **values_by_name(states, [math.nan] * len(states) if estimate is None
                         else estimate.state.tolist(), 'estimated_{}'),
        'distance_outside [half-ranges]': float(report.measurement.outside),
        'level [0 learned, 1 linear, 2 hold, 3 safe, 4 manual]': float(report.depth),
        'gain': float(law.gain),
        'riccati_residual': float(law.residual),
        'growth_per_sample': float(law.growth),
        **labelled(inputs, 'transfer', transfer, difference=True),
        **labelled({name: signals.states[name] for name in signals.controlled}, 'setpoint',
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

    There is a point for each node; the inputs of a point hold until the next one.
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


def active_constraints(signals: Signals, plan: Plan, stamp: Time, frame_id: str) -> JointState:
    """Return which limits are active in a plan, under names that explain -1 and 1."""
    return _named({what.format(name): value for what, of, values in (
        ('at_range_{} [-1 lower, 1 upper]', signals.inputs, plan.at_range),
        ('at_rate_{} [-1 falling, 1 rising]', signals.inputs, plan.at_rate),
        ('at_limit_{} [-1 lower, 1 upper]', signals.every, plan.at_state))
        for name, value in zip(of, values.tolist(), strict=True)}, stamp, frame_id)


class ReportPublisher:
    """Publish the report of a step: tracked set-points, prediction, internals and plan."""

    def __init__(self, endpoints: topics.EndpointMonitor, wiring: SignalTopics) -> None:
        states = wiring.signals.states
        self._setpoints = SignalPublisher(
            wiring.active_setpoints, states,
            lambda topic, kind: endpoints.publish(topic, kind, topics.LATCHED_QOS))
        self._predicted = SignalPublisher(wiring.predicted, states, endpoints.publish)
        self._internals = endpoints.publish(topics.CONTROLLER_INTERNALS)
        self._plan = endpoints.publish(topics.PREDICTED_TRAJECTORY)
        self._active_limits = endpoints.publish(topics.ACTIVE_CONSTRAINTS)
        self._published: Array | None = None  # (n_c,) set-points

    def publish(self, signals: Signals, report: StepReport, stamp: Time, frame_id: str) -> None:
        """Publish a report; the set-points only if they have changed."""
        target, predicted, plan = report.target, report.measurement.predicted, report.command.plan
        if target is not None and (self._published is None
                                   or (target.setpoint != self._published).any()):
            self._published = target.setpoint
            self._setpoints.send(target.setpoint, stamp, frame_id)
        if predicted is not None and self._predicted.has_subscribers():
            self._predicted.send(predicted, stamp, frame_id)
        if topics.has_subscribers(self._internals):
            self._internals.publish(internals(signals, report, stamp, frame_id))
        if plan is not None and topics.has_subscribers(self._plan):
            self._plan.publish(planned(signals, plan, stamp, frame_id))
        if plan is not None and topics.has_subscribers(self._active_limits):
            self._active_limits.publish(active_constraints(signals, plan, stamp, frame_id))


class RecordPublisher:
    """
    Publish numbered records; the caller holds the lock of the controller's state meanwhile.

    A replay begins at a snapshot of that state: there is one when the controller begins to act,
    before which nothing is published, one every ten seconds, and two for each new subscriber: it
    may discover this publisher later than it is discovered, and miss messages in between.
    """

    def __init__(self, endpoints: topics.EndpointMonitor,
                 snapshot: Callable[[], Mapping[str, Any]]) -> None:
        self._snapshot = snapshot
        self._run, self._number, self._due = secrets.token_hex(8), 0, 0.0
        self._started, self._subscribers = False, 0
        self._publisher = endpoints.publish(topics.EVENT_LOG)

    def start(self) -> None:
        """Publish the state from which the controller begins to act."""
        self._started = True
        self.publish_snapshot(START)

    def watch(self) -> None:
        """Publish a snapshot if there is a new subscriber, or any and one is due."""
        before, self._subscribers = self._subscribers, self._publisher.get_subscription_count()
        if self._subscribers > before:
            self.publish_snapshot()
            self._due = time.monotonic() + _AGAIN
        elif self._subscribers and time.monotonic() > self._due:
            self.publish_snapshot()

    def publish_snapshot(self, event: str = SNAPSHOT) -> None:
        """Publish the state."""
        self._publish(event, self._snapshot())
        self._due = time.monotonic() + _SNAPSHOT_PERIOD

    def publish_event(self, event: events.Event, outcome: events.EventOutcome) -> None:
        """Publish an event with its outcome."""
        if topics.has_subscribers(self._publisher):
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
        # a later subscriber begins at a snapshot
        if topics.has_subscribers(self._publisher):
            self._publisher.publish(String(data=EventRecord(self._run, number, event,
                                                            fields).text()))
