# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Conditions of a loop that raise alarms: statuses, repeated errors, and silence of nodes."""

from collections import deque
from collections.abc import Mapping

from koopman_ros.panel.alarms import Alarms, Priority
from koopman_ros.panel.files import sanitize_text
from koopman_ros.panel.snapshot import (
    CONTROLLER,
    ERROR,
    OK,
    PLANT,
    REQUESTS,
    ROLES,
    SilentTopic,
    TaskStatus,
    TRAINER,
)

_SILENT = 3.5  # s without a status, of which there is one per second
_PERIODS = 5.0  # usual times between two measurements without one
_MAX_TASKS = 64  # statuses of the loop that are kept, and of other nodes
_MAX_NAME = 200  # characters
# So many errors within so many seconds are an alarm, however short each of them is.
_REPEATED, _WITHIN = 5, 60.0


class Conditions:
    """
    Last statuses and messages of a loop, and their alarms.

    :param nodes: roles of the loop's nodes by their full names without the first slash.
    :param now: wall time, as in all methods.
    """

    def __init__(self, nodes: Mapping[str, str], now: float) -> None:
        self.alarms = Alarms()
        self.plant = ''  #: name of the plant
        self.statuses: dict[str, TaskStatus] = {}
        self._nodes, self._start = dict(nodes), now
        # wall time and message of the last changes to ERROR, by task
        self._errors: dict[str, deque[tuple[float, str]]] = {}
        self._last: dict[str, float] = {}  # wall time of the last message, by role
        self._period = 0.0  # of the measurements
        self._watched = [CONTROLLER, PLANT]

    def take_message(self, role: str, now: float) -> None:
        """Take note of a message of a node; of the plant it is a measurement."""
        last = self._last.get(role)
        if role == PLANT and last is not None and now > last:
            self._period = min(0.9 * (self._period or now - last) + 0.1 * (now - last), 600.0)
        self._last[role] = now

    def task(self, name: str) -> str:
        """
        Return ``<role>: <task>`` for a status of a node of this loop.

        The name of another node is returned as it is, but '' for a node of another loop: one with
        the base name of a role in another namespace.
        """
        node, _, task = name.partition(': ')
        role = self._nodes.get(node)
        if role is not None:
            return f'{role}: {task}'
        return '' if node.rsplit('/', 1)[-1] in self._nodes.values() else name

    def take_status(self, name: str, level: int, message: str, values: Mapping[str, str],
                    now: float, plant: str = '') -> None:
        """Take the status of a task; WARN and ERROR raise an alarm."""
        role = self._nodes.get(name.partition(': ')[0])
        name = sanitize_text(self.task(name), _MAX_NAME)
        # other nodes cannot crowd out the loop's
        alike = [task for task in self.statuses
                 if (task.partition(':')[0] in ROLES) is (role is not None)]
        if not name or (name not in alike and len(alike) >= _MAX_TASKS):
            return
        if role in (CONTROLLER, TRAINER):
            self.take_message(role, now)
            if role not in self._watched:
                self._watched.append(role)
        if role in (PLANT, CONTROLLER):
            self.plant = plant or self.plant
        before = self.statuses.get(name)
        self.statuses[name] = TaskStatus(name, level, message, dict(values))
        if level >= ERROR and (before is None or before.level < ERROR):
            self._errors.setdefault(name, deque(maxlen=_REPEATED)).append((now, message))
        # a refused request is shown to its operator
        priority = Priority.HIGH if level >= ERROR else (
            Priority.MEDIUM if role == CONTROLLER and name != REQUESTS else Priority.LOW)
        # a warning that the control task repeats has a task and an alarm of its own
        repeated = level < ERROR and values.get('condition', 'control') != 'control'
        self.alarms.report(name, level > OK and not repeated, priority, f'{name}: {message}', now)

    def advance(self, now: float) -> None:
        """Raise the alarms of silence and of repeated errors, and let delays run out."""
        silent = {silence.role for silence in self.silences(now)}
        for name, errors in self._errors.items():
            often = len(errors) == _REPEATED and now - errors[0][0] <= _WITHIN
            self.alarms.report(
                f'{name}, repeated errors', often, Priority.HIGH, f'{name}: at least {_REPEATED} '
                f'errors within {_WITHIN:g} s, the last: {errors[-1][1]}', now)
        for role in self._watched:
            text = 'no measurement' if role == PLANT else f'no message from the {role}'
            self.alarms.report(f'silence of {role}', role in silent,
                               Priority.LOW if role == TRAINER else Priority.HIGH, text, now)
        self.alarms.advance(now)

    def silences(self, now: float) -> tuple[SilentTopic, ...]:
        """Return the silent nodes."""
        found = []
        for role in self._watched:
            patience = max(_SILENT, _PERIODS * self._period) if role == PLANT else _SILENT
            last = self._last.get(role, self._start)
            if now - last > patience:
                found.append(SilentTopic(role, last, role in self._last))
        return tuple(found)
