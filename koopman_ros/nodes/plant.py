# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The plant node: a simulated plant that publishes measurements and takes commands."""

from enum import Enum
from functools import partial
import math
import sys
import time
from typing import Any

import numpy as np
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from koopman_ros import plants
from koopman_ros.core.message_fields import base_name
from koopman_ros.core.time_base import TimeBase
from koopman_ros.core.units import (
    LAST_STAMP_SECONDS,
    NANOSECONDS,
    quantity_text,
    seconds_text,
    values_by_name,
)
from koopman_ros.parameters.plant import PlantParameters, PlantTable
from koopman_ros.parameters.signal_topics import PLANT_KINDS, SIGNALS, SignalTopics
from koopman_ros.ros import topics
from koopman_ros.ros.diagnostics import Severity, TaskReport
from koopman_ros.ros.host import run_loops
from koopman_ros.ros.hosted import wall_timer
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.process import run
from koopman_ros.ros.rclpy_internals import events_executor
from koopman_ros.ros.signals import SignalPublisher, SignalSample, SignalSubscriber
from koopman_ros.ros.simulated_plant import Analyser, SimulatedPlant
from koopman_ros.ros.time_conversion import stamp_message

_POLL_PERIOD = 0.01  # s; for conditions that no message announces
_LAST_STAMP_NS = (LAST_STAMP_SECONDS + 1) * NANOSECONDS - 1
_SILENCE = 3.0  # s without a command, and five periods, after which the status warns


class RunPhase(Enum):
    """Phase of the simulation; the value is the message for the operator."""

    WAITING = 'waiting for a controller or trainer to subscribe'
    RUNNING = 'running'
    FINISHED = 'finished: simulated duration reached'
    OUT_OF_STAMPS = (f'finished: message stamps end at {LAST_STAMP_SECONDS} s; restart the plant '
                     'with a smaller start_time')
    TRIPPED = 'stopped'


class PlantNode(ManagedNode):
    """Run a plant in time; docs/reference/interfaces.md has its topics and services."""

    def __init__(self, **options: Any) -> None:
        super().__init__('plant', **options)
        self._table = table = PlantTable(self.given())
        # in the file of a whole loop; a plant has its own
        self._settings = self.declare_table(table, (*SIGNALS, 'model'))

    def configure(self) -> None:
        """Create the plant at its initial state, its publishers and subscriptions."""
        table = self._table
        self._settings = parameters = self.current(table)
        self._signals = signals = table.described
        self._real_time = parameters.speed == 1.0 and not parameters.lockstep
        self._period_ns = round(parameters.sample_period * NANOSECONDS)
        self._start_ns = round(parameters.start_time * NANOSECONDS)
        self._plant = SimulatedPlant(table, parameters, self._start_ns)
        if self._plant.note:
            self.get_logger().warning(self._plant.note)
        self._phase, self._trip = RunPhase.WAITING if parameters.lockstep else RunPhase.RUNNING, ''
        self._sample = 0  # number of the next measurement
        self._answered = True  # whether the last measurement has its command
        self._commands = self._rejected = self._missed = self._foreign = 0
        self._waiting_in_vain, self._rejection = False, ''
        self._wall_start = self._wall_published = time.monotonic()
        # when it last came, by name of the input
        self._commanded = dict.fromkeys(signals.inputs, self._wall_start)

        self._received: dict[str, float] = {}  # of the commands for the last measurement
        wiring = SignalTopics.of(signals, parameters, PLANT_KINDS)
        clock = parameters.publish_clock and not self._real_time
        # the subscriptions first: a controller that hears the measurement has then seen them, too
        self._endpoints = endpoints = topics.EndpointMonitor(
            self, lambda: self._diagnostics.publish_if_changed(), {
                place.topic: f'command the {base_name(name, signals.inputs[name])}'
                for name, place in wiring.commands.items()} | {
                place.topic: f'publish the {name}' for name, place in (
                    *wiring.measured.items(), *wiring.measured_disturbances.items())} | (
                {topics.CLOCK: 'publish the time'} if clock else {}))
        self._sources = endpoints.sources = {
            place.topic: TimeBase(late=-1) for place in wiring.commands.values()}
        self._command_subscriber = SignalSubscriber(
            self, endpoints.subscribe, wiring.commands, signals.inputs, self._on_command)
        self._clock_publisher = endpoints.publish(
            topics.CLOCK, qos=topics.CLOCK_QOS) if clock else None
        # the states last: who has found them has found the inputs, too
        self._applied = SignalPublisher(wiring.applied, signals.inputs, self._latched)
        self._disturbances = SignalPublisher(
            wiring.measured_disturbances, signals.disturbances, endpoints.publish)
        analysers = {name: state for name, state in parameters.states.items()
                     if state.analysis_period > 0.0}
        self._analysers = [
            Analyser(SignalPublisher({name: wiring.measured[name]}, signals.states,
                                     endpoints.publish), list(signals.states).index(name),
                     round(state.analysis_period * NANOSECONDS),
                     round(state.analysis_delay * NANOSECONDS))
            for name, state in analysers.items()]
        sensors = {name: place for name, place in wiring.measured.items() if name not in analysers}
        self._sensed = [name in sensors for name in signals.states]
        self._states = SignalPublisher(sensors, signals.states, endpoints.publish)
        counted = {wiring.measured[name].topic
                   for name in tuple(filter(None, parameters.measured)) or sensors}
        self._counted = [publisher for publisher in self._states.publishers
                         if publisher.topic_name in map(self.resolve_topic_name, counted)]
        self.diagnostics.hardware_id = self._plant.process.system.name
        self._diagnostics = self.diagnostics.add('simulation', self._status)
        self.create_service(Trigger, '~/reset', self._on_reset)
        wall_period = parameters.sample_period / (parameters.speed or math.inf)
        if parameters.lockstep:
            wall_timer(self, _POLL_PERIOD, self._on_poll)
            if parameters.speed:
                wall_timer(self, wall_period, self._step_in_lockstep)
        else:
            self._tick = wall_timer(self, wall_period, self._step_in_time)
        self.follow_table(table, parameters, self._on_parameters)
        pace = ('as fast as possible' if not parameters.speed else 'in real time'
                if self._real_time else f'at {parameters.speed:g} times real time')
        start = '' if self._real_time else f' from {seconds_text(self._start_ns)} s'
        lockstep = (f', in lock-step: starts when {parameters.lockstep_subscribers} nodes '
                    'subscribe and a controller is found') if parameters.lockstep else ''
        self.get_logger().info(f'{self._plant.process.system.name} started: a measurement every '
                               f'{parameters.sample_period:g} s{start}, {pace}{lockstep}')

    def activate(self) -> None:
        """Resume the plant's time."""
        self._commanded = dict.fromkeys(self._signals.inputs, time.monotonic())
        if not self._sample:
            return
        if self._settings.lockstep:
            self._answered = True
            self._continue_lockstep()
        elif self._real_time:
            # its stamps are the system's time, which goes on
            self._resynchronise()
        elif self._settings.speed:
            # the next tick, in a period from now, is that of the next sample
            passed = (self._sample - 1) * self._period_ns / NANOSECONDS
            self._wall_start = time.monotonic() - passed / self._settings.speed
            self._tick.reset()

    def _latched(self, topic: str, kind: Any) -> Any:
        return self._endpoints.publish(topic, kind, topics.LATCHED_QOS)

    def _now_ns(self) -> int:
        """Return the plant time at the present wall time."""
        elapsed = time.monotonic() - self._wall_start
        return self._start_ns + round(elapsed * self._settings.speed * NANOSECONDS)

    def _step_in_time(self) -> None:
        if not self.active:
            return
        if self._sample == 0:
            # time begins now, and the next tick is in a period from now: after a first one that
            # was late, all stamps would be ahead of the clock
            if self._real_time:
                self._start_ns = time.time_ns()
                self._plant.skip_to(self._start_ns)
            self._wall_start = time.monotonic()
            self._tick.reset()
        if self._phase is not RunPhase.RUNNING:
            return
        if self._settings.speed:
            # a timer skips the periods that it missed, and so do the samples; a late one is of the
            # period that has begun, not of the next one, whose stamp would be ahead of the clock
            due = (self._now_ns() - self._start_ns) // self._period_ns
            self._sample = max(self._sample, due)
        self._measure()

    def _on_poll(self) -> None:
        """Start lock-step once the loop is complete, and watch for a missing command."""
        if not self.active:
            return
        if self._phase is RunPhase.WAITING:
            listeners = min(publisher.get_subscription_count() for publisher in self._counted)
            if listeners >= self._settings.lockstep_subscribers and all(
                    self.count_publishers(topic) > 0
                    for topic in self._command_subscriber.topics):
                self._phase = RunPhase.RUNNING
                self._measure()
            return
        waited = time.monotonic() - self._wall_published
        if (self._phase is RunPhase.RUNNING and not self._answered
                and waited > self._settings.lockstep_timeout):
            self._missed += 1
            self._answered = self._waiting_in_vain = True
            self.get_logger().warning(
                f'no command for the measurement at {seconds_text(self._plant.process.time_ns)} s '
                f'within {self._settings.lockstep_timeout} s: the last one is held',
                throttle_duration_sec=10.0)
            self._continue_lockstep()

    def _step_in_lockstep(self) -> None:
        if self.active and self._phase is RunPhase.RUNNING and self._answered:
            self._measure()

    def _continue_lockstep(self) -> None:
        # with a speed the next tick of the pacing timer does it
        if not self._settings.speed:
            self._step_in_lockstep()

    def _measure(self) -> None:
        """Advance to the next sample and publish it."""
        instant = self._start_ns + self._sample * self._period_ns
        duration_ns = round(self._settings.duration * NANOSECONDS)
        if duration_ns and instant > self._start_ns + duration_ns:
            self._phase = RunPhase.FINISHED
            self.get_logger().info(self._phase.value)
        elif instant > _LAST_STAMP_NS:
            self._phase = RunPhase.OUT_OF_STAMPS
            self.get_logger().error(self._phase.value)
        elif self._advance(instant):
            sample, self._sample = self._sample, self._sample + 1
            self._answered = False
            self._received = {}
            self._wall_published = time.monotonic()
            self._publish(sample)
        self._diagnostics.publish_if_changed()

    def _publish(self, sample: int) -> None:
        """Publish inputs and disturbances, then states, to which the controller responds."""
        stamp, frame_id = stamp_message(self._plant.process.time_ns), self._settings.frame_id
        if self._clock_publisher is not None and topics.has_subscribers(self._clock_publisher):
            self._clock_publisher.publish(Clock(clock=stamp))
        self._applied.send(self._plant.process.applied, stamp, frame_id)
        self._disturbances.send(self._table.measured_disturbances(self._settings), stamp, frame_id)
        measured, variance, resolution = self._plant.measure(sample)
        for analyser in self._analysers:
            analyser.sample(self._plant.process.time_ns, measured, frame_id)
        measured, variance, resolution = (
            of[self._sensed] for of in (measured, variance, resolution))
        self._states.send(measured, stamp, frame_id, variance, resolution)

    def _advance(self, time_ns: int) -> bool:
        """Simulate up to an instant; stop a plant that diverges."""
        try:
            self._plant.advance(time_ns)
        except plants.IntegrationError as error:
            self._phase, self._trip = RunPhase.TRIPPED, str(error)
            self.get_logger().error(f'{error}; call ~/reset to restart')
            self._diagnostics.publish_if_changed()
            return False
        return True

    def _on_command(self, received: SignalSample) -> None:
        if not self.active:
            return
        if received.number is not None:
            self._sources[received.topic].take(
                received.number, time.monotonic(), self._command_patience)
        lockstep = self._settings.lockstep
        if lockstep and received.stamped and received.stamp_ns != self._plant.process.time_ns:
            # it answers no open measurement: late, or from another node
            self._foreign += 1
            return
        self._received |= received.values
        if lockstep and len(self._received) < len(self._signals.inputs):
            return
        wrong = [name for name, value in self._received.items() if not math.isfinite(value)]
        if not wrong:
            self._commands += 1
            self._commanded |= dict.fromkeys(self._received, time.monotonic())
            self._rejection = ''
            # in lock-step it was given at its measurement, otherwise now
            if lockstep or self._advance_to_now():
                followed = dict(zip(self._signals.inputs, self._plant.process.followed.tolist(),
                                    strict=True))
                self._plant.command(np.array(list((followed | self._received).values())))
        else:
            self._rejected += 1
            unit = self._signals.inputs[wrong[0]]
            self._rejection = (
                f'{base_name(wrong[0], unit)} command '
                f'{quantity_text(self._received[wrong[0]], unit)} is not finite and was rejected: '
                'the last valid one is held')
            self.get_logger().warning(self._rejection, throttle_duration_sec=1.0)
            self._diagnostics.publish_if_changed()
        if not lockstep:
            self._received = {}
        elif self._phase is RunPhase.RUNNING and not self._answered:
            self._answered, self._waiting_in_vain = True, False
            self._continue_lockstep()

    def _advance_to_now(self) -> bool:
        if self._phase is not RunPhase.RUNNING or not self.active:
            return False
        # never past the next sample, which is measured under the command of its time
        ahead = self._start_ns + self._sample * self._period_ns
        now = self._now_ns() if self._settings.speed else self._plant.process.time_ns
        return self._advance(min(now, ahead))

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._phase in (RunPhase.FINISHED, RunPhase.OUT_OF_STAMPS):
            response.message = ('the simulated duration is reached: restart the plant'
                                if self._phase is RunPhase.FINISHED else self._phase.value)
            return response
        response.success = True
        self._plant.reset()
        if self._phase is RunPhase.TRIPPED:
            self._phase, self._trip = RunPhase.RUNNING, ''
            self._resynchronise()
        response.message = 'reset to ' + ', '.join(
            f'{name} {value:.6g} {unit[1:-1]}' for (name, unit), value in (
                (label.rsplit(' ', 1), value) for label, value in self._plant.figures().items()))
        self.get_logger().info(response.message)
        self._diagnostics.publish_if_changed()
        return response

    def _resynchronise(self) -> None:
        """Resume after a stop, during which the plant's time did not advance."""
        if self._settings.lockstep:
            self._answered = True
            self._continue_lockstep()
            return
        passed = self._now_ns() if self._settings.speed else self._plant.process.time_ns
        self._sample = max(self._sample, -(-(passed - self._start_ns) // self._period_ns))
        self._plant.skip_to(passed)

    def _on_parameters(self, parameters: PlantParameters) -> None:
        if not self._settings.lockstep:
            self._advance_to_now()
        self._settings = parameters
        self._plant.tune(parameters)

    def _status(self) -> TaskReport:
        level, message = Severity.OK, self._phase.value
        if not self.active:
            message = 'inactive'
        elif self._phase is RunPhase.TRIPPED:
            level, message = Severity.ERROR, f'stopped: {self._trip}; call ~/reset'
        elif self._phase is RunPhase.OUT_OF_STAMPS:
            level = Severity.ERROR
        elif self._rejection:
            level, message = Severity.WARN, self._rejection
        elif complaint := self._endpoints.complaint:
            level, message = Severity.WARN, complaint
        elif self._phase is RunPhase.WAITING:
            level = Severity.WARN
        elif self._unanswered():
            level, message = Severity.WARN, (
                'running, but no command is received: the last one is held; check that the '
                'controller is active, and its topics and ROS domain')
        return TaskReport(level, message, lambda: {
            'time [s]': seconds_text(self._plant.process.time_ns),
            **self._plant.figures(),
            **values_by_name({base_name(name, unit): unit
                              for name, unit in self._signals.inputs.items()},
                             self._plant.process.followed.tolist(), '{} command'),
            'measurements': self._sample,
            'commands': self._commands,
            'rejected commands': self._rejected,
            'missed commands': self._missed,
            'foreign commands': self._foreign,
        })

    def _unanswered(self) -> bool:
        """Return whether commands of an input are missing."""
        if self._phase is not RunPhase.RUNNING or self._settings.lockstep:
            return self._waiting_in_vain
        return time.monotonic() - min(self._commanded.values()) > self._command_patience

    @property
    def _command_patience(self) -> float:
        """Seconds within which the controller commands the inputs several times."""
        return max(_SILENCE, 5.0 * self._settings.sample_period / (
            self._settings.speed or math.inf))


def main(args: list[str] | None = None) -> int:
    """Run the plant node."""
    return run('plant', PlantNode, args, partial(run_loops, 'plant', PlantNode), events_executor)


if __name__ == '__main__':
    sys.exit(main())
