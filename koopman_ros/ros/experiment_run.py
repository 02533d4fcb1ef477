# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A run of an identification experiment, from its first measurement to its last command."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import contextlib
from functools import partial
import math
import time
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_msgs.msg import String

from koopman_ros.control.experiment import (
    advance,
    begin,
    end,
    Experiment,
    ExperimentPhase,
    ExperimentProgress,
    TrackingMonitor,
)
from koopman_ros.core.arrays import Array
from koopman_ros.core.message_fields import base_name, MessageField
from koopman_ros.core.status import Reason, reason, StatusCode
from koopman_ros.core.units import NANOSECONDS, quantity_text, values_by_name
from koopman_ros.event_log import records
from koopman_ros.parameters.signal_topics import SignalTopics
from koopman_ros.parameters.trainer import COMMAND, MANUAL, SETPOINT, TrainerParameters
from koopman_ros.ros import topics
from koopman_ros.ros.hosted import wall_timer
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.rclpy_internals import take_message
from koopman_ros.ros.signals import (
    InputWait,
    MeasuredInputs,
    SignalPublisher,
    SignalSample,
    SignalSubscriber,
    synchroniser,
)
from koopman_ros.ros.time_conversion import stamp_message, stamp_nanoseconds

_TICK = 0.1  # s
_DEVIATIONS = 10  # commands of a controller, and
_DEVIATION_TIME = 5.0  # s, after which it is said not to follow; a busy machine may take a while
_RETURN_TIME = 2.0  # s for the way back at the end of the process


def stepped(settings: TrainerParameters, wiring: SignalTopics) -> dict[str, MessageField]:
    """Return where an experiment publishes, by name of the signal that it steps."""
    if settings.experiment_signal == SETPOINT:
        return wiring.setpoints
    return wiring.manual if settings.experiment_signal == MANUAL else wiring.commands


class ExperimentRun:
    """
    Step the signals from the first measurement on until :meth:`destroy`.

    :param commanded: last command of the inputs, by name, as far as it is known.
    :param on_end: called when the steps are over, with the reason when it must command no more.
    :raises ValueError: for bounds that exclude a plan.
    """

    def __init__(self, node: ManagedNode, settings: TrainerParameters, wiring: SignalTopics,
                 commanded: Mapping[str, float], on_end: Callable[[Reason | None], None]) -> None:
        places = stepped(settings, wiring)
        signals = wiring.signals
        self._settings, self._signals = settings, signals
        self._on_setpoints = settings.experiment_signal == SETPOINT
        self._units = {name: (signals.states if self._on_setpoints else signals.inputs)[name]
                       for name in places}
        # status of the controller
        self._tracked: dict[str, float] = {}  # set-points, by name
        self._automatic = False
        # set-points stand in with which the bounds can be tried before those of now are known
        self.plan: Experiment = settings.experiment(
            signals, np.zeros(len(places)) if self._on_setpoints else None)
        self._topics = [node.resolve_topic_name(place.topic) for place in places.values()]
        self.progress: ExperimentProgress | None = None
        # why it cannot start, or None with the first measurement
        self.started = Future()
        self._node = node
        self._timeout, self._on_end = settings.experiment_timeout, on_end
        self._commanded = commanded
        self._applied = MeasuredInputs(self._units)
        self._wait = InputWait[tuple[int, Array, str]](
            node, self._inputs_missing, lambda sample: self._answer(*sample))
        self._frame_id, self._received_at = '', time.monotonic()
        self._sent: Array | None = None
        self._monitors = [TrackingMonitor(span)
                          for span in (self.plan.upper - self.plan.lower).tolist()]
        self._endpoints = topics.EndpointMonitor(node, lambda: None)
        self._assembler = synchroniser(
            wiring.measured, signals.states, settings.synchronisation_tolerance)
        self._measured = SignalSubscriber(
            node, self._subscribe, wiring.measured, signals.states, self._on_measurement)
        self._answers = SignalSubscriber(
            node, self._subscribe, wiring.commands, signals.inputs, self._on_command) if (
                settings.experiment_signal != COMMAND) else None
        self._inputs = None if self._on_setpoints else SignalSubscriber(
            node, self._subscribe, wiring.applied, signals.inputs, self._on_applied)
        if self._on_setpoints:
            SignalSubscriber(node, partial(self._subscribe, latched=True), wiring.active_setpoints,
                             signals.states,
                             lambda received: self._tracked.update(received.values))
            self._subscribe(topics.EVENT_LOG, self._on_record, String)
        self._publisher = SignalPublisher(places, self._units, self._endpoints.publish)
        self._timer = wall_timer(node, _TICK, self._on_tick)

    def destroy(self) -> None:
        """Command no more."""
        self._wait.clear()
        self._node.destroy_timer(self._timer)
        self._endpoints.destroy()

    def _subscribe(self, topic: str, callback: Callable[[Any], None], kind: Any,
                   latched: bool = False) -> Subscription:
        # now, as the first message counts; the monitor follows publishers that start later
        publishers = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(topic))
        qos = topics.matching_profile(topics.LOOP_QOS, publishers, topics.LOOP_QOS.depth)
        if latched:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        return self._endpoints.subscribe(topic, callback, kind, qos)

    @property
    def topics(self) -> str:
        """Topics of the stepped signals."""
        return ', '.join(dict.fromkeys(self._topics))

    @property
    def running(self) -> bool:
        """Whether the run waits for its first measurement, or steps."""
        return self.progress is None or self.progress.phase is ExperimentPhase.RUNNING

    @property
    def _setpoints_missing(self) -> bool:
        return self._on_setpoints and (
            not self._automatic or len(self._tracked) < len(self._units))

    @property
    def return_text(self) -> str:
        """Values to which the signals return after the steps."""
        return f'{self._values_text("to", self.plan.home)}, where it is held'

    def _values_text(self, preposition: str, values: Array) -> str:
        """Write values (m,) with their names and units."""
        return ', '.join(
            f'{self._label(name)} {preposition} {quantity_text(value, unit)}'
            for (name, unit), value in zip(self._units.items(), values.tolist(), strict=True))

    def _inputs_missing(self) -> bool:
        # a controller answers the first measurement, too
        return self.progress is None and self._inputs is not None and (
            (self._answers is not None and not self._commanded)
            or (not self._applied.complete and self._inputs.published()))

    def _present(self, stamp_ns: int) -> Array:
        """
        Return the present inputs (m,) at a stamp, from which the steps begin.

        Each is the one measured within `experiment_timeout` of the stamp, or else the last
        command, an older measurement, or the safe value.
        """
        start = self.plan.home.copy()
        recent = round(self._timeout * NANOSECONDS)
        for i, (name, unit) in enumerate(self._units.items()):
            stamp, measured = self._applied.get(name)
            found = [measured] if abs(stamp_ns - stamp) <= recent else []
            found += [self._commanded.get(name, math.nan), measured]
            start[i] = next(filter(math.isfinite, found), start[i])
            if not any(map(math.isfinite, found)):
                self._node.get_logger().warning(
                    f'experiment: {self._label(name)} is neither measured nor commanded: the '
                    f'steps begin at its safe value, {quantity_text(start[i], unit)}')
        return start

    def _on_applied(self, received: SignalSample) -> None:
        self._applied.take(received)
        self._wait.look()

    def _label(self, name: str) -> str:
        return name if self._on_setpoints else base_name(name, self._units[name])

    def figures(self, what: str, values: Array) -> dict[str, float]:
        """Return values (m,) by name with unit."""
        return values_by_name({self._label(name): unit for name, unit in self._units.items()},
                              values.tolist(), f'{{}} {what}')

    def stop(self, phase: ExperimentPhase, why: Reason | None = None) -> None:
        """End the steps; the signals then return."""
        if self.progress is not None:
            self.progress = end(self.progress, phase, why)

    def return_before_exit(self) -> None:
        """Return the signals for at most 2 s, and leave them there."""
        if self.progress is None:
            return
        deadline = time.monotonic() + _RETURN_TIME
        while time.monotonic() < deadline and not self._returned:
            for stamp_ns in self._waiting_stamps():
                self.progress = advance(self.plan, self.progress, None, stamp_ns)
                self._command(self.progress.command, stamp_ns)
            time.sleep(0.001)
        if not self._returned:
            self._node.get_logger().warning(
                'experiment: ended during the return: '
                f'{self._values_text("at", self.progress.command)}, held there, instead of '
                f'{self._values_text("at", self.plan.home)}; command the inputs manually or start '
                'the controller')

    @property
    def _returned(self) -> bool:
        return self.progress is not None and bool((self.progress.command == self.plan.home).all())

    def _waiting_stamps(self) -> list[int]:
        """Take one measurement from each topic without the executor; return their stamps."""
        found = []
        for subscription in self._endpoints.subscriptions:
            if subscription.topic_name in self._measured.topics and (
                    taken := take_message(subscription)):
                header = getattr(taken[0], 'header', None)
                found.append(self._node.get_clock().now().nanoseconds if (
                    header is None) else stamp_nanoseconds(header.stamp))
        return found

    def _on_measurement(self, received: SignalSample) -> None:
        if (whole := self._assembler.take(received.stamp_ns, received.values)) is not None:
            self._wait.take((*whole, received.frame_id))

    def _answer(self, stamp_ns: int, measured: Array, frame_id: str) -> None:
        if self.progress is None and not self._started(stamp_ns, measured):
            return
        assert self.progress is not None
        newest_ns, was_running = self.progress.time_ns, self.running
        self._frame_id = frame_id
        self.progress = advance(self.plan, self.progress, measured, stamp_ns)
        if self.progress.time_ns != newest_ns:
            # a stamp that does not advance is no new measurement
            self._received_at = time.monotonic()
        self._command(self.progress.command, stamp_ns)
        if was_running and not self.running:
            self._on_end(None)

    def _started(self, stamp_ns: int, measured: Array) -> bool:
        """Start if the set-points are known; return whether the run has started."""
        if self.started.done() or self._setpoints_missing:
            return False
        if self._on_setpoints:
            self.plan = self._settings.experiment(
                self._signals, np.array([self._tracked[name] for name in self._units]))
        self.started.set_result(rejection := self.plan.rejection(measured))
        if rejection is not None:
            return False
        self.progress = begin(
            self.plan, stamp_ns, None if self._on_setpoints else self._present(stamp_ns))
        self._received_at = time.monotonic()
        return True

    def _command(self, values: Array, stamp_ns: int) -> None:
        if self._on_setpoints and self._sent is not None and (values == self._sent).all():
            # a set-point stays where it was asked to be
            return
        self._sent = values
        self._publisher.send(values, stamp_message(stamp_ns), self._frame_id)

    def _on_command(self, received: SignalSample) -> None:
        """Check that the controller follows the requests, by its own answers."""
        self._wait.look()
        if self.progress is None:
            return
        values, code = (self._tracked, StatusCode.NOT_TRACKED) if self._on_setpoints else (
            received.values, StatusCode.NOT_FOLLOWED)
        now = time.monotonic()
        for i, name in enumerate(self._units):
            if name not in values:
                continue
            value, command = values[name], float(self.progress.command[i])
            monitor = self._monitors[i] = self._monitors[i].after(value, command, now)
            if monitor.deviations >= _DEVIATIONS and now - monitor.since >= _DEVIATION_TIME:
                self._on_end(reason(code, signal=name, value=value, requested=command))
                return

    def _on_record(self, message: String) -> None:
        """Check that the controller stays in automatic mode."""
        with contextlib.suppress(records.RecordError):
            mode = records.parse(message.data).fields.get('mode')
            self._automatic = self._automatic or mode == 'automatic'
            if mode == 'manual':
                why = reason(StatusCode.IN_MANUAL_MODE)
                if self.progress is not None:
                    self._on_end(why)
                elif not self.started.done():
                    self.started.set_result(why)

    def _on_tick(self) -> None:
        """Check for other publishers and for missing measurements."""
        self._wait.look()
        why = None
        for topic in dict.fromkeys(self._topics):
            if others := other_publishers(self._node, topic, own=1):
                why = reason(StatusCode.OTHER_PUBLISHER, nodes=others, topic=topic)
        if why is None and self._answers is not None and not self._answers.published():
            why = reason(StatusCode.CONTROLLER_GONE)
        elif why is None and time.monotonic() - self._received_at > self._timeout:
            why = reason(StatusCode.NOTHING_TRACKED if self._setpoints_missing
                         else StatusCode.SILENCE, timeout=self._timeout)
        if self.progress is None:
            if why is not None and not self.started.done():
                self.started.set_result(why)
        elif why is not None and why.code is StatusCode.SILENCE:
            was_running = self.running
            # the return is timed by the wall clock
            self.progress = advance(
                self.plan, end(self.progress, ExperimentPhase.ABORTED, why), None,
                self.progress.time_ns + round(_TICK * NANOSECONDS))
            self._command(self.progress.command, self.progress.time_ns)
            if was_running:
                self._on_end(None)
        elif why is not None:
            self._on_end(why)


def other_publishers(node: Node, topic: str, own: int = 0) -> str:
    """Return the nodes that publish on a topic, except `own` publishers of this node."""
    names = list(map(topics.node_name, node.get_publishers_info_by_topic(topic)))
    me = node.get_fully_qualified_name()
    # another node may have the same name
    others = {name for name in names if name != me}
    return ' and '.join(sorted(others | ({me} if names.count(me) > own else set())))
