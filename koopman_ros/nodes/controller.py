# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controller node: answers each temperature measurement with a coolant set-point."""

from collections.abc import Mapping
from dataclasses import asdict
import sys
import threading

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.publisher import Publisher
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.timer import Timer
from sensor_msgs.msg import Temperature
from std_srvs.srv import SetBool, Trigger

from koopman_ros.arrays import Array
from koopman_ros.control import Arrival, Controller, events, MANUAL, Mode, Report, State
from koopman_ros.control.events import Event, ModeChange, Silence
from koopman_ros.parameters.controller import ControllerParameters, TABLE
from koopman_ros.parameters.wire import LONGEST_FRAME_ID
from koopman_ros.reasons import level_words
from koopman_ros.replay import records
from koopman_ros.ros import controller_messages as messages
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_message, stamp_nanoseconds, temperature_message
from koopman_ros.ros.model_reload import load_suitable, ModelReload, rests_outside, Situation
from koopman_ros.ros.node import DiagnosticsPublisher, LoopNode, Status, wall_timer, words_of
from koopman_ros.ros.process import run
from koopman_ros.ros.watchdog import PERIOD, Timing, Watchdog
from koopman_ros.units import NANOSECONDS, to_kelvin

_WATCH_STEP = NANOSECONDS // 2  # of plant time between two commands without a measurement
_COOLANT_PATIENCE = 0.5  # s that the first answer waits for the applied coolant temperature
# A step that the watchdog has overtaken so often is given up, and its measurement with it.
_ATTEMPTS = 2


class ControllerNode(LoopNode):
    """
    Carry messages to and from the control step; docs/interfaces.md has its topics and services.

    All runs in the executor's thread, but for the watch over silence while that thread is busy.
    The lock is held where the state changes and its command goes out, not while a measurement is
    answered, so that the watchdog goes by the last state that commanded.
    """

    def __init__(self) -> None:
        super().__init__('controller')
        self._settings = parameters = self.declare_table(TABLE)
        self._models = ModelReload(
            self, load_suitable(parameters.model), lambda: Situation(
                self._settings.settings(), self._state,
                np.array([to_kelvin(self._temperature)])),
            lambda: self._exchange(records.MODEL, {'model': self._models.in_force.identity}),
            lambda: self._diagnostics.publish_if_changed())
        self._controller = self._built()
        self._state = State()
        self._lock, self._telling = threading.Lock(), threading.Lock()
        self._report = self._logged = Report(Mode.AUTOMATIC, next(iter(self._controller.levels)))
        self._refused = self._rests_outside = ''
        self._counts = messages.Counts()
        self._temperature, self._timing = np.nan, Timing(self)
        self._coolant: Temperature | None = None
        self._waiting: list[Temperature] = []  # measurements that came before the coolant
        self._patience: Timer | None = None
        self._frame_id, self._frame_length = '', 0  # the length where it is too long

        self._matching = topics.Matching(
            self, lambda: self._diagnostics.publish_if_changed(), topics.SINGLE)
        self._commands = self._matching.publish(topics.COOLANT_SETPOINT)
        self._active = self.create_publisher(*topics.of(topics.ACTIVE_SETPOINT))
        self._predicted = self.create_publisher(*topics.of(topics.PREDICTED_TEMPERATURE))
        self._internals = self.create_publisher(*topics.of(topics.CONTROLLER_STATE))
        self._published_setpoint: float | None = None
        self._diagnostics = DiagnosticsPublisher(self, 'control', 'controller', self._status)
        # volatile, so that `ros2 topic pub` matches
        self._matching.subscribe(topics.SETPOINT, self._on_setpoint)
        self._matching.subscribe(topics.MANUAL_COOLANT_SETPOINT, lambda message: self._change(
            messages.manual_command(message)))
        self._coolants = self._matching.subscribe(topics.COOLANT_TEMPERATURE, self._on_coolant)
        # a sensor driver that publishes best effort needs this overridden to match
        self._matching.subscribe(
            topics.TEMPERATURE, self._on_temperature,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self.create_service(SetBool, '~/set_automatic', self._on_set_automatic)
        # a group of its own, or measurements would wait until a model is read
        self.create_service(Trigger, '~/reload_model', self._models.on_reload,
                            callback_group=MutuallyExclusiveCallbackGroup())
        wall_timer(self, PERIOD, self._on_watch)
        self._records = messages.RecordPublisher(
            self._matching, lambda: records.snapshot(
                self._state, asdict(self._settings), self._models.in_force.identity), self._lock)
        self.follow_table(TABLE, parameters, self._on_parameters, self._models.accept)
        self.get_logger().info(self._models.in_force.about)
        self._warn_of_rest()
        self._watchdog = Watchdog(self._on_busy)
        self._watchdog.start()

    def complete(self) -> None:
        """Let nobody command while the middleware is taken down."""
        self._watchdog.end()

    def _on_temperature(self, message: Temperature) -> None:
        # whether the applied coolant temperature will be known in a moment
        if self._waiting or (
                self._state.command is None and self._coolant is None and self._patience is None
                and self.count_publishers(self._coolants.topic_name) > 0):
            self._waiting.append(message)
            if self._patience is None:
                self._patience = wall_timer(self, _COOLANT_PATIENCE, self._answer_waiting)
            return
        self._answer(message)

    def _on_coolant(self, message: Temperature) -> None:
        # only value and stamp are kept
        message.header.frame_id = ''
        self._coolant = message
        if self._waiting:
            self._answer_waiting()

    def _answer_waiting(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
        waiting, self._waiting = self._waiting, []
        for message in waiting:
            self._answer(message)

    def _answer(self, message: Temperature) -> None:
        stamp_ns, arrived = stamp_nanoseconds(message.header.stamp), self._timing.now()
        frame_id = message.header.frame_id
        self._frame_id = frame_id[:LONGEST_FRAME_ID]
        self._frame_length = len(frame_id) if len(frame_id) > LONGEST_FRAME_ID else 0
        for _ in range(_ATTEMPTS):
            before = state = self._state
            done: list[tuple[Event, events.Outcome]] = []
            if state.command is None and self._coolant is not None:
                initial = messages.initialisation(self._coolant)
                done.append((initial, events.apply(self._controller, state, initial)))
                state = done[0][1].state
            asked = messages.measurement(message, self._coolant)
            outcome = events.apply(self._controller, state, asked)
            assert outcome.command is not None and outcome.report is not None
            with self._lock:
                if self._state is not before:
                    # the watchdog has commanded meanwhile: the answer must go on from there
                    continue
                self._state = outcome.state
                self._publish(self._commands, outcome.command, message.header.stamp)
                for event, led_to in (*done, (asked, outcome)):
                    self._records.publish_event(event, led_to)
                if stamp_ns != before.time_ns:
                    self._timing.note(stamp_ns, arrived)
                self._timing.answered()
            break
        else:
            self.get_logger().error(
                'a measurement is not answered, as a control step takes longer than the watchdog '
                'waits: choose a smaller model', throttle_duration_sec=1.0)
            return
        report = outcome.report
        self._temperature = message.temperature
        self._counts.measurements += 1
        self._counts.late += report.measurement.arrival is Arrival.LATE
        self._counts.missed += report.measurement.missed
        self._counts.refused += report.measurement.arrival is Arrival.REJECTED
        self._tell(report, message.header.stamp)

    def _on_watch(self) -> None:
        self._timing.busy = False
        self._watchdog.beat()
        watched = self._watch(self._timing.silence)
        if watched is not None:
            self._tell(*watched)

    def _on_busy(self, seconds: float) -> None:
        """Stand in for the executor; called in the watchdog's thread."""
        watched = self._watch(self._timing.busy_silence(seconds))
        if watched is None:
            return
        self._timing.busy = True
        # the executor may be stuck in there
        if self._telling.acquire(blocking=False):
            try:
                self._publish_beside(*watched)
                self._diagnostics.publish_if_changed()
            finally:
                self._telling.release()

    def _watch(self, silence: float) -> tuple[Report, Time] | None:
        """Hold the command, or go to the safe coolant, in a silence; return what was commanded."""
        with self._lock:
            timeout, state = self._settings.measurement_timeout, self._state
            if not timeout or not silence > timeout or state.time_ns is None:
                return None
            now_ns = state.time_ns + round(silence * NANOSECONDS)
            if state.commanded_ns is not None and now_ns - state.commanded_ns < _WATCH_STEP:
                return None
            silence_ends = Silence(now_ns)
            outcome = events.apply(self._controller, state, silence_ends)
            if outcome.command is None or outcome.report is None:
                return None
            self._state, stamp = outcome.state, stamp_message(now_ns)
            self._publish(self._commands, outcome.command, stamp)
            self._records.publish_event(silence_ends, outcome)
            return outcome.report, stamp

    def _tell(self, report: Report, stamp: Time) -> None:
        """Publish and log what is known beside the command."""
        with self._telling:
            self._publish_beside(report, stamp)
        if report.level not in (self._logged.level, MANUAL):
            change = f'{level_words(self._logged.level)} -> {level_words(report.level)}'
            if report.depth > self._logged.depth:
                why = words_of(self._controller.model)(report.reason)
                self.get_logger().warning(f'{change}: {why}', throttle_duration_sec=1.0)
            else:
                self.get_logger().info(change, throttle_duration_sec=1.0)
            self._logged = report
        if report.measurement.clock_went_back:
            self.get_logger().warning('the measurement is older than the last one: time starts '
                                      'afresh', throttle_duration_sec=1.0)
        self._diagnostics.publish_if_changed()

    def _publish_beside(self, report: Report, stamp: Time) -> None:
        self._report = report
        target, predicted = report.target, report.measurement.predicted
        if target is not None and target.setpoint[0] != self._published_setpoint:
            self._published_setpoint = float(target.setpoint[0])
            self._publish(self._active, target.setpoint, stamp)
        if predicted is not None:
            self._publish(self._predicted, predicted, stamp)
        self._internals.publish(messages.internals(report, stamp, self._frame_id))

    def _publish(self, publisher: Publisher, kelvin: Array, stamp: Time) -> None:
        publisher.publish(temperature_message(float(kelvin[0]), stamp, self._frame_id))

    def _on_setpoint(self, message: Temperature) -> None:
        stamp_ns = stamp_nanoseconds(message.header.stamp)
        if self._change(messages.setpoint_request(message)):
            scheduled = any(entry[0] == stamp_ns for entry in self._state.setpoint.scheduled)
            when = f', holds from {stamp_ns / NANOSECONDS:.3f} s on' if scheduled else ''
            self.get_logger().info(f'set-point {message.temperature:.6g} degC accepted{when}',
                                   throttle_duration_sec=1.0)

    def _on_set_automatic(self, request: SetBool.Request, response: SetBool.Response
                          ) -> SetBool.Response:
        mode = Mode.AUTOMATIC if request.data else Mode.MANUAL
        self._change(ModeChange(mode))
        response.success, response.message = True, f'{mode.value} mode'
        self.get_logger().info(response.message)
        return response

    def _change(self, event: Event) -> bool:
        """Apply what is not answered by a command; return whether it is not refused."""
        with self._lock:
            outcome = events.apply(self._controller, self._state, event)
            self._state = outcome.state
            self._records.publish_event(event, outcome)
        self._refused = words_of(self._controller.model)(outcome.refused)
        if self._refused:
            self.get_logger().warning(self._refused, throttle_duration_sec=1.0)
        elif isinstance(event, events.SetpointRequest):
            self._counts.setpoint_received = True
        self._diagnostics.publish_if_changed()
        return not self._refused

    def _built(self) -> Controller:
        return Controller(self._models.in_force.model, self._settings.settings())

    def _on_parameters(self, parameters: ControllerParameters) -> None:
        before, self._settings = self._settings, parameters
        fields: dict[str, object] = {'parameters': {
            name: value for name, value in asdict(parameters).items()
            if value != getattr(before, name)}}
        if self._models.take_over():
            fields['model'] = self._models.in_force.identity
        self._exchange(records.PARAMETERS, fields)

    def _exchange(self, event: str, fields: Mapping[str, object]) -> None:
        """Put the parameters and the model of now in force."""
        with self._lock:
            predecessor, self._controller = self._controller, self._built()
            self._state = self._controller.hand_over(predecessor, self._state)
            self._records.publish(event, fields)
        self._warn_of_rest()
        self._diagnostics.publish_if_changed()

    def _warn_of_rest(self) -> None:
        """Say that the safe coolant leads out of the model's range, once for each reason."""
        before, self._rests_outside = self._rests_outside, rests_outside(self._controller)
        if self._rests_outside not in ('', before):
            self.get_logger().warning(self._rests_outside)

    def _status(self) -> Status:
        frame = (f'the frame_id of the measurement has {self._frame_length} characters, of which '
                 f'{LONGEST_FRAME_ID} are passed on: shorten it at the sensor'
                 ) if self._frame_length else ''
        return messages.status(messages.Situation(
            self._controller, self._settings, self._state, self._report, self._counts,
            self._timing, self._matching.complaint or frame, self._refused, self._models.refused,
            {**self._models.figures(), 'safe coolant': self._rests_outside or 'within reach'},
            self._temperature))


def main(args: list[str] | None = None) -> int:
    """Run the controller node."""
    return run('controller', ControllerNode, args)


if __name__ == '__main__':
    sys.exit(main())
