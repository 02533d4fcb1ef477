# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Where the signals of a plant are on the wire, by parameter; topics of no signal."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
import functools
from functools import cached_property
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any

from koopman_ros.core.arrays import Array
from koopman_ros.core.declaration import parameter
from koopman_ros.core.message_fields import (
    base_name,
    JOINT_STATE,
    MessageField,
    place,
    SIGNAL_NAME,
)
from koopman_ros.core.paths import config_directory
from koopman_ros.core.status import StatusFormatter
from koopman_ros.core.units import (
    check_unit,
    conversion,
    Display,
    display_unit,
    Displays,
    shown,
)
from koopman_ros.core.yaml_text import load_yaml
from koopman_ros.model import Coordinates, LiftedModel
from koopman_ros.parameters.table import ConfigurationError

CONTROLLER_INTERNALS = 'controller_internals'
EVENT_LOG = 'event_log'
PREDICTED_TRAJECTORY = 'predicted_trajectory'
ACTIVE_CONSTRAINTS = 'active_constraints'
AUDIT_LOG = 'audit_log'
DIAGNOSTICS = '/diagnostics'
SETPOINTS = 'setpoints'  # of several signals in one message
CLOCK = '/clock'

#: the default system
DEFAULT_SYSTEM = 'reactor'

QUALITY = '1'  #: unit of a quality

LONGEST_FRAME_ID = 256  # characters that are passed on

# The places of signals: of states, then of inputs and of disturbances.
KINDS = ('measured', 'quality', 'late', 'setpoints', 'joint_setpoints', 'active_setpoints',
         'predicted', 'applied', 'commands', 'manual', 'measured_disturbances')
PLANT_KINDS = ('measured', 'applied', 'commands', 'measured_disturbances')
# parameters that name them
SIGNALS = ('states_measured', 'inputs_commanded', 'disturbances_measured', 'controlled')

_PRESETS = 'plants'  # folder of the parameter files of the plants that are shipped
_NAMED = re.compile(r'([A-Za-z_]\w*)\s*\[(.+)\]')


def _topic(description: str) -> Any:
    return parameter('', description, read_only=True)


@dataclass(frozen=True)
class MeasuredPlace:
    """Where a signal is measured."""

    topic: str = _topic('Topic of the measurements; for an input: of the applied value.')
    type: str = _topic('Message type as package/msg/Name; empty: the usual type for the unit.')
    field: str = _topic('Message field that holds the value, e.g. temperature, twist.linear.x, '
                        'data[2] or position[shaft]; empty: the usual field of the type.')
    unit: str = _topic('Unit of that value; empty: the usual unit of the type.')


@dataclass(frozen=True)
class StatePlaces(MeasuredPlace):
    """Where a measured state is; its set-points and prediction have the same type and field."""

    quality_topic: str = _topic('Topic of the measurement quality, as a level of '
                                'DiagnosticStatus: 0 good, 1 uncertain, higher bad; empty: none.')
    quality_type: str = parameter(
        'std_msgs/msg/UInt8', 'Message type of the quality.', read_only=True,
        choices=('std_msgs/msg/UInt8', 'diagnostic_msgs/msg/DiagnosticStatus'))
    setpoint_topic: str = _topic('Topic of requested set-points.')
    active_setpoint_topic: str = _topic('Topic of the active set-point.')
    predicted_topic: str = _topic('Topic of the predicted measurement.')


@dataclass(frozen=True)
class AnalysisPlaces:
    """Topic of the late values of a state, e.g. of a laboratory."""

    analysis_topic: str = _topic('Topic of late values, e.g. of a laboratory analyser; empty: '
                                 'none.')
    analysis_type: str = _topic('Message type of these values; empty: the usual type.')
    analysis_field: str = _topic('Message field that holds the value; empty: the usual field.')
    analysis_unit: str = _topic('Unit of that value; empty: the usual unit of the type.')


@dataclass(frozen=True)
class CommandedPlaces(MeasuredPlace):
    """Where an input is measured, and where it is commanded."""

    command_topic: str = _topic('Topic of the commands.')
    command_type: str = _topic('Message type of the commands; empty: that of the measurements.')
    command_field: str = _topic('Message field that holds the command; empty: the usual field of '
                                'the type.')
    command_unit: str = _topic('Unit of that value; empty: the usual unit of the type.')


@dataclass(frozen=True)
class InputPlaces(CommandedPlaces):
    """The same with an operator."""

    manual_topic: str = _topic('Topic of the manual commands.')


@dataclass(frozen=True)
class Signals:
    """
    The signals of a plant: names and units.

    :raises ConfigurationError: for controlled signals that are not states, or too many.
    """

    states: Mapping[str, str]  #: units of the measured states, by name
    inputs: Mapping[str, str]  #: units of the inputs, by name
    controlled: tuple[str, ...] = ()  #: names of the states that have a set-point
    #: units of all states of the model, in its order; empty where all are measured
    model_states: Mapping[str, str] = field(default_factory=dict)
    #: units of the measured disturbances, by name
    disturbances: Mapping[str, str] = field(default_factory=dict)

    @property
    def every(self) -> Mapping[str, str]:
        """Units of all states, by name, in the order of the model."""
        return self.model_states or self.states

    @property
    def estimated(self) -> dict[str, str]:
        """Units of the states that are not measured, by name."""
        return {name: unit for name, unit in self.every.items() if name not in self.states}

    @property
    def units(self) -> dict[str, str]:
        """Units of all, by name."""
        return {**self.states, **self.inputs, **self.disturbances}

    def __post_init__(self) -> None:
        for name in self.units:
            if not SIGNAL_NAME.fullmatch(name):
                raise ConfigurationError(
                    f'{name!r} is the name of a signal, used in topics and parameters: use '
                    'letters, digits and _, beginning with a letter')
        wrong = [name for name in self.controlled if name not in self.states]
        if wrong or len(set(self.controlled)) < len(self.controlled):
            raise ConfigurationError(
                f'controlled = {list(self.controlled)} must name measured signals, each once: '
                f'choose from {", ".join(self.states)}')

    def __str__(self) -> str:
        """Write states, inputs and disturbances with units."""
        return ' and '.join(
            f'{kind} ' + ', '.join(described(of))
            for kind, of in (('states', self.states), ('inputs', self.inputs),
                             ('measured disturbances', self.disturbances))
            if of or kind != 'measured disturbances')

    def defaults(self) -> dict[str, str]:
        """Return the topics of all places, by parameter."""
        alone = len(self.controlled) == 1
        topics = {f'{name}.topic': name for name in self.disturbances}
        for name in self.states:
            of = '' if alone else f'{name}/'
            controlled = name in self.controlled
            topics |= {f'{name}.topic': name, f'{name}.predicted_topic': f'predicted_{name}',
                       f'{name}.setpoint_topic': f'{of}setpoint' if controlled else '',
                       f'{name}.active_setpoint_topic': (
                           f'{of}active_setpoint' if controlled else '')}
        for name, unit in self.inputs.items():
            command = f'{base_name(name, unit)}_setpoint'
            topics |= {f'{name}.topic': name, f'{name}.command_topic': command,
                       f'{name}.manual_topic': f'manual_{command}'}
        return topics


def signals_of(model: LiftedModel, controlled: tuple[str, ...] = (),
               measured: Collection[str] = ()) -> Signals:
    """
    Return the signals of a model.

    :param controlled: names of states; all that are measured by default.
    :param measured: names of states, in any order; by default those of the training record.
    """
    every, inputs, disturbances = (dict(zip(of.names, of.units, strict=True))
                                   for of in (model.states, model.inputs, model.disturbances))
    # in the order of the states, as the control step wants them
    states = {name: unit for i, (name, unit) in enumerate(every.items()) if (
        name in measured if measured else i in model.measured)}
    named = tuple(filter(None, controlled))
    own = tuple(name for name in states if name in named)
    return Signals(states, inputs, (named if len(own) < len(named) else own) or tuple(states),
                   {} if len(states) == len(every) else every, disturbances)


def box_defaults(box: Coordinates, **values: Array) -> dict[str, float]:
    """Return values (n,) of the signals of a box as people read them, like ``pump.min``."""
    return {f'{name}.{row}': shown(value, unit) for row, numbers in values.items()
            for name, unit, value in zip(box.names, box.units, numbers.tolist(), strict=True)}


def words_of(signals: Signals,
             shown: Mapping[str, Display] = MappingProxyType({})) -> StatusFormatter:
    """Return the words for some signals; `shown` are those not written as they usually are."""
    return StatusFormatter(Displays(signals.units, {'K': Display('K', 'degC', '.2f'), **shown}))


def _role(signals: str, topic: str, *, commanded: bool = False
          ) -> cached_property[dict[str, MessageField]]:
    """Return a property of SignalTopics: the places of some signals, by name."""
    def found(self: SignalTopics) -> dict[str, MessageField]:
        given, units = {
            'inputs': (self.inputs, self.signals.inputs),
            'disturbances': (self.disturbances, self.signals.disturbances),
        }.get(signals, (self.states, self.signals.states))
        names = self.signals.controlled if signals == 'controlled' else given
        field_of = _command_field if commanded else _measured_field
        return {name: _place(getattr(given[name], topic), name, units[name], field_of(given[name]))
                for name in names}

    return cached_property(found)


@dataclass(frozen=True)
class SignalTopics:
    """
    The places of all signals.

    :raises ConfigurationError: for a field that is not a path in a message, or a missing topic.
    """

    signals: Signals
    states: Mapping[str, Any]  #: places of a node's states, by name
    inputs: Mapping[str, Any]  #: places of its inputs, by name
    kinds: tuple[str, ...] = KINDS  #: which of the properties below the node has
    #: places of its measured disturbances, by name
    disturbances: Mapping[str, Any] = field(default_factory=dict)
    #: places of late values, by name of the state
    analyses: Mapping[str, AnalysisPlaces] = field(default_factory=dict)

    @classmethod
    def of(cls, signals: Signals, parameters: Any, kinds: tuple[str, ...] = KINDS) -> SignalTopics:
        """Return the places that the parameters of a node name."""
        return cls(signals, parameters.states, parameters.inputs, kinds, parameters.disturbances,
                   getattr(parameters, 'every_state', {}))  # late values are the controller's

    #: measurements of the states, and their predictions
    measured = _role('states', 'topic')
    predicted = _role('states', 'predicted_topic')
    #: requested and active set-points of the controlled states
    setpoints = _role('controlled', 'setpoint_topic')
    active_setpoints = _role('controlled', 'active_setpoint_topic')
    #: commands of the inputs, those of an operator, and measurements of the applied inputs
    commands = _role('inputs', 'command_topic', commanded=True)
    manual = _role('inputs', 'manual_topic', commanded=True)
    applied = _role('inputs', 'topic')
    measured_disturbances = _role('disturbances', 'topic')

    @cached_property
    def joint_setpoints(self) -> dict[str, MessageField]:
        """Requested set-points in one message of named values, where there are several."""
        units = {name: self.signals.states[name] for name in self.signals.controlled}
        return {name: _place(SETPOINTS, name, unit, {
            'type': JOINT_STATE, 'field': f'position[{name}]', 'unit': display_unit(unit)})
            for name, unit in units.items()} if len(units) > 1 else {}

    @cached_property
    def quality(self) -> dict[str, MessageField]:
        """Qualities of the measurements that have one."""
        return {name: _place(given.quality_topic, name, QUALITY, {'type': given.quality_type})
                for name, given in self.states.items() if given.quality_topic}

    @cached_property
    def late(self) -> dict[str, MessageField]:
        """Late values of states that have some."""
        return {name: _place(given.analysis_topic, name, self.signals.every[name], {
            kind: getattr(given, f'analysis_{kind}') for kind in ('type', 'field', 'unit')})
            for name, given in self.analyses.items() if given.analysis_topic}

    def check(self) -> str:
        """Return their defect in words, or an empty string."""
        try:
            for kind in self.kinds:
                places = getattr(self, kind)
                if missing := [name for name, found in places.items() if not found.topic]:
                    return f'{missing[0]} has no topic: set one'
            used = {found.topic: name for name, found in (
                *self.measured.items(), *self.measured_disturbances.items())}
            for name, found in self.commands.items():
                if found.topic in used:
                    return (f'{name} is commanded on {found.topic!r}, the topic on which '
                            f'{used[found.topic]} is measured: change one of them')
            for places in ({**self.measured, **self.measured_disturbances}, self.commands):
                names: dict[tuple[str, str], str] = {}
                for name, found in places.items():
                    if (other := names.setdefault((found.topic, found.field), name)) != name:
                        return (f'{other} and {name} are both in the field {found.field} of '
                                f'{found.topic!r}: set another topic or field for one of them')
        except ValueError as error:
            return str(error)
        return ''

    @property
    def topics(self) -> tuple[str, ...]:
        """All of them, each once."""
        return tuple(dict.fromkeys(
            found.topic for kind in self.kinds for found in getattr(self, kind).values()))


def _measured_field(given: MeasuredPlace) -> dict[str, str]:
    return {'type': given.type, 'field': given.field, 'unit': given.unit}


def _command_field(given: CommandedPlaces) -> dict[str, str]:
    same = given.command_type in ('', given.type)
    return {'type': given.command_type or given.type,
            'field': given.command_field or (given.field if same else ''),
            'unit': given.command_unit or (given.unit if same else '')}


def _place(topic: str, name: str, unit: str, given: Mapping[str, str]) -> MessageField:
    try:
        found = place(topic, name, unit, given)
        conversion(found.unit, unit)
    except ValueError as error:
        raise ConfigurationError(f'{name}: {error}') from error
    return found


def described(units: Mapping[str, str]) -> tuple[str, ...]:
    """Return signals as :func:`named_units` reads them, e.g. ``level [m]``."""
    return tuple(f'{name} [{unit}]' for name, unit in units.items())


def named_units(texts: Collection[str]) -> dict[str, str]:
    """Return units by name of signals described as ``name [unit]``; ConfigurationError if not."""
    found = {}
    for text in texts:
        match = _NAMED.fullmatch(text.strip())
        if match is None or match[1] in found:
            raise ConfigurationError(f'{text!r} must be a name and a unit, each name once, e.g. '
                                     "'level [m]'")
        try:
            check_unit(match[2])
        except ValueError as error:
            raise ConfigurationError(f'{text!r}: {error}') from error
        found[match[1]] = match[2]
    return found


def system_of(given: Mapping[str, Any]) -> str:
    """Return the system that parameters name, or the default."""
    return str(given.get('system', DEFAULT_SYSTEM))


def bundled_plants() -> list[str]:
    """Return the names of the plants that have a parameter file."""
    return sorted(file.stem for file in (config_directory() / _PRESETS).glob('*.yaml'))


def plant_defaults(system: str, node: str) -> dict[str, Any]:
    """
    Return the defaults of a node, by parameter, from the file of a plant that is shipped.

    A plant without a file has none.
    """
    path = config_directory() / _PRESETS / f'{system}.yaml'
    if not system.isidentifier() or not path.is_file():
        return {}
    return file_parameters(path, node)


def file_parameters(path: Path, node: str) -> dict[str, Any]:
    """
    Return the parameters of a node, by name, from a ROS parameter file.

    :raises ValueError: for a file other than a parameter file.
    """
    content = _content(path)
    values: dict[str, Any] = {}
    try:
        for section, found in content.items():
            # for a node of the usual name, without a namespace
            if section in ('/**', node, f'/{node}', f'/**/{node}'):
                _flatten('', found.get('ros__parameters', {}), values)
    except AttributeError as error:
        raise ValueError(f'{path}: not a parameter file: write <node>: ros__parameters: <name>: '
                         '<value>') from error
    return values


@functools.cache
def _content(path: Path) -> Any:
    try:
        return load_yaml(path.read_text())
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from error


def _flatten(prefix: str, tree: Mapping[str, Any], into: dict[str, Any]) -> None:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            _flatten(f'{prefix}{key}.', value, into)
        else:
            into[f'{prefix}{key}'] = tuple(value) if isinstance(value, list) else value


def rejection(names: Collection[str]) -> str:
    """Return why a list of names cannot be that of topics, or an empty string."""
    return '' if names and all(names) else (
        f'topics = {list(names)} must contain at least one name and no empty one')
