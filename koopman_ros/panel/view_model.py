# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""View model of a loop: faceplates, statuses, alarms and trends, without ROS."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any

from koopman_ros.core.message_fields import base_name
from koopman_ros.core.paths import backup_path
from koopman_ros.core.status import level_words
from koopman_ros.core.units import conversion, display_unit, printed
from koopman_ros.panel.conditions import Conditions
from koopman_ros.panel.faceplates import pen, Range, readable, SignalValues
from koopman_ros.panel.process_alarms import ProcessAlarms
from koopman_ros.panel.requests import AuditEntry
from koopman_ros.panel.snapshot import CONTROL, CONTROLLER, OK, PLANT, ROLES, Snapshot, TaskStatus
from koopman_ros.panel.trends import Trends
from koopman_ros.parameters.description import ParameterDescription
from koopman_ros.parameters.panel import ProcessLimits
from koopman_ros.parameters.signal_topics import Signals

_BACK = 1.0  # s; a stamp that is earlier by more restarts the time
_SIGNAL = re.compile(r'(?:(estimated|deviation)_)?(\w+) \[(.+)\]')
_LIMIT = re.compile(r'at_(range|rate|limit)_(\w+) \[')
_OF_LIMITS: Mapping[tuple[str, float], str] = {
    ('range', -1.0): 'at its lower limit', ('range', 1.0): 'at its upper limit',
    ('rate', -1.0): 'at its rate limit (falling)', ('rate', 1.0): 'at its rate limit (rising)',
    ('limit', -1.0): 'kept above its lower limit', ('limit', 1.0): 'kept below its upper limit'}
MAX_AUDIT = 5000  #: actions that are kept
_UNPLANNED = 3  # answers without a plan end the last plan: one message may be lost


class LoopViewModel:
    """
    State of a loop as far as it was received.

    All methods are called from one thread; :attr:`trends`, :attr:`alarms` and :attr:`audit` from
    any.

    :param signals: of the plant.
    :param read: units in which people read them, by name.
    :param span: s of the past that the trends keep.
    :param now: wall time, as in all methods.
    :param nodes: roles of the loop's nodes by their full names without the first slash.
    """

    def __init__(self, signals: Signals, read: Mapping[str, str], span: float, now: float,
                 nodes: Mapping[str, str] = ROLES) -> None:
        self.signals, self.read = signals, read
        self.conditions, self.trends = (
            Conditions(nodes, now, signals.units), Trends(span))
        self.alarms = self.conditions.alarms
        self._span = span
        self._all = {name: SignalValues(name, unit, read[name])
                     for name, unit in signals.units.items()}
        self._states, self._inputs, self._disturbances = (
            {name: self._all[name] for name in of}
            for of in (signals.states, signals.inputs, signals.disturbances))
        self._time = math.nan
        self._arrived: dict[str, float] = {}  # wall time of the last values, by kind
        self._unplanned = 0
        self._mode = self._level = ''
        self._estimates: tuple[tuple[str, str], ...] = ()
        self._parameters: dict[str, Mapping[str, ParameterDescription]] = {}
        self._before: dict[tuple[str, str], str] = {}  # values before, by role and name
        self._marked = now  # time of the last alarm that is a mark in the trends
        self._about: Mapping[str, str] = MappingProxyType({})
        self._previous_model = ''
        self._model: dict[str, Any] = {}
        self._process = ProcessAlarms(self.alarms)
        self.limits: Mapping[str, ProcessLimits] = {}  #: of the alarms of measurements, by name
        self._audit: deque[AuditEntry] = deque(maxlen=MAX_AUDIT)

    @property
    def audit(self) -> tuple[AuditEntry, ...]:
        """The last actions of operators."""
        return tuple(self._audit)

    def take_action(self, entry: AuditEntry) -> None:
        """Take an action of an operator with its answer."""
        self._audit.append(entry)

    # Messages.

    def take_signals(self, kind: str, values: Mapping[str, float], stamp: float, now: float
                     ) -> None:
        """Take values of signals in their own units, by the kind of their topic."""
        if kind == 'measured':
            self._take_time(stamp, now)
        elif kind in ('commands', 'predicted'):
            # no line across a silence of the controller
            if now - self._arrived.get(kind, now) > self.conditions.patience(PLANT):
                self.trends.interrupt(pen(kind, name) for name in values)
            self._arrived[kind] = now
        for name, value in values.items():
            read = self._all[name].shown(value)
            own, key = self._all[name], kind.removesuffix('_disturbances')
            if own.get(key) != read:
                own.before[key] = own.get(key)
            own.values[key] = read
            # a latched set-point has the stamp of its beginning
            if math.isfinite(read) and kind != 'active_setpoints':
                self._draw(pen(kind, name), stamp, read)
        if kind == 'measured' and not math.isnan(self._time):
            for name, limits in self.limits.items():
                own = self._all[name]
                self._process.take(
                    readable(name), printed(own.read), own.get('measured'),
                    own.get('active_setpoints') if self._mode == 'automatic' else math.nan,
                    limits, now)
            for name in self.signals.controlled:
                setpoint = self._states[name].get('active_setpoints')
                if math.isfinite(setpoint) and not self.conditions.is_silent(CONTROLLER, now):
                    self._draw(pen('active_setpoints', name), self._time, setpoint)

    def _take_time(self, stamp: float, now: float) -> None:
        if stamp < self._time - _BACK:
            # a simulation has restarted
            self.trends.rewind(stamp)
        elif self.conditions.is_silent(PLANT, now):
            self.trends.interrupt()
        self.conditions.take_message(PLANT, now)
        self._time = stamp

    def _draw(self, name: str, stamp: float, value: float) -> None:
        # not before the first measurement, nor from before a restart of the time
        if not math.isnan(self._time) and stamp >= self._time - self._span:
            self.trends.add(name, stamp, value)

    def take_internals(self, values: Mapping[str, float]) -> None:
        """Take the topic `controller_internals`: values by name with unit."""
        for name, own in self._inputs.items():
            prefix = f'{name} ' if len(self._inputs) > 1 else ''
            own.values['disturbance'] = values.get(f'{prefix}disturbance [{own.unit}]', math.nan)
        found = {match.groups()[:2]: (value, match[3]) for key, value in values.items()
                 if (match := _SIGNAL.fullmatch(key)) and math.isfinite(value)}
        estimates = []
        for (kind, name), (value, unit) in found.items():
            if kind == 'estimated' and name not in self._states:
                deviation = found.get(('deviation', name))
                spread = f' ± {deviation[0]:.2g}' if deviation else ''
                estimates.append(
                    (readable(name), f'{value:.4g}{spread} {printed(unit)}'))
        self._estimates = tuple(estimates)

    def take_plan(self, names: Sequence[str], stamp: float, times: Sequence[float],
                  rows: Sequence[Sequence[float]]) -> None:
        """
        Take a plan of the controller; an inconsistent one is ignored.

        :param names: of signals, with units.
        :param times: since the stamp, in s, with values of all signals in each row.
        """
        plans = []
        try:
            for name, values in list(zip(names, list(zip(*rows, strict=True)), strict=True)):
                found = _SIGNAL.fullmatch(name)
                if found and (own := self._all.get(found[2])):
                    to_read = conversion(found[3], own.read)
                    plans.append((own, tuple(
                        (stamp + after, float(to_read(value)))
                        for after, value in zip(times, values, strict=True))))
        except ValueError:
            return
        for own, plan in plans:
            own.plan = plan
        self._unplanned = 0

    def take_limits(self, values: Mapping[str, float]) -> None:
        """Take the active limits of the plan, by name."""
        words: dict[str, list[str]] = {}
        for key, value in values.items():
            found = _LIMIT.match(key)
            if found and (text := _OF_LIMITS.get((found[1], value))):
                words.setdefault(found[2], []).append(text)
        for name, own in self._all.items():
            own.active = ', '.join(words.get(name, ()))

    def take_record(self, event: str, fields: Mapping[str, Any], now: float, who: str = ''
                    ) -> None:
        """
        Take a record of the controller's event log; a malformed one is ignored.

        :param who: operator who caused it, or empty.
        """
        self.conditions.take_message(CONTROLLER, now)
        if event == 'measurement':
            # one that is reported on change may stand for many
            self.conditions.take_message(PLANT, now)
        try:
            self._take_event(event, fields, f' by {who}' if who else '')
        except (AttributeError, KeyError, TypeError, ValueError):
            return

    def _take_event(self, event: str, fields: Mapping[str, Any], by: str) -> None:
        match event:
            case 'measurement' | 'silence':
                mode, level = str(fields['mode']), str(fields['level'])
                if self._level and level != self._level:
                    self._mark('level', f'{level_words(self._level)} → {level_words(level)}')
                self._mode, self._level = mode, level
                self._unplanned += 1
                if self._unplanned == _UNPLANNED:
                    for own in self._all.values():
                        own.plan, own.active = (), ''
            case 'setpoint' if fields['accepted']:
                names = fields.get('signals') or self.signals.controlled
                for name, value in zip(names, fields['value'], strict=True):
                    own = self._states[name]
                    self._change('set-point', own, 'target', own.shown(value), by)
            case 'manual_command' if fields['accepted']:
                for own, value in zip(self._inputs.values(), fields['value'], strict=True):
                    self._change('manual', own, 'manual',
                                 self.limited(own.name, own.shown(value)), by)
            case 'mode':
                before, self._mode = self._mode, str(fields['mode'])
                self._forget('manual')
                self._mark('mode', f'{before} → {self._mode}{by}' if before else
                           f'{self._mode}{by}')
            case 'model':
                self._replace_model(fields['model'], by)
            case 'parameters':
                if changes := ', '.join(self._parameter_change(name, value) for name, value
                                        in dict(fields['parameters']).items()):
                    self._mark('parameter', f'{changes}{by}')
                if 'model' in fields:
                    self._replace_model(fields['model'], by)
            case 'start' | 'snapshot':
                if event == 'start':
                    self._forget('manual', 'target')
                self._mode = str(fields['state']['mode']['name']).lower()
                self._model = dict(fields['model'])

    def _forget(self, *kinds: str) -> None:
        for own in self._all.values():
            for kind in kinds:
                own.values.pop(kind, None)

    def _parameter_change(self, name: str, value: Any) -> str:
        found = self._parameters.get(CONTROLLER, {}).get(name)
        # the parameter may have been read before its record is here
        known = found.text if found and found.value != value else (
            self._before.get((CONTROLLER, name), '–'))
        return f'{name}: {known} → {value:.10g}' if isinstance(value, float) else (
            f'{name}: {known} → {value}')

    def _change(self, mark: str, own: SignalValues, kind: str, value: float, by: str) -> None:
        """Take a requested value, and mark its change in the trends."""
        sent = 'active_setpoints' if kind == 'target' else 'commands'
        # the controller may have followed before its record is here
        fallback = own.before.get(sent, math.nan) if own.get(sent) == value else own.get(sent)
        before, own.values[kind] = own.get(kind, fallback), value
        if before != value:
            self._mark(mark, f'{readable(own.name)} {before:.6g} → {value:.6g} '
                             f'{printed(own.read)}{by}')

    def _replace_model(self, model: Mapping[str, Any], by: str) -> None:
        before, self._model = self._model, dict(model)
        self._mark('model', f'{before.get("name", "–")} → {model["name"]}{by}')
        if not before or before['digest'] == model['digest']:
            return
        name = str(before['name'])
        if name != model['name']:
            self._previous_model = name
        elif name.endswith('.safetensors'):
            # another training has replaced the file
            self._previous_model = str(backup_path(Path(name)))

    def _mark(self, kind: str, text: str) -> None:
        if not math.isnan(self._time):
            self.trends.mark(self._time, kind, text)

    def take_parameters(self, role: str, values: Mapping[str, ParameterDescription]) -> None:
        """Take all parameters of a node; none if it is gone."""
        before = self._parameters.get(role, {})
        self._before |= {(role, name): found.text for name, found in before.items()
                         if name in values and values[name].value != found.value}
        self._parameters[role] = MappingProxyType(dict(values))

    def take_model(self, ranges: Mapping[str, Range], about: Mapping[str, str]) -> None:
        """
        Take the content of the current model's file.

        :param ranges: training ranges, in the units of the signals.
        :param about: origin and held-out figures, in words.
        """
        self._about = MappingProxyType(dict(about))
        shown = self.shown_ranges(ranges)
        for name, own in self._all.items():
            own.training = shown.get(name)

    def shown_ranges(self, ranges: Mapping[str, Range]) -> dict[str, Range]:
        """Return ranges of the shown signals in the units in which people read them."""
        return {name: (own.shown(ranges[name][0]), own.shown(ranges[name][1]))
                for name, own in self._all.items() if name in ranges}

    # Snapshots.

    def advance(self, now: float) -> None:
        """Let time pass: raise alarms, and mark them in the trends."""
        self.conditions.advance(now)
        raised = [entry for entry in self.alarms.journal(self._marked)
                  if entry.what == 'raised' and entry.time > self._marked]
        for entry in reversed(raised):
            self._mark('alarm', entry.text)
            self._marked = entry.time

    def snapshot(self, now: float) -> Snapshot:
        """Return the state at this instant."""
        silences = self.conditions.silences(now)
        silent = {one.role for one in silences}
        no_controller = CONTROLLER in silent
        control = self.conditions.statuses.get(CONTROL, TaskStatus(CONTROL, OK, ''))
        levels = self._parameters.get(CONTROLLER, {}).get('fallback_order')
        best = str(levels.value[0]) if levels else 'sdre'
        reason = control.values.get('reason', 'none')
        rejected, uncertain = (control.values.get(f'{quality} measurements', '').split(', ')
                               for quality in ('rejected', 'uncertain'))
        quality = {**dict.fromkeys(uncertain, 'uncertain'), **dict.fromkeys(rejected, 'rejected')}
        return Snapshot(
            plant=self.conditions.plant, wall=now, time=self._time,
            mode='' if no_controller else self._mode,
            level='' if no_controller else level_words(self._level),
            fallback=bool(self._level) and self._level not in (best, 'manual'),
            reason='' if reason == 'none' or no_controller else reason,
            states=tuple(own.state(name in self.signals.controlled, self._bounds(own, 'mpc.{}.{}'),
                                   self._bounds(own, '{}.sensor_{}'), silent,
                                   '' if no_controller else quality.get(name, ''),
                                   name in self._disturbances)
                         for name, own in {**self._states, **self._disturbances}.items()),
            inputs=tuple(own.input(self._bounds(own), silent, self._level,
                                   self._dead_time(own, control.values))
                         for own in self._inputs.values()),
            estimates=self._estimates, statuses=MappingProxyType(dict(self.conditions.statuses)),
            standing=self.alarms.standing, shelved=self.alarms.shelved,
            stale=self.conditions.stale(now), silences=silences,
            parameters=MappingProxyType(dict(self._parameters)), model=self._about,
            previous_model=self._previous_model)

    def _dead_time(self, own: SignalValues, control: Mapping[str, str]) -> float:
        label = f'{base_name(own.name, own.unit)} ' if len(self._inputs) > 1 else ''
        try:
            return float(control.get(f'{label}dead time [s]', 'nan'))
        except ValueError:
            return math.nan

    def limited(self, name: str, value: float) -> float:
        """Return a manual command within the limits of the controller, as people read it."""
        low, high = self._bounds(self._inputs[name]) or (-math.inf, math.inf)
        return min(max(value, low), high)

    def _bounds(self, own: SignalValues, name: str = '{}.{}') -> Range | None:
        """
        Return two parameters of the controller as a range; None where neither is finite.

        :param name: of the parameters, with places for the signal and for ``min`` or ``max``.
        """
        given = self._parameters.get(CONTROLLER, {})
        lower, upper = (given.get(name.format(own.name, end)) for end in ('min', 'max'))
        if not (lower and upper and isinstance(lower.value, int | float)
                and isinstance(upper.value, int | float)):
            return None
        # a parameter is in the display unit, and unbounded at the end of its range
        to_read = conversion(display_unit(own.unit), own.read)
        low = to_read(float(lower.value)) if lower.value > lower.lower else -math.inf
        high = to_read(float(upper.value)) if upper.value < upper.upper else math.inf
        return (low, high) if math.isfinite(low) or math.isfinite(high) else None
