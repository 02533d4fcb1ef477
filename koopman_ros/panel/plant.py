# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the panel knows of a loop: faceplates, statuses, alarms and trends, without ROS."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any

from koopman_ros.panel.alarms import Alarm, Alarms, Priority
from koopman_ros.panel.trends import Trends
from koopman_ros.parameters.wire import Signals
from koopman_ros.reasons import level_words
from koopman_ros.resources import predecessor
from koopman_ros.units import conversion, display_unit, printed

OK, WARN, ERROR = 0, 1, 2  #: levels of a status
PLANT, CONTROLLER, TRAINER = 'plant', 'controller', 'trainer'  #: roles of nodes
_ROLES: Mapping[str, str] = MappingProxyType(
    {PLANT: PLANT, CONTROLLER: CONTROLLER, TRAINER: TRAINER})
LOST = 'connection lost'  #: message of a node that is silent
CONTROL, REQUESTS = f'{CONTROLLER}: control', f'{CONTROLLER}: requests'

_SILENT = 3.5  # s without a status, of which there is one a second
_PERIODS = 5.0  # usual times between two measurements without one
_BACK = 1.0  # s; a stamp that is earlier by more begins time afresh
_MOST_FOREIGN = 64  # statuses of other nodes that are kept
# So many errors within so many seconds are an alarm, however short each of them is.
_REPEATED, _WITHIN = 5, 60.0
_DEVIATION = re.compile(r'deviation_(\w+) \[')
_NAMED = re.compile(r'estimated_(\w+) \[(.+)\]')
_SIGNAL = re.compile(r'(\w+) \[(.+)\]')
_LIMIT = re.compile(r'at_(range|rate|limit)_(\w+) \[')
_OF_LIMITS: Mapping[tuple[str, float], str] = {
    ('range', -1.0): 'at its lower limit', ('range', 1.0): 'at its upper limit',
    ('rate', -1.0): 'falling as fast as it may', ('rate', 1.0): 'rising as fast as it may',
    ('limit', -1.0): 'kept above its lower limit', ('limit', 1.0): 'kept below its upper limit'}
_UNPLANNED = 3  # answers without a plan, after which the last one is over: one may be lost

Range = tuple[float, float]
_NO_VALUES: Mapping[str, str] = MappingProxyType({})


def label(name: str) -> str:
    """Return the name of a signal as it is read."""
    return name.replace('_', ' ')


def number(value: float, decimals: int) -> str:
    """Write a number, or a dash for none."""
    return f'{value:.{decimals}f}' if math.isfinite(value) else '–'


@dataclass(frozen=True)
class Face:
    """What is shown of a signal, in the unit that people read; NaN for what is not known."""

    name: str
    unit: str  #: as it is printed
    span: Range  #: of its bar
    decimals: int  #: of its numbers
    training: Range | None  #: what the acting model was trained with
    abnormal: str  #: what is out of order, or empty
    limits: Range | None  #: of the command, or what the predictive law keeps a state within
    active: str  #: which limits of it are active in the plan, in words, or empty
    plan: Sequence[tuple[float, float]]  #: times and values ahead; empty without a plan

    @property
    def label(self) -> str:
        """Its name as it is read."""
        return label(self.name)

    def text(self, value: float) -> str:
        """Write one of its values, without the unit."""
        return number(value, self.decimals)

    def share(self, value: float) -> float:
        """Return where a value is on the bar, from 0 to 1."""
        low, high = self.span
        return min(max((value - low) / (high - low), 0.0), 1.0) if math.isfinite(value) else 0.0


@dataclass(frozen=True)
class StateFace(Face):
    """A measured state."""

    controlled: bool  #: whether it has a set-point
    measured: float
    setpoint: float  #: that is tracked
    asked: float  #: that was asked for last and accepted
    predicted: float  #: what the model expected of the measurement


@dataclass(frozen=True)
class InputFace(Face):
    """An input."""

    command: float
    applied: float  #: what acts, where it is measured
    manual: float  #: what was commanded by hand last and accepted
    disturbance: float  #: as a change of the input, in its own unit
    own_unit: str  #: of a difference


@dataclass(frozen=True)
class TaskStatus:
    """What a task of a node last said of itself."""

    name: str  #: node and task
    level: int  #: OK, WARN or ERROR
    message: str
    values: Mapping[str, str] = field(default_factory=dict)
    heard: float = 0.0  #: when, by the wall clock


@dataclass(frozen=True)
class Silence:
    """A source that is not heard any more."""

    source: str
    since: float  #: when it was last heard, by the wall clock; or the start of the panel
    ever: bool  #: whether it was heard at all


@dataclass(frozen=True)
class ParameterView:
    """A parameter of a node as the node describes it."""

    name: str
    value: Any
    unit: str
    meaning: str
    range: str  #: in words
    lower: float
    upper: float
    read_only: bool
    choices: tuple[str, ...] = ()

    def read(self, text: str) -> Any:
        """
        Return the value that a text stands for.

        :raises ValueError: for one that is of another type or out of range, in words.
        """
        text = text.strip()
        if isinstance(self.value, bool):
            if text.lower() not in ('true', 'false'):
                raise ValueError('write true or false')
            return text.lower() == 'true'
        if isinstance(self.value, (int, float)):
            try:
                found = type(self.value)(text.replace(',', '.'))
            except ValueError:
                kind = 'a whole number' if isinstance(self.value, int) else 'a number'
                raise ValueError(f'{text!r} is not {kind}') from None
            if not self.lower <= found <= self.upper:
                raise ValueError(f'must be {self.range or "a finite number"}')
            return found
        if isinstance(self.value, tuple):
            parts = [part.strip() for part in text.strip('[]').split(',')]
            if self.value and isinstance(self.value[0], float):
                try:
                    return tuple(float(part) for part in parts)
                except ValueError:
                    raise ValueError('write numbers with commas between them') from None
            return tuple(parts)
        if self.choices and text not in self.choices:
            raise ValueError(f'must be {self.range}')
        return text

    @property
    def text(self) -> str:
        """The value as it is written."""
        if isinstance(self.value, bool):
            return str(self.value).lower()
        if isinstance(self.value, float):
            return f'{self.value:.10g}'
        if isinstance(self.value, tuple):
            return ', '.join(f'{part:.10g}' if isinstance(part, float) else str(part)
                             for part in self.value)
        return str(self.value)


@dataclass(frozen=True)
class Snapshot:
    """All that the pages show of one instant, which never changes."""

    plant: str  #: its name
    wall: float  #: when it was taken
    time: float  #: stamp of the last measurement
    mode: str  #: automatic or manual, empty where it is not known
    level: str  #: of control that acts, in words
    fallback: bool  #: whether it is not the best one
    reason: str  #: why, in words
    states: tuple[StateFace, ...]
    inputs: tuple[InputFace, ...]
    estimates: tuple[tuple[str, str], ...]  #: states that are not measured, and their values
    statuses: Mapping[str, TaskStatus]
    standing: tuple[Alarm, ...]  #: alarms, the most urgent first
    shelved: tuple[Alarm, ...]
    silences: tuple[Silence, ...]
    parameters: Mapping[str, Mapping[str, ParameterView]]  #: by node
    model: Mapping[str, str]  #: what is known of the acting model beside its status
    previous_model: str  #: that acted before, as far as the panel saw, or empty

    def status(self, name: str) -> TaskStatus:
        """
        Return the status of a task, or an empty one if there is none.

        That of a controller or trainer that is silent is an error, with its last values.
        """
        found = self.statuses.get(name, TaskStatus(name, OK, ''))
        lost = any(one.ever and one.source == name.partition(':')[0] != PLANT
                   for one in self.silences)
        return replace(found, level=ERROR, message=LOST) if lost else found


@dataclass
class _Signal:
    unit: str
    read: str  # unit in which people read it, as all values here
    values: dict[str, float] = field(default_factory=dict)
    training: Range | None = None
    active: str = ''
    plan: tuple[tuple[float, float], ...] = ()

    def shown(self, value: float) -> float:
        return float(conversion(self.unit, self.read)(float(value)))


class PlantView:
    """
    Keeps what was heard of a loop; all is called from one thread but for trends and alarms.

    :param signals: of the plant.
    :param read: units in which people read them, by name.
    :param span: of the past that the trends keep, in s.
    :param now: by the wall clock, as everywhere here.
    :param nodes: roles of the loop's own nodes by their full names without the first slash.
    """

    def __init__(self, signals: Signals, read: Mapping[str, str], span: float, now: float,
                 nodes: Mapping[str, str] = _ROLES) -> None:
        self._nodes = dict(nodes)
        # when each task last turned to ERROR, and its message
        self._errors: dict[str, deque[tuple[float, str]]] = {}
        self.signals, self.read = signals, read
        self.alarms = Alarms()
        self.trends = Trends(span)
        self._span, self._start = span, now
        self._states = {
            name: _Signal(unit, read[name]) for name, unit in signals.states.items()}
        self._inputs = {
            name: _Signal(unit, read[name]) for name, unit in signals.inputs.items()}
        self.plant = ''
        self._time = math.nan
        self._unplanned = 0
        self._mode = self._level = ''
        self._statuses: dict[str, TaskStatus] = {}
        self._own_tasks: set[str] = set()
        self._estimates: dict[str, str] = {}
        self._parameters: dict[str, Mapping[str, ParameterView]] = {}
        self._heard: dict[str, float] = {}
        self._period = 0.0
        self._watched = [CONTROLLER, PLANT]
        self._looked = now  # at the journal
        self._about: Mapping[str, str] = _NO_VALUES
        self._previous_model = self._digest = ''

    # What is heard.

    def hear(self, kind: str, values: Mapping[str, float], stamp: float, now: float) -> None:
        """Take values of signals in their own units, by the kind of their place on the wire."""
        of = self._states if kind in (
            'measured', 'active_setpoints', 'predicted') else self._inputs
        if kind == 'measured':
            self._beat(stamp, now)
        for name, value in values.items():
            read = of[name].shown(value)
            of[name].values[kind] = read
            # the latched ones carry the stamp of when they began to hold
            if math.isfinite(read) and kind != 'active_setpoints':
                self._draw(pen(kind, name), stamp, read)
        if kind == 'measured' and not math.isnan(self._time):
            for name in self.signals.controlled:
                held = self._states[name].values.get('active_setpoints', math.nan)
                if math.isfinite(held):
                    self._draw(pen('active_setpoints', name), self._time, held)

    def _beat(self, stamp: float, now: float) -> None:
        if stamp < self._time - _BACK:
            # simulated time that begins again would run back over what was drawn
            self.trends.rewind(stamp)
        last = self._heard.get(PLANT)
        if last is not None and now > last:
            self._period = now - last if not self._period else min(
                0.9 * self._period + 0.1 * (now - last), 600.0)
        self._heard[PLANT], self._time = now, stamp

    def _draw(self, name: str, stamp: float, value: float) -> None:
        # a message without a measurement yet, or from before its time went back
        if not math.isnan(self._time) and stamp >= self._time - self._span:
            self.trends.add(name, stamp, value)

    def internals(self, values: Mapping[str, float]) -> None:
        """Take what the controller says of itself, by name with unit."""
        several = len(self._inputs) > 1
        for name, own in self._inputs.items():
            text = f'{name} disturbance [{own.unit}]' if several else f'disturbance [{own.unit}]'
            own.values['disturbance'] = values.get(text, math.nan)
        deviations = {found[1]: value for key, value in values.items()
                      if (found := _DEVIATION.match(key)) and math.isfinite(value)}
        # another model may estimate others
        self._estimates = {}
        for key, value in values.items():
            found = _NAMED.fullmatch(key)
            if found and found[1] not in self._states and math.isfinite(value):
                known = deviations.get(found[1])
                spread = '' if known is None else f' ± {known:.2g}'
                self._estimates[found[1]] = f'{value:.4g}{spread} {found[2].replace("deg", "°")}'

    def planned(self, names: Sequence[str], stamp: float, times: Sequence[float],
                rows: Sequence[Sequence[float]]) -> None:
        """
        Take what the controller plans from a stamp on; what is no plan is passed over.

        :param names: of signals, with units.
        :param times: since the stamp, in s, with values of all signals in each row.
        """
        signals = {**self._states, **self._inputs}
        plans = []
        try:
            for name, values in list(zip(names, list(zip(*rows, strict=True)), strict=True)):
                found = _SIGNAL.fullmatch(name)
                if found and (own := signals.get(found[1])):
                    to_read = conversion(found[2], own.read)
                    plans.append((own, tuple(
                        (stamp + after, float(to_read(value)))
                        for after, value in zip(times, values, strict=True))))
        except ValueError:
            return
        for own, plan in plans:
            own.plan = plan
        self._unplanned = 0

    def limits(self, values: Mapping[str, float]) -> None:
        """Take which limits are active in that plan, by name."""
        words: dict[str, list[str]] = {}
        for key, value in values.items():
            found = _LIMIT.match(key)
            if found and (said := _OF_LIMITS.get((found[1], value))):
                words.setdefault(found[2], []).append(said)
        for name, own in (*self._states.items(), *self._inputs.items()):
            own.active = ', '.join(words.get(name, ()))

    def _without_plan(self) -> None:
        for own in (*self._states.values(), *self._inputs.values()):
            own.plan, own.active = (), ''

    def record(self, event: str, fields: Mapping[str, Any], now: float) -> None:
        """Take a record of the controller; one that is not as it should be is passed over."""
        self._heard[CONTROLLER] = now
        try:
            self._take(event, fields)
        except (AttributeError, KeyError, TypeError, ValueError):
            return

    def _take(self, event: str, fields: Mapping[str, Any]) -> None:
        match event:
            case 'measurement' | 'silence':
                mode, level = str(fields['mode']), str(fields['level'])
                if self._level and level != self._level:
                    self._mark('level', f'{level_words(self._level)} → {level_words(level)}')
                self._mode, self._level = mode, level
                self._unplanned += 1
                if self._unplanned == _UNPLANNED:
                    self._without_plan()
            case 'setpoint' if fields['accepted']:
                names = fields.get('signals') or self.signals.controlled
                for name, value in zip(names, fields['value'], strict=True):
                    own = self._states[name]
                    own.values['asked'] = own.shown(value)
                    self._mark('setpoint', f'{label(name)} {self._quantity(name)}')
            case 'manual_command' if fields['accepted']:
                for own, value in zip(self._inputs.values(), fields['value'], strict=True):
                    own.values['manual'] = own.shown(value)
                self._mark('manual', 'manual command')
            case 'mode':
                self._mode = str(fields['mode'])
                self._mark('mode', f'{self._mode} mode')
            case 'model':
                name, before = str(fields['model']['name']), self._digest
                self._mark('model', f'model {name}')
                self._digest = str(fields['model']['digest'])
                if self._digest != before and name.endswith('.safetensors'):
                    # read anew, from a file that another training has written since
                    self._previous_model = str(predecessor(Path(name)))
            case 'parameters':
                self._mark('model' if 'model' in fields else 'parameter',
                           ', '.join(map(str, fields['parameters'])))
                if 'model' in fields:
                    self._digest = str(fields['model']['digest'])
            case 'start' | 'snapshot':
                self._mode = str(fields['state']['mode']['name']).lower()
                self._digest = str(fields['model']['digest'])

    def _quantity(self, name: str) -> str:
        own = self._states[name]
        return f'{own.values["asked"]:.6g} {printed(own.read)}'

    def _mark(self, kind: str, text: str) -> None:
        if not math.isnan(self._time):
            self.trends.mark(self._time, kind, text)

    def task(self, name: str) -> str:
        """
        Return the name under which a status is kept: ``<role>: <task>`` of the loop's own nodes.

        An empty string is that of a node of another loop, which has the base name of a role in
        another namespace.
        """
        node, _, task = name.partition(': ')
        role = self._nodes.get(node)
        if role is not None:
            return f'{role}: {task}'
        return '' if node.rsplit('/', 1)[-1] in self._nodes.values() else name

    def status(self, name: str, level: int, message: str, values: Mapping[str, str],
               now: float, plant: str = '') -> None:
        """Take the status of a task of a node; its level becomes an alarm."""
        name, role = self.task(name), self._nodes.get(name.partition(': ')[0])
        if not name or (role is None and name not in self._statuses
                        and len(self._statuses) >= _MOST_FOREIGN + len(self._own_tasks)):
            return
        if role is not None:
            self._own_tasks.add(name)
        if role in (CONTROLLER, TRAINER):
            self._heard[role] = now
            if role not in self._watched:
                self._watched.append(role)
        if role in (PLANT, CONTROLLER):
            self.plant = plant or self.plant
        before = self._statuses.get(name)
        self._statuses[name] = TaskStatus(name, level, message, dict(values), now)
        if level >= ERROR and (before is None or before.level < ERROR):
            self._errors.setdefault(name, deque(maxlen=_REPEATED)).append(
                (now, message))
        # the operator who made a request has its answer
        priority = Priority.HIGH if level >= ERROR else (
            Priority.MEDIUM if role == CONTROLLER and name != REQUESTS else Priority.LOW)
        # a warning that the control task repeats has a task and an alarm of its own
        repeated = level < ERROR and values.get('condition', 'control') != 'control'
        self.alarms.report(name, level > OK and not repeated, priority, f'{name}: {message}', now)

    def parameters(self, node: str, values: Mapping[str, ParameterView]) -> None:
        """Take all parameters of a node, in place of those before; none where it is gone."""
        before = self._parameters.get(node, {}).get('model')
        self._parameters[node] = MappingProxyType(dict(values))
        if node == CONTROLLER and before and 'model' in values and (
                values['model'].value != before.value):
            self._previous_model = str(before.value)

    def trained(self, ranges: Mapping[str, Range], about: Mapping[str, str]) -> None:
        """
        Take what the file of the acting model says.

        :param ranges: it was trained with, in the units of the signals.
        :param about: origin and held-out figures, in words.
        """
        self._about = MappingProxyType(dict(about))
        for name, own in (*self._states.items(), *self._inputs.items()):
            bounds = ranges.get(name)
            own.training = None if bounds is None else (
                own.shown(bounds[0]), own.shown(bounds[1]))

    # What is shown.

    def advance(self, now: float) -> None:
        """Let time pass: who is silent for too long becomes an alarm."""
        silent = {silence.source for silence in self._silences(now)}
        for name, errors in self._errors.items():
            often = len(errors) == _REPEATED and now - errors[0][0] <= _WITHIN
            self.alarms.report(
                f'{name}, repeated errors', often, Priority.HIGH, f'{name}: at least {_REPEATED} '
                f'errors within {_WITHIN:g} s, the last: {errors[-1][1]}', now)
        for source in self._watched:
            what = 'no measurement' if source == PLANT else f'nothing from the {source}'
            self.alarms.report(f'silence of {source}', source in silent,
                               Priority.LOW if source == TRAINER else Priority.HIGH, what, now)
        self.alarms.advance(now)
        raised = [entry for entry in self.alarms.journal(self._looked) if entry.what == 'raised'
                  and entry.time > self._looked]
        for entry in reversed(raised):
            self._mark('alarm', entry.text)
            self._looked = entry.time

    def _silences(self, now: float) -> tuple[Silence, ...]:
        found = []
        for source in self._watched:
            patience = max(_SILENT, _PERIODS * self._period) if source == PLANT else _SILENT
            last = self._heard.get(source, self._start)
            if now - last > patience:
                found.append(Silence(source, last, source in self._heard))
        return tuple(found)

    def snapshot(self, now: float) -> Snapshot:
        """Return all that is shown now."""
        silences = self._silences(now)
        quiet = {silence.source for silence in silences}
        control = self._statuses.get(CONTROL)
        values = control.values if control else _NO_VALUES
        reason = values.get('reason', '')
        level = self._level
        return Snapshot(
            plant=self.plant, wall=now, time=self._time,
            mode='' if CONTROLLER in quiet else self._mode,
            level='' if CONTROLLER in quiet else level_words(level),
            fallback=bool(level) and level not in (self._best_level(), 'manual'),
            reason='' if reason == 'none' or CONTROLLER in quiet else reason,
            states=tuple(self._state(name, own, PLANT in quiet)
                         for name, own in self._states.items()),
            inputs=tuple(self._input(name, own, CONTROLLER in quiet)
                         for name, own in self._inputs.items()),
            estimates=tuple((label(name), text) for name, text in self._estimates.items()),
            statuses=MappingProxyType(dict(self._statuses)),
            standing=self.alarms.standing, shelved=self.alarms.shelved,
            silences=silences, parameters=MappingProxyType(dict(self._parameters)),
            model=self._about, previous_model=self._previous_model)

    def _state(self, name: str, own: _Signal, silent: bool) -> StateFace:
        found = own.values
        measured = found.get('measured', math.nan)
        setpoint = found.get('active_setpoints', math.nan)
        limits = self._bounds(f'mpc.{name}', own, 'min', 'max')
        span = _span([own.training, self._bounds(name, own, 'sensor_min', 'sensor_max')],
                     [measured, setpoint, *(limits or ())])
        abnormal = 'no measurement' if silent or math.isnan(measured) else ''
        if not abnormal and own.training and not own.training[0] <= measured <= own.training[1]:
            abnormal = 'above the trained range' if (
                measured > own.training[1]) else 'below the trained range'
        return StateFace(
            name, printed(own.read), span, _decimals(span), own.training, abnormal, limits,
            own.active, own.plan, name in self.signals.controlled, measured, setpoint,
            found.get('asked', setpoint), found.get('predicted', math.nan))

    def _input(self, name: str, own: _Signal, silent: bool) -> InputFace:
        found, limits = own.values, self._bounds(name, own, 'min', 'max')
        command, applied = found.get('commands', math.nan), found.get('applied', math.nan)
        span = _span([limits, own.training], [command, applied])
        slack = 1e-6 * (span[1] - span[0])
        abnormal = ''
        if limits and math.isfinite(command):
            abnormal = ('at its upper limit' if command >= limits[1] - slack else
                        'at its lower limit' if command <= limits[0] + slack else '')
        if silent and math.isfinite(command):
            abnormal = 'last command, the controller is silent'
        return InputFace(
            name, printed(own.read), span, _decimals(span), own.training, abnormal, limits,
            own.active, own.plan, command, applied, found.get('manual', math.nan),
            found.get('disturbance', math.nan), own.unit)

    def _best_level(self) -> str:
        """Return the first of the controller's levels."""
        levels = self._parameters.get(CONTROLLER, {}).get('levels')
        return str(levels.value[0]) if levels else 'sdre'

    def limited(self, name: str, value: float) -> float:
        """Return a manual command within the limits of the controller, in the unit it is read."""
        low, high = self._bounds(name, self._inputs[name], 'min', 'max') or (-math.inf, math.inf)
        return min(max(value, low), high)

    def _bounds(self, name: str, own: _Signal, low: str, high: str) -> Range | None:
        given = self._parameters.get(CONTROLLER, {})
        if (lower := given.get(f'{name}.{low}')) and (upper := given.get(f'{name}.{high}')) and (
                isinstance(lower.value, int | float) and isinstance(upper.value, int | float)):
            # parameters are in the usual unit, and at the end of their range stand for none
            to_read = conversion(display_unit(own.unit), own.read)
            found = (to_read(float(lower.value)) if lower.value > lower.lower else -math.inf,
                     to_read(float(upper.value)) if upper.value < upper.upper else math.inf)
            return found if found[0] > -math.inf or found[1] < math.inf else None
        return None


def pen(kind: str, name: str) -> str:
    """Return the name of the pen of a signal."""
    return {'measured': f'{name}', 'active_setpoints': f'{name} set-point',
            'predicted': f'{name} predicted', 'planned': f'{name} planned',
            'commands': f'{name} command', 'applied': f'{name}'}[kind]


def _span(ranges: Sequence[Range | None], values: Sequence[float]) -> Range:
    """Return the range of a bar: the first that is known, a little wider, with all values."""
    known = next((one for one in ranges if one and math.isfinite(one[1] - one[0])), None)
    finite = [value for value in values if math.isfinite(value)]
    low, high = known or (min(finite, default=0.0), max(finite, default=1.0))
    margin = 0.1 * (high - low) or max(1.0, 0.1 * abs(high))
    return min([low - margin, *finite]), max([high + margin, *finite])


def _decimals(span: Range) -> int:
    """Return how many decimals tell two of some two hundred marks on a bar apart."""
    return min(max(2 - math.floor(math.log10(span[1] - span[0])), 0), 6)
