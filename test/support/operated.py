# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A loop whose messages a test sends, as a source of the panel's pages."""

from collections.abc import Mapping
from concurrent.futures import Future
import threading
import time
from typing import Any

from koopman_ros.panel.requests import Action, Answer, AuditEntry
from koopman_ros.panel.snapshot import CONTROLLER, ERROR, OK, PLANT, Snapshot, TRAINER
from koopman_ros.panel.training_report import Learning
from koopman_ros.panel.view_model import LoopViewModel
from koopman_ros.parameters.description import ParameterDescription
from koopman_ros.parameters.signal_topics import Signals

INFINITE = 1e9


def described(name: str, value: Any, unit: str = '', lower: float = -INFINITE,
              upper: float = INFINITE) -> ParameterDescription:
    return ParameterDescription(name, value, unit, f'meaning of {name}', f'[{lower}, {upper}]',
                                lower, upper, False)


class OperatedLoop:
    """
    A reactor with a temperature and a coolant, whose controller accepts every set-point.

    :ivar silent: roles that send nothing.
    :ivar asked: actions that reached the loop.
    :ivar answer: to each of them.
    """

    def __init__(self, title: str = 'reactor') -> None:
        self.title, self.learning = title, Learning()
        self.silent: set[str] = set()
        self.asked: list[Action] = []
        self.answer = Answer(True, 'accepted')
        self.measured, self.applied, self.command = 47.0, 20.0, 20.0
        self.level = 'sdre'
        self.control: dict[str, str] = {'mode': 'automatic', 'model': 'old'}
        self._statuses: dict[str, tuple[int, str, Mapping[str, str]]] = {}
        signals = Signals({'temperature': 'degC'}, {'coolant': 'degC'}, ('temperature',))
        self._begun = time.time()
        self.view = LoopViewModel(signals, signals.units, 3600.0, self._begun)
        self.view.take_model({'temperature': (30.0, 55.0), 'coolant': (5.0, 32.0)}, {})
        self.view.take_parameters(CONTROLLER, {
            one.name: one for one in (
                described('coolant.min', 5.0, 'degC'), described('coolant.max', 32.0, 'degC'),
                described('model', 'old'))})
        self.view.take_parameters(TRAINER, {
            one.name: one for one in (
                described('experiment_signal', 'setpoint'), described('model', 'old'),
                *(described(f'experiment_{what}', 60.0, 's')
                  for what in ('length', 'min_hold_time', 'max_hold_time')),
                described('temperature.experiment_min', 35.0, 'degC'),
                described('temperature.experiment_max', 52.0, 'degC'),
                described('temperature.setpoint_min', 40.0, 'degC'),
                described('temperature.setpoint_max', 50.0, 'degC'),
                described('coolant.experiment_min', 10.0, 'degC'),
                described('coolant.experiment_max', 20.0, 'degC'),
                described('coolant.safe_value', 15.0, 'degC'))})
        self._lock = threading.Lock()
        self._setpoint = 45.0
        self._record('setpoint', value=[45.0], accepted=True, reason=[])

    def _record(self, event: str, who: str = '', **fields: Any) -> None:
        self.view.take_record(event, fields, time.time(), who)

    def status(self, name: str, level: int = ERROR, message: str = '',
               values: Mapping[str, str] | None = None) -> None:
        """Report a status from now on."""
        self._statuses[name] = level, message, values or {}

    def forget(self, name: str) -> None:
        """Report a status no more."""
        del self._statuses[name]

    @property
    def snapshot(self) -> Snapshot:
        """What the loop sends now."""
        with self._lock:
            now, view = time.time(), self.view
            if PLANT not in self.silent:
                view.take_signals('measured', {'temperature': self.measured}, now, now)
                view.take_signals('applied', {'coolant': self.applied}, now, now)
            if CONTROLLER not in self.silent:
                view.take_signals('commands', {'coolant': self.command}, now, now)
                view.take_signals('predicted', {'temperature': self.measured}, now, now)
                view.take_signals('active_setpoints', {'temperature': self._setpoint}, now, now)
                self._record('silence' if PLANT in self.silent else 'measurement',
                             mode='automatic', level=self.level)
                view.conditions.take_status('controller: control', OK, 'automatic', self.control,
                                            now, 'reactor')
            if TRAINER not in self.silent:
                view.conditions.take_status('trainer: recording', OK, 'not recording', {}, now)
            for name, (level, message, values) in list(self._statuses.items()):
                view.conditions.take_status(name, level, message, values, now)
            view.advance(now)
            return view.snapshot(now)

    def request(self, action: Action) -> Future[Answer]:
        """Answer what an operator asks for."""
        answer = self.answer
        with self._lock:
            self.asked.append(action)
            if action.what == 'setpoint' and answer.accepted:
                self._setpoint = float(action.value)
                self._record('setpoint', action.who, value=[self._setpoint], accepted=True,
                             reason=[])
            self.view.take_action(AuditEntry.of(action, answer, time.time()))
        future: Future[Answer] = Future()
        future.set_result(answer)
        return future
