# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controller node: answers each measurement with a command."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
import gc
import math
import sys
import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_srvs.srv import SetBool, Trigger

from koopman_ros.arrays import Array
from koopman_ros.assembler import Assembler
from koopman_ros.control import (
    Arrival,
    Controller,
    events,
    HOLD,
    MANUAL,
    Mode,
    Recent,
    Report,
    SAFE,
    Setpoint,
    State,
)
from koopman_ros.control.events import Event, ModeChange, Silence
from koopman_ros.parameters.controller import built, ControllerParameters, table_of
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.parameters.wire import (
    LONGEST_FRAME_ID,
    preset,
    shipped,
    signals_of,
    system_of,
    Wiring,
)
from koopman_ros.reasons import Code, level_words
from koopman_ros.replay import records
from koopman_ros.ros import controller_messages as messages
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_message
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.model_reload import (
    load_suitable,
    LoadedModel,
    ModelReload,
    rests_outside,
    Situation,
)
from koopman_ros.ros.node import Level, Status, wall_timer, words_of
from koopman_ros.ros.process import run
from koopman_ros.ros.signals import Heard, Inlet, Outlet
from koopman_ros.ros.watchdog import PERIOD, Timing, Watchdog
from koopman_ros.time_base import Advance, TimeBase
from koopman_ros.units import display_unit, NANOSECONDS, shown
from koopman_ros.wire import stem

# A measurement and the inputs that acted on it are stamped no further apart.
_SAME_TIME_NS = 2 * NANOSECONDS
_WATCH_STEP = NANOSECONDS // 2  # of plant time between two commands without a measurement
_OVERDUE = 3.0  # usual intervals after which a measurement no longer decides the next command
_SETTLED = 1e-4  # of an input's range: such a change of the command in a watch step is none
_SOURCES_WINDOW = 10.0  # s, where no time-out of the measurements says how long
_REFUSAL_SHOWN = 60.0  # s for which a request that was refused or limited is a warning
_PATIENCE = 0.5  # s that the first answer waits for the measured inputs
_CAUSES = {None: Code.NO_MEASUREMENT, Advance.OLD: Code.STAMPS_STAND,
           Advance.TWO_SOURCES: Code.TWO_SOURCES}
# A step that the watchdog has overtaken so often is given up, and its measurement with it.
_ATTEMPTS = 2


@dataclass(frozen=True, slots=True)
class _Sample:
    """A measurement that is to be answered."""

    stamp: Time
    stamp_ns: int
    values: Array  #: (n_y,) in the units of the signals
    two_sources: bool  #: whether several publishers send such measurements in turn


class ControllerNode(ManagedNode):
    """
    Carry messages to and from the control step; docs/interfaces.md has its topics and services.

    All runs in the executor's thread, but for the watch over silence while that thread is busy.
    The lock is held where the state changes and its command goes out, not while a measurement is
    answered, so that the watchdog goes by the last state that commanded.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('controller', **options)
        self._watchdog: Watchdog | None = None
        given = self.given()
        system = system_of(given)
        model = str(given.get('model') or preset(system, 'controller').get('model', ''))
        if not model:
            raise ConfigurationError(
                f'there is no model of the system {system!r}: name one in model, or in system one '
                f'of {", ".join(shipped())}')
        loaded = load_suitable(model, force=bool(given.get('load_refused_model', False)))
        self._table = table = table_of(loaded.model, given)
        self._settings = self.declare_table(table)
        self._signals = signals_of(
            loaded.model, self._settings.tuning.controlled, self._settings.states)
        self._loaded: LoadedModel | None = loaded
        # (n_u,) last command before the node became inactive, which is still in force at the plant
        self._last_command: Array | None = None

    def configure(self) -> None:
        """Load the model and make what the loop needs; nothing is commanded yet."""
        table = self._table
        self._settings = parameters = self.current(table)
        # the one of the start, unless its name was changed since then
        loaded, self._loaded = self._loaded, None
        if loaded is None or loaded.name != parameters.model:
            loaded = load_suitable(parameters.model, self._signals,
                                   force=parameters.load_refused_model)
        signals = self._signals
        self._words = words_of(signals)
        self._models = ModelReload(
            self, loaded, signals, lambda: Situation(
                self._settings, self._state, self._measured,
                self._recent.windows(self._settings.model_check_length)),
            lambda: self._exchange(records.MODEL, {'model': self._models.in_force.identity}),
            lambda: self._diagnostics.publish_if_changed())
        self._controller = self._built()
        self._state = State()
        self._recent = Recent()
        self._lock, self._telling = threading.Lock(), threading.Lock()
        self._report = self._logged = Report(Mode.AUTOMATIC, next(iter(self._controller.levels)))
        # why the last request was refused or limited, and when
        self._request, self._requested = '', 0.0
        self._rests_outside = ''
        # until when a status is not looked at again while level and whether there is a reason stay
        self._told, self._untold = (0.0, '', False), False
        self._received = time.monotonic()  # when the commands last had subscribers, or none went
        self._counts = messages.Counts()
        # why the watch holds the command, and whether the law still changes it in a silence
        self._held_for: Code | None = None
        self._settling = False
        self._measured, self._timing = np.full(len(signals.states), np.nan), Timing(self)
        self._assembler = Assembler(
            tuple(signals.states), round(parameters.synchronisation_tolerance * NANOSECONDS))
        self._applied: dict[str, tuple[int, float]] = {}  # stamp and value by name of the input
        self._waiting: list[_Sample] = []  # measurements that came before the measured inputs
        self._patience: Any = None  # a timer
        self._frame_id, self._frame_length = '', 0  # the length where it is too long

        wiring = Wiring(signals, parameters.states, parameters.inputs)
        self._matching = matching = topics.Matching(
            self, lambda: self._diagnostics.publish_if_changed(), self._single(wiring))
        # by topic of the measurements with one publisher: the numbers of its messages
        self._sources = {place.topic: TimeBase(late=-1) for place in wiring.measured.values()
                         if place.topic in self._single(wiring)}
        self._commands = Outlet(wiring.commands, signals.inputs, matching.publish)
        self._active = Outlet(wiring.active_setpoints, signals.states, self._latched)
        self._predicted = Outlet(wiring.predicted, signals.states, matching.publish)
        self._internals = matching.publish(topics.CONTROLLER_STATE)
        self._plan = matching.publish(topics.CONTROLLER_PLAN)
        self._active_limits = matching.publish(topics.ACTIVE_LIMITS)
        self._published_setpoint: Array | None = None
        self.diagnostics.hardware_id = loaded.model.provenance.plant or parameters.system
        self._diagnostics = self.diagnostics.add(messages.CONTROL, self._status)
        self._conditions = {name: self.diagnostics.add(name, partial(self._condition, name))
                            for name in messages.CONDITIONS}
        # volatile, so that `ros2 topic pub` matches
        for name, place in wiring.setpoints.items():
            Inlet(self, matching.subscribe, {name: place}, signals.states, self._on_setpoint)
        for name, place in wiring.manual.items():
            Inlet(self, matching.subscribe, {name: place}, signals.inputs, self._on_manual)
        self._inputs = Inlet(
            self, matching.subscribe, wiring.applied, signals.inputs, self._on_applied)
        measured = Inlet(
            self, matching.subscribe, wiring.measured, signals.states, self._on_measurement)
        if measured.unstamped:
            self.get_logger().warning(
                f'messages of {", ".join(measured.unstamped)} have no stamp: they are stamped at '
                'their arrival')
        self.create_service(SetBool, '~/set_automatic', self._on_set_automatic)
        # a group of its own, or measurements would wait until a model is read
        self.create_service(Trigger, '~/reload_model', self._models.on_reload,
                            callback_group=MutuallyExclusiveCallbackGroup())
        wall_timer(self, PERIOD, self._on_watch)
        self._records = messages.RecordPublisher(
            self._matching, lambda: records.snapshot(
                self._state, table.values(self._settings), self._models.in_force.identity),
            self._lock)
        self.follow_table(table, parameters, self._on_parameters, self._models.accept)
        self.get_logger().info(self._models.in_force.about)
        self._warn_of_rest()
        # what is there by now stays: nobody is to look through it for garbage between two samples
        gc.freeze()
        self._watchdog = Watchdog(self._on_busy)
        self._watchdog.start()

    def activate(self) -> None:
        """Begin to command, from the present inputs; earlier set-point requests are kept."""
        with self._lock:
            asked = self._state.setpoint
            self._state = State(self._state.mode, Setpoint(
                asked.requested, scheduled=asked.scheduled))
            self._waiting.clear()
            self._timing, self._received = Timing(self), time.monotonic()
            self._sources = {topic: TimeBase(late=-1) for topic in self._sources}
            self._held_for, self._settling = None, False
            self._records.start()

    def deactivate(self) -> None:
        """Answer nothing that waits; a command of the watchdog that is on its way goes out."""
        with self._lock:
            self._waiting.clear()
            if self._state.command is not None:
                self._last_command = self._state.command

    def complete(self) -> None:
        """Let nobody command while the middleware is taken down."""
        if self._watchdog is not None:
            self._watchdog.end()
            self._models.end()

    def _single(self, wiring: Wiring) -> dict[str, str]:
        """Return what is done on topics on which only one node may publish."""
        own = self._signals.defaults().values()
        return {place.topic: f'{verb} the {what}' for verb, places in (
            ('command', {stem(name, self._signals.inputs[name]): place
                         for name, place in wiring.commands.items()}),
            ('publish', wiring.measured)) for what, place in places.items()
            # a message of named values may be one of several that make up a sample, but not on
            # the topic that is named after one of them
            if '[' not in place.field or place.topic in own}

    def _latched(self, topic: str, kind: Any) -> Any:
        return self._matching.publish(topic, kind, topics.LATCHED_QOS)

    def _on_measurement(self, heard: Heard) -> None:
        self._frame_id = heard.frame_id[:LONGEST_FRAME_ID]
        length, stamp_ns = len(heard.frame_id), heard.stamp_ns
        self._frame_length = length if length > LONGEST_FRAME_ID else 0
        source, at = self._sources.get(heard.topic), self._timing.now()
        if source is not None and heard.number is not None:
            source.take(heard.number, at[0], self._window)
        late = self._assembler.late.total()
        whole = self._assembler.take(stamp_ns, heard.values)
        if self._assembler.late.total() > late:
            self._timing.ignore(at)
        if whole is None or not self.active:
            return
        two_sources = any(one.conflict or (one.newest is None and self._matching.shared(topic))
                          for topic, one in self._sources.items())
        sample = _Sample(heard.stamp if whole[0] == stamp_ns else stamp_message(whole[0]),
                         *whole, two_sources)
        # whether the measured inputs will be known in a moment
        if self._waiting or (
                self._state.command is None and len(self._applied) < len(self._signals.inputs)
                and self._patience is None and self._inputs.published()):
            self._waiting.append(sample)
            if self._patience is None:
                self._patience = wall_timer(self, _PATIENCE, self._answer_waiting)
            return
        self._answer(sample)

    def _on_applied(self, heard: Heard) -> None:
        for name, value in heard.values.items():
            self._applied[name] = (heard.stamp_ns, value)
        if self._waiting and len(self._applied) == len(self._signals.inputs):
            self._answer_waiting()

    def _answer_waiting(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
        waiting, self._waiting = self._waiting, []
        for sample in waiting:
            self._answer(sample)

    def _known_inputs(self, stamp_ns: int | None = None) -> Array | None:
        """Return the inputs (n_u,) measured last, if they all are, and go with a stamp."""
        found = [self._applied.get(name) for name in self._signals.inputs]
        if any(entry is None or (
                stamp_ns is not None and abs(entry[0] - stamp_ns) > _SAME_TIME_NS)
                for entry in found):
            return None
        return np.array([entry[1] for entry in found if entry is not None])

    @property
    def _window(self) -> float:
        """Shortest time between two changes of the source, in s, where one may take over."""
        return self._settings.measurement_timeout or _SOURCES_WINDOW

    def _present_inputs(self, stamp_ns: int) -> Array | None:
        """
        Return the inputs (n_u,) that the first command after an activation begins from, or None.

        They are those measured at about that stamp, or else the last command before the node
        became inactive, or else an older measurement.
        """
        if (measured := self._known_inputs(stamp_ns)) is not None:
            return measured
        return self._known_inputs() if self._last_command is None else self._last_command

    def _answer(self, sample: _Sample) -> None:
        stamp_ns, arrived = sample.stamp_ns, self._timing.now()
        advance = self._timing.arrive(
            stamp_ns, arrived, self._settings.measurement_timeout, sample.two_sources)
        if advance is Advance.TWO_SOURCES and self._state.command is not None:
            self._answer_neither(sample)
            return
        since_ns = stamp_ns if self._state.time_ns is None else self._state.time_ns
        countable = None if advance is Advance.OLD else self._timing.countable(
            max(0.0, (stamp_ns - since_ns) / NANOSECONDS), stamp_ns, arrived)
        for _ in range(_ATTEMPTS):
            before = state = self._state
            done: list[tuple[Event, events.Outcome]] = []
            if state.command is None and (known := self._present_inputs(stamp_ns)) is not None:
                initial = events.Initialisation(known)
                done.append((initial, events.apply(self._controller, state, initial)))
                state = done[0][1].state
            asked = events.Measurement(stamp_ns, sample.values, self._known_inputs(stamp_ns),
                                       countable)
            outcome = events.apply(self._controller, state, asked)
            assert outcome.command is not None and outcome.report is not None
            with self._lock:
                if self._state is not before:
                    # the watchdog has commanded meanwhile: the answer must go on from there
                    continue
                self._state = outcome.state
                self._commands.send(outcome.command, sample.stamp, self._frame_id)
                for event, led_to in (*done, (asked, outcome)):
                    self._records.publish_event(event, led_to)
                if advance is not Advance.OLD:
                    self._timing.note(stamp_ns, arrived)
                    self._held_for, self._settling = None, False
                self._timing.answered()
            break
        else:
            self.get_logger().error(
                'a measurement is not answered, as a control step takes longer than the watchdog '
                'waits: choose a smaller model', throttle_duration_sec=1.0)
            return
        report = outcome.report
        self._recent.add(
            asked, report.measurement, before.command, self._settings.model_check_length)
        self._measured = sample.values
        self._counts.measurements += 1
        self._counts.late += report.measurement.arrival is Arrival.LATE
        self._counts.missed += report.measurement.missed
        self._counts.refused += report.measurement.arrival is Arrival.REJECTED
        if report.reason is not None and (cause := report.reason.cause) is not None:
            self._counts.late_plans += cause.code is Code.TOO_LATE
            self._counts.unsolved_plans += cause.code in (Code.PLAN_NOT_SOLVED, Code.PLAN_MOVES)
        self._tell(report, sample.stamp)

    def _answer_neither(self, sample: _Sample) -> None:
        """Hold the command, since it is not known which of two sources measures the plant."""
        with self._lock:
            watched = self._command_unmeasured(
                self._timing.silence, Code.TWO_SOURCES, sample.stamp)
            if watched is None and self._state.command is not None:
                self._commands.send(self._state.command, sample.stamp, self._frame_id)
        self._measured = sample.values
        self._counts.measurements += 1
        self._counts.refused += 1
        if watched is not None:
            self._tell(*watched)

    def _on_watch(self) -> None:
        self._timing.busy = False
        assert self._watchdog is not None
        self._watchdog.beat()
        watched = self._watch(self._timing.silence, acting=True)
        if watched is not None:
            self._tell(*watched)
        if self._state.command is None or not self.active or all(
                map(topics.heard, self._commands.publishers)):
            self._received = time.monotonic()
        if self._untold:
            self._say(self._report, time.monotonic())
        with self._lock:
            self._records.watch()

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

    def _watch(self, silence: float, acting: bool = False) -> tuple[Report, Time] | None:
        """
        Command what has to be commanded without a measurement; return what was.

        :param acting: whether the law may be computed for what the operator requests.
        """
        with self._lock:
            timeout = self._settings.measurement_timeout
            if not self.active:
                return None
            if timeout and silence > timeout and self._state.time_ns is not None:
                why = self._timing.no_news(timeout)
                return self._command_unmeasured(silence, _CAUSES[why])
            if self._manual_waits(silence) or (acting and self._setpoint_waits(silence)):
                return self._command_unmeasured(silence, None)
            return None

    def _command_unmeasured(self, silence: float, cause: Code | None, stamp: Time | None = None
                            ) -> tuple[Report, Time] | None:
        """
        Command without a measurement, if it is time to; return what was commanded.

        The caller holds the lock.

        :param cause: as of :class:`Silence`.
        :param stamp: of the command; None for the present time of the measurements' clock.
        """
        state = self._state
        now_ns = self._timing.now()[2] if state.time_ns is None else (
            state.time_ns + round(silence * NANOSECONDS))
        if state.commanded_ns is not None and cause is self._held_for and (
                now_ns - state.commanded_ns < _WATCH_STEP):
            return None
        silence_ends = Silence(now_ns, cause)
        outcome = events.apply(self._controller, state, silence_ends)
        if outcome.command is None or outcome.report is None:
            return None
        self._state, self._held_for = outcome.state, cause
        self._timing.commanded()
        if state.command is not None:
            moved = np.abs(outcome.command - state.command)
            limits = self._controller.tuning.limits
            self._settling = cause is None and bool(
                (moved > _SETTLED * (limits.upper - limits.lower)).any())
        stamp = stamp_message(now_ns) if stamp is None else stamp
        self._commands.send(outcome.command, stamp, self._frame_id)
        self._records.publish_event(silence_ends, outcome)
        return outcome.report, stamp

    def _manual_waits(self, silence: float) -> bool:
        """Tell whether a manual command is not reached, and no measurement came lately."""
        state, wanted = self._state, self._state.manual_input
        return (state.mode is Mode.MANUAL and wanted is not None and state.command is not None
                and silence * NANOSECONDS > _WATCH_STEP and not np.array_equal(
                    self._controller.tuning.limits.within(wanted), state.command))

    def _setpoint_waits(self, silence: float) -> bool:
        """Tell whether a set-point is not reached, and a measurement is overdue."""
        state, setpoint = self._state, self._state.setpoint
        interval = 0.0 if math.isinf(state.interval) else state.interval
        if (state.mode is not Mode.AUTOMATIC or state.time_ns is None
                or state.supervisor.level in (HOLD, SAFE)
                or silence <= max(_OVERDUE * interval, 1.0)):
            return False
        now_ns, requested = state.time_ns + round(silence * NANOSECONDS), setpoint.requested
        moves = (requested is not None and setpoint.active is not None
                 and bool((np.abs(requested - setpoint.active) > 0.0).any()))
        return self._settling or moves or any(at <= now_ns for at, _ in setpoint.scheduled)

    def _tell(self, report: Report, stamp: Time) -> None:
        """Publish and log what is known beside the command."""
        with self._telling:
            self._publish_beside(report, stamp)
        if report.level not in (self._logged.level, MANUAL):
            change = f'{level_words(self._logged.level)} -> {level_words(report.level)}'
            if report.depth > self._logged.depth:
                why = self._words(report.reason)
                self.get_logger().warning(f'{change}: {why}', throttle_duration_sec=1.0)
            else:
                self.get_logger().info(change, throttle_duration_sec=1.0)
            self._logged = report
        if report.measurement.clock_went_back:
            self.get_logger().warning('the measurement is older than the last one: time starts '
                                      'afresh', throttle_duration_sec=1.0)
        # of many measurements in a moment the first is told of, and the last, by the watch at the
        # latest
        until, *told = self._told
        now = time.monotonic()
        self._untold = [report.level, report.reason is None] == told and now < until
        if not self._untold:
            self._say(report, now)

    def _say(self, report: Report, now: float) -> None:
        self._told = now + PERIOD, report.level, report.reason is None
        self._untold = False
        self._diagnostics.publish_if_changed()

    def _publish_beside(self, report: Report, stamp: Time) -> None:
        self._report = report
        target, predicted = report.target, report.measurement.predicted
        if target is not None and target.setpoint is not self._published_setpoint and (
                self._published_setpoint is None
                or (target.setpoint != self._published_setpoint).any()):
            self._published_setpoint = target.setpoint
            self._active.send(target.setpoint, stamp, self._frame_id)
        if predicted is not None and self._predicted.heard():
            self._predicted.send(predicted, stamp, self._frame_id)
        if topics.heard(self._internals):
            self._internals.publish(messages.internals(
                self._signals, report, stamp, self._frame_id))
        if (plan := report.command.plan) is not None:
            if topics.heard(self._plan):
                self._plan.publish(messages.planned(
                    self._signals, plan, stamp, self._frame_id))
            if topics.heard(self._active_limits):
                self._active_limits.publish(messages.active_limits(
                    self._signals, plan, stamp, self._frame_id))

    def _on_setpoint(self, heard: Heard) -> None:
        (name, value), = heard.values.items()
        several = len(self._signals.controlled) > 1
        if self._change(events.SetpointRequest(
                heard.stamp_ns, np.array([value]), (name,) if several else None)):
            scheduled = any(entry[0] == heard.stamp_ns
                            for entry in self._state.setpoint.scheduled)
            when = f', holds from {heard.stamp_ns / NANOSECONDS:.3f} s on' if scheduled else ''
            unit = self._signals.states[name]
            self.get_logger().info(
                f'set-point {shown(value, unit):.6g} {display_unit(unit)} of {name} accepted'
                f'{when}', throttle_duration_sec=1.0)

    def _on_manual(self, heard: Heard) -> None:
        held = self._state.manual_input
        if held is None:
            held = self._state.command
        # the others stay
        asked = np.array([heard.values.get(name, math.nan if held is None else held[i])
                          for i, name in enumerate(self._signals.inputs)])
        if self._state.command is None and (known := self._known_inputs()) is not None:
            self._change(events.Initialisation(known))
        self._change(events.ManualCommand(asked))

    def _on_set_automatic(self, request: SetBool.Request, response: SetBool.Response
                          ) -> SetBool.Response:
        mode = Mode.AUTOMATIC if request.data else Mode.MANUAL
        self._change(ModeChange(mode))
        # the law moves the command from where the operator left it, with measurements or without
        self._settling = mode is Mode.AUTOMATIC
        response.success, response.message = True, f'{mode.value} mode'
        self.get_logger().info(response.message)
        return response

    def _change(self, event: Event) -> bool:
        """Apply what is not answered by a command; return whether it is not refused."""
        with self._lock:
            outcome = events.apply(self._controller, self._state, event)
            self._state = outcome.state
            self._records.publish_event(event, outcome)
        note = f'request refused: {self._words(outcome.refused)}' if outcome.refused else (
            self._limited(event.value) if isinstance(event, events.ManualCommand) else '')
        self._request, self._requested = note, time.monotonic()
        if note:
            self.get_logger().warning(note, throttle_duration_sec=1.0)
        if outcome.refused is None and isinstance(event, events.SetpointRequest):
            self._counts.setpoint_received = True
        self._conditions[messages.REQUESTS].publish_if_changed()
        self._diagnostics.publish_if_changed()
        return outcome.refused is None

    def _limited(self, asked: Array) -> str:
        """Return what becomes of a manual command (n_u,) outside the limits, or nothing."""
        within = self._controller.tuning.limits.within(asked)
        parts = [f'manual {stem(name, unit)} {shown(wanted, unit):.2f} {display_unit(unit)} is '
                 f'limited to {shown(limit, unit):.2f} {display_unit(unit)}'
                 for (name, unit), wanted, limit in zip(
                     self._signals.inputs.items(), asked.tolist(), within.tolist(), strict=True)
                 if wanted != limit]
        return ', '.join(parts)

    def _built(self) -> Controller:
        return built(self._settings, self._models.in_force.model)

    def _on_parameters(self, parameters: ControllerParameters) -> None:
        before = self._table.values(self._settings)
        self._settings = parameters
        fields: dict[str, object] = {'parameters': {
            name: value for name, value in self._table.values(parameters).items()
            if value != before[name]}}
        if self._models.take_over():
            fields['model'] = self._models.in_force.identity
        self._exchange(records.PARAMETERS, fields)

    def _exchange(self, event: str, fields: Mapping[str, object]) -> None:
        """Put the parameters and the model of now in force."""
        with self._lock:
            predecessor, self._controller = self._controller, self._built()
            if predecessor.model.states.names != self._controller.model.states.names:
                # what is estimated is something else; what was last said is of another model
                self._signals = signals_of(
                    self._controller.model, self._signals.controlled, self._signals.states)
                self._report = replace(self._report, estimate=None, target=None)
            self._state = self._controller.hand_over(predecessor, self._state)
            self._records.publish(event, fields)
        self._warn_of_rest()
        self._diagnostics.publish_if_changed()

    def _warn_of_rest(self) -> None:
        """Say that the safe input leads out of the model's range, once for each reason."""
        before, self._rests_outside = self._rests_outside, rests_outside(
            self._controller)
        if self._rests_outside not in ('', before):
            self.get_logger().warning(self._rests_outside)

    def _open_loop(self) -> Status:
        """Return whether the commands have subscribers."""
        return messages.open_loop(
            [publisher.topic_name for publisher in self._commands.publishers
             if not topics.heard(publisher)], time.monotonic() - self._received)

    def _situation(self) -> messages.Situation:
        frame = (f'the frame_id of the measurement has {self._frame_length} characters, of which '
                 f'{LONGEST_FRAME_ID} are passed on: shorten it at the sensor'
                 ) if self._frame_length else ''
        recent = time.monotonic() - self._requested < _REFUSAL_SHOWN
        return messages.Situation(
            self._controller, self._settings, self._signals, self._state, self._report,
            self._counts, self._timing, self._matching.complaint or frame,
            self._request if recent else '', self._models.refused,
            lambda: {**self._models.figures(),
                     'safe input': self._rests_outside or 'within reach'},
            self._measured, self._assembler, self._open_loop())

    def _condition(self, name: str) -> Status:
        return messages.condition(self._situation(), name) if self.active else Status(
            Level.OK, 'inactive')

    def _status(self) -> Status:
        status = messages.status(self._situation())
        # without measurements answered there is nothing to complain of
        return status if self.active else replace(status, level=Level.OK, message='inactive')


def main(args: list[str] | None = None) -> int:
    """Run the controller node."""
    return run('controller', ControllerNode, args, hosts=True)


if __name__ == '__main__':
    sys.exit(main())
