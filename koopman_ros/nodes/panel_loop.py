# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A loop of the panel: its messages, and the actions of operators on it."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
import os
from pathlib import Path
import time
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import ParameterEvent
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from koopman_ros.core.paths import model_path
from koopman_ros.core.status import reason, StatusCode
from koopman_ros.core.units import conversion, Display, display_unit, NANOSECONDS, printed
from koopman_ros.event_log import records
from koopman_ros.model import load
from koopman_ros.panel.alarm_store import AlarmStore
from koopman_ros.panel.faceplates import Range
from koopman_ros.panel.files import sanitize_text
from koopman_ros.panel.history import HistoryFile
from koopman_ros.panel.learning_watch import LearningWatch
from koopman_ros.panel.model_card import model_card, training_ranges
from koopman_ros.panel.requests import (
    Action,
    Answer,
    AuditEntry,
    MANUAL,
    Requests,
    SETPOINT,
    UNKNOWN,
)
from koopman_ros.panel.snapshot import (
    CONTROL,
    CONTROLLER,
    PANEL,
    PLANT,
    RECORDING,
    REQUESTS,
    TRAINER,
    TRAINING,
)
from koopman_ros.panel.training_report import Learning
from koopman_ros.panel.view_model import LoopViewModel
from koopman_ros.parameters.panel import panel_signals, panel_table, PanelParameters
from koopman_ros.parameters.signal_topics import Signals, SignalTopics, words_of
from koopman_ros.parameters.table import ConfigurationError, ParameterTable
from koopman_ros.ros import remote_node, topics
from koopman_ros.ros.hosted import wall_timer
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.remote_node import RemoteNode
from koopman_ros.ros.repeated_values import RepeatedValues
from koopman_ros.ros.signals import SignalSample, SignalSubscriber
from koopman_ros.ros.time_conversion import stamp_nanoseconds

# The panel never slows a publisher.
_WATCHING = topics.profile(100, reliable=False)
_PERIOD = 0.2  # s between two snapshots
_REMOTE_PERIOD = 0.5  # s between two looks at other nodes
_LOGGED = 300  # characters of an action in the log
#: node, service and type of the service, by action
_SERVICES = {
    'reset': (PLANT, 'reset', Trigger), 'reload': (CONTROLLER, 'reload_model', Trigger),
    'automatic': (CONTROLLER, 'set_automatic', SetBool),
    'clear safe state': (CONTROLLER, 'clear_safe_state', Trigger),
    'train': (TRAINER, 'train', Trigger), 'cancel': (TRAINER, 'cancel_training', Trigger),
    'record': (TRAINER, 'record', SetBool), 'experiment': (TRAINER, 'experiment', SetBool)}
_DONE = ('acknowledge', 'shelve', 'unshelve')  #: actions that the pages have carried out


class Declared(NamedTuple):
    """The parameters of a loop, declared by its node."""

    table: ParameterTable[PanelParameters]
    settings: PanelParameters
    signals: Signals


def declare(node: LoopNode) -> Declared:
    """Declare the parameters of a loop, or of the panel itself."""
    given = node.given()
    present = load(model_path(str(name))) if (name := given.get('model')) else None
    table = panel_table(present, given)
    return Declared(table, node.declare_table(table), panel_signals(present, given))


class PanelLoop:
    """
    Forward the messages of a loop to its view model, and actions of operators to its nodes.

    The pages run in a thread of their own; they read :attr:`snapshot`, which is replaced as a
    whole, and call :meth:`request`.

    :param node: in the namespace of the loop.
    :param declared: parameters of the node.
    """

    def __init__(self, node: LoopNode, declared: Declared) -> None:
        self.node = node
        table, settings, signals = declared
        self._settings, self._signals = settings, signals
        self._wiring = wiring = SignalTopics.of(signals, settings)
        read = settings.read(signals)
        nodes = {PLANT: PLANT, CONTROLLER: settings.controller, TRAINER: settings.trainer}
        #: roles of the loop's nodes by their full names without the first slash
        self.roles = {node.resolve_service_name(name).lstrip('/'): role
                      for role, name in nodes.items()}
        self.view = LoopViewModel(signals, read, settings.span, time.time(), self.roles)
        self.view.limits = settings.limits(signals)
        node.follow_table(table, settings, self._on_parameters)
        self._files = [*self._opened('alarm_file', AlarmStore, self.view.alarms),
                       *self._opened('history_file', HistoryFile, self.view)]
        self.snapshot = self.view.snapshot(time.time())
        self._words = words_of(signals, {
            name: Display(unit, read[name], '.6g') for name, unit in signals.units.items()
            if read[name] != display_unit(unit)})
        self._requests = Requests(
            {SETPOINT: signals.controlled, MANUAL: tuple(signals.inputs)}, self._rejection)
        self._posted: deque[Callable[[], None]] = deque()
        self._wake = node.create_guard_condition(node.guarded(self._on_posted))
        self._repeated = RepeatedValues(node)
        self._training_ranges: dict[str, Range] = {}
        self._model: dict[str, str] = {}
        self._watch = LearningWatch(settings.system, wiring, node.get_namespace(),
                                    node.resolve_topic_name)
        self._subscribe()
        self._operator_actions = self._matching.publish(topics.AUDIT_LOG)
        self._nodes = {role: RemoteNode(
            node, name, {service: kind for of, service, kind in _SERVICES.values() if of == role},
            None if role == PLANT else partial(self.view.take_parameters, role))
            for role, name in {**nodes, PANEL: node.get_name()}.items()}
        wall_timer(node, _PERIOD, self._on_timer)
        wall_timer(node, _REMOTE_PERIOD, self._on_remote_timer)

    def _on_parameters(self, settings: PanelParameters) -> None:
        self._settings, self.view.limits = settings, settings.limits(self._signals)

    def _subscribe(self) -> None:
        matching = self._matching = topics.EndpointMonitor(self.node, lambda: None)
        for kind, qos in (('measured', _WATCHING), ('predicted', _WATCHING),
                          ('measured_disturbances', _WATCHING),
                          ('applied', _WATCHING), ('commands', _WATCHING),
                          ('active_setpoints', topics.LATCHED_QOS)):
            SignalSubscriber(self.node, lambda topic, callback, of,
                             qos=qos: matching.subscribe(topic, callback, of, qos),
                             getattr(self._wiring, kind), self._signals.units,
                             partial(self._on_signal, kind))
        matching.subscribe(topics.CONTROLLER_INTERNALS, self._on_internals, qos=_WATCHING)
        matching.subscribe(topics.PREDICTED_TRAJECTORY, self._on_plan, qos=_WATCHING)
        matching.subscribe(topics.ACTIVE_CONSTRAINTS, self._on_limits, qos=_WATCHING)
        matching.subscribe(topics.EVENT_LOG, self._on_record)

    def _opened(self, parameter: str, kind: type[Any], of: Any
                ) -> Iterator[AlarmStore | HistoryFile]:
        """Open the file of a parameter, if it names one."""
        if not (path := getattr(self._settings, parameter)):
            return
        try:
            file = kind(of, Path(path), time.time())
        except (OSError, ValueError) as error:
            raise ConfigurationError(
                f'{parameter} = {path!r} cannot be used ({error}): name a new file in a writable '
                'folder, or a file written by a panel') from error
        if file.complaint:
            self.node.get_logger().warning(file.complaint)
        yield file

    @property
    def plant(self) -> str:
        """Name of the plant."""
        return self.view.conditions.plant or self._settings.system

    @property
    def files(self) -> tuple[str, ...]:
        """Absolute paths of the files that are written."""
        return tuple(os.path.realpath(path) for path in (
            self._settings.alarm_file, self._settings.history_file) if path)

    def complete(self) -> None:
        """End a comparison, and save alarms and history."""
        self._watch.complete()
        for file in self._files:
            file.close()

    # For the pages; called from their thread.

    @property
    def title(self) -> str:
        """Title of all pages: by default the namespace and the plant."""
        return self._settings.title or ' '.join(filter(None, (
            self.node.get_namespace().strip('/'), self.plant)))

    @property
    def learning(self) -> Learning:
        """The last training and comparison."""
        return self._watch.learning

    def request(self, action: Action) -> Future[Answer]:
        """Carry out an action of an operator; the answer follows."""
        future: Future[Answer] = Future()
        self.post(partial(self._execute, action, future))
        return future

    def post(self, call: Callable[[], None]) -> None:
        """Call a function in the thread of the node; from any thread."""
        self._posted.append(call)
        self._wake.trigger()

    def _on_posted(self) -> None:
        while self._posted:
            self._posted.popleft()()

    # Messages.

    def _on_signal(self, kind: str, sample: SignalSample) -> None:
        now = time.time()
        self.view.take_signals(kind, sample.values, sample.stamp_ns / NANOSECONDS, now)
        if kind == 'active_setpoints':
            # the effect of an entry is shown without a wait for the timer
            self.snapshot = self.view.snapshot(now)

    def _on_internals(self, message: JointState) -> None:
        self.view.take_internals(dict(zip(message.name, message.position, strict=False)))

    def _on_plan(self, message: JointTrajectory) -> None:
        self.view.take_plan(
            message.joint_names, stamp_nanoseconds(message.header.stamp) / NANOSECONDS,
            [stamp_nanoseconds(point.time_from_start) / NANOSECONDS for point in message.points],
            [point.positions for point in message.points])

    def _on_limits(self, message: JointState) -> None:
        self.view.take_limits(dict(zip(message.name, message.position, strict=False)))

    def _on_record(self, message: String) -> None:
        try:
            record = records.parse(message.data)
        except records.RecordError as error:
            self.node.get_logger().warning(str(error), throttle_duration_sec=10.0)
            return
        who = self._requests.take_record(record.event, record.fields, time.monotonic())
        self.view.take_record(record.event, record.fields, time.time(), who)

    def take_status(self, status: DiagnosticStatus) -> None:
        """Take the status of a task of one of the loop's nodes, or of a node of no loop."""
        values = {item.key: item.value for item in status.values}
        self.view.conditions.take_status(status.name, status.level[0], status.message, values,
                                         time.time(), status.hardware_id)
        name = self.view.conditions.task(status.name)
        if name == CONTROL:
            self._read_model(values)
        elif name == REQUESTS:
            self._requests.take_status(status.message)
        elif name == TRAINING:
            self._watch.training(
                values, str(self.snapshot.parameter(TRAINER, 'model_output') or ''))
        elif name == RECORDING:
            self._watch.recording(values.get('bag', ''))

    def on_event(self, event: ParameterEvent) -> None:
        """Take a parameter event of any node; from any thread."""
        for node in self._nodes.values():
            node.on_event(event)

    def _read_model(self, status: Mapping[str, str]) -> None:
        """Show training range and origin of the current model if its file can be read here."""
        in_force = {key: status.get(key, '') for key in ('model', 'model reloads')}
        name = in_force['model']
        if not name or in_force == self._model:
            return
        self._model = in_force
        try:
            model = load(model_path(name))
        except (OSError, ValueError) as error:
            self.node.get_logger().warning(f'trained ranges are not shown: {error}')
            self._training_ranges, card = {}, {}
        else:
            self._training_ranges, card = training_ranges(model), model_card(model)
        self.view.take_model(self._training_ranges, card)

    def _on_timer(self) -> None:
        now = time.time()
        self.view.advance(now)
        for file in self._files:
            try:
                file.save(now)
            except OSError as error:
                self.node.get_logger().error(f'{type(file).__name__} is not written: {error}',
                                             throttle_duration_sec=60.0)
        self._requests.advance(time.monotonic())
        self._watch.advance()
        self.snapshot = self.view.snapshot(now)

    def _on_remote_timer(self) -> None:
        for node in self._nodes.values():
            node.update()

    # Actions.

    def _execute(self, action: Action, future: Future[Answer]) -> None:
        reply = partial(self._reply, action, future)
        try:
            self._carry_out(action, reply)
        except (KeyError, TypeError, ValueError, AssertionError) as error:
            reply(Answer(False, str(error) or type(error).__name__))

    def _reply(self, action: Action, future: Future[Answer], answer: Answer) -> None:
        entry = AuditEntry.of(action, answer, time.time(), self.view.read.get(action.name, ''))
        self.view.take_action(entry)
        self._operator_actions.publish(String(data=entry.text()))
        word = ('accepted' if answer.accepted else
                'unknown' if answer.text.startswith(UNKNOWN) else 'rejected')
        value = sanitize_text(f'{action.name} {action.value}', _LOGGED)
        self.node.get_logger().info(f'{action.who}: {action.what} {value}: {word}')
        self.snapshot = self.view.snapshot(time.time())
        if not future.done():
            future.set_result(answer)

    def _carry_out(self, action: Action, reply: Callable[[Answer], None]) -> None:
        if action.what in _DONE:
            reply(Answer(True, 'done'))
        elif action.what in ('setpoint', 'manual'):
            self._send(action, reply)
        elif action.what == 'compare':
            model = self.snapshot.parameter(CONTROLLER, 'model')
            reply(_not_running(CONTROLLER) if model is None else self._watch.compare(str(model)))
        elif action.what == 'end comparison':
            reply(self._watch.cancel())
        elif action.what == 'parameters':
            self._requests.expect('parameters', action.who, time.monotonic())
            self._nodes[action.name].set_parameters(action.value, lambda response: reply(
                self._unanswered(action.name) if response is None else Answer(
                    response.result.successful, response.result.reason or 'set')))
        else:
            role, service, kind = _SERVICES[action.what]
            if event := {'automatic': 'mode', 'reload': 'model'}.get(action.what):
                self._requests.expect(event, action.who, time.monotonic())
            request = kind.Request() if kind is Trigger else kind.Request(data=bool(action.value))
            self._nodes[role].call(service, request, lambda response: reply(
                self._unanswered(role) if response is None else Answer(
                    response.success, response.message)))

    def _unanswered(self, role: str) -> Answer:
        if not self._nodes[role].running:
            return _not_running(role)
        return Answer(False, f'{UNKNOWN}the {role} did not answer within {remote_node.TIMEOUT:g} '
                             's: check its log; it may still carry out the request')

    def _send(self, action: Action, reply: Callable[[Answer], None]) -> None:
        """Publish a set-point or a manual command until the controller answers."""
        name, value, setpoint = action.name, float(action.value), action.what == 'setpoint'
        place = (self._wiring.setpoints if setpoint else self._wiring.manual)[name]
        read, unit = self.view.read[name], self._signals.units[name]
        if not self.node.count_publishers(topics.EVENT_LOG):
            reply(_not_running(CONTROLLER))
            return
        low, high = map(conversion(place.unit, read), place.range)
        if not low <= value <= high:
            # the controller would read it as no number
            reply(Answer(False, f'outside {low:.6g} to {high:.6g} {read}, the range of the '
                                f'messages on {place.topic}'))
            return
        accepted = 'accepted'
        if setpoint and self.snapshot.mode == 'manual':
            accepted = 'accepted: the controller follows it only in automatic mode'
        elif not setpoint and (limited := self.view.limited(name, value)) != value:
            accepted = f'limited to {limited:.6g} {printed(read)}'
        own = float(conversion(read, unit)(value))
        answered = self._repeated.send(name, place, unit, own)

        def on_answer(answer: Answer) -> None:
            answered()
            reply(answer)

        # as the controller reads the value from the message
        to_field, from_field = conversion(unit, place.unit), conversion(place.unit, unit)
        self._requests.add(SETPOINT if setpoint else MANUAL, name,
                           float(from_field(float(to_field(own)))), time.monotonic(), on_answer,
                           accepted, action.who)

    def _rejection(self, codes: Sequence[str], name: str, value: float) -> str:
        """Write the reason of a rejected set-point; '' if only the controller knows it."""
        if codes[:1] != (StatusCode.SETPOINT_OUTSIDE.value,) or name not in self._training_ranges:
            return ''
        low, high = self._training_ranges[name]
        if low <= value <= high:
            return self._words(reason(StatusCode.SETPOINT_OUTSIDE, signal=name, value=value,
                                      lower=low, upper=high))
        read = self.view.read[name]
        to_read = conversion(self._signals.states[name], read)
        return f'outside {to_read(low):.6g} to {to_read(high):.6g} {read}, the trained range'


def _not_running(node: str) -> Answer:
    return Answer(False, f'the {node} is not running: start it')
