# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Conditions of a loop that raise alarms: statuses, repeated errors, and silence of nodes."""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
import re

from koopman_ros.panel.alarms import Alarm, Alarms, Priority
from koopman_ros.panel.files import sanitize_text
from koopman_ros.panel.snapshot import (
    CONNECTIONS,
    CONTROL,
    CONTROLLER,
    ERROR,
    EXPERIMENT,
    MEASUREMENTS,
    OK,
    PLANT,
    RECORDING,
    REQUESTS,
    ROLES,
    SilentTopic,
    TaskStatus,
    TRAINER,
    TRAINING,
)

_SILENT = 3.5  # s without a status, of which there is one per second
_START = 30.0  # s for which the nodes of a loop may start one after the other
_STALE = 10.0  # s without a status after which its alarms are marked as stale
_GONE = 60.0  # s after which its node is gone for good, and its alarms return
_ENDED = 10.0  # s for which an experiment or training that failed is an active alarm
_PERIODS = 5.0  # usual times between two measurements without one
_MAX_TASKS = 64  # statuses of the loop that are kept, and of other nodes
_MAX_NAME = 200  # characters
# errors within seconds that are an alarm, however short each of them is
_REPEATED, _WITHIN = 5, 60.0
#: of tasks, where it does not follow from the level: that of the loss of the command, and that of
#: what disturbs no control
_PRIORITIES = {CONNECTIONS: Priority.HIGH, EXPERIMENT: Priority.LOW, TRAINING: Priority.LOW,
               RECORDING: Priority.MEDIUM}
#: tasks and silences from causes to consequences
_CAUSES = (f'{PLANT}: ', 'silence of plant', 'silence of controller', MEASUREMENTS, CONTROL,
           f'{CONTROLLER}: ', 'process: ', f'{TRAINER}: ')
_SPREADS = 30.0  # s within which the consequences of a cause are raised
_NUMBER = re.compile(r'(?<![\w.])[-+]?\d+(\.\d+)?(e[-+]\d+)?')


def grouped(alarms: Sequence[Alarm]) -> list[tuple[Alarm, Sequence[Alarm]]]:
    """
    Return alarms with their consequences, in the order of the causes.

    The cause is the alarm that stands nearest to the plant in the loop, of those that were raised
    within half a minute.
    """
    def depth(alarm: Alarm) -> int:
        return next((at for at, prefix in enumerate(_CAUSES) if alarm.key.startswith(prefix)), -1)

    causes: dict[str, list[Alarm]] = {}
    # the first alarm of a depth may be the cause of all that are deeper
    heads: list[Alarm] = []
    for alarm in sorted(alarms, key=lambda one: (depth(one), one.since)):
        head = next((one for one in heads if 0 <= depth(one) < depth(alarm)
                     and abs(alarm.since - one.since) <= _SPREADS), None)
        if head is None:
            heads.append(alarm)
        causes.setdefault((head or alarm).key, []).extend([alarm] if head else [])
    order = {alarm.key: at for at, alarm in enumerate(alarms)}
    # a group is as urgent as its most urgent alarm
    return sorted(((alarm, causes[alarm.key]) for alarm in heads), key=lambda group: min(
        order[one.key] for one in (group[0], *group[1])))


def _said(task: str, text: str) -> str:
    """Write the text of a status after its node and task, once each."""
    node, _, what = task.partition(': ')
    return f'{node}: {text}' if what and text.startswith(f'{what} ') else f'{task}: {text}'


class Conditions:
    """
    Last statuses and messages of a loop, and their alarms.

    :param nodes: roles of the loop's nodes by their full names without the first slash.
    :param now: wall time, as in all methods; if it jumps back, all ages stay as they are.
    :param signals: names that are written in words in messages.
    """

    def __init__(self, nodes: Mapping[str, str], now: float, signals: Iterable[str] = ()) -> None:
        self.alarms = Alarms()
        # names of signals in sentences, but not in topics, parameters and paths
        names = '|'.join(re.escape(name) for name in signals if '_' in name) or r'(?!)'
        self._names = re.compile(rf'(?<![\w./])({names})(?![\w/]|\.\w)')
        self.plant = ''  #: name of the plant
        self.statuses: dict[str, TaskStatus] = {}
        self._nodes, self._start, self._now = dict(nodes), now, now
        # wall time and message of the last changes to ERROR, by task
        self._errors: dict[str, deque[tuple[float, str]]] = {}
        self._keys: dict[str, tuple[str, ...]] = {}  # of the alarms of each task
        self._heard: dict[str, float] = {}  # wall time of the last status, by task
        self._since: dict[str, float] = {}  # wall time of the present message, by task
        self._begun: dict[str, float] = {}  # wall time of the first message, by role
        self._last: dict[str, float] = {}  # wall time of the last message, by role
        self._period = 0.0  # of the measurements
        self._watched = [CONTROLLER, PLANT]

    def take_message(self, role: str, now: float) -> None:
        """Take note of a message of a node; of the plant it is a measurement."""
        self._follow_clock(now)
        last = self._last.get(role)
        if last is None or now - last > self.patience(role):
            self._begun[role] = now
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
        self._follow_clock(now)
        role = self._nodes.get(name.partition(': ')[0])
        name = sanitize_text(self.task(name), _MAX_NAME)
        # other nodes cannot crowd out the loop's
        alike = [task for task in self.statuses
                 if (task.partition(':')[0] in ROLES) is (role is not None)]
        if not name or (name not in alike and len(alike) >= _MAX_TASKS and not (
                level > OK and self._forget_one(alike, now))):
            return
        if role in (CONTROLLER, TRAINER):
            self.take_message(role, now)
            if role not in self._watched:
                self._watched.append(role)
        if role in (PLANT, CONTROLLER):
            self.plant = plant or self.plant
        message = self._in_words(message)
        before = self.statuses.get(name)
        status = self.statuses[name] = TaskStatus(
            name, level, message or ('' if level == OK else 'no reason was given'), dict(values))
        if before is None or before.message != status.message:
            self._since[name] = now
        if level >= ERROR and (before is None or before.level < ERROR):
            self._errors.setdefault(name, deque(maxlen=_REPEATED)).append((now, status.message))
        self._heard[name] = now
        priority = _PRIORITIES.get(name, Priority.HIGH if level >= ERROR else (
            Priority.MEDIUM if role == CONTROLLER else Priority.LOW))
        active = level > OK and self._is_alarm(status, now)
        # one alarm a condition, which is its sentence without the numbers
        warnings = [self._in_words(text) for key, text in values.items()
                    if key.startswith('warning ')]
        texts = {sanitize_text(f'{name}: {_NUMBER.sub("#", text)}', _MAX_NAME): text
                 for text in warnings or [status.message]}
        # of texts that alternate, each would end before the delay
        replaced = before is not None and before.level > OK and not (
            set(texts) & set(self._keys[name]))
        for key in {*self._keys.get(name, ()), *texts}:
            self.alarms.report(key, active and key in texts, priority,
                               _said(name, texts.get(key, '')), now,
                               0.0 if replaced else None)
        self._keys[name] = tuple(texts)

    def _in_words(self, text: str) -> str:
        return self._names.sub(lambda found: found[0].replace('_', ' '), text)

    def _forget_one(self, tasks: Sequence[str], now: float) -> bool:
        """Make room for an alarm: forget a task without one; return whether there was any."""
        name = next((task for task in tasks if self.statuses[task].level == OK
                     and task not in self._errors), None)
        if name is None:
            return False
        self._forget(name, now)
        return True

    def _forget(self, name: str, now: float) -> None:
        """Forget a task, whose alarms return."""
        status = self.statuses.pop(name)
        del self._since[name], self._heard[name]
        for key in self._keys.pop(name):
            self.alarms.report(key, False, Priority.LOW, status.message, now)

    def _is_alarm(self, status: TaskStatus, now: float) -> bool:
        """Return whether a warning or an error is an alarm, and no other alarm shows it."""
        if status.name == REQUESTS or (
                status.name == EXPERIMENT and status.message.startswith('rejected')):
            # the operator who made the request reads the answer
            return False
        if status.name in (EXPERIMENT, TRAINING):
            return now - self._since[status.name] < _ENDED
        if status.name.startswith(f'{PLANT}: ') and any(
                status.message in other.message for other in self.statuses.values()
                if other.level > OK and other.name.startswith(f'{CONTROLLER}: ')):
            # the controller has noticed it as well
            return False
        if status.name == MEASUREMENTS:
            return not self.is_silent(PLANT, now)
        if status.name != CONTROL:
            return True
        if self._unmeasured():
            return now - self._begun[CONTROLLER] > _START and not self.is_silent(PLANT, now)
        return status.level >= ERROR or status.values.get('condition', 'control') == 'control'

    def _unmeasured(self) -> bool:
        """Return whether the controller complains of missing measurements."""
        status = self.statuses.get(CONTROL, TaskStatus(CONTROL, OK, ''))
        try:
            return status.level > OK and (status.values.get('measurements') == '0' or float(
                status.values['since last measurement [s]']) > self.patience(PLANT))
        except (KeyError, ValueError):
            return False

    def advance(self, now: float) -> None:
        """Raise the alarms of silence and of repeated errors, and let delays run out."""
        self._follow_clock(now)
        for name in [task for task, heard in self._heard.items() if now - heard > (
                # perhaps a driver without statuses has replaced a simulated plant
                _STALE if task.startswith(f'{PLANT}: ') else _GONE)]:
            self._forget(name, now)
        for name, errors in self._errors.items():
            often = len(errors) == _REPEATED and now - errors[0][0] <= _WITHIN
            self.alarms.report(
                f'{name}, repeated errors', often, Priority.HIGH, f'{name}: at least {_REPEATED} '
                f'errors within {_WITHIN:g} s, the last: {errors[-1][1]}', now)
        for role in self._watched:
            text = f'no message from the {role}'
            if role == PLANT:
                # the message of the controller says how it reacts
                reported = self._unmeasured() and not self.is_silent(CONTROLLER, now)
                text = self.statuses[CONTROL].message if reported else 'no measurement'
            silent = self.is_silent(role, now) and (
                role in self._last or now - self._start > _START)
            self.alarms.report(f'silence of {role}', silent,
                               Priority.LOW if role == TRAINER else Priority.HIGH, text, now)
        self.alarms.advance(now)

    def _follow_clock(self, now: float) -> None:
        back = max(self._now - now, 0.0)
        self._now = now
        if back:
            self._start -= back
            for times in (self._since, self._heard, self._begun, self._last):
                times.update({key: time - back for key, time in times.items()})
            for name, errors in self._errors.items():
                self._errors[name] = deque(
                    [(time - back, text) for time, text in errors], _REPEATED)

    def stale(self, now: float) -> frozenset[str]:
        """Return the keys of alarms whose nodes no longer report them."""
        return frozenset(key for name, heard in self._heard.items() if now - heard > _STALE
                         for key in self._keys.get(name, ()))

    def silences(self, now: float) -> tuple[SilentTopic, ...]:
        """Return the silent nodes."""
        return tuple(SilentTopic(role, self._last.get(role, self._start), role in self._last)
                     for role in self._watched if self.is_silent(role, now))

    def is_silent(self, role: str, now: float) -> bool:
        """Return whether a node has sent no message for too long."""
        return now - self._last.get(role, self._start) > self.patience(role)

    def patience(self, role: str) -> float:
        """Return the s after which a node without a message is silent."""
        return max(_SILENT, _PERIODS * self._period) if role == PLANT else _SILENT
