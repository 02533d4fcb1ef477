# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controller node: answers each measurement with a command."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
import gc
import sys
import threading
import time
from typing import Any

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_srvs.srv import Trigger

from koopman_ros.control import events, MANUAL, Mode, State, StepReport
from koopman_ros.core.message_fields import base_name
from koopman_ros.core.status import level_words
from koopman_ros.core.time_base import Advance
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.evaluation import MeasurementBuffer
from koopman_ros.event_log import records
from koopman_ros.parameters.controller import built, ControllerParameters, OF_THE_MODEL, table_of
from koopman_ros.parameters.model_checks import (
    load_suitable,
    LoadedModel,
    ModelCheckContext,
    rests_outside,
)
from koopman_ros.parameters.signal_topics import (
    bundled_plants,
    plant_defaults,
    signals_of,
    SignalTopics,
    system_of,
    words_of,
)
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.ros import controller_status as status
from koopman_ros.ros import topics
from koopman_ros.ros.control_loop import Commanded, ControlLoop
from koopman_ros.ros.controller_messages import RecordPublisher, ReportPublisher
from koopman_ros.ros.diagnostics import TaskReport
from koopman_ros.ros.host import run_loops
from koopman_ros.ros.hosted import wall_timer
from koopman_ros.ros.latch_file import LatchFile
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.measurements import Measurements, Sample
from koopman_ros.ros.model_reload import ModelReload
from koopman_ros.ros.operator_requests import OperatorRequests
from koopman_ros.ros.process import run
from koopman_ros.ros.rclpy_internals import events_executor
from koopman_ros.ros.signals import SignalPublisher
from koopman_ros.ros.time_conversion import stamp_message
from koopman_ros.ros.timing import Timing
from koopman_ros.ros.watchdog import PERIOD, Watchdog

# A measurement and the inputs that acted on it are stamped no further apart.
_SAME_TIME_NS = 2 * NANOSECONDS
_SOURCES_WINDOW = 10.0  # s, where no time-out of the measurements says how long


class ControllerNode(ManagedNode):
    """
    Carry messages to and from the control step.

    Its topics and services are in docs/reference/interfaces.md.

    All runs in the executor's thread, but for the watch over silence while that thread is busy.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('controller', **options)
        self._watchdog: Watchdog | None = None
        given = self.given()
        system = system_of(given)
        model = str(given.get('model') or plant_defaults(system, 'controller').get('model', ''))
        if not model:
            raise ConfigurationError(
                f'no model is known for the system {system!r}: set model, or set system to one of '
                f'{", ".join(bundled_plants())}')
        loaded = load_suitable(model, force=bool(given.get('load_rejected_model', False)))
        self._table = table = table_of(loaded.model, given)
        self._settings = self.declare_table(table, OF_THE_MODEL)
        self._signals = signals_of(
            loaded.model, self._settings.tuning.controlled, self._settings.states)
        self._loaded: LoadedModel | None = loaded
        # before the node became inactive: its last command is still in force at the plant
        self._last = State()
        self._latch = LatchFile(self)

    def configure(self) -> None:
        """Load the model and create the loop, which does not command yet."""
        table = self._table
        self._settings = parameters = self.current(table)
        # the one of the start, unless its name was changed since then
        loaded, self._loaded = self._loaded, None
        if loaded is None or loaded.name != parameters.model:
            loaded = load_suitable(parameters.model, self._signals,
                                   force=parameters.load_rejected_model)
        signals = self._signals
        self._models = ModelReload(
            self, loaded, signals, self._model_situation,
            lambda: self._exchange(records.MODEL, {'model': self._models.in_force.identity}),
            lambda: self._diagnostics.publish_if_changed())
        self._timing, self._recent = Timing(self), MeasurementBuffer()
        self._loop = ControlLoop(
            built(parameters, loaded.model), self._timing, parameters.measurement_timeout,
            lambda command, stamp_ns: self._commands.send(
                command, stamp_message(stamp_ns), self._measurements.frame_id),
            lambda event, outcome: self._records.publish_event(event, outcome))
        self._report_lock = threading.Lock()
        self._report = self._logged = StepReport(
            Mode.AUTOMATIC, next(iter(self._loop.controller.levels)))
        self._safe_input_warning = self._dead_time_change = ''
        # no status is collected until then, unless the level or the presence of a reason changes
        self._last_status, self._status_pending = (0.0, '', False), False
        self._received = time.monotonic()  # when the commands last had subscribers, or none went
        self._counts = status.Counts()
        self._measured = np.full(len(signals.states), np.nan)
        self._connect(SignalTopics.of(signals, parameters))
        self.diagnostics.hardware_id = loaded.model.provenance.plant or parameters.system
        self._diagnostics = self.diagnostics.add_group(self._statuses, status.TASKS)
        self.follow_table(table, parameters, self._on_parameters, self._models.accept)
        self.get_logger().info(self._models.in_force.about)
        self._check_safe_input()
        # objects of the start are not searched for garbage between two samples
        gc.freeze()
        self._watchdog = Watchdog(self._on_busy_executor)
        self._watchdog.start()

    def _connect(self, wiring: SignalTopics) -> None:
        """Create publishers, subscriptions, services and the timer of the watch."""
        exclusive = self._exclusive_topics(wiring)
        self._endpoints = endpoints = topics.EndpointMonitor(
            self, lambda: self._diagnostics.publish_if_changed(), exclusive)
        self._commands = SignalPublisher(wiring.commands, self._signals.inputs, endpoints.publish)
        self._reports = ReportPublisher(endpoints, wiring)
        self._measurements = Measurements(
            self, endpoints, wiring, exclusive, self._settings, self._answer)
        self._requests = OperatorRequests(
            self, endpoints, wiring, self._loop, self._measurements.applied, self._report_status)
        # a group of its own, or measurements would wait until a model is read
        self.create_service(Trigger, '~/reload_model', self._models.on_reload,
                            callback_group=MutuallyExclusiveCallbackGroup())
        wall_timer(self, PERIOD, self._on_watch)
        self._records = RecordPublisher(
            endpoints, lambda: records.snapshot(
                self._loop.state, self._table.values(self._settings),
                self._models.in_force.identity))

    def activate(self) -> None:
        """Begin to command, from the present inputs; earlier set-point requests are kept."""
        with self._loop.lock:
            self._timing, self._received = Timing(self), time.monotonic()
            self._loop.begin(self._timing, self._last,
                             self._settings.tuning.safe_latch and self._latch.marked)
            self._measurements.begin(
                self._timing, lambda: self._settings.measurement_timeout or _SOURCES_WINDOW,
                lambda: self._loop.state.command is not None)
            self._records.start()

    def deactivate(self) -> None:
        """Discard waiting measurements; a command that the watchdog is sending still goes out."""
        with self._loop.lock:
            self._loop.active = False
            self._measurements.end()
            self._latch.update(self._loop.state.supervisor.latched)
            if self._loop.state.command is not None:
                self._last = self._loop.state

    def complete(self) -> None:
        """Stop watchdog and model reload before the middleware shuts down."""
        if self._watchdog is not None:
            self._watchdog.end()
            self._models.end()

    def _exclusive_topics(self, wiring: SignalTopics) -> dict[str, str]:
        """Return the action on each topic on which only one node may publish."""
        own = self._signals.defaults().values()
        clock = {topics.CLOCK: 'publish the time'} if (
            self.get_parameter('use_sim_time').value) else {}
        return {**clock, **{place.topic: f'{verb} the {what}' for verb, places in (
            ('command', {base_name(name, self._signals.inputs[name]): place
                         for name, place in wiring.commands.items()}),
            ('publish', wiring.measured)) for what, place in places.items()
            # a message of named values may be one of several that make up a sample, but not on
            # the topic that is named after one of them
            if '[' not in place.field or place.topic in own}}

    def _answer(self, sample: Sample) -> None:
        stamp_ns, arrived, before = sample.stamp_ns, self._timing.now(), self._loop.state
        advance = self._timing.arrive(
            stamp_ns, arrived, self._settings.measurement_timeout, sample.two_sources)
        if advance is Advance.TWO_SOURCES and before.command is not None:
            self._measured = sample.values
            self._counts.measurements += 1
            self._counts.rejected += 1
            if (held := self._loop.hold_between_sources(stamp_ns)) is not None:
                self._report_command(held)
            return
        since_ns = stamp_ns if before.time_ns is None else before.time_ns
        countable = None if advance is Advance.OLD else self._timing.countable(
            max(0.0, (stamp_ns - since_ns) / NANOSECONDS), stamp_ns, arrived)
        applied = self._measurements.applied
        measured = applied.at(stamp_ns, _SAME_TIME_NS)
        # the first command after an activation begins from the measured inputs, or else from the
        # last command before the node became inactive
        present = applied.latest if self._last.command is None else self._last.command
        disturbances, ages = self._measurements.disturbances.with_ages(stamp_ns)
        event = events.Measurement(stamp_ns, sample.values, measured, countable, disturbances,
                                   ages, sample.quality)
        outcome = self._loop.answer(event, present if measured is None else measured, arrived,
                                    advance is not Advance.OLD)
        if outcome is None or outcome.report is None:
            self.get_logger().error(
                'no command for a measurement, because a control step takes longer than the '
                'watchdog waits: choose a smaller model', throttle_duration_sec=1.0)
            return
        report = outcome.report
        acting = outcome.state.disturbances
        # behind a lag of the model the command counts
        model = self._loop.controller.model
        recent = replace(event, applied=None) if model.lagged != model.commanded else event
        self._recent.add(
            recent, report.measurement, before.command, self._settings.model_check_length,
            None if acting is None else acting.value)
        self._measured = sample.values
        self._counts.take(report)
        self._report_command(Commanded(report, stamp_ns))

    def _on_watch(self) -> None:
        self._timing.busy = False
        assert self._watchdog is not None
        self._watchdog.beat()
        commanded = self._loop.watch(self._timing.silence, acting=True)
        if commanded is not None:
            self._report_command(commanded)
        if self._loop.state.command is None or not self.active or all(
                map(topics.has_subscribers, self._commands.publishers)):
            self._received = time.monotonic()
        if self.active:
            self._latch.update(self._loop.state.supervisor.latched)
        if self._status_pending:
            self._report_status()
        with self._loop.lock:
            self._records.watch()

    def _on_busy_executor(self, seconds: float) -> None:
        """Command in place of the busy executor; called in the watchdog's thread."""
        commanded = self._loop.watch(self._timing.busy_silence(seconds))
        if commanded is None:
            return
        self._timing.busy = True
        # the executor may be stuck in there
        if self._report_lock.acquire(blocking=False):
            try:
                self._publish_report(commanded)
                self._diagnostics.publish_if_changed()
            finally:
                self._report_lock.release()

    def _publish_report(self, commanded: Commanded) -> None:
        self._report = commanded.report
        self._reports.publish(self._signals, commanded.report,
                              stamp_message(commanded.stamp_ns), self._measurements.frame_id)

    def _report_command(self, commanded: Commanded) -> None:
        """Publish and log the report of a command."""
        report = commanded.report
        with self._report_lock:
            self._publish_report(commanded)
        if report.level not in (self._logged.level, MANUAL):
            change = f'{level_words(self._logged.level)} -> {level_words(report.level)}'
            if report.depth > self._logged.depth:
                why = words_of(self._signals)(report.reason)
                self.get_logger().warning(f'{change}: {why}', throttle_duration_sec=1.0)
            else:
                self.get_logger().info(change, throttle_duration_sec=1.0)
            self._logged = report
        if report.measurement.clock_went_back:
            self.get_logger().warning('the stamp of the measurement jumped back by more than 1 s: '
                                      'controller time is reset', throttle_duration_sec=1.0)
        self._report_status()

    def _report_status(self) -> None:
        """Publish a changed status; of many measurements and requests within PERIOD the last."""
        report, (until, *shown) = self._report, self._last_status
        now = time.monotonic()
        self._status_pending = [report.level, report.reason is None] == shown and now < until
        if not self._status_pending:
            self._last_status = now + PERIOD, report.level, report.reason is None
            self._diagnostics.publish_if_changed()

    def _statuses(self) -> dict[str, TaskReport]:
        loop = self._loop
        situation = status.StatusContext(
            loop.controller, self._settings, self._signals, loop.state, self._report,
            self._counts, self._timing, self._measurements.assembler, self._measurements.awaited,
            self._measured,
            complaint=self._endpoints.complaint or self._measurements.complaint,
            unheard=[publisher.topic_name for publisher in self._commands.publishers
                     if not topics.has_subscribers(publisher)],
            unheard_for=time.monotonic() - self._received,
            setpoint_received=self._requests.setpoint_received,
            request='; '.join(filter(None, (
                self._requests.complaint, self._requests.sender_gone))),
            model_rejected=self._models.complaint,
            model=lambda: {**self._models.figures(),
                           'dead time change': self._dead_time_change or 'none',
                           'safe input': self._safe_input_warning or 'within reach'})
        return status.statuses(situation) if self.active else status.inactive(situation)

    def _model_situation(self) -> ModelCheckContext:
        return ModelCheckContext(self._settings, self._loop.state, self._measured,
                                 self._recent.windows(self._settings.model_check_length))

    def _on_parameters(self, parameters: ControllerParameters) -> None:
        before = self._table.values(self._settings)
        self._settings, self._loop.timeout = parameters, parameters.measurement_timeout
        fields: dict[str, object] = {'parameters': {
            name: value for name, value in self._table.values(parameters).items()
            if value != before[name]}}
        if self._models.take_over():
            fields['model'] = self._models.in_force.identity
        self._exchange(records.PARAMETERS, fields)

    def _exchange(self, event: str, fields: Mapping[str, object]) -> None:
        """Switch to the present parameters and model."""
        before = self._loop.controller
        self._loop.exchange(built(self._settings, self._models.in_force.model),
                            lambda: self._records.publish(event, fields))
        if change := status.dead_time_change(before, self._loop.controller):
            self._dead_time_change = change
            self.get_logger().info(change)
        model = self._loop.controller.model
        if model.states.names != before.model.states.names:
            # the estimate changed its meaning; the last message is about another model
            self._signals = signals_of(model, self._signals.controlled, self._signals.states)
            self._report = replace(self._report, estimate=None, target=None)
        self._check_safe_input()
        self._diagnostics.publish_if_changed()

    def _check_safe_input(self) -> None:
        """Warn if the safe input leads out of the model's range, once for each reason."""
        before = self._safe_input_warning
        self._safe_input_warning = rests_outside(self._loop.controller)
        if self._safe_input_warning not in ('', before):
            self.get_logger().warning(self._safe_input_warning)


def main(args: list[str] | None = None) -> int:
    """Run the controller node, or with ``--loops`` one for each of many loops."""
    return run('controller', ControllerNode, args, partial(
        run_loops, 'controller', ControllerNode), events_executor)


if __name__ == '__main__':
    sys.exit(main())
