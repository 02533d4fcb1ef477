# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The panel node: shows the loop in a browser, and passes on what an operator asks for there."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
import gc
import importlib
import math
from pathlib import Path
import sys
import threading
import time
from types import ModuleType
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rcl_interfaces.msg import ParameterEvent
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from koopman_ros.bags import BagReadError
from koopman_ros.lifting import LiftedModel, load
from koopman_ros.panel.alarm_memory import AlarmMemory
from koopman_ros.panel.learning import Learning
from koopman_ros.panel.past import fill_in, read_past
from koopman_ros.panel.plant import (
    CONTROLLER,
    ParameterView,
    PLANT,
    PlantView,
    Range,
    REQUESTS,
    TRAINER,
)
from koopman_ros.panel.requests import (
    Action,
    action_text,
    Answer,
    MANUAL,
    Requests,
    SETPOINT,
)
from koopman_ros.panel.texts import plain
from koopman_ros.parameters.panel import panel_signals, panel_table
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.parameters.wire import Wiring
from koopman_ros.reasons import Code, reason
from koopman_ros.replay import records
from koopman_ros.resources import model_path
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_nanoseconds
from koopman_ros.ros.learning import LearningWatch
from koopman_ros.ros.node import Level, LoopNode, Status, wall_timer, words_of
from koopman_ros.ros.process import run
from koopman_ros.ros.remote import RemoteNode
from koopman_ros.ros.signals import Heard, Inlet, Outlet
from koopman_ros.units import conversion, Display, display_unit, NANOSECONDS, printed
from koopman_ros.wire import Place

# The loop waits for nobody who only looks on.
_WATCHING = topics.profile(100, reliable=False)
_PERIOD = 0.2  # s between two snapshots
_LOOK = 0.5  # s between two looks at other nodes
_SENDING = 0.05  # s between two looks at what is to be sent
_REPEAT = 0.7  # s without an answer after which a request is sent again
_LOGGED = 300  # characters of an action in the log
_GONE = '{} is not there: start it'
_SERVICES = {'reload': (CONTROLLER, 'reload_model'), 'train': (TRAINER, 'train'),
             'cancel': (TRAINER, 'cancel_training'), 'automatic': (CONTROLLER, 'set_automatic'),
             'record': (TRAINER, 'record'), 'experiment': (TRAINER, 'experiment')}
_TRAINING, _RECORDING = 'trainer: training', 'trainer: recording'
_NOTED = ('acknowledge', 'shelve', 'unshelve')  #: done already, in the pages
_UNUSED = ('aiohttp', 'tornado')  #: packages that the pages leave alone
_SWITCHES = ('automatic', 'record', 'experiment')  #: those that take a yes or no


@dataclass
class _Letter:
    """A value on its way to the controller, on a topic of its own for as long as it takes."""

    outlet: Outlet
    publisher: Publisher
    value: float
    due: float
    deadline: float
    done: bool = False


class PanelNode(LoopNode):
    """
    Carry what is heard to the view, and what operators ask for to topics and services.

    The pages run in a thread of their own; they read :attr:`snapshot`, which is replaced as a
    whole, and hand in what they ask for by :meth:`ask`.
    """

    def __init__(self) -> None:
        super().__init__('panel')
        given = self.given()
        present = load(model_path(str(name))) if (name := given.get('model')) else None
        self.settings = settings = self.declare_table(panel_table(present, given))
        self._signals = signals = panel_signals(present, given)
        self._wiring = wiring = Wiring(signals, settings.states, settings.inputs)
        read = settings.read(signals)
        nodes = {PLANT: PLANT, CONTROLLER: settings.controller, TRAINER: settings.trainer}
        self.view = PlantView(signals, read, settings.span, time.time(), {
            self.resolve_service_name(name).lstrip('/'): role for role, name in nodes.items()})
        self._memory = self._recalled(settings.alarm_file)
        self.snapshot = self.view.snapshot(time.time())
        self._words = words_of(signals, {
            name: Display(unit, read[name], '.6g') for name, unit in signals.units.items()
            if read[name] != display_unit(unit)})
        self._requests = Requests(
            {SETPOINT: signals.controlled, MANUAL: tuple(signals.inputs)}, self._refusal)
        self._asked: deque[tuple[Action, Future[Answer]]] = deque()
        self._letters: list[_Letter] = []
        self._trained: dict[str, Range] = {}
        self._model = ''
        self._past: threading.Thread | None = None
        self._watch = LearningWatch(self, settings.system, wiring)
        self._ended = threading.Event()

        matching = self._matching = topics.Matching(self, lambda: None)
        for kind, units in (('measured', signals.states), ('predicted', signals.states),
                            ('applied', signals.inputs), ('commands', signals.inputs)):
            Inlet(self, lambda topic, hear, of: matching.subscribe(topic, hear, of, _WATCHING),
                  getattr(wiring, kind), units, partial(self._on_signal, kind))
        Inlet(self, lambda topic, hear, of: matching.subscribe(
            topic, hear, of, topics.LATCHED_QOS), wiring.active_setpoints, signals.states,
            partial(self._on_signal, 'active_setpoints'))
        matching.subscribe(topics.CONTROLLER_STATE, self._on_internals, qos=_WATCHING)
        matching.subscribe(topics.CONTROLLER_PLAN, self._on_plan, qos=_WATCHING)
        matching.subscribe(topics.ACTIVE_LIMITS, self._on_limits, qos=_WATCHING)
        matching.subscribe(topics.CONTROLLER_EVENTS, self._on_record)
        matching.subscribe(topics.DIAGNOSTICS, self._on_diagnostics, qos=QoSProfile(depth=100))
        self._actions = matching.publish(topics.OPERATOR_ACTIONS)
        self._nodes = {role: RemoteNode(self, getattr(settings, role), partial(
            self._on_parameters, role)) for role in (CONTROLLER, TRAINER)}
        for what, (role, service) in _SERVICES.items():
            self._nodes[role].offer(SetBool if what in _SWITCHES else Trigger, service)
        self.create_subscription(
            ParameterEvent, '/parameter_events', self._on_event, QoSProfile(depth=1000))
        self._wake = self.create_guard_condition(self._on_asked)
        wall_timer(self, _PERIOD, self._on_tick)
        wall_timer(self, _LOOK, self._on_look)
        self._sending = wall_timer(self, _SENDING, self._on_sending)
        self._sending.cancel()
        try:
            self._server = self._serve()
        except BaseException:
            # nobody else has it to destroy, and it would go on listening in this process
            self.destroy_node()
            raise
        self.diagnostics.add('pages', self._status)
        self.get_logger().info(f'the panel is at {self._server.address}')

    def _recalled(self, path: str) -> AlarmMemory | None:
        if not path:
            return None
        try:
            memory = AlarmMemory(self.view.alarms, Path(path), time.time())
        except (OSError, ValueError) as error:
            raise ConfigurationError(
                f'alarm_file = {path!r} cannot be used ({error}): name a new file in a folder '
                'that can be written, or one that a panel wrote') from error
        if memory.complaint:
            self.get_logger().warning(memory.complaint)
        return memory

    def _serve(self) -> Any:
        try:
            serving = _imported_server()
        except ImportError as error:
            raise ConfigurationError(
                f'the panel needs {error.name}, which is missing: '
                "pip install 'nicegui>=3'") from error
        settings = self.settings
        server = serving.PanelServer(
            self, settings.host, settings.port, settings.users, settings.tls_certificate,
            settings.tls_key, [*filter(None, settings.trusted_proxy)])
        server.start()
        return server

    def complete(self) -> None:
        """End the pages."""
        self._ended.set()
        self._watch.complete()
        self._server.stop()
        if self._memory is not None:
            self._memory.close()
        if self._past is not None:
            self._past.join(_LOOK)

    # For the pages; called from their thread.

    @property
    def title(self) -> str:
        """What is written above each page."""
        return self.settings.title or self.snapshot.plant or self.settings.system

    @property
    def learning(self) -> Learning:
        """The last training and comparison."""
        return self._watch.learning

    def ask(self, action: Action) -> Future[Answer]:
        """Do what an operator asks for; the answer comes later."""
        future: Future[Answer] = Future()
        self._asked.append((action, future))
        self._wake.trigger()
        return future

    # What is heard.

    def _on_signal(self, kind: str, heard: Heard) -> None:
        self.view.hear(kind, heard.values, heard.stamp_ns / NANOSECONDS, time.time())

    def _on_internals(self, message: JointState) -> None:
        self.view.internals(dict(zip(message.name, message.position, strict=False)))

    def _on_plan(self, message: JointTrajectory) -> None:
        self.view.planned(
            message.joint_names, stamp_nanoseconds(message.header.stamp) / NANOSECONDS,
            [stamp_nanoseconds(point.time_from_start) / NANOSECONDS for point in message.points],
            [point.positions for point in message.points])

    def _on_limits(self, message: JointState) -> None:
        self.view.limits(dict(zip(message.name, message.position, strict=False)))

    def _on_record(self, message: String) -> None:
        try:
            record = records.parse(message.data)
        except records.RecordError as error:
            self.get_logger().warning(str(error), throttle_duration_sec=10.0)
            return
        self.view.record(record.event, record.fields, time.time())
        self._requests.record(record.event, record.fields, time.monotonic())

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.view.status(
                status.name, status.level[0], status.message,
                {item.key: item.value for item in status.values}, time.time(),
                status.hardware_id)
            name = self.view.task(status.name)
            if name == REQUESTS:
                self._requests.status(status.message)
            if name == _TRAINING:
                output = self.snapshot.parameters.get(TRAINER, {}).get('model_output')
                self._watch.training({item.key: item.value for item in status.values},
                                     str(output.value) if output else '')
            if name == _RECORDING:
                bag = next((item.value for item in status.values if item.key == 'bag'), '')
                self._watch.recording(bag)
                if self._past is not None:
                    continue
                first = self.snapshot.time
                if bag and not math.isnan(first):
                    self._past = threading.Thread(
                        target=self._read_past, args=(bag, first), daemon=True)
                    self._past.start()

    def _read_past(self, bag: str, first: float) -> None:
        """Fill in what was before the panel; called in a thread of its own."""
        try:
            past = read_past(bag, self._wiring, self.view.read, self.resolve_topic_name,
                             self.settings.span, self._ended.is_set)
        except (OSError, BagReadError) as error:
            self.get_logger().warning(f'the trends begin with the panel: {error}')
            return
        if not self._ended.is_set():
            fill_in(self.view, past, first)

    def _on_event(self, event: ParameterEvent) -> None:
        for node in self._nodes.values():
            node.on_event(event)

    def _on_parameters(self, role: str, found: Mapping[str, ParameterView]) -> None:
        self.view.parameters(role, found)
        if role == CONTROLLER and 'model' in found:
            self._take_model(str(found['model'].value))

    def _take_model(self, name: str) -> None:
        """Show the range that a model was trained with, where its file can be read here."""
        if name == self._model:
            return
        self._model = name
        try:
            model = load(model_path(name))
        except (OSError, ValueError) as error:
            self.get_logger().warning(f'no training range is shown: {error}')
            self._trained, about = {}, {}
        else:
            self._trained = {name: (low, high) for of in (model.states, model.inputs)
                             for name, low, high in zip(
                                 of.names, of.lower.tolist(), of.upper.tolist(), strict=True)}
            about = _about(model)
        self.view.trained(self._trained, about)

    def _on_tick(self) -> None:
        now = time.time()
        self.view.advance(now)
        if self._memory is not None:
            try:
                self._memory.keep(now)
            except OSError as error:
                self.get_logger().error(
                    f'alarms are not written to {self.settings.alarm_file}: {error}',
                    throttle_duration_sec=60.0)
        self.diagnostics.hardware_id = self.view.plant or self.settings.system
        self._requests.advance(time.monotonic())
        self._watch.advance()
        self.snapshot = self.view.snapshot(now)

    def _on_look(self) -> None:
        for node in self._nodes.values():
            node.look()

    # What operators ask for.

    def _on_asked(self) -> None:
        while self._asked:
            action, future = self._asked.popleft()
            reply = partial(self._reply, action, future)
            try:
                self._do(action, reply)
            except (KeyError, TypeError, ValueError, AssertionError) as error:
                reply(Answer(False, str(error) or type(error).__name__))

    def _reply(self, action: Action, future: Future[Answer], answer: Answer) -> None:
        self._actions.publish(String(data=action_text(
            action, answer, time.time(), self.view.read.get(action.name, ''))))
        word = 'accepted' if answer.accepted else 'refused'
        value = plain(f'{action.name} {action.value}', _LOGGED)
        self.get_logger().info(f'{action.who}: {action.what} {value}: {word}')
        if not future.done():
            future.set_result(answer)

    def _do(self, action: Action, reply: Callable[[Answer], None]) -> None:
        if action.what in ('setpoint', 'manual'):
            self._send(action, reply)
        elif action.what == 'compare':
            acting = self.snapshot.parameters.get(CONTROLLER, {}).get('model')
            reply(self._watch.compare(str(acting.value)) if acting else Answer(
                False, _GONE.format('the controller')))
        elif action.what == 'end comparison':
            reply(self._watch.cancel())
        elif action.what in _NOTED:
            reply(Answer(True, 'done'))
        elif action.what == 'parameters':
            self._nodes[action.name].set_parameters(
                action.value, lambda response: reply(Answer(False, _GONE.format(action.name))
                                                     if response is None else Answer(
                    response.result.successful, response.result.reason or 'set')))
        else:
            role, service = _SERVICES[action.what]
            request = SetBool.Request(data=bool(action.value)) if (
                action.what in _SWITCHES) else Trigger.Request()
            self._nodes[role].call(service, request, lambda response: reply(
                Answer(False, _GONE.format(f'the {role}')) if response is None else Answer(
                    response.success, response.message)))

    def _send(self, action: Action, reply: Callable[[Answer], None]) -> None:
        """Publish a value until it is answered; nobody publishes there but for that."""
        setpoint = action.what == 'setpoint'
        places: Mapping[str, Place] = self._wiring.setpoints if setpoint else self._wiring.manual
        units = self._signals.states if setpoint else self._signals.inputs
        place, unit = places[action.name], units[action.name]
        value = float(conversion(self.view.read[action.name], unit)(float(action.value)))
        if not self.count_publishers(topics.CONTROLLER_EVENTS):
            reply(Answer(False, _GONE.format('the controller')))
            return
        outlet = Outlet({action.name: place}, units, lambda topic, kind: self.create_publisher(
            kind, topic, topics.LOOP_QOS))
        now = time.monotonic()
        letter = _Letter(outlet, outlet.publishers[0], value, now, now + 4.0)
        # as the controller finds it, after there and back
        there, back = conversion(unit, place.unit), conversion(place.unit, unit)

        def answered(answer: Answer) -> None:
            letter.done = True
            reply(answer)

        self._letters.append(letter)
        self._sending.reset()
        self._requests.add(SETPOINT if setpoint else MANUAL, action.name,
                           float(back(float(there(value)))), now, answered,
                           'accepted' if setpoint else self._becomes(action.name, action.value))

    def _becomes(self, name: str, asked: float) -> str:
        """Return the answer to a manual command that the controller accepts."""
        limited = self.view.limited(name, float(asked))
        return 'accepted' if limited == float(asked) else (
            f'limited to {limited:.6g} {printed(self.view.read[name])}')

    def _on_sending(self) -> None:
        now = time.monotonic()
        for letter in list(self._letters):
            if letter.done or now > letter.deadline:
                self._letters.remove(letter)
                self.destroy_publisher(letter.publisher)
                continue
            listeners = letter.publisher.get_subscription_count()
            if now >= letter.due and listeners and listeners >= self.count_subscribers(
                    letter.publisher.topic_name):
                letter.outlet.send(np.array([letter.value]), Time(), 'panel')
                letter.due = now + _REPEAT
        if not self._letters:
            # until there is one again
            self._sending.cancel()

    def _refusal(self, codes: Sequence[str], name: str, value: float) -> str:
        """Write why a set-point is refused, where all that the sentence needs is known here."""
        if codes[:1] != (Code.SETPOINT_OUTSIDE.value,) or name not in self._trained:
            return ''
        low, high = self._trained[name]
        read = self.view.read[name]
        to_read = conversion(self._signals.states[name], read)
        return (f'outside {to_read(low):.6g} to {to_read(high):.6g} {read}, '
                'the trained range') if not low <= value <= high else (
            self._words(reason(Code.SETPOINT_OUTSIDE, signal=name, value=value, lower=low,
                               upper=high)))

    def _status(self) -> Status:
        return Status(Level.OK, f'{self._server.pages} pages open', {
            'address': self._server.address, 'pages': self._server.pages})


def _imported_server() -> ModuleType:
    """
    Import what serves the pages, which other programs do without.

    A third of its time would go into HTTP clients that it takes along where they are installed,
    and that nobody here uses, and into looking through what is imported for garbage.
    """
    absent = [name for name in _UNUSED if name not in sys.modules]
    # as if they were not installed
    sys.modules.update(dict.fromkeys(absent))  # type: ignore[arg-type]
    collecting = gc.isenabled()
    gc.disable()
    try:
        return importlib.import_module('koopman_ros.panel.server')
    finally:
        for name in absent:
            del sys.modules[name]
        if collecting:
            gc.enable()


def _about(model: LiftedModel) -> dict[str, str]:
    """Return origin and held-out figures of a model, in words."""
    origin = model.provenance
    return {
        'class': model.kind,
        'acceptance': origin.acceptance,
        'learned from': origin.plant, 'derivatives': origin.method,
        'made by': f'koopman_ros {origin.package_version}' if origin.package_version else '',
        'seed': '' if origin.seed is None else str(origin.seed),
        **{f'held out: {name}': f'{figure:.4g}' for name, figure in origin.metrics.items()}}


def main(args: list[str] | None = None) -> int:
    """Run the panel node."""
    return run('panel', PanelNode, args)


if __name__ == '__main__':
    sys.exit(main())
